"""The one table of what may happen to motors, their bus, their set-up, and the program that plays.

Each row is played at three fidelities, each by one test (``tests/damiao/test_incidents.py``):

- samples: what the watch sees of it, and says, without motors and time
(``rigs.motors.watched_samples``); - simulated: a whole run on simulated motors and a simulated bus,
in simulated time. Each plays on
  one or several arms: two pendulums, of which the motors' states are compared
  (``rigs.motors.pendulum_runs``), an arm that floats (``rigs.motors.floating_arm``), the Kinova arm
  by a guessed model, and two arms that are not as their models say, with their model and without
  (``rigs.motors.fault_bench``);
- process: ``robot-sysid motors play`` in real time (``rigs.motors.process_incidents``).

What makes no sense at a fidelity says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rigs.motors import watched_samples
from rigs.motors.damiao_rig import combine_causes, delay_cause, fault, swing
from rigs.motors.fault_bench import SHOULDER, Case
from rigs.motors.floating_arm import FloatingCase
from rigs.motors.motor_causes import (
    JAMMED,
    PowerDip,
    SaggingSupply,
    SecondMaster,
    SecondMotor,
    ask_for_too_much,
    break_driver,
    close_terminal,
    delay_answers,
    exchange_ids,
    fault_of_all,
    fill_disk,
    grip_mass,
    hang_up,
    insist_on_stop,
    lose_answers,
    lost_motor,
    make_link_heavier,
    mount_otherwise,
    own_position,
    push,
    raise_error,
    raise_signal,
    slow_adapter,
    stall,
    start_away,
    switch_bus_off,
)
from rigs.motors.pendulum_runs import BRAKES, DROPS, SLOWLY, TRIPS, PendulumCase
from rigs.motors.process_incidents import (
    ProcessCase,
    close_console,
    send_signals,
    small_files_only,
)
from rigs.motors.watched_samples import SampleCase, sample_case, swing_case
from robot_sysid.damiao.bus import LinkError
from robot_sysid.damiao.protocol import DISABLED, ENABLED

WRIST = 5
"""The Kinova arm's joint near its tip, which gravity hardly loads."""
SMALL_WRIST = 3
"""That of the arms that are not as their models say."""


@dataclass(frozen=True)
class NotPlayed:
    """Why a row is not played at a fidelity."""

    reason: str


@dataclass(frozen=True)
class Incident:
    """What happens, and at each fidelity what has to come of it.

    Attributes:
        name: of the row.
        samples: what the watch sees, and says.
        simulated: runs by the arm that they are played on: "pendulums", "floating", "kinova" or
            "worn".
        process: what happens to the program that plays.
    """

    name: str
    samples: SampleCase | NotPlayed
    simulated: Mapping[str, Case | PendulumCase | FloatingCase] | NotPlayed
    process: ProcessCase | NotPlayed


BY_THE_ARM = NotPlayed(
    "what the samples are depends on what the arm does: simulated runs show it"
)
NO_SAMPLE = NotPlayed("it happens to the program or its bus, and no sample shows it")
BEFORE_SAMPLES = NotPlayed("it is refused before there is any sample")
LIKE_ANOTHER = NotPlayed(
    "the samples are those of another row: the watch does not see the difference"
)
FILTERED = NotPlayed(
    "the filter refuses such samples before the watch sees them: "
    "tests/damiao/safety/test_plausibility.py"
)
ONLY_A_BOUND = NotPlayed(
    "it is below a bound of the watch, which only single signals come near: "
    "runs of sound arms, which nothing stops, are in test_sound_arms.py"
)
SIGNAL_OF_OTHERS = NotPlayed("its signals are those of rows that are played")
NOBODY_LEFT = NotPlayed(
    "a program that is killed does nothing more; what motors then do by themselves, "
    "the stalled program and the driver that raises for good show"
)
SAME_PROGRAM = NotPlayed(
    "the program does the same in simulated time, where every run is alike; in real time is "
    "played what happens to the program itself"
)
ARM_IS_ALONE = NotPlayed(
    "the bus of the arm in real time is the process that has to tell where the arm is"
)
NO_PROGRAM = NotPlayed("a defect of the program: it has none that could be called up")

# --- how rows are written -------------------------------------------------------------------------

kinova = partial(Case, "")
worn = partial(Case, "", bound=0.05)
process = partial(ProcessCase, "")
pendulums = PendulumCase
floating = FloatingCase
shoulder = partial(fault, SHOULDER)
wrist = partial(fault, WRIST)
AT_START = {"phase": "", "after": 0.0}
REFUSED = {**AT_START, "endings": ("refused",)}
COMPLETED = {**AT_START, "endings": ("completed",)}
MAYBE_SEEN = {**AT_START, "endings": ("stopped", "completed")}
OTHERS = "others departure"
SECOND = "a second motor has its id"
FOREIGN = "gets commands of another program"
UNSEEN = "another program commands it"
SHIFTED = "position: it reports"
REVERSED = "went against its commands"
DIFFERS = "torque: it reports"
NEEDS = "torque: it needs"
SPEED = "speed: its positions change by"
SLOW_SPEED = "speed: in a second its positions change by"
SLOW_TORQUE = "torque: in a second it reports"
UNANSWERED = "did not answer in time"
REPEATS = "rad again and again"
LATE = "late for a control cycle"
LOST = (
    "answer in time to 5 commands in a row; no confirmation that these motors are disabled: "
    "motor 2. Cut"
)
SWITCHED_OFF = "was switched off, or started again"
RAMP = "raising the gains"
WAY = "moving to the first point"
# The other joint has no stiffness.
LOOSE = {"motion": swing(2, 3.0, amplitude=0.3), "kp": (0.0, 60.0)}
FIRST = {"start": [0.3, -0.3]}
ANOTHER_ARM = {
    0: {"direction": -1, "offset": 0.2},
    2: {"direction": -1},
    3: {"offset": -0.3},
}
stand = watched_samples.stand
miss = watched_samples.miss_answers
refuse = watched_samples.refuse_answer


def drifting_torque(t):
    """Return by how far a joint sags whose torque becomes too small within a second [rad]."""
    return -0.09 * np.clip(t - 1.0, 0.0, 1.0)


def other_load(p):
    """Return a torque that turns its sign at a position of 0 rad [N m]."""
    return 18.0 * np.sin(p)


def exchanged_load(t):
    """Return where a joint goes that carries that torque with the other sign [rad]."""
    return 2.0 * other_load(0.3 * np.cos(2.0 * t)) / watched_samples.KP


def silence_then(code):
    """Return cycles of a motor that is silent, and then says once that it does not drive."""
    return [*miss(5), refuse(5, code)]


def silence_after_belief():
    """Return cycles of a motor that says so, is believed again, and then falls silent."""
    said = [*miss(4), refuse(4, DISABLED)]
    return [*said, *stand(1), *miss(6)]


def damaged_answers():
    """Return cycles of answers that cannot be true, of which one has a damaged status."""
    return [*(refuse(k, ENABLED) for k in range(5)), refuse(5, 3)]


def two_reports(code):
    """Return cycles in which a motor says twice that it does not drive."""
    return [*stand(3), refuse(3, code), refuse(4, code)]


def ends_of_gaps():
    """Return cycles of two short silences, with answers between."""
    return [*miss(5), *stand(20), *miss(5)]


# --- the table ------------------------------------------------------------------------------------

INCIDENTS = (
    # Motors that do not answer, or say that they do not drive.
    Incident(
        "motor lost",
        LIKE_ANOTHER,
        {
            "pendulums": pendulums(fault(1, silent=True), "1D 0D 0D", LOST),
            "floating": floating(lost_motor(0), 3, "motor 1 .* did not answer"),
            "kinova": kinova(lost_motor(SHOULDER), UNANSWERED, quantity=OTHERS),
        },
        ARM_IS_ALONE,
    ),
    Incident(
        "answers lost",
        sample_case("did not answer in time to 5 commands in a row", partial(miss, 6)),
        {
            "pendulums": pendulums(fault(1, lost_replies=True), "11 00 00", LOST),
            "floating": floating(
                fault(0, lost_replies=True), 3, "motor 1 .* did not answer", 0.1
            ),
            "kinova": kinova(shoulder(lost_replies=True), UNANSWERED),
        },
        ARM_IS_ALONE,
    ),
    Incident(
        "five answers lost, once and again",
        sample_case(None, partial(miss, 5), ends_of_gaps),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "each fifth answer late, twice",
        sample_case(None, partial(watched_samples.answer_late, 2)),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "30 % of the answers lost",
        LIKE_ANOTHER,
        {"worn": worn(lose_answers(0.3), UNANSWERED)},
        SAME_PROGRAM,
    ),
    Incident(
        "answers 5 ms late",
        LIKE_ANOTHER,
        {"worn": worn(delay_answers(5e-3), UNANSWERED)},
        SAME_PROGRAM,
    ),
    Incident(
        "answers 20 ms late",
        sample_case(
            "did not answer in time again and again",
            partial(watched_samples.answer_late, 15),
        ),
        {"worn": worn(delay_answers(20e-3))},
        SAME_PROGRAM,
    ),
    Incident(
        "answers 50 ms late",
        LIKE_ANOTHER,
        {"worn": worn(delay_answers(50e-3), UNANSWERED, bound=0.15)},
        SAME_PROGRAM,
    ),
    Incident(
        "adapter turns slow",
        LIKE_ANOTHER,
        {
            "pendulums": pendulums(
                slow_adapter(5e-3, 16e-3), BRAKES, UNANSWERED, is_recorded=False
            )
        },
        SAME_PROGRAM,
    ),
    Incident(
        "motor reports a fault",
        sample_case("reports status A", partial(two_reports, 0xA)),
        {
            "floating": floating(fault(0, status=0xA), 3, "motor 1 .* reports status A"),
            "kinova": kinova(shoulder(status=0xA), "reports status A", quantity=OTHERS),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "motor says now and then that it does not drive, and drives",
        FILTERED,
        {"floating": floating(fault(0, false_status=3), 1, "", 0.1)},
        SAME_PROGRAM,
    ),
    Incident(
        "fault in the ramp",
        LIKE_ANOTHER,
        {"pendulums": pendulums(fault(0, status=0xA), "A1 A0 A0", "status A", FIRST, RAMP, 0.05)},
        SAME_PROGRAM,
    ),
    Incident(
        "fault on the way",
        LIKE_ANOTHER,
        {"pendulums": pendulums(fault(0, status=0xA), "A1 A0 A0", "status A", FIRST, WAY)},
        SAME_PROGRAM,
    ),
    Incident(
        "does not enable",
        BEFORE_SAMPLES,
        {
            "pendulums": pendulums(
                fault(1, status=9), "09 09 09", "not enable", {}, "enabling", 0.0
            )
        },
        SAME_PROGRAM,
    ),
    Incident(
        "all motors fail",
        LIKE_ANOTHER,
        {
            "pendulums": pendulums(
                combine_causes(fault(0, status=9), fault(1, status=9)), "99 99 99", "status 9"
            )
        },
        SAME_PROGRAM,
    ),
    Incident(
        "a second one fails while it brakes",
        LIKE_ANOTHER,
        {
            "pendulums": pendulums(
                combine_causes(fault(0, status=0xA), delay_cause(0.02, fault(1, status=0xB))),
                *("AB AB AB", "motor 1 reports status A"),
            )
        },
        SAME_PROGRAM,
    ),
    Incident(
        "motor disabled",
        sample_case(SWITCHED_OFF, partial(two_reports, DISABLED)),
        {
            "pendulums": pendulums(fault(1, status=0), "10 00 00", "motor 2 was switched off"),
            "worn": worn(shoulder(status=DISABLED), "status 0", quantity=OTHERS),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "power dip of one motor",
        sample_case(SWITCHED_OFF, partial(silence_then, DISABLED)),
        {"worn": worn(PowerDip(SHOULDER), "answer", quantity=OTHERS)},
        SAME_PROGRAM,
    ),
    Incident(
        "power dip of all motors",
        LIKE_ANOTHER,
        {"worn": worn(fault_of_all(status=DISABLED), "status 0")},
        SAME_PROGRAM,
    ),
    Incident(
        "motor silent, then reports a fault",
        sample_case("reports status A", partial(silence_then, 0xA)),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "motor silent after a status that was taken back",
        sample_case("did not answer in time to 5 commands in a row", silence_after_belief),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "answers that cannot be true",
        sample_case("what cannot be true", damaged_answers),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "supply sags",
        LIKE_ANOTHER,
        {"kinova": kinova(SaggingSupply(SHOULDER), "reports status 9", quantity=OTHERS)},
        SAME_PROGRAM,
    ),
    Incident(
        "power stage hot",
        BY_THE_ARM,
        {"pendulums": pendulums(fault(1, temperature_mos=81), BRAKES, "motor 2 is at 81 deg C")},
        SAME_PROGRAM,
    ),
    Incident(
        "winding hot",
        BY_THE_ARM,
        {"pendulums": pendulums(fault(1, temperature_rotor=81), BRAKES, "motor 2 is at 81 deg C")},
        SAME_PROGRAM,
    ),
    # Motors that make another torque than they are told.
    Incident(
        "motor makes half its torque",
        swing_case("motor 2 disagrees in torque: it needs", off=drifting_torque),
        {
            "floating": floating(
                fault(0, torque_share=0.5), 3, "motor 1 .* is not carried", 0.2
            ),
            "kinova": kinova(shoulder(torque_share=0.5), NEEDS),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "torque changes its sign, shoulder",
        BY_THE_ARM,
        {
            "kinova": kinova(shoulder(torque_share=-1.0), REVERSED),
            "worn": worn(shoulder(torque_share=-1.0), REVERSED, bound=0.2),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "torque changes its sign, wrist",
        BY_THE_ARM,
        {"kinova": kinova(wrist(torque_share=-1.0), REVERSED, bound=0.3)},
        SAME_PROGRAM,
    ),
    Incident(
        "motor makes 0.6 of its torque, at kp 500",
        BY_THE_ARM,
        {"kinova": kinova(shoulder(torque_share=0.6), NEEDS)},
        SAME_PROGRAM,
    ),
    Incident(
        "motor makes half and says so",
        swing_case("motor 2 disagrees in torque: in a second it reports", torque=0.5),
        {"kinova": kinova(shoulder(torque_share=0.5, torque_factor=0.5), DIFFERS)},
        SAME_PROGRAM,
    ),
    Incident(
        "weak motor",
        LIKE_ANOTHER,
        {
            "pendulums": pendulums(
                fault(1, peak_torque=0.05), "11 10 00", "2 disagrees in"
            )
        },
        SAME_PROGRAM,
    ),
    Incident(
        "torque reversed",
        swing_case("motor 2 disagrees in torque: it reports", torque=-1.0),
        {"kinova": kinova(shoulder(torque_factor=-1.0), DIFFERS)},
        SAME_PROGRAM,
    ),
    Incident(
        "torque reads 0.8 times",
        swing_case(f"motor 2 disagrees in {SLOW_TORQUE}", torque=0.8),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "torque reads 1.25 times",
        swing_case(f"motor 2 disagrees in {SLOW_TORQUE}", torque=1.25),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "torque reads 0.9 times",
        swing_case(None, (0.0,), seconds=6.0, torque=0.9),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "torque reads 1.1 times",
        swing_case(None, (0.0,), seconds=6.0, torque=1.1),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "gains ignored",
        BY_THE_ARM,
        {"worn": worn(shoulder(stiffness_share=0.0), bound=0.15, **AT_START)},
        SAME_PROGRAM,
    ),
    Incident(
        "gains ignored suddenly",
        BY_THE_ARM,
        {"worn": worn(shoulder(stiffness_share=0.0))},
        SAME_PROGRAM,
    ),
    Incident(
        "gains ignored by all motors",
        BY_THE_ARM,
        {"worn": worn(fault_of_all(stiffness_share=0.0), **AT_START)},
        SAME_PROGRAM,
    ),
    # Positions and speeds that are not the joint's.
    Incident(
        "encoder frozen, shoulder",
        swing_case("motor 2 disagrees in position: it reports", frozen_after=0.5),
        {
            "floating": floating(fault(0, frozen_encoder=own_position), 0, "", 0.3),
            "kinova": kinova(shoulder(frozen_encoder=own_position), REPEATS),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "encoder frozen, wrist",
        LIKE_ANOTHER,
        {"kinova": kinova(wrist(frozen_encoder=own_position), REPEATS)},
        SAME_PROGRAM,
    ),
    Incident(
        "reported position frozen",
        LIKE_ANOTHER,
        {"kinova": kinova(shoulder(frozen_position=own_position), REPEATS)},
        SAME_PROGRAM,
    ),
    Incident(
        "answers of one motor frozen",
        LIKE_ANOTHER,
        {
            "kinova": kinova(shoulder(is_stale=True), REPEATS),
            "worn": worn(shoulder(is_stale=True)),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "answers of all motors frozen",
        LIKE_ANOTHER,
        {"worn": worn(fault_of_all(is_stale=True))},
        SAME_PROGRAM,
    ),
    Incident(
        "velocity reversed",
        swing_case(f"motor 2 disagrees in {SPEED}", velocity=-1.0),
        {"kinova": kinova(shoulder(velocity_factor=-1.0), SPEED)},
        SAME_PROGRAM,
    ),
    Incident(
        "velocity reads 0.8 times",
        swing_case(f"motor 2 disagrees in {SLOW_SPEED}", velocity=0.8),
        {
            "pendulums": pendulums(
                fault(1, velocity_factor=0.8), SLOWLY, "in speed: in a second", LOOSE
            )
        },
        SAME_PROGRAM,
    ),
    Incident(
        "velocity reads 1.2 times",
        swing_case(f"motor 2 disagrees in {SLOW_SPEED}", velocity=1.2),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "velocity reads 0.98 times",
        swing_case(None, (0.0,), seconds=6.0, velocity=0.98),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "velocity reads 1.02 times",
        swing_case(None, (0.0,), seconds=6.0, velocity=1.02),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "gear slips 0.3 rad/s",
        BY_THE_ARM,
        {"kinova": kinova(shoulder(slip_rate=0.3), SHIFTED, bound=0.4)},
        SAME_PROGRAM,
    ),
    Incident(
        "gear slips, velocity is the joint's",
        swing_case(f"motor 2 disagrees in {SPEED}", slip=0.3),
        {"kinova": kinova(shoulder(slip_rate=0.3, slip_is_felt=False), SPEED, bound=0.3)},
        SAME_PROGRAM,
    ),
    Incident(
        "gear slips 0.06 rad/s, velocity is the joint's",
        swing_case(f"motor 2 disagrees in {SLOW_SPEED}", slip=0.06),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "gear slips -0.06 rad/s, velocity is the joint's",
        swing_case(f"motor 2 disagrees in {SLOW_SPEED}", slip=-0.06),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "gear slips 0.015 rad/s, velocity is the joint's",
        swing_case(None, (0.0,), seconds=6.0, slip=0.015),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "gear of an unloaded wrist slips",
        BY_THE_ARM,
        {"kinova": kinova(wrist(slip_rate=0.25), SHIFTED, bound=0.7)},
        SAME_PROGRAM,
    ),
    Incident(
        "encoder jumps 0.3 rad",
        FILTERED,
        {
            "floating": floating(
                fault(0, encoder_error=0.3), 3, "motor 1 .* jumped by", 0.1
            ),
            "worn": worn(shoulder(encoder_error=0.3)),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "encoder jumps 0.1 rad",
        FILTERED,
        {"worn": worn(shoulder(encoder_error=0.1))},
        SAME_PROGRAM,
    ),
    Incident(
        "reported position jumps 0.15 rad",
        FILTERED,
        {"pendulums": pendulums(fault(1, shift=0.15), BRAKES, "what cannot be true")},
        SAME_PROGRAM,
    ),
    Incident(
        "reported position jumps 0.3 rad",
        FILTERED,
        {
            "floating": floating(
                fault(0, shift=0.3), 3, "motor 1 .* jumped by", 0.1
            ),
            "worn": worn(shoulder(shift=0.3), bound=0.1),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "one velocity wrong in one sample",
        sample_case(None, partial(watched_samples.damage_sample, velocity=[0.0, 1.0])),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "one torque wrong in one sample",
        sample_case(None, partial(watched_samples.damage_sample, torque=[8.0, 0.0])),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "zero 0.3 rad off",
        BY_THE_ARM,
        {"kinova": kinova(shoulder(encoder_error=0.3), SHIFTED, 0.35, **AT_START)},
        SAME_PROGRAM,
    ),
    Incident(
        "zero -0.3 rad off",
        BY_THE_ARM,
        {"kinova": kinova(shoulder(encoder_error=-0.3), SHIFTED, 0.35, **AT_START)},
        SAME_PROGRAM,
    ),
    # The arm, and what it meets.
    Incident(
        "nothing",
        sample_case(None, partial(watched_samples.swing, seconds=6.0)),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "every fifth answer lost",
        swing_case(None, (0.2,), seconds=6.0),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "joint swings by 0.03 rad about its path",
        swing_case(None, (0.0,), seconds=6.0, off=lambda t: 0.03 * np.sin(2.0 * t)),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "joint goes 0.03 rad off its path",
        swing_case(None, (0.0,), seconds=6.0, off=lambda t: 0.03 * np.clip(t - 1.0, 0.0, 1.0)),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "3 kg gripped",
        BY_THE_ARM,
        {"kinova": kinova(grip_mass, NEEDS)},
        SAME_PROGRAM,
    ),
    Incident(
        "push of 60 N",
        BY_THE_ARM,
        {"kinova": kinova(push, NEEDS)},
        SAME_PROGRAM,
    ),
    Incident(
        "joint jammed, shoulder",
        LIKE_ANOTHER,
        {
            "pendulums": pendulums(
                fault(0, jam_damping=1e6), "01 00 00", "rad again and again"
            ),
            "kinova": kinova(shoulder(jam_damping=JAMMED), REPEATS),
        },
        SAME_PROGRAM,
    ),
    Incident(
        "joint jammed, wrist",
        LIKE_ANOTHER,
        {"kinova": kinova(wrist(jam_damping=JAMMED), REPEATS)},
        SAME_PROGRAM,
    ),
    Incident(
        "last link twice as heavy",
        BY_THE_ARM,
        {"worn": worn(make_link_heavier(2.0), **COMPLETED)},
        SAME_PROGRAM,
    ),
    Incident(
        "last link three times as heavy",
        BY_THE_ARM,
        {"worn": worn(make_link_heavier(3.0), bound=0.1, **MAYBE_SEEN)},
        SAME_PROGRAM,
    ),
    # The set-up.
    Incident(
        "second motor of the same id, wrist",
        sample_case(SECOND, partial(watched_samples.count_frames, 7, surplus=[0, 1])),
        {"kinova": kinova(SecondMotor(WRIST), SECOND)},
        SAME_PROGRAM,
    ),
    Incident(
        "second motor of the same id, shoulder",
        LIKE_ANOTHER,
        {"kinova": kinova(SecondMotor(SHOULDER), SECOND)},
        SAME_PROGRAM,
    ),
    Incident(
        "second motor that answers last",
        LIKE_ANOTHER,
        {"kinova": kinova(SecondMotor(WRIST, is_first=False), SECOND)},
        SAME_PROGRAM,
    ),
    Incident(
        "second motor that is disabled",
        LIKE_ANOTHER,
        {"kinova": kinova(SecondMotor(WRIST, status=DISABLED), SECOND)},
        SAME_PROGRAM,
    ),
    Incident(
        "two answers too many",
        sample_case(None, partial(watched_samples.count_frames, 2, surplus=[0, 1])),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "second master, wrist",
        sample_case(FOREIGN, partial(watched_samples.count_frames, 4, foreign=[0, 1])),
        {"kinova": kinova(SecondMaster(WRIST), FOREIGN)},
        SAME_PROGRAM,
    ),
    Incident(
        "second master, not seen",
        LIKE_ANOTHER,
        {"kinova": kinova(SecondMaster(WRIST, is_seen=False), UNSEEN)},
        SAME_PROGRAM,
    ),
    Incident(
        "second master, shoulder",
        LIKE_ANOTHER,
        {"kinova": kinova(SecondMaster(SHOULDER), FOREIGN)},
        SAME_PROGRAM,
    ),
    Incident(
        "two commands of others",
        sample_case(None, partial(watched_samples.count_frames, 2, foreign=[0, 1])),
        ONLY_A_BOUND,
        SAME_PROGRAM,
    ),
    Incident(
        "joint carries the arm the other way",
        sample_case(
            "motor 2 disagrees in torque: it carries the arm with",
            partial(watched_samples.swing, off=exchanged_load, fed=other_load),
        ),
        SIGNAL_OF_OTHERS,
        SAME_PROGRAM,
    ),
    Incident(
        "ids of two types exchanged",
        BEFORE_SAMPLES,
        {"worn": worn(exchange_ids(0, SMALL_WRIST), "PMAX", **REFUSED)},
        SAME_PROGRAM,
    ),
    Incident(
        "another arm's map",
        BEFORE_SAMPLES,
        {"worn": worn(mount_otherwise(ANOTHER_ARM), "starts at", **REFUSED)},
        SAME_PROGRAM,
    ),
    Incident(
        "shoulder turned round",
        BEFORE_SAMPLES,
        {"worn": worn(mount_otherwise({SHOULDER: {"direction": -1}}), "starts at", **REFUSED)},
        SAME_PROGRAM,
    ),
    Incident(
        "offset 0.3 rad off",
        BY_THE_ARM,
        {"worn": worn(mount_otherwise({SHOULDER: {"offset": 0.3}}), bound=0.4, **MAYBE_SEEN)},
        SAME_PROGRAM,
    ),
    Incident(
        "starts 0.3 rad away",
        BY_THE_ARM,
        {"worn": worn(start_away(0.3), **COMPLETED)},
        SAME_PROGRAM,
    ),
    Incident(
        "starts 0.6 rad away",
        BEFORE_SAMPLES,
        {"worn": worn(start_away(0.6), "starts at", **REFUSED)},
        SAME_PROGRAM,
    ),
    # The bus, and the program that plays.
    Incident(
        "bus off for 30 ms",
        NO_SAMPLE,
        {"worn": worn(switch_bus_off(0.03), "no more frames")},
        ARM_IS_ALONE,
    ),
    Incident(
        "bus off for 1 s",
        NO_SAMPLE,
        {"worn": worn(switch_bus_off(1.0), "Cut their power")},
        ARM_IS_ALONE,
    ),
    Incident(
        "bus off",
        NO_SAMPLE,
        {
            "pendulums": pendulums(
                break_driver(LinkError("gone"), 1e9), TRIPS, "gone; no confirmation"
            ),
            "floating": floating(
                break_driver(LinkError("gone"), 1e9),
                *(3, "gone; no confirmation .* Cut their power"),
            ),
            "worn": worn(switch_bus_off(100.0), "Cut their power"),
        },
        ARM_IS_ALONE,
    ),
    Incident(
        "driver raises, for good",
        NO_SAMPLE,
        {"pendulums": pendulums(break_driver(KeyError("x"), 1e9), TRIPS, "Cut their power")},
        ARM_IS_ALONE,
    ),
    Incident(
        "driver exits, 20 ms",
        NO_SAMPLE,
        {"pendulums": pendulums(break_driver(SystemExit(7), 0.02), BRAKES, "SystemExit: 7")},
        ARM_IS_ALONE,
    ),
    Incident(
        "computer busy for 50 ms",
        NO_SAMPLE,
        {"pendulums": pendulums(stall(0.05), BRAKES, f"{LATE}, limit 20")},
        SAME_PROGRAM,
    ),
    Incident(
        "program stopped for a while",
        NO_SAMPLE,
        {"pendulums": pendulums(stall(0.2), TRIPS, f"ms {LATE}")},
        process(
            send_signals("SIGSTOP", "SIGCONT", apart=0.5), 3, LATE, brakes=False
        ),
    ),
    Incident(
        "killed",
        NO_SAMPLE,
        NOBODY_LEFT,
        process(send_signals("SIGKILL"), -9, off_within=0.4, brakes=False),
    ),
    Incident(
        "terminated",
        NO_SAMPLE,
        {"pendulums": pendulums(raise_signal("SIGTERM"), BRAKES, "stopped by SIGTERM")},
        process(send_signals("SIGTERM"), 3, "stopped by SIGTERM"),
    ),
    Incident(
        "hung up",
        NO_SAMPLE,
        {"pendulums": pendulums(hang_up, BRAKES, "stopped by SIGHUP")},
        process(send_signals("SIGHUP"), 3, "stopped by SIGHUP"),
    ),
    Incident(
        "Ctrl-C",
        NO_SAMPLE,
        {
            "pendulums": pendulums(raise_signal("SIGINT"), BRAKES, "stopped by SIGINT"),
            "floating": floating(raise_signal("SIGINT"), 3, "stopped by SIGINT", 0.1),
        },
        process(send_signals("SIGINT"), 3, "stopped by SIGINT"),
    ),
    Incident(
        "Ctrl-Z",
        NO_SAMPLE,
        NotPlayed("like Ctrl-C, but for its signal, which not every system has"),
        process(send_signals("SIGTSTP"), 3, "stopped by SIGTSTP"),
    ),
    Incident(
        "Ctrl-C twice",
        NO_SAMPLE,
        {"pendulums": pendulums(insist_on_stop, DROPS, "stopped by SIGINT")},
        process(
            send_signals("SIGINT", "SIGINT", apart=0.25),
            *(3, "stopped by SIGINT"),
            off_within=0.5,
            brakes=False,
        ),
    ),
    Incident(
        "console closed",
        NO_SAMPLE,
        {"floating": floating(close_terminal, 3, "cannot print", 0.2)},
        process(close_console, 3, "nobody reads its output any more"),
    ),
    Incident(
        "full disk",
        NO_SAMPLE,
        {
            "pendulums": pendulums(
                fill_disk, BRAKES, "cannot record: No space left on device", is_recorded=False
            )
        },
        process(send_signals(), 3, "cannot record", small_files_only, off_within=9.0),
    ),
    Incident(
        "a defect",
        NO_SAMPLE,
        {
            "pendulums": pendulums(
                raise_error(RuntimeError("unforeseen")), BRAKES, "RuntimeError: unforeseen"
            )
        },
        NO_PROGRAM,
    ),
    Incident(
        "too much torque",
        NO_SAMPLE,
        {"pendulums": pendulums(ask_for_too_much, BRAKES, "motor 1 would be asked for")},
        NO_PROGRAM,
    ),
)  # fmt: skip
"""What may happen, on any arm."""


def cases_of(play: Callable[[Incident], object]) -> list:
    """Return what rows are played by, with their names, of a fidelity or of one of its arms.

    ``play`` returns it of a row, and ``NotPlayed`` or None where there is nothing.
    """
    pairs = [(incident.name, play(incident)) for incident in INCIDENTS]
    return [
        replace(case, name=name)
        for name, case in pairs
        if case is not None and not isinstance(case, NotPlayed)
    ]


def on_arm(arm: str) -> Callable[[Incident], object]:
    """Return the function of a row that returns its run on a simulated arm, or None."""

    def run_of(incident: Incident) -> object:
        """Return the row's run on the arm, or None."""
        runs = incident.simulated
        return None if isinstance(runs, NotPlayed) else runs.get(arm)

    return run_of


SAMPLES = cases_of(lambda incident: incident.samples)
PENDULUMS = cases_of(on_arm("pendulums"))
FLOATING = cases_of(on_arm("floating"))
CASES = cases_of(on_arm("kinova"))
WORN_CASES = cases_of(on_arm("worn"))
PROCESSES = cases_of(lambda incident: incident.process)

UNVERIFIED = (
    Case("ids of equal motors exchanged", exchange_ids(SHOULDER, SHOULDER + 1), **MAYBE_SEEN),
    Case("base turned round", mount_otherwise({0: {"direction": -1}}), **MAYBE_SEEN),
    Case("wrist turned round", mount_otherwise({SMALL_WRIST: {"direction": -1}}), **MAYBE_SEEN),
)  # fmt: skip
"""Mountings that nothing before a run shows but a joint map that somebody has verified by hand.

Here it was verified wrongly, and no torque tells: gravity hardly loads these joints, or alike. They
are printed, and nothing bounds what comes of them.
"""


def cases_on(setup, cases=(*WORN_CASES, *UNVERIFIED)) -> list[Case]:
    """Return cases on an arm, with its model given and without."""
    return [
        replace(case, setup=replace(setup, model_is_given=is_given))
        for is_given in (True, False)
        for case in cases
    ]


def departure_of(case, outcome) -> float:
    """Return how far joints got from their paths [rad]; no motor was enabled by a refused run."""
    return 0.0 if outcome.ending == "refused" else outcome.figures[case.quantity]

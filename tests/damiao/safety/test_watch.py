"""What stops a run: faults on the bus, and position, speed or torque that disagree."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.damiao_rig import mit_command, state, undoubted_replies
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import DISABLED, ENABLED, BusTiming
from robot_sysid.damiao.references import Reference
from robot_sysid.damiao.safety.holding import HoldingTorque, torque_doubt
from robot_sysid.damiao.safety.plausibility import NO_STATUS
from robot_sysid.damiao.safety.watch import PLAYING, Phase, Watch
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records.usual_errors import WEIGHT

JOINTS = damiao_joints(["DM4340"] * 2, 2)
STEPS = np.full(2, 4e-4), np.array([0.02, 0.02]), np.full(2, 0.0137)
PEAK = np.full(2, 27.0)
KP = 180.0
KD = 4.5
CYCLE = 0.004
HOLDING = HoldingTorque(JOINTS, lambda q: 8.0 * np.cos(q), torque_doubt(JOINTS))


def watch(**settings):
    """A watch over two joints."""
    settings = PlaySettings(**settings)
    complete = settings.for_motors([j.spec for j in JOINTS], BusTiming())
    return Watch(JOINTS, complete, STEPS, PEAK, HOLDING)


def words_of(cycles, phase=PLAYING, **settings):
    """What a watch says to cycles of replies and commands, or None."""
    watched = watch(**settings)
    try:
        for replies, command in cycles:
            watched.health.update(replies)
            watched.check(replies, command, followed(command), phase)
    except HardwareAbort as stopped:
        return str(stopped)
    return None


def followed(command):
    """The reference of a command whose torque is the weight."""
    weight = command.torque
    return Reference(
        command.position, command.velocity, weight, weight, WEIGHT * np.abs(weight)
    )


def cycle(k, command, answered, *signals):
    """Return replies and command of a cycle; the second joint's signals may be missing."""
    seen = np.array([True, answered])
    now = state(*np.where(seen, signals, np.nan), status=np.where(seen, 1, NO_STATUS))
    return undoubted_replies(
        seen, np.where(seen, k * CYCLE, np.nan), now, seen
    ), command


def stand(cycles, q=0.0, answered=True):
    """Yield cycles of joints that stand, the second at q [rad]; their command holds them at 0."""
    for k in range(cycles):
        command = mit_command(np.zeros(2), 0.0, KP, KD)
        yield cycle(k, command, answered, [0.0, q], [0.0, 0.0], [0.0, -KP * q])


# --- the bus --------------------------------------------------------------------------------------


def test_a_motor_may_be_silent_for_so_long_and_no_longer():
    """Six cycles in which it is not commanded, because the answer to the first one is missing."""

    def silent(count):
        for k, (replies, command) in enumerate(stand(count, answered=False)):
            yield replace(replies, requested=np.array([True, k == 0])), command

    gaps = [*silent(5)]
    assert words_of(gaps) is None
    assert words_of([*gaps, *stand(20), *gaps]) is None
    assert "motor 2 did not answer in time for 6 cycles" in words_of(silent(6))


def test_a_motor_whose_answers_come_late_again_and_again_is_stopped():
    """Each fifth command is answered as late as the next one is sent."""
    cycles = [*stand(4, answered=False), *stand(1)]
    for k, (replies, command) in enumerate(cycles[:4]):
        cycles[k] = replace(replies, requested=np.array([True, k == 0])), command
    assert words_of(cycles * 2) is None
    assert "motor 2 did not answer in time again and again" in words_of(cycles * 15)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({"surplus": [0, 1]}, "a second motor has its id"),
        ({"foreign": [0, 1]}, "gets commands of another program"),
    ],
)
def test_frames_too_many_are_named_unless_there_are_few(counts, words):
    cycles = [
        (replace(replies, **{k: np.array(v) for k, v in counts.items()}), command)
        for replies, command in stand(4)
    ]
    assert words_of(cycles[:2]) is None
    assert words in words_of(cycles)


def refused(k, code):
    """Return a cycle in which the second joint's answer has a status code, and is not believed."""
    command = mit_command(np.zeros(2), 0.0, KP, KD)
    replies, _ = cycle(k, command, False, [0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    both = np.array([True, True])
    doubted = np.array([False, True])
    return replace(
        replies, requested=both, doubted=doubted, reported=np.array([ENABLED, code])
    ), command


@given(st.lists(st.sampled_from([ENABLED, DISABLED, 3, 0xA]), max_size=40))
def test_a_status_that_an_answer_repeats_stops_the_run_and_each_one_is_counted(codes):
    """Whether the answers are believed or not."""
    watched = watch(max_missed=50)
    pairs = [k for k in range(1, len(codes)) if codes[k] == codes[k - 1] != ENABLED]
    first = min(pairs, default=None)
    for k, code in enumerate(codes):
        replies, command = refused(k, code) if code != ENABLED else [*stand(1)][0]
        replies = replace(replies, reported=np.array([ENABLED, code]))
        watched.health.update(replies)
        if k != first:
            watched.check(replies, command, followed(command))
            continue
        words = "was switched off, or started again" if code == DISABLED else "reports"
        with pytest.raises(HardwareAbort, match=f"motor 2 {words}.*status {code:X}: "):
            watched.check(replies, command, followed(command))
        break
    played = codes if first is None else codes[: first + 1]
    faults = [code for code in played if code != ENABLED]
    assert watched.health.reports == [{}, Counter(faults)]
    assert watched.health.failed.tolist() == [False, first is not None]


def test_what_a_motor_said_is_the_reason_why_it_is_silent():
    """It was away for a while, and has said only once that it is disabled."""
    away = [*stand(5, answered=False)]
    assert "was switched off" in words_of([*away, refused(5, DISABLED)])
    assert "reports status A" in words_of([*away, refused(5, 0xA)])
    # One that was believed since then has another reason.
    back = [*away[:4], refused(4, DISABLED), *stand(1), *stand(6, answered=False)]
    assert "did not answer in time for 6 cycles" in words_of(back)
    # So has one whose answers are damaged, of which one is damaged there.
    noise = [refused(k, ENABLED) for k in range(5)]
    assert "what cannot be true" in words_of([*noise, refused(5, 3)], max_missed=3)


# --- position, speed and torque -------------------------------------------------------------------


@pytest.mark.parametrize(("velocity", "is_old"), [(0.0, False), (0.9, True)])
def test_answers_that_stay_the_same_though_they_report_motion_are_not_trusted(
    velocity, is_old
):
    """The stop must not use them, whatever row of the watch began it."""
    watched = watch()
    command = mit_command(np.zeros(2), 0.0, KP, KD)
    signals = [0.0, 0.0], [0.0, velocity], [0.0, -KD * velocity]
    with pytest.raises(HardwareAbort) if is_old else contextlib.nullcontext():
        for k in range(9):
            replies, _ = cycle(k, command, True, *signals)
            watched.check(replies, command, followed(command), Phase(rises=True))
    assert watched.trusted_joints.tolist() == [True, not is_old]


def swing(
    seconds=3.0,
    off=lambda t: 0.0,
    velocity=1.0,
    torque=1.0,
    fed=lambda p: 8.0 * np.cos(p),
    frozen_after=np.inf,
    misses=0.0,
    slip=0.0,
):
    """Yield cycles of joints that swing, the second with what is wrong with it.

    Its position is off by an angle ``off(t)`` [rad], what it reports has other scales ``velocity``
    and ``torque``, or stays the same; a share of its answers is missing, or its gear slips [rad/s].
    """
    random = np.random.default_rng(0)
    q, qd = 0.3, 0.0
    for k in range(round(seconds / CYCLE)):
        time = k * CYCLE
        p = 0.3 * np.cos(2.0 * time) + slip * time
        v = -0.6 * np.sin(2.0 * time)
        command = mit_command([0.0, p], [0.0, v], KP, KD, [8.0, fed(p)])
        if time < frozen_after:
            q = p + off(time)
            qd = v + (off(time + 1e-6) - off(time)) / 1e-6
        else:
            qd = 0.0
        commanded = command.motor_torque(np.array([0.0, q]), np.array([0.0, qd]))[1]
        reported = round(q / 4e-4) * 4e-4, qd * velocity, commanded * torque
        answered = random.random() >= misses
        yield cycle(k, command, answered, *zip((0.0, 0.0, 8.0), reported))


def test_an_arm_that_does_as_it_should_is_left_alone():
    assert words_of(swing(seconds=6.0)) is None


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"velocity": -1.0}, "speed: its positions change by"),
        ({"velocity": 0.8}, "speed: in a second its positions change by"),
        ({"velocity": 1.2}, "speed: in a second its positions change by"),
        ({"torque": -1.0}, "torque: it reports"),
        ({"torque": 0.5}, "torque: in a second it reports"),
        ({"torque": 0.8}, "torque: in a second it reports"),
        ({"torque": 1.25}, "torque: in a second it reports"),
        ({"slip": 0.3}, "speed: its positions change by"),
        ({"slip": 0.06}, "speed: in a second its positions change by"),
        ({"slip": -0.06}, "speed: in a second its positions change by"),
        ({"off": lambda t: -0.09 * np.clip(t - 1.0, 0.0, 1.0)}, "torque: it needs"),
        ({"frozen_after": 0.5}, "position: it reports"),
    ],
)
@pytest.mark.parametrize("misses", [0.0, 0.2])
def test_a_signal_that_is_wrong_stops_the_joint_with_its_name(wrong, words, misses):
    """Also where every fifth answer is missing."""
    message = words_of(swing(misses=misses, **wrong), max_missed=50)
    assert message is not None and message.startswith("motor 2 disagrees in " + words)


@pytest.mark.parametrize(
    "right",
    [
        {"slip": 0.015},
        {"velocity": 0.98},
        {"velocity": 1.02},
        {"torque": 0.9},
        {"torque": 1.1},
        {"off": lambda t: 0.03 * np.sin(2.0 * t)},
        {"off": lambda t: 0.03 * np.clip(t - 1.0, 0.0, 1.0)},
        {"misses": 0.2},
    ],
)
def test_below_its_bound_a_signal_stops_nothing(right):
    assert words_of(swing(seconds=6.0, **right), max_missed=50) is None


@pytest.mark.parametrize("rate", [-0.06, 0.06])
def test_a_position_that_drifts_in_spite_of_its_velocity_is_found_in_time(rate):
    """Before it is 0.15 rad off; its joint moves to and fro ten times as fast."""
    cycles = [*swing(seconds=6.0, slip=rate)]
    within = round(0.15 / abs(rate) / CYCLE)
    assert words_of(cycles[:within], max_missed=50) is not None


def test_a_single_wrong_sample_stops_nothing():
    """One frame may be damaged where no filter notices it."""
    cycles = [*swing()]
    for values in ({"velocity": [0.0, 1.0]}, {"torque": [8.0, 0.0]}):
        replies, command = cycles[300]
        feedback = replace(
            replies.feedback, **{k: np.array(v) for k, v in values.items()}
        )
        damaged = [*cycles[:300], (replace(replies, feedback=feedback), command)]
        assert words_of([*damaged, *cycles[301:]]) is None


def test_a_joint_that_carries_the_arm_the_other_way_is_another_joint():
    """So it is where the cables of two arms were exchanged in a symmetric pose."""

    def load(p):
        return 18.0 * np.sin(p)

    cycles = swing(off=lambda t: 2.0 * load(0.3 * np.cos(2.0 * t)) / KP, fed=load)
    words = words_of(cycles)
    assert words.startswith("motor 2 disagrees in torque: it carries the arm with")


def test_while_gains_rise_a_new_load_is_judged_by_how_far_the_arm_sinks():
    """It swings about where it will settle; a rated 9 N m sink it by 0.05 rad, two stop it."""
    rising = {"phase": Phase(stands=True, rises=True), "kp": (KP,)}
    assert words_of(stand(50, q=-0.09), **rising) is None
    words = words_of(stand(50, q=-0.11), **rising)
    assert words == (
        "motor 2 disagrees in position: it is at -0.110 rad, and commanded to 0.000"
    )


def test_a_joint_that_slows_down_within_a_cycle_is_not_taken_for_one_of_another_scale():
    """Light joints follow v = v_des + k (p_des - p), and are sampled at the end of each cycle."""
    watched = watch(rate=50.0)
    kp = np.array(watched._settings.kp)
    kd = np.array(watched._settings.kd)
    cycle = 0.02
    fade = cycle * kp[0] / kd[0]
    q = target = np.zeros(2)
    for k in range(200):
        speed = np.full(2, 1.0 + 0.5 * np.sin(0.3 * k * cycle))
        target = target + speed * cycle
        ahead = speed / (kp[0] / kd[0])
        # By the exponential of the equation.
        away = (q - target - ahead) * np.exp(-fade)
        q = target + ahead + away
        qd = -away * kp[0] / kd[0]
        command = mit_command(target, speed, kp, kd)
        now = state(q, qd, command.motor_torque(q, qd))
        both = np.ones(2, bool)
        replies = undoubted_replies(both, np.full(2, k * cycle), now, both)
        watched.check(replies, command, followed(command))

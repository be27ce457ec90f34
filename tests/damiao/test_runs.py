"""Whole runs: those that end well, what is refused before anything moves, and what goes wrong.

Single faults are rows of ``test_incidents.py``.
"""

from __future__ import annotations

import numpy as np
import pytest

from rigs.files.places import ROOT
from rigs.motors.damiao_rig import (
    BIT_RATE,
    Damage,
    Rig,
    combine_causes,
    delay_cause,
    fault,
    lifted_swing,
    motor,
    restart_motor,
    swing,
)
from rigs.motors.motor_causes import slow_adapter
from rigs.motors.pendulum_runs import states_of
from robot_sysid.damiao.checks.preflight import stops
from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.protocol import (
    DISABLE,
    DISABLED,
    ENABLED,
    CanFrame,
    Register,
    is_special,
    special_frame,
)
from robot_sysid.errors import HardwareAbort

USUAL = {"rate": 250.0}
STRONG = 8.0
"""Torque of gravity on a level pendulum that its motor carries with some effort [N m]."""
LIFTED = {
    "motion": lifted_swing(0.8, duration=1.0, gravity=STRONG),
    "start": [0.8, 0.8],
    "gravity": STRONG,
    "ramp_time": 0.3,
    "rest_time": 0.3,
    **USUAL,
}
"""A rig whose arm is lifted, and would fall."""
SECOND = np.array([0.0, 1.0])
"""Share of each joint in what only the second one has."""


# --- runs that end well -------------------------------------------------------------------------


def test_an_undisturbed_run_plays_everything_and_disables(plain_run):
    run = plain_run
    recording = run.assert_played()
    assert recording.ending == "completed"
    assert len(recording.columns["time"]) == run.report.cycles == 101
    assert np.all(np.isfinite(recording.joint_values("pos")))
    disabled = [f.time for f in run.wire.sent if f.data[7:] == b"\xfd" and f.id == 1]
    assert len(disabled) == 6
    np.testing.assert_allclose(np.diff(disabled[:5]), 2e-3, atol=1e-9)
    run.assert_harmless()


@pytest.mark.slow
def test_lost_replies_and_a_short_stall_leave_gaps_and_nothing_is_replayed(rig):
    run = rig(**USUAL)
    found = delay_cause(0.008, fault(1, lost_replies=False))
    run.during("playing", 0.3, combine_causes(fault(1, lost_replies=True), found))
    run.during("playing", 0.5, lambda r: r.clock.stall(0.015)).run()
    recording = run.assert_played()
    q = recording.joint_values("pos")
    assert np.isfinite(q[:, 0]).all() and np.isnan(q[:, 1]).sum() == 4
    # It is not answered; after a cycle again not, as it was found no earlier; then it waits.
    assert run.report.missed.tolist() == [0, 1]
    time = recording.columns["time"]
    assert run.report.skipped in (2, 3) and len(time) == 251 - run.report.skipped
    assert np.max(np.diff(time)) == pytest.approx(
        0.004 * (1 + run.report.skipped), abs=1e-9
    )
    assert np.all(np.diff(recording.columns["j0_cmd_pos"][:120]) >= 0.0)


@pytest.mark.slow
def test_a_status_in_every_tenth_answer_is_counted_in_a_run_that_goes_on(rig):
    """Its rows have no values of this motor, but for the status."""
    wrong = fault(1, false_status=3, false_every=10)
    run = rig(**USUAL).during("playing", 0.2, wrong).run(settle=0.0)
    recording = run.assert_played()
    status = recording.joint_values("status")[:, 1]
    n_rows = np.count_nonzero(status == 3)
    assert n_rows == pytest.approx(0.8 * 250 / 10, abs=1)
    np.testing.assert_array_equal(
        np.isnan(recording.joint_values("pos")[:, 1]), status == 3
    )
    # Some of them came while the arm came to rest.
    (none, reports) = run.report.reports
    assert none == {} and [*reports] == [3] and n_rows <= reports[3] <= n_rows + 3
    assert run.report.confirmed_reports == run.report.reports
    assert run.report.refused.tolist() == run.report.missed.tolist() == [0, reports[3]]
    assert not np.any(run.report.n_lost) and not run.report.is_flawless


def test_each_command_is_answered_or_its_answer_refused_late_or_lost(rig):
    run = rig(**USUAL)
    run.bus.error_frames = 2
    sent = []
    lost = []

    def lose_or_delay(frame):
        """Every 60th answer of the second motor is lost, and every 60th is 5 ms late."""
        plays = run.has_begun("playing") and not run.has_begun("coming")
        if frame.id == 0x12 and plays:
            sent.append(frame)
            if len(sent) % 60 == 20:
                lost.append(frame)
                return None
            if len(sent) % 60 == 50:
                return frame._replace(time=frame.time + 0.005)
        return frame

    run.bus.route = lose_or_delay

    def see_errors(rig):
        rig.bus.error_frames += 3

    run.during("playing", 0.1, see_errors)
    run.during("playing", 0.2, Damage("status", 7, 1)).run(settle=0.0)
    report = run.report
    assert report.n_lost.tolist() == [0, len(lost)] and len(lost) > 3
    assert report.late.tolist() == [0, (len(sent) + 10) // 60]
    assert report.refused.tolist() == [0, 1] and report.error_frames == 3
    assert report.reports == ({}, {7: 1}) and report.confirmed_reports == ({}, {})
    assert (
        report.missed.tolist()
        == (report.n_lost + report.late + report.refused).tolist()
    )
    commands = [frame for frame in run.wire.sent if not is_special(frame.data)]
    for j in range(2):
        n_sent = sum(frame.id == run.motors[j].can_id for frame in commands)
        assert report.commands[j] == n_sent


def test_a_run_without_a_fault_of_the_bus_is_flawless(plain_run):
    report = plain_run.report
    assert report.is_flawless and np.all(report.commands > 100)
    assert report.confirmed_reports == ({}, {})


def test_register_limits_can_be_accepted_by_name_and_are_what_the_codec_uses(
    rig, plain_run
):
    plain = plain_run.recording.joint_values("tau")
    options = {"motion": swing(2, duration=0.8), "faults": [fault(0, TMAX=20)]}
    run = rig(accept_register_limits=True, **options).run()
    recording = run.assert_played()
    assert any("TMAX=20" in line for line in recording.head)
    np.testing.assert_allclose(recording.joint_values("tau"), plain, rtol=0, atol=0.05)


def test_the_frames_in_the_manual_are_those_of_a_run(tmp_path):
    """Each line of the manual is found in a run, in its order."""
    text = (ROOT / "docs" / "motors_reference.md").read_text(encoding="utf-8")
    block = (
        text.partition("## The frames of a run")[2]
        .partition("```text\n")[2]
        .split("```")[0]
    )
    slower = {"ramp_time": 0.3, "approach_time": 0.3, **USUAL}
    run = Rig(tmp_path, 1, **slower)
    run.arm.mechanism.timestep = 2e-3
    run.run()
    lines = iter(
        f"{'->' if sent else '<-'} {frame.id:03X} {frame.data.hex(' ').upper()}"
        for frame, sent in run.wire.frames
    )
    for line in block.splitlines():
        assert line[:30] in lines, line


# --- refused before anything moves --------------------------------------------------------------


def without_mode(hit):
    return {n: v for n, v in hit.registers.items() if n != Register.CTRL_MODE}


WRONG = (
    ({"TMAX": 40}, "has PMAX, VMAX, TMAX 12.5, 10, 40 but a DM4340 has"),
    (
        {"VMAX": 8},
        "12.5, 8, 28 but a DM4340 has 12.5, 10, 28; if the motor is right, give --acc",
    ),
    ({"CTRL_MODE": 2}, "is in mode 2 (POS_VEL)"),
    ({"TIMEOUT": 0}, "watchdog of 0 ms is not from"),
    ({"TIMEOUT": 100}, "watchdog of 5 ms is not from"),
    ({"TIMEOUT": 2e6}, "watchdog of 100000 ms is not from"),
    ({"status": 8}, "reports status 8: over-voltage"),
    ({"temperature_mos": 70}, "is at 70 deg C, above 60"),
    ({"temperature_rotor": 61}, "is at 61 deg C, above 60"),
    ({"silent": True}, "motor 10 does not answer"),
    ({"lost_replies": True}, "motor 11 does not answer"),
    ({"status": ENABLED, "TIMEOUT": 6e4}, "motor 12 is enabled already"),
    ({"MST_ID": 0x21}, "answers on 0x21 but the trajectory expects 0x1d"),
    ({"registers": without_mode}, "answer for CTRL_MODE; try again"),
)


def test_every_motor_that_is_not_as_expected_is_named_with_what_is_wrong(rig):
    faults = [fault(j, **values) for j, (values, _) in enumerate(WRONG)]
    run = rig(14, motion=swing(14), faults=faults).run()
    texts = stops(run.checks)
    for number, (_, message) in enumerate(WRONG, start=1):
        (matching,) = [text for text in texts if message in text]
        assert f"motor {number} " in matching or f"motor {number}'s" in matching, (
            matching
        )
    assert len(texts) == len(WRONG)
    assert str(run.error).startswith("not played: ") and isinstance(
        run.error, HardwareAbort
    )
    run.assert_never_moved()
    assert not run.record_path.exists()


def as_if_somebody_talked(run):
    for k in range(10):
        run.bus.send_when_free(0.004 * k, CanFrame(0x11, bytes(8)))


def extra(*joint):
    return {"extra_motors": [motor(DamiaoJoint(*joint))]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (extra("DM4340", 2, 0x12), "2 motors answer to the id of motor 2"),
        (
            extra("DM4310", 9, 0x102),
            "would be taken as commands by the motor with CAN id 2",
        ),
        (
            {"faults": [as_if_somebody_talked]},
            "another program is talking to these motors",
        ),
        (
            {
                "faults": [
                    fault(0, registers=lambda hit: {**hit.registers, BIT_RATE: 9.0})
                ]
            },
            "does not answer; check power, wiring, its id, bit rate, --fd",
        ),
        (
            {"start": [0.0, 0.7]},
            "but the trajectory starts at 0.000, more than 0.5 away",
        ),
        ({"start": [-2 * np.pi, 0.0]}, "lost its turn count"),
        ({"faults": [slow_adapter(0.016, 0.016)]}, "use --rate 50"),
        ({"max_temperature": 30.0}, "is at 31 deg C, above 30"),
        ({"faults": [lambda run: run.stop("asked before")]}, "asked before"),
    ],
)
def test_a_bus_or_an_arm_that_is_not_as_it_should_be_is_refused(rig, options, message):
    run = rig(**options).run()
    assert isinstance(run.error, HardwareAbort) and message in str(run.error), run.error
    run.assert_never_moved()


def farthest_from(angle, run):
    """Return how far a joint was from an angle until motors were disabled [rad]."""
    disable = special_frame(DISABLE, 0).data
    ends = [frame.time for frame in run.wire.sent if frame.data == disable]
    return max(
        np.max(np.abs(q - angle)) for time, q, _ in run.arm.truth if time < ends[0]
    )


def mirror_joint(run):
    """The second motor turns the other way, and shows the right position where it stands."""
    run.mount(1, direction=-1, offset=1.6)


@pytest.mark.parametrize(
    ("share", "faults", "message"),
    [
        (1.0 - 2.0 * SECOND, (), "motor 2 disagrees in position"),
        (0.0, (), "disagrees in torque: it carries the arm with"),
        (1.0, [mirror_joint], "motor 2 disagrees in position"),
        (1.0, [fault(1, torque_factor=5 / 3)], "in torque: in a second it reports"),
    ],
)
def test_a_torque_that_does_not_carry_the_arm_is_named_before_it_runs_away(
    rig, share, faults, message
):
    *motion, tau = lifted_swing(0.8, duration=1.0, gravity=STRONG)
    options = {"start": [0.8, 0.8], "ramp_time": 0.3, "gravity": STRONG, **USUAL}
    run = rig(motion=(*motion, share * tau), faults=faults, **options)
    run.run(settle=0.0)
    assert message in str(run.error), run.error
    assert not run.has_begun("moving")
    assert farthest_from(0.8, run) < 0.12


# --- faults while it plays ----------------------------------------------------------------------


def to_zero(hit):
    return -hit.position


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seconds", "shift"),
    [(0.002, 2.0 * np.pi), (0.008, 0.0), (0.008, to_zero), (0.014, -0.3)],
)
def test_a_motor_that_starts_again_is_not_taken_for_a_cable(rig, seconds, shift):
    """Whatever position it then has: its turn count may be lost, or its zero."""
    run = rig(**USUAL)
    run.during("playing", 0.25, restart_motor(1, seconds, shift)).run(settle=0.0)
    assert "motor 2 was switched off, or started again" in str(run.error), run.error
    assert run.error.report.reports[1][DISABLED] >= 1


def test_a_motor_that_starts_again_more_slowly_is_named_after_the_stop(rig):
    run = rig(**USUAL)
    run.during("playing", 0.25, restart_motor(1, 0.05, to_zero)).run(settle=0.0)
    silent, since = str(run.error).split("; it has answered since then: ")
    assert silent == "motor 2 did not answer in time to 5 commands in a row"
    assert since.startswith("motor 2 was switched off, or started again: it reports st")


def test_a_motor_that_only_says_that_it_does_not_drive_goes_on_holding_its_joint(rig):
    """A stop lets go of nothing that it held: its watchdog would be left to drop the joint."""
    run = rig(**LIFTED)
    seen = []
    run.during("stopping", 0.2, lambda r: seen.append(states_of(r)))
    lies = fault(1, false_status=3, false_every=1)
    run.during("moving", 0.05, lies).run(settle=0.0)
    assert "motor 2 reports status 3" in str(run.error)
    assert seen == ["11"]
    assert farthest_from(0.8, run) < 0.04


@pytest.mark.parametrize("delay", [0.005, 0.02, 0.05])
def test_an_arm_that_is_stopped_while_its_gains_rise_is_carried(rig, delay):
    """What has been fed forward by then is only a part of what carries it."""
    run = rig(**LIFTED)
    run.during("raising", delay, lambda r: r.stop("stopped by SIGTERM")).run(settle=0.0)
    assert str(run.error) == "stopped by SIGTERM"
    assert farthest_from(0.8, run) < 0.03

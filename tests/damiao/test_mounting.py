"""Mirrored joints, joint maps, motors outside the chain, and how an arm is left."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from rigs.files.places import EXAMPLE
from rigs.motors.damiao_rig import lifted_swing, map_line, swing, trajectory_of
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.checks.preflight import bus_checks, stops
from robot_sysid.damiao.joints import DamiaoJoint, damiao_joints, map_joints
from robot_sysid.damiao.protocol import DISABLED, ENABLED, Register
from robot_sysid.damiao.safety.holding import file_holding
from robot_sysid.damiao.simulated import simulated_motor
from robot_sysid.errors import InputError

STANDING = 0.7


@pytest.fixture
def standing_rig(rig):
    """A rig of an arm that gravity pulls down, and that is lowered at the end."""
    motion = lifted_swing(STANDING, duration=0.8)
    return rig(motion=motion, start=[STANDING] * 2, park="rest")


# --- mounting -------------------------------------------------------------------------------------


def test_a_mirrored_and_shifted_motor_moves_its_joint_as_the_file_says(rig, plain_run):
    """The recording is the same as that of a motor that sits straight."""
    odd = rig(motion=swing(2, duration=0.8))
    odd.mount(1, direction=-1, offset=0.6)
    joints = tuple(motor.joint for motor in odd.motors)
    odd.plan = replace(odd.plan, trajectory=replace(odd.plan.trajectory, joints=joints))
    odd.run()
    assert plain_run.error is None and odd.error is None
    for signal, close in (("pos", 2e-3), ("vel", 0.05), ("tau", 0.15)):
        straight, turned = (r.recording.joint_values(signal) for r in (plain_run, odd))
        np.testing.assert_allclose(turned, straight, atol=close)
    assert odd.motors[1].position == pytest.approx(
        0.6 - odd.arm.mechanism.q[1], abs=0.01
    )


# --- motors outside the trajectory ----------------------------------------------------------------


@pytest.fixture
def gripper():
    """A motor outside the trajectory."""
    motor = simulated_motor(DamiaoJoint("DM4310", 8, 0x18), watchdog=0.1)
    motor.position = 0.3
    return motor


def test_other_motors_are_left_limp(rig, gripper):
    phases = []
    run = rig(motion=swing(2, duration=0.8), extra_motors=[gripper])
    run.during("playing", 0.2, lambda r: phases.append(gripper.status)).run()
    run.assert_played()
    assert "left limp: motor 8" in " ".join(check.text for check in run.checks)
    assert phases == [DISABLED]
    assert run.recording.joint_values("pos").shape[1] == 2


def test_a_motor_that_another_program_has_enabled_is_refused(rig, gripper):
    """Left alone it would go on driving while the run says that all motors are disabled."""
    gripper.status = ENABLED
    gripper.registers[Register.TIMEOUT] = 9e4
    run = rig(extra_motors=[gripper]).run()
    words = "motor 8 is not in the trajectory, and is enabled by another program"
    assert words in str(run.error)
    run.assert_never_moved()
    silent = inspect_bus(run.link)
    silent.motors[8] = replace(silent.motors[8], feedback=None)
    assert words in stops([*bus_checks(run.plan, silent)])[0]


# --- how the arm is left --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("cause", [None, "stopped by SIGTERM"])
def test_an_arm_is_lowered_until_nothing_pulls(standing_rig, cause):
    """At its end, and where it is stopped."""
    run = standing_rig
    if cause:
        run.during("playing", 0.3, lambda r: r.stop(cause))
    run.run(settle=1.0)
    assert str(run.error) == str(cause) and run.states() == [DISABLED] * 2
    assert np.max(np.abs(run.arm.mechanism.q)) < 0.1
    begin, _ = run.span("stopping" if cause else "lowering")
    speeds = [np.max(np.abs(qd)) for time, _, qd in run.arm.truth if time > begin + 0.2]
    assert np.max(speeds) < 0.4


@pytest.mark.slow
def test_the_recording_of_the_example_gives_the_true_link_back(monkeypatch):
    """Plan, play, record, identify: the whole loop."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    assert importlib.import_module("validate_damiao_loop").main() == 0


# --- maps and torques -----------------------------------------------------------------------------


def test_a_map_that_lacks_a_joint_of_the_model_is_refused(tmp_path):
    joints = damiao_joints(["DM4340"] * 2, 2)
    rows = [map_line("a", 1, 17, 1), map_line("b", 2, 18, -1)]
    assert [j.direction for j in map_joints(joints, rows, ())] == [1, -1]
    assert [j.name for j in map_joints(joints, rows, ["b", "a"])] == ["b", "a"]
    with pytest.raises(InputError, match="no line for c; it has a, b"):
        map_joints(joints, rows, ["a", "c"])
    with pytest.raises(InputError, match="joint map: 2, of the trajectory: 1;"):
        map_joints(joints[:1], rows, ())


@pytest.mark.parametrize(
    ("bend", "held"),
    [(lambda t: 0.0 * t, 5.0), (lambda t: 1.0 + 0.0 * t, None), (np.cos, 5.0)],
)
def test_without_a_model_the_file_says_what_holds_the_arm(bend, held):
    """5 N m where the motor of a swapped id holds none, and 12 more or less for what begins.

    Unless the file never stops to accelerate near its first point.
    """
    time = np.arange(101) / 50
    qdd = 1.5 * bend(3 * np.pi * time)[:, None]
    qd = np.cumsum(qdd, axis=0) / 50
    q = np.cumsum(qd, axis=0) / 50
    check = file_holding(trajectory_of((time, q, qd, 5.0 - 8.0 * qdd)))
    assert not check.contradicts(q[0] + 0.2, np.array([0.1]))
    assert not check.contradicts(q[0], np.array([held or -5.0]))
    assert check.contradicts(q[0], np.array([0.1])) == bool(held)

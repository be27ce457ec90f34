"""The command motors move: from where an arm stands to a pose of its model, or why not."""

from __future__ import annotations

import re
import shlex

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.wrong_arms import resting_torque
from rigs.motors.clocks import heard_signals
from rigs.motors.damiao_rig import MotorBus, only_asks, trajectory_of
from rigs.motors.recordings import read_recording
from robot_sysid.commands.motors.moving import goal_pose, moving_activity, moving_plan
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import DISABLED
from robot_sysid.damiao.references import Reference
from robot_sysid.damiao.safety.holding import gravity_holding
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.errors import InputError
from robot_sysid.simulation.plant import ArmStepper

KEYS = '<key name="home" qpos=".1 .2"/><key name="up" qpos="0 0"/><key qpos=".35 .05"/>'
JOINT = 'armature=".05" damping="1" frictionloss=".05" range="-2.5 2.5"'
MODEL = small_arms.serial_arm(
    (small_arms.Y, small_arms.Y), joint=JOINT, extra=f"<keyframe>{KEYS}</keyframe>"
)
ROBOT = small_arms.robot_of(MODEL)
START = 0.3, 0.1
USUAL = "--accept-directions --rate 100 --channel can0"


def test_a_pose_is_a_keyframe_or_a_position_of_each_joint():
    for words, pose in (
        (["home"], [0.1, 0.2]),
        (["0"], [0.1, 0.2]),
        (["2"], [0.35, 0.05]),
        (["#2"], [0.35, 0.05]),
        (["-1.5", "2e-1"], [-1.5, 0.2]),
    ):
        assert goal_pose(ROBOT, words).tolist() == pose
    listed = "the keyframes of .* are home, up, #2, and else .*: joint0, joint1"
    for words in (["rest"], ["3"], ["-1"], ["1", "2", "3"], ["0", "nan"], []):
        with pytest.raises(InputError, match=listed):
            goal_pose(ROBOT, words)


def test_a_model_without_keyframes_takes_positions():
    robot = small_arms.robot_of(
        small_arms.serial_arm((small_arms.Y, small_arms.Y), joint=JOINT)
    )
    assert goal_pose(robot, ["0.5", "1"]).tolist() == [0.5, 1.0]
    with pytest.raises(InputError, match="are none, and else it takes one position"):
        goal_pose(robot, ["home"])


POSES = st.lists(st.floats(-2.5, 2.5), min_size=2, max_size=2).map(np.array)


def plan_between(start, goal):
    """The plan of a motion of the arm between two poses."""
    still = np.zeros((2, 2))
    motion = np.array([0.0, 1.0]), still + start, still, still
    standing = trajectory_of(motion, "DM4340", "DM4340")
    settings = PlaySettings(start_tolerance=0.05)
    plan = Plan(standing, settings, model_limits=ROBOT.limits)
    return moving_plan(plan, ROBOT, goal)


@given(start=POSES, goal=POSES)
def test_the_motion_that_is_checked_is_smooth_and_slow(start, goal):
    """A straight line, at rest at both ends, no faster than the approach of a trajectory."""
    plan = plan_between(start, goal)
    motion = plan.trajectory
    assert_allclose(motion.q[[0, -1]], [start, goal], atol=1e-12)
    assert_allclose(motion.qd[[0, -1]], 0.0, atol=1e-12)
    assert np.max(np.abs(motion.qd)) <= plan.settings.approach_speed + 1e-12
    slopes = np.gradient(motion.q, motion.time, axis=0)
    assert_allclose(slopes[1:-1], motion.qd[1:-1], atol=1e-3)
    line = goal - start
    across = (motion.q - start) @ np.array([-line[1], line[0]])
    assert_allclose(across, 0.0, atol=1e-12)
    at_ends = resting_torque(ROBOT, motion.q[[0, -1]], ROBOT.thetas)
    # The torque of its small acceleration at the ends.
    assert_allclose(motion.tau[[0, -1]], at_ends, atol=0.02)


@given(
    start=POSES,
    goal=POSES,
    sunk=st.lists(st.floats(-0.05, 0.05), min_size=2, max_size=2).map(np.array),
)
def test_the_motion_that_is_played_is_the_checked_one(start, goal, sunk):
    """But for what the arm has sunk before its motors hold it; fed is the gravity of the model."""
    plan = plan_between(start, goal)
    holding = gravity_holding(ROBOT, plan.trajectory.joints)
    activity = moving_activity(plan, holding, "goal")
    standing = Reference.at_rest(start + sunk, holding)
    reference = activity.begin(standing)
    for time, checked in zip(plan.trajectory.time[::40], plan.trajectory.q[::40]):
        played = reference(time)
        assert np.max(np.abs(played.position - checked)) <= 0.05 + 1e-12
        assert np.max(np.abs(played.velocity)) <= plan.settings.approach_speed + 1e-12
        expected = resting_torque(ROBOT, played.position[None], ROBOT.thetas)[0]
        assert_allclose(played.torque, expected, atol=1e-9)
    end = reference(activity.duration)
    assert_allclose(end.position, goal, atol=1e-12)
    assert_allclose(end.velocity, 0.0, atol=1e-12)


@pytest.fixture
def bus():
    """The arm of the model with motors, which stands in a pose that is no keyframe."""
    mechanism = ArmStepper(ROBOT, START, 2e-3)
    joints = damiao_joints(["DM4340"] * 2, 2)
    bus = MotorBus(joints, mechanism, watchdog=0.15, echo=True)
    bus.arm.takes_whole_steps = True
    with heard_signals():
        yield bus


def last_position(bus):
    """Where the joints were when the motors were disabled [rad]."""
    return next(q for time, q, _ in bus.arm.truth if time >= bus.arm.off_at - 2e-3)


@pytest.mark.slow
def test_an_arm_is_moved_to_a_keyframe_and_disabled(motors, bus, arm_file, tmp_path):
    record = tmp_path / "move.csv"
    words = (
        "move --to home --yes",
        USUAL,
        "--model",
        arm_file(MODEL),
        "--record",
        record,
    )
    out = motors.succeed(*words)
    assert "moving to home (2.3 s)" in out and "Done: moved to home" in out
    bus.arm.advance(bus.clock.now() + 0.1)
    assert_allclose(last_position(bus), [0.1, 0.2], atol=0.01)
    assert bus.states() == [DISABLED] * 2
    positions = read_recording(record).joint_values("pos")
    assert_allclose(positions[[0, -1]], [START, [0.1, 0.2]], atol=0.01)


def test_the_person_is_asked_and_nothing_moves_without_a_yes(
    motors, bus, arm_file, monkeypatch
):
    words = "move --to 0 0", USUAL, "--model", arm_file(MODEL)
    assert "give --yes" in motors.fail(2, *words)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    prompts = []
    monkeypatch.setattr("builtins.input", lambda prompt: prompts.append(prompt) or "no")
    assert "not confirmed; nothing was moved" in motors.fail(2, *words)
    assert "The arm will move" in prompts[0] and only_asks(bus.wire.sent)


BALL = '<geom type="sphere" size=".05" pos="0 0 .25"/>'
WALL = '<geom type="box" size=".02 .5 .5" pos=".3 0 .5"/>'
BEHIND_WALL = MODEL.replace("</body></worldbody>", f"</body>{WALL}</worldbody>")
BEHIND_WALL = re.sub("(<joint name=.joint1.*?/>)", rf"\1{BALL}", BEHIND_WALL)
REFUSED = {
    "nowhere": (2, MODEL, "--to sleep", "the keyframes of arm.xml are home, up, #2"),
    "too far": (3, MODEL, "--to 2.6 0", "beyond the model's limit, 2.5, at"),
    "a wall": (3, BEHIND_WALL, "--to 2 0", "touch at"),
    "your limit": (3, MODEL, "--to up --max-torque 1e-3", "beyond your limit, 0.001"),
}
"""The exit code, the model, where to, and what is said."""


@pytest.mark.parametrize("name", REFUSED)
def test_a_way_that_is_not_free_is_refused_before_anything_moves(
    motors, bus, arm_file, name
):
    code, model, goal, message = REFUSED[name]
    words = "move --yes", goal, USUAL, "--model", arm_file(model)
    err = motors.fail(code, *words)
    assert message in err
    assert only_asks(bus.wire.sent) and bus.states() == [DISABLED] * 2
    if name in ("too far", "a wall"):
        assert "move to another pose, or bring the arm elsewhere by hand" in err


def test_a_pose_that_does_not_exist_is_refused_before_a_motor_is_asked(
    motors, bus, arm_file
):
    motors.fail(2, "move --yes --to sleep", USUAL, "--model", arm_file(MODEL))
    assert bus.wire.frames == []


def test_joints_of_which_nobody_knows_how_they_turn_are_not_moved(
    motors, bus, arm_file
):
    upright = MODEL.replace(f'axis="{small_arms.Y}"', f'axis="{small_arms.Z}"', 1)
    words = "move --yes --to up --rate 100 --channel can0 --model", arm_file(upright)
    err = motors.fail(3, *words)
    assert "nobody has verified which way motor 1 (joint joint0)" in err
    assert only_asks(bus.wire.sent)


@pytest.mark.slow
def test_a_simulated_arm_is_moved_and_the_printed_command_moves_the_real_one(
    motors, bus, arm_file, monkeypatch, tmp_path
):
    """And the command behind that plans a motion for the motors that it has met."""
    monkeypatch.chdir(tmp_path)
    model = arm_file(MODEL)
    words = "move --simulate --to 2 --pose .3 0 --motor-type DM4340 --rate 100 --model"
    out = motors.succeed(words, model, "--accept-directions")
    assert bus.wire.frames == [] and "moving to 2" in out
    line = out.splitlines()[-1]
    assert "--to 2" in line and "--channel can0" in line
    out = motors.succeed(*shlex.split(line)[2:], "--yes")
    assert "moving to 2" in out
    step = out.splitlines()[-1]
    assert step.startswith(f"  robot-sysid plan {model} --for arm --motor-type")


@pytest.mark.slow
def test_an_arm_that_stands_beside_its_goal_is_not_there_and_arrives_as_is_printed(
    motors, arm_file, tmp_path, monkeypatch
):
    """Its masses are a third off, and it is soft: it sags by more than somebody overlooks."""
    monkeypatch.chdir(tmp_path)
    lighter = re.sub('mass="(.*?)"', lambda m: f'mass="{0.7 * float(m[1]):g}"', MODEL)
    model = arm_file(lighter, "lighter.xml")
    simulated = "--simulate --motor-type DM4340 --pose 0.3 0.1 --plant-model"
    words = ("move --to 1 0.5 --kp 8 --rate 100", simulated, arm_file(MODEL))
    code, out, _ = motors.run(*words, "--model", model)
    *_, verdict, sentence, line = out.splitlines()
    assert code == 1
    found = re.fullmatch(
        r"Not there: joint0 stands (0\.\d+) rad from 1 0.5; its stiffness of 8 N·m/rad makes (\S+) "
        "N·m there, by which weight and friction differ from the model's, and all motors are "
        "disabled",
        verdict,
    )
    assert 0.05 < float(found[1]) < 0.3
    assert float(found[2]) == pytest.approx(8.0 * float(found[1]), rel=0.1)
    assert sentence == "Next, move it with the stiffness by motor type:"
    assert "Done: moved to 1 0.5" in motors.succeed(*shlex.split(line)[2:])


@pytest.mark.slow
def test_an_arm_that_is_not_its_model_s_is_stopped_and_held(motors, bus, arm_file):
    """Its model is a tenth as heavy: it sags from its path, and is stopped as by play."""
    light = MODEL.replace('mass="1.2"', 'mass=".02"').replace('mass=".8"', 'mass=".01"')
    light = re.sub('fullinertia="[^"]*"', 'diaginertia=".001 .001 .001"', light)
    words = "move --yes --to 1 1 --kp 5", USUAL, "--model", arm_file(light)
    code, _, err = motors.run(*words)
    assert code == 3 and "motor" in err
    bus.arm.advance(bus.clock.now() + 0.1)
    assert bus.states() == [DISABLED] * 2

"""The steps that motors setup and map print: each runs as it is printed, and leads on."""

from __future__ import annotations

import shlex

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.walk import in_haste
from rigs.arms.wrong_arms import resting_torque
from rigs.motors.damiao_rig import fault, map_line, trajectory_file
from robot_sysid.damiao.joints import BY_HAND, write_joint_map
from robot_sysid.damiao.protocol import Register

SETUP = "setup --channel can0"
MODEL = small_arms.serial_arm(
    (small_arms.Y, small_arms.Y), joint='range="-2 2" armature=".02"'
)


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A model in the working folder, whose name needs quotes."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "my arm.xml"
    path.write_text(MODEL)
    return path


def step_in(out):
    """Return the words of the command that is printed last, without the program's name."""
    sentence, line = out.splitlines()[-2:]
    assert sentence.startswith("Next, ") and line.startswith("  robot-sysid ")
    return shlex.split(line)[1:]


def run(motors, words, codes=(0,)):
    """Run the words of a command; return its output."""
    code, out, err = motors.run_program(in_haste(words))
    assert code in codes, err
    return out


def still_trajectory(folder, n_joints=2, seconds=1.0):
    """Write a motion of as many joints that stand still at zero, with the torque of the model."""
    robot = small_arms.robot_of(MODEL)
    still = np.zeros((2, n_joints))
    gravity = resting_torque(robot, np.zeros((1, 2)), robot.thetas)[0]
    torque = still + np.resize(gravity, n_joints)
    folder.mkdir(exist_ok=True)
    return trajectory_file(
        folder, (np.array([0.0, seconds]), still, still, torque)
    ).path


def test_without_a_model_the_motors_are_watched(motors, bus, model):
    words = step_in(motors.succeed(SETUP))
    assert words == ["motors", "monitor", "--channel", "can0"]

    def press():
        raise KeyboardInterrupt

    # Until the person has seen enough.
    bus.at(5.0, press)
    assert run(motors, words, (0, 130)).count("0x11") > 2


@pytest.mark.slow
def test_from_the_motors_over_the_planned_motion_to_the_check(motors, bus, model):
    """With the model a motion is planned for the types that the registers tell; then it is used."""
    words = step_in(motors.succeed(*SETUP.split(), "--model", model))
    assert words[:2] == ["plan", str(model)]
    assert words.count("--motor-type") == 2 and "DM4340" in words
    simulate = step_in(run(motors, words))
    assert simulate[:2] == ["motors", "simulate"]
    check = step_in(motors.succeed(*SETUP.split(), "--model", model))
    assert check[:3] == ["motors", "check", "planned/damiao_trajectory.csv"]
    # It runs as printed; what it still asks for is motors map, for joints that nobody has turned.
    assert "motors map" in run(motors, check, (1,))
    assert "ready to play" in run(motors, [*check, "--accept-directions"])


def test_a_map_leads_to_a_plan_for_the_motors_of_the_joints(
    motors, bus, person, model, tmp_path
):
    """The first joint has motor 2, of another type."""
    for name, value in zip(("PMAX", "VMAX", "TMAX"), (12.5, 45.0, 54.0)):
        fault(1, **{name: value})(bus)

    def turn(j):
        def turn_and_say():
            bus.arm.mechanism.q[j] += 0.4
            return "yes"

        return turn_and_say

    person[0].extend([turn(1), turn(0), ""])
    out = motors.succeed(*["map", "--channel", "can0", "--model"], model)
    words = step_in(out)
    types = [word for flag, word in zip(words, words[1:]) if flag == "--motor-type"]
    assert types == ["DM8009", "DM4340"]
    assert words[:2] == ["plan", str(model)]
    assert words[words.index("--joint-map") + 1] == "joint_map.csv"


@pytest.mark.slow
def test_a_map_made_before_the_plan_is_in_every_line_until_the_arm_is_played(
    motors, bus, model, tmp_path
):
    mapped = tmp_path / "mine.csv"
    rows = [map_line(f"joint{k}", k + 1, 0x11 + k, 1, 0.0, BY_HAND) for k in range(2)]
    write_joint_map(mapped, rows)
    types = ["--motor-type", "DM4340"] * 2
    plan = ["plan", str(model), *types, "--output-dir", "planned", "--joint-map"]
    words = [*plan, "mine.csv"]
    for command in ("simulate", "check", "play"):
        words = step_in(run(motors, words))
        assert words[:2] == ["motors", command]
        assert words[words.index("--joint-map") + 1] == "mine.csv"
    write_joint_map(mapped, rows[:1])
    code, _, error = motors.run_program([*plan, "mine.csv"])
    assert code == 2 and "the joint map has no line for joint1" in error


@pytest.mark.parametrize("folder", [".", "planned", "sysid_output"])
def test_a_planned_motion_is_found_and_checked(motors, bus, model, tmp_path, folder):
    path = still_trajectory(tmp_path / folder)
    for options in ((), ("--model", model)):
        words = step_in(motors.succeed(*SETUP.split(), *options))
        assert words[:2] == ["motors", "check"]
        assert tmp_path / words[2] == path
        assert "ready to play" in run(motors, [*words, "--accept-directions"])


@pytest.mark.slow
def test_a_recording_that_is_not_kept_is_not_named(motors, model, tmp_path):
    path = still_trajectory(tmp_path, seconds=6.0)
    out = motors.succeed("simulate", path, "--rate 50 --model", model)
    assert "does not show what the arm is: the arm is at rest" in out
    assert "measured.csv" not in out


@pytest.mark.slow
def test_behind_a_rehearsal_motors_are_mapped_or_checked_by_the_map_that_is_there(
    motors, model, tmp_path
):
    path = still_trajectory(tmp_path)
    simulate = "simulate", path, "--rate 50 --model", model
    words = step_in(motors.succeed(*simulate))
    assert words[:2] == ["motors", "map"] and "can0" in words
    rows = [map_line(f"joint{k}", 2 - k, 0x12 - k) for k in range(2)]
    write_joint_map(tmp_path / "joint_map.csv", rows)
    words = step_in(motors.succeed(*simulate))
    assert words[:2] == ["motors", "check"]
    assert words[words.index("--joint-map") + 1] == "joint_map.csv"
    write_joint_map(tmp_path / "joint_map.csv", rows[:1])
    assert step_in(motors.succeed(*simulate))[1] == "map"


def test_the_motion_of_another_arm_is_not_proposed(motors, bus, model, tmp_path):
    still_trajectory(tmp_path, n_joints=3)
    assert step_in(motors.succeed(SETUP))[1] == "check"
    assert step_in(motors.succeed(*SETUP.split(), "--model", model))[0] == "plan"
    (tmp_path / "damiao_trajectory.csv").write_text("no trajectory")
    assert step_in(motors.succeed(SETUP))[1] == "monitor"


def test_no_motion_is_planned_for_motors_whose_type_is_not_known(motors, bus, model):
    bus.motors[1].registers[Register.TMAX] = 77.0
    out = motors.succeed(*SETUP.split(), "--model", model)
    assert step_in(out) == ["motors", "monitor", "--channel", "can0"]
    assert "the registers of one motor per joint have to tell its type" in out


def test_types_that_share_their_limits_are_not_guessed(motors, bus, model):
    """DMH6215 and DMG6220."""
    for name, value in zip(("PMAX", "VMAX", "TMAX"), (12.5, 45.0, 10.0)):
        fault(0, **{name: value})(bus)
    assert step_in(motors.succeed(*SETUP.split(), "--model", model))[1] == "monitor"


def test_a_model_that_cannot_be_read_changes_no_motor(motors, bus, model):
    model.write_text("<mujoco/>")
    words = *SETUP.split(), "--motor 1 --watchdog 0.2 --store", "--model", model
    registers = dict(bus.motors[0].registers)
    motors.fail(2, *words)
    assert bus.motors[0].registers == registers and bus.wire.frames == []


def test_options_about_a_model_need_one(motors, bus):
    err = motors.fail(2, *SETUP.split(), "--joint joint0")
    assert "--joint is about a model; add --model" in err and bus.wire.frames == []


def test_a_motor_with_a_new_id_is_found_under_it(motors, bus, model):
    """The first joint's motor becomes motor 1."""
    bus.motors[0].registers[Register.ESC_ID] = 5.0
    words = *SETUP.split(), "--motor 5 --new-id 1 --store", "--model", model
    assert step_in(motors.succeed(*words))[0] == "plan"

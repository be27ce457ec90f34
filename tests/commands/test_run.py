"""``robot-sysid MODEL``: options reach their records, and nothing unchecked is played or kept."""

from __future__ import annotations

import json
import shutil
import time
from types import SimpleNamespace

import numpy as np
import pytest

from robot_sysid.cli import main
from robot_sysid.config import config_from
from robot_sysid.motion.limit_check import LimitCheck
from robot_sysid.motion.trajectory_files import load_trajectory
from robot_sysid.simulation.forward_dynamics import ForwardPlant
from tests.support import arms, option_samples, witness
from tests.support.excitation_arms import TUBES
from tests.support.option_samples import MET, MOTORS
from tests.support.places import GUESS, MODELS

SAMPLES = list(option_samples.samples())
RATE = ("--sample-rate", "100")
SHORT = ("--duration", "3", *RATE, "--seed", "1")
JOINTS = 4


def motor_types(count):
    return ("--export-damiao", *(word for _ in range(count) for word in ("--motor-type", "DM4340")))


@pytest.fixture
def asked(monkeypatch):
    """Function: the configuration that a command line asks for, without running it."""
    seen = []
    outcome = SimpleNamespace(failure=None, files=(), report_lines=lambda verbose: [])
    for pipeline in ("robot_sysid.pipeline.run", "robot_sysid.commands.run._of_servos"):
        monkeypatch.setattr(pipeline, lambda config, _: seen.append(config) or outcome)

    def ask(*arguments):
        assert main([str(word) for word in arguments]) == 0
        return seen.pop()

    return ask


def test_without_options_the_configuration_is_the_default_one(asked):
    assert asked("arm.xml") == config_from("arm.xml")


@pytest.mark.parametrize("sample", SAMPLES, ids=str)
def test_every_option_reaches_its_record(sample, asked):
    there = dict(MOTORS if sample.option.key == "export_damiao" else MET[sample.option.needs][0])
    there.pop(sample.option.key, None)
    config = asked("arm.xml", *option_samples.typed(there), *sample.words)
    assert getattr(getattr(config, sample.record), sample.field) == sample.value
    assert config == config_from("arm.xml", **there, **{sample.option.key: sample.value})


@pytest.fixture
def arm(arm_file):
    return arm_file(TUBES)


# A motion that is played, kept or bound by a limit, in each way there is.
CHECKED = {
    "exported": motor_types(JOINTS),
    "simulated forward": ("--plant-model", "arm.xml", "--simulation", "forward"),
    "saved": ("--save-trajectory", "other.json"),
    "from a file": ("--trajectory", "plan.json"),
    "file, exported": ("--trajectory", "plan.json", *motor_types(JOINTS)),
    "limited": ("--max-acceleration", "5"),
    "planned": ("--plan-only",),
    "planned, exported": ("--plan-only", *motor_types(JOINTS)),
    "designed": ("--excitation", "optimal", "--excitation-time-budget", "0.01"),
}


@pytest.mark.parametrize("case", CHECKED)
def test_where_a_limit_is_broken_nothing_is_played_written_or_called_good(
    case, command, arm_file, monkeypatch
):
    bare = arm_file(arms.serial_arm((arms.Z, arms.Y, arms.X, arms.Y)))
    command.run(bare, *SHORT, "--plan-only", "--save-trajectory", "plan.json")
    shutil.rmtree(bare.parent / "sysid_output", ignore_errors=True)
    monkeypatch.setattr(LimitCheck, "failure", property(lambda check: "it breaks the law"))

    def played(*_):
        raise AssertionError("simulated although it breaks a limit")

    monkeypatch.setattr(ForwardPlant, "step", played)
    short = RATE if "plan.json" in CHECKED[case] else SHORT
    code = 1 if "--plan-only" in CHECKED[case] else 2
    assert "it breaks the law" in command.refused(bare, *short, *CHECKED[case], code=code)


@pytest.fixture
def plan(command, arm):
    """A trajectory of that arm that obeys the limits it was made for."""
    command.run(arm, *SHORT, "--plan-only", "--save-trajectory", "plan.json")
    return arm.parent / "plan.json"


BROKEN = {
    "velocity": ("--max-velocity", "0.3"),
    "acceleration": ("--max-acceleration", "1"),
    "torque": ("--max-torque", "1.5"),
    "workspace": ("--workspace", "-0.13", "0.13", "-0.13", "0.13", "1", "2"),
    "keep out": ("--keep-out", "1", "0", "0", "-0.09"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_trajectory_file_beyond_a_limit_is_refused(case, command, arm, plan):
    words = (
        "must not be run: it breaks ",
        "relax that limit, slow the motion down with --speed, or",
    )
    message = command.refused(arm, "--trajectory", plan, *RATE, *BROKEN[case])
    assert all(word in message for word in words)
    exported = command.refused(
        arm, "--trajectory", plan, *RATE, *BROKEN[case], *motor_types(JOINTS)
    )
    assert exported == message


def test_a_trajectory_file_within_its_limits_is_used(command, arm, plan):
    printed = command.run(arm, "--trajectory", plan, *RATE, *motor_types(JOINTS))
    assert (arm.parent / "sysid_output" / "damiao_trajectory.csv").exists()
    assert "another model file" not in printed.err


def test_a_trajectory_file_edited_to_leave_a_joints_range_is_refused(command, arm, plan):
    content = json.loads(plan.read_text())
    content["amplitude"][-1] = [12.0 * value for value in content["amplitude"][-1]]
    plan.write_text(json.dumps(content))
    wide = ("--max-velocity", "1000")
    message = command.refused(arm, "--trajectory", plan, *RATE, *wide, *motor_types(JOINTS))
    assert "it breaks the position limit of joint joint3" in message


def test_a_plan_of_another_arm_is_refused_though_it_has_as_many_joints(command, arm, plan):
    other = arm.with_name("other.xml")
    other.write_text(TUBES.replace('name="joint3"', 'name="wrist"'))
    message = command.refused(other, "--trajectory", plan, *RATE)
    assert "made for the 4 joints joint0, joint1, joint2, joint3, but this arm has the" in message
    assert "joint0, joint1, joint2, wrist; design one for this arm" in message


def test_a_plan_for_another_model_file_of_the_same_joints_is_checked_and_noted(command, arm, plan):
    other = arm.with_name("other.xml")
    other.write_text(TUBES.replace("<mujoco>", '<mujoco model="other">'))
    printed = command.run(other, "--trajectory", plan, *RATE)
    assert "plan.json was made for another model file; it is checked against" in printed.err


@pytest.mark.slow
@pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")
def test_plans_do_not_pass_from_one_public_arm_to_another(command):
    panda, kinova, xarm = (
        MODELS / name
        for name in ("franka_panda/panda.xml", "kinova_gen3/gen3.xml", "ufactory_xarm7/xarm7.xml")
    )
    command.run(panda, *SHORT, "--plan-only", "--save-trajectory", "plan.json")
    message = command.refused(kinova, "--trajectory", "plan.json", *RATE)
    assert "this arm has the 7 joints joint_1, joint_2" in message
    # The same joint names, but this arm cannot bend its elbow backwards.
    message = command.refused(xarm, "--trajectory", "plan.json", *RATE)
    assert "this trajectory must not be run: it breaks " in message


def test_the_example_arm_is_not_asked_for_more_torque_than_allowed(command):
    weak = ("--max-torque", "1e-3", *motor_types(7))
    assert "holding still takes 10.9 N·m at joint joint1" in command.refused(GUESS, *SHORT, *weak)


@pytest.mark.parametrize("case", sorted({*BROKEN} - {"torque"}))
def test_an_exported_motion_obeys_what_was_asked_for(case, command, arm):
    """From the file that would be played, held against the numbers that were typed."""
    command.run(arm, *SHORT, *BROKEN[case], *motor_types(JOINTS), "--save-trajectory", "plan.json")
    robot, saved = arms.robot_of(TUBES), load_trajectory(arm.parent / "plan.json").plan
    found = witness.peaks(robot, saved)
    numbers = [float(word) for word in BROKEN[case][1:]]
    if case == "velocity":
        assert np.max(found.velocity) <= numbers[0]
    elif case == "acceleration":
        assert np.max(found.acceleration) <= numbers[0]
    elif case == "keep out":
        assert witness.distance_to_plane(robot, saved, numbers, "link0") >= 0.0
    else:
        for axis, (low, high) in zip(np.eye(3), np.reshape(numbers, (3, 2))):
            assert witness.distance_to_plane(robot, saved, (*axis, low), "link3") >= 0.0
            assert witness.distance_to_plane(robot, saved, (*-axis, -high), "link3") >= 0.0
    table = np.genfromtxt(
        arm.parent / "sysid_output" / "damiao_trajectory.csv", delimiter=",", skip_header=JOINTS + 1
    )
    np.testing.assert_allclose(table[:, 1::3], saved.evaluate(table[:, 0]).q, rtol=0.0, atol=5.1e-5)


ENDLESS = {
    "slowed down": ("--speed", "1e-12"),
    "sampled": ("--sample-rate", "1e12"),
    "exported": (*motor_types(JOINTS), "--damiao-rate", "1e9"),
    "file": ("--trajectory", "plan.json"),
    "file, slowed down": ("--trajectory", "plan.json", "--speed", "1e-3"),
}


@pytest.mark.parametrize("case", ENDLESS)
def test_more_samples_than_anybody_can_wait_for_are_refused_at_once(case, command, arm):
    duration = {"file": 1e12}.get(case, 1e4)
    names = [f"joint{j}" for j in range(JOINTS)]
    sines = {"center": [0.0] * JOINTS, "amplitude": [[0.1]] * JOINTS, "fade": 1.0}
    sines = {**sines, "frequency_hz": [[0.1]] * JOINTS, "phase": [[0.0]] * JOINTS}
    head = {"format": "robot-sysid trajectory", "version": 1, "joints": names, "kind": "sines"}
    (arm.parent / "plan.json").write_text(json.dumps({**head, **sines, "duration": duration}))
    started = time.monotonic()
    message = command.refused(arm, *ENDLESS[case])
    assert "samples, more than the 1e+09 a run can take" in message
    assert time.monotonic() - started < 5.0


def test_an_arm_without_dry_friction_can_be_simulated_forward(command, arm_file):
    path = arm_file(arms.serial_arm(arms.SEVEN_AXES, joint='range="-2.5 2.5" damping=".1"'))
    forward = ("--plant-model", path, "--simulation", "forward")
    known = [f"--{cause}-uncertainty=0" for cause in ("link", "scale", "zero", "gravity")]
    printed = command.run(path, *forward, *known, "--duration", "3", "--seed", "1")
    assert "Mass: 0.800 kg" in printed.out
    assert "frictionloss" not in printed.err


@pytest.mark.parametrize(
    ("option", "numbers"),
    [("--velocity-deadband", "0.1,0.2"), ("--noise-torque", "1,1,1"), ("--max-torque", "9,9")],
)
@pytest.mark.parametrize("simulation", ["inverse", "forward"])
def test_lists_that_do_not_fit_the_joints_are_refused(simulation, option, numbers, command, arm):
    plant = ("--plant-model", arm, "--simulation", simulation)
    message = command.refused(arm, *SHORT, *plant, option, numbers)
    assert f"{option} takes one number, or one for each of the 4 joints" in message


def test_a_file_that_is_called_like_a_command_is_a_path_away(command, arm):
    (arm.parent / "plan").write_text(TUBES)
    assert "required: MODEL" in command.refused("plan")
    assert "Loading robot model from plan" in command.run("./plan", *SHORT).out

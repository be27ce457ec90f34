"""Every command that is printed runs as it is printed, and the path of commands ends.

A person identifies an arm from a log, or weighs what is bolted on, and does what the program says
next until it says nothing more. The arm is simulated: its links differ from the model.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.walk import MOST_STEPS, TrueArm, Walk
from rigs.files.places import MODELS
from rigs.logs.driver_logs import (
    DRIVER_LOGS,
    SO101,
    UNWEIGHED_LOGS,
    UR_CONSTANTS,
    so101_data_set,
)
from robot_sysid.parser import load_robot_model

JOINT = 'range="-2 2" armature=".02"'
SMALL = small_arms.serial_arm(joint=JOINT)
ZOO = [
    ("kinova_gen3/gen3_official.xml", None),
    ("franka_panda/panda.xml", None),
    ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ("kuka_iiwa_14/iiwa14.xml", None),
    ("universal_robots_ur5e/ur5e.xml", None),
    ("ufactory_xarm7/xarm7.xml", None),
    ("trossen/wxai/wxai_follower.xml", None),
    ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    ("aloha/aloha.xml", "left/wrist_rotate"),
    ("so101/so101_new_calib.urdf", "wrist_roll"),
]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder whose name needs quotes, in which every command runs."""
    path = tmp_path / "my arm"
    path.mkdir()
    monkeypatch.chdir(path)
    return path


def require_done(walk, wanted):
    """Every command has run, and the path ended with what was wanted."""
    steps = walk.steps
    for step in (*steps, *walk.remedies):
        if step in walk.refused:
            continue
        assert step.code == 0, (step.line, step.output[-2000:])
    assert len(steps) <= MOST_STEPS
    assert any(wanted in step.output for step in steps), steps[-1].output


FILE = "/updated_model."
"""What an output names that ends in a file to use."""


def walk_from_log(path, arm, options=(), runs_remedies=True):
    """Look at a log of an arm and do what is printed, until there is no next step."""
    log = Path("first log.csv")
    arm.record(log, arm.first_plan, arm.tool_mass)
    words = ["robot-sysid", "log", str(log), str(path), *options]
    walk = Walk(arm, runs_remedies)
    walk.follow(shlex.join(words))
    require_done(walk, FILE)
    return walk.steps


def walk_from_gripper(path, arm, options=()):
    """Plan a motion that weighs what is bolted on and do what is printed."""
    words = ["robot-sysid", "plan", str(path), *options, "--for", "payload"]
    walk = Walk(arm)
    walk.follow(shlex.join(words))
    require_done(walk, "Copy into the controller")
    return walk.steps


def walk_from_recording(path, model, arm, record_again=None):
    """Look at a recording without any option and do what is printed next; return the walk."""
    walk = Walk(arm, False, record_again, has_tool=False)
    walk.follow(shlex.join(["robot-sysid", "log", str(path), str(model)]))
    require_done(walk, FILE)
    return walk


def small_arm():
    """A small arm, whose model is in a file with a quote in its name."""
    path = Path("it's.xml")
    path.write_text(SMALL)
    return path, TrueArm(load_robot_model(path))


def test_from_a_log_to_the_file_to_use():
    steps = walk_from_log(*small_arm(), runs_remedies=False)
    assert steps[1].line == "robot-sysid identify 'it'\"'\"'s.xml' 'first log.csv'"
    # The tool of its first log is weighed by difference.
    assert len(steps) == 3


@pytest.mark.slow
def test_from_a_self_test_to_the_file_to_use():
    path, arm = small_arm()
    walk = Walk(arm)
    walk.follow(shlex.join(["robot-sysid", str(path)]))
    require_done(walk, FILE)
    names = [step.line.split()[1] for step in walk.steps]
    assert names[1:] == ["plan", "identify", "payload"]


@pytest.mark.slow
def test_the_second_motion_that_is_proposed_makes_the_file_better():
    """At least half as much as its sentence says."""
    path, _ = small_arm()
    arm = TrueArm(load_robot_model(path), carries=False)
    log = Path("first log.csv")
    short = replace(arm.first_plan, duration=4.0, fade=1.0)
    arm.record(log, short.scale_amplitudes(0.4), 0.0)
    arm.tool_mass = 0.0
    walk = Walk(arm, has_tool=False)
    walk.follow(shlex.join(["robot-sysid", "identify", str(path), str(log)]))
    require_done(walk, "If ")
    plan, both = walk.remedies
    assert plan.line.split()[1] == "plan" and "first log.csv" in both.line
    first, second = (
        json.loads((Path(folder) / "params.json").read_text())["file"]["elsewhere"]
        for folder in ("sysid_output", "sysid_output/both")
    )
    after = second["after"]["relative_error"]
    assert after < 0.9 * first["after"]["relative_error"]
    assert after < 2.0 * first["next"]["relative_error"]


@pytest.mark.slow
def test_a_base_without_mass_is_left_alone_from_a_plan_to_the_file_to_use():
    """Two slides and a hinge, as models have that place an arm on a plane; their travel ends."""
    content = small_arms.serial_bodies(small_arms.SEVEN_AXES[:4], joint=JOINT)
    dummy = '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
    base = [
        f'<joint name="{name}" type="{kind}" axis="{axis}" range="-1 1"/>'
        for name, kind, axis in (
            ("along", "slide", small_arms.X),
            ("across", "slide", small_arms.Y),
            ("turn", "hinge", small_arms.Z),
        )
    ]
    content = small_arms.link(base[2], content, "stand")
    for joint in (base[1], base[0]):
        content = small_arms.link(joint, content, inertial=dummy)
    path = Path("on a base.xml")
    path.write_text(small_arms.world(content))
    arm = TrueArm(load_robot_model(path), carries=False)
    arm.tool_mass = 0.0
    walk = Walk(arm, has_tool=False)
    walk.follow(shlex.join(["robot-sysid", "plan", str(path)]))
    require_done(walk, FILE)
    plan, identify, *_ = walk.steps
    assert "along, across, turn" in plan.output
    trajectory = next(Path().rglob("trajectory.csv")).read_text().partition("\n")[0]
    names = ("joint0", "joint1", "joint2", "joint3")
    assert all(name in trajectory for name in names) and "along" not in trajectory
    files = [*Path().rglob("updated_model.xml")]
    before = mujoco.MjModel.from_xml_path(str(path))
    for file in files:
        after = mujoco.MjModel.from_xml_path(str(file))
        assert np.array_equal(after.body_mass[:4], before.body_mass[:4])
        assert np.array_equal(after.dof_damping[:3], before.dof_damping[:3])
    assert files


@pytest.mark.slow
def test_from_a_gripper_to_its_card():
    steps = walk_from_gripper(*small_arm())
    assert len(steps) == 2


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")
@pytest.mark.parametrize(("model", "joint"), ZOO)
def test_public_arms_are_led_to_the_file_and_to_the_card(model, joint):
    path = MODELS / model
    options = () if joint is None else ("--joint", joint)
    arm = TrueArm(load_robot_model(path, joint=joint))
    walk_from_log(path, arm, options)
    walk_from_gripper(path, arm, options)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("log", DRIVER_LOGS, ids=lambda log: log.name)
def test_a_drivers_recording_leads_to_the_file(log):
    if log.model and not MODELS.is_dir():
        pytest.skip("the public models are not here")
    robot = log.robot(Path())
    walk = walk_from_recording(log.write(Path()), robot.path, TrueArm(robot))
    # A model of two arms needs to be told which.
    assert len(walk.refused) == log.name.startswith("OpenArm")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")
@pytest.mark.parametrize("log", UNWEIGHED_LOGS, ids=lambda log: log.name)
def test_motor_currents_lead_over_a_known_mass_to_the_file(log):
    """Nothing is fitted to currents before a known mass has shown what an ampere is worth."""

    def record_again(path, load):
        folder = Path("with a weight")
        folder.mkdir()
        log.write(folder, load=load).rename(path)

    robot = log.robot(Path())
    arm = TrueArm(robot, constants=UR_CONSTANTS)
    walk = walk_from_recording(log.write(Path()), robot.path, arm, record_again)
    assert walk.refused
    weighing = walk.steps[len(walk.refused)]
    assert "--known-mass 1" in weighing.line and weighing.code == 0


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(not SO101.exists(), reason="the public models are not here")
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_positions_and_goals_of_a_servo_arm_lead_to_the_file(version):
    arm = TrueArm(load_robot_model(SO101))
    walk = walk_from_recording(so101_data_set(Path(), version), SO101, arm)
    assert walk.refused == walk.steps[:1]

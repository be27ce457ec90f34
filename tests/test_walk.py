"""Every command that is printed runs as it is printed, and the path of commands ends.

A person identifies an arm from a log, or weighs what is bolted on, and does what the program says
next until it says nothing more. The arm is simulated: its links differ from the model.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from robot_sysid.estimation.algebra import consistent_bodies
from robot_sysid.motion import ExcitationOptions
from robot_sysid.parser import load_robot_model
from tests.support import arms
from tests.support.places import MODELS
from tests.support.walk import MOST_STEPS, TrueArm, Walk

JOINT = 'range="-2 2" armature=".02"'
SMALL = arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT)
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


@pytest.fixture
def short_search(monkeypatch):
    """Plans are hardly searched for: only what is printed counts."""

    def shortened(self, count):
        return replace(self, draws=3, starts=1, rounds=1, iterations=3, evaluations=30)

    monkeypatch.setattr(ExcitationOptions, "for_joints", shortened)
    monkeypatch.setattr(consistent_bodies, "_DRAWS", 24)


def require_done(walk, wanted):
    """Every command has run, and the path ended with what was wanted."""
    steps = walk.steps
    for step in (*steps, *walk.remedies):
        assert step.code == 0, (step.line, step.output[-2000:])
    assert len(steps) <= MOST_STEPS
    assert any(wanted in step.output for step in steps), steps[-1].output


def walk_from_log(path, arm, options=(), runs_remedies=True):
    """Look at a log of an arm and do what is printed, until there is no next step."""
    log = Path("first log.csv")
    arm.record(log, arm.first_plan, arm.tool_mass)
    words = ["robot-sysid", "log", str(log), str(path), *options]
    walk = Walk(arm, runs_remedies)
    walk.follow(shlex.join(words))
    require_done(walk, "Use this file: ")
    return walk.steps


def walk_from_gripper(path, arm, options=()):
    """Plan a motion that weighs what is bolted on and do what is printed."""
    words = ["robot-sysid", "plan", str(path), *options, "--for", "payload"]
    walk = Walk(arm)
    walk.follow(shlex.join(words))
    require_done(walk, "Copy into the controller")
    return walk.steps


def small_arm(tool=0.05):
    """A small arm, whose model is in a file with a quote in its name."""
    path = Path("it's.xml")
    path.write_text(SMALL)
    return path, TrueArm(load_robot_model(path), tool=tool)


def test_from_a_log_to_the_file_to_use(short_search):
    steps = walk_from_log(*small_arm(), runs_remedies=False)
    assert steps[1].line == "robot-sysid identify 'it'\"'\"'s.xml' 'first log.csv'"
    assert "Copy into the controller" in steps[-1].output


@pytest.mark.slow
def test_from_a_gripper_to_its_card(short_search):
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

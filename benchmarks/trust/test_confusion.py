"""Every cause of ``benchmarks.trust.confusion_mistakes`` makes a log and a model that can be
read, is named, and makes no trusted answer wrong."""

from __future__ import annotations

import pytest

from benchmarks.trust.confusion import Judge, check_scene
from benchmarks.trust.confusion_causes import draw_scene
from benchmarks.trust.confusion_mistakes import MISTAKES
from rigs.arms.drawn_models import model_path
from rigs.arms.wrong_arms import ARMS
from rigs.files.places import MODELS
from robot_sysid.errors import ModelError
from robot_sysid.parser import load_robot_model

WRIST = "silent", "rotor and friction are all that the joint's torque is of"
PLAY = "silent", "no number is off by more than two of its errors"
UNNAMED = {
    "all_times_0_7": ("silent", "the links make up for it"),
    "all_times_1_4": ("doubt", "one link's mass explains it as well"),
    "all_times_1_25": ("doubt", "one link's mass explains it as well"),
    "last_signs": ("silent", "the last link and its tool are nearly round"),
    "wrist_times_0_7": WRIST,
    "last_times_1_5": WRIST,
    "backlash": PLAY,
    "base_backlash": PLAY,
    "wrist_backlash": PLAY,
}
"""Mistakes that are not named on this arm, to what is said and why that is so."""
DURATION = 20.0
"""Of a log that has to be named [s]."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not MODELS.exists(), reason="models of public arms are not here"
    ),
]


@pytest.mark.parametrize("cause", MISTAKES.values(), ids=list(MISTAKES))
def test_a_cause_makes_a_log_and_a_model(cause, tmp_path):
    duration = cause.duration or 8.0
    scene = draw_scene(MODELS / ARMS["ur5e"], "ur5e", "real", duration, 1)
    judge = Judge(cause.spoil(scene), tmp_path)
    assert all(path.exists() for path in judge.write_logs(judge.scene.logs))
    if cause.faults == (("tied",),):
        with pytest.raises(ModelError, match="tied|loop of bodies"):
            load_robot_model(judge.model)
        return
    robot = load_robot_model(judge.model)
    assert robot.joint_names == judge.joint_names
    assert len(judge.innocents) in (0, robot.n_joints - 1)


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_and_makes_no_trusted_answer_wrong(name):
    """Nor does following what is printed, nor accepting its doubts."""
    cause = MISTAKES[name]
    duration = cause.duration or DURATION
    scene = draw_scene(MODELS / ARMS["ur5e"], "ur5e", "real", duration, 1)
    outcome = check_scene(cause.spoil(scene), is_answered=True)
    assert "harmful" not in [*outcome.classify_costs()], outcome
    usual = "rightly" if cause.faults else "silent", ""
    expected, _ = UNNAMED.get(name, usual)
    assert outcome.classify_naming(cause) == expected, outcome


@pytest.mark.parametrize("seed", range(8))
def test_a_model_that_is_drawn_is_that_of_an_arm(seed, tmp_path):
    robot = load_robot_model(model_path(f"drawn-{seed}", MODELS, tmp_path))
    assert robot.n_joints in (6, 7)
    assert 3.0 < robot.mass < 60.0
    assert 0.3 < robot.length < 2.5

"""Mistakes in the numbers of public models, by logs of arms that are as far off as real ones."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.core_fits import fit_logs
from rigs.arms.wrong_arms import ARMS, draw_arm, write_link
from rigs.files.places import MODELS
from robot_sysid import spatial
from robot_sysid.model.mistakes import MistakeKind
from robot_sysid.parser import load_robot_model

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not MODELS.exists(), reason="needs the public models"),
]


@pytest.fixture(scope="module")
def xarm7():
    return load_robot_model(MODELS / ARMS["xarm7"])


def test_centres_of_two_links_with_wrong_signs_are_named_and_right_in_the_answer(xarm7):
    truth = draw_arm(xarm7, "real", False, 20.0, False, 3)
    model = copy.copy(xarm7.mj_model)
    for number in (1, 3):
        mass, centre, inertia = spatial.com_from_theta(xarm7.thetas[number])
        wrong = spatial.theta_from_com(mass, -centre, inertia)
        write_link(model, xarm7.links[number], wrong)
    robot = load_robot_model(model, xarm7.joint_names[-1])
    answer = fit_logs(robot, replace(truth.log, name="log"))
    named = {m.links: m.kind for m in answer.question.mistakes}
    assert named == {(1,): MistakeKind.MIRRORED, (3,): MistakeKind.MIRRORED}
    for number in (1, 3):
        first = answer.at(answer.arm.links[number])[1:4]
        off = answer.values[first] - truth.arm.thetas[number][1:4]
        assert np.max(np.abs(off) / answer.errors[first]) < 3.0

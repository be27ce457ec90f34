"""Torques in units of their own: named by joint, and no error of a right log is taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.log_checks import check_against_model, low_pass
from robot_sysid.diagnosis.log_rows import log_rows, rms
from robot_sysid.diagnosis.torque_units import LARGER, SMALLER, foreign_unit_finding
from tests.support import arms
from tests.support.wrong_logs import truth_of

PER_NM = np.array([0.02, 0.006, 0.11, 0.05, 0.015])
"""Recorded torque per torque of each joint, by another constant in each."""


@pytest.fixture(scope="module")
def log(contest):
    """Return the equations of the five-joint arm's log."""
    return contest.posterior.model.log


@pytest.fixture(scope="module")
def loaded(log):
    """Return the indices of the joints that carry weight in the log."""
    weight = rms(log.model_weight)
    return np.flatnonzero(weight > 0.1 * np.max(weight))


def find(log, factor):
    """Return the finding on a log whose torques are multiplied by a factor (n,) or a number."""
    return foreign_unit_finding(log.with_torque(factor * log.torque), np.ones(5))


def first_scales(finding):
    """Return the torque scales (n,) that a weighing begins with."""
    flag, scales, *_ = finding.payload_options
    assert flag == "--torque-scale"
    return np.array([float(scale) for scale in scales.split(",")])


@pytest.mark.parametrize(("unit", "kind"), [(1.0, "smaller"), (1e4, "larger")])
def test_constants_of_each_joint_are_listed_and_weighing_begins_with_them(
    log, loaded, unit, kind
):
    finding = find(log, unit * PER_NM)
    assert finding.level is Level.REFUSE
    assert f"times {kind} than the model's" in finding.text
    for joint in range(5):
        name = log.robot.joint_names[joint]
        assert (f"{name} " in finding.text) == (joint in loaded)
    ratio = first_scales(finding)[loaded] / (unit * PER_NM[loaded])
    # The arm carries what its model lacks.
    assert np.all((ratio > 0.8) & (ratio < 2.0))
    again = foreign_unit_finding(log.with_torque(PER_NM * log.torque), np.full(5, 2.0))
    doubled = first_scales(again) / first_scales(find(log, PER_NM))
    assert_allclose(doubled, 2.0, rtol=0.01)


def test_torques_of_the_opposite_sign_are_turned_round_by_a_correction(log, loaded):
    sign = np.ones(5)
    sign[loaded[-1]] = -1.0
    finding = find(log, sign * PER_NM)
    name = log.robot.joint_names[loaded[-1]]
    assert f"; of {name} they have the opposite sign of the model's; " in finding.text
    assert finding.correction.quantities == ("torque",)
    assert_allclose(finding.correction.factors, sign)
    assert np.all(first_scales(finding) > 0.0)
    assert find(log, PER_NM).correction is None


def test_one_joint_with_the_models_weight_is_enough_for_newton_metres(log, loaded):
    for joint in loaded:
        factor = PER_NM.copy()
        factor[joint] = 1.0
        assert find(log, factor) is None


@pytest.mark.parametrize("factor", [1.0, 1.1 / SMALLER, 0.5 * LARGER])
def test_scales_of_wrong_links_and_tools_are_no_units(log, factor):
    assert find(log, factor) is None


def test_a_torque_that_lacks_its_weight_is_no_unit(log):
    resting = log.with_torque(log.torque - log.model_weight)
    assert foreign_unit_finding(resting, np.ones(5)) is None


def test_slides_are_not_compared_with_hinges():
    """The force on a slide that lifts the arm, in N, is no measure of the hinges' torques."""
    truth = truth_of(arms.robot_of(arms.SLIDE_IN_CHAIN), seed=1)
    log = log_rows(truth.robot, low_pass([truth.log], None))
    weight = rms(log.model_weight)
    names = truth.robot.joint_names
    lift = names.index("lift")
    bend = names.index("bend")
    assert weight[bend] < 0.1 * weight[lift]
    factor = np.ones(4)
    factor[lift] = 0.01
    one_unit = log.with_torque(factor * log.model_weight)
    assert foreign_unit_finding(one_unit, np.ones(4)) is None
    factor[:] = [1.0, 0.01, 0.05, 0.2]
    units = log.with_torque(factor * log.model_weight)
    text = foreign_unit_finding(units, np.ones(4)).text
    assert "(lift 100, bend 20, roll 5)" in text


@pytest.mark.parametrize(
    "links_known", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_the_log_is_refused_whether_or_not_links_are_known(truth, links_known):
    """A payload by difference needs no right links, but torques."""
    tau = truth.log.tau * PER_NM * [1.0, -1.0, 1.0, -1.0, 1.0]
    log = replace(truth.log, tau=tau)
    findings = check_against_model(truth.robot, [log], links_known=links_known)
    (refusal,) = (cause for cause in findings if cause.level is Level.REFUSE)
    assert refusal.name == "torque-unit"
    assert refusal.payload_options

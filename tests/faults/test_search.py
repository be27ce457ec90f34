"""Law: an explanation that is put in is found with its value; where nothing is, none is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from robot_sysid.estimate.offers import Offers
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.estimate.questions import Question
from robot_sysid.faults.misfits import time_findings, weighed_time
from robot_sysid.faults.plausibility import is_plausible
from robot_sysid.faults.reading_search import Evidence
from robot_sysid.faults.table import explanations
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import CLEAR
from tests.faults.conftest import findings_of, found_in, judged

QUESTION = Question(EstimationOptions())


def test_a_right_log_is_used_whole_and_has_no_explanation(four_joints):
    answer = judged(four_joints.robot, four_joints.log)
    assert answer.findings == ()
    fit = answer.fit
    assert fit.unexplained_share < 0.02 and is_plausible(fit)
    assert abs(fit.by_name["m"] - four_joints.theta[0]) < 3.0 * fit.error_of("m")
    (recording,) = fit.recordings
    assert recording.touched == ()


def test_each_explanation_is_found_with_the_value_that_is_put_in(right):
    """Where nothing is put in, none is found."""
    unspoilt = Offers(right)
    sums = right.sums
    shown = 0
    offered = explanations(right)
    for explanation in offered:
        effect = explanation.effect
        at = sums.at(effect.names)
        value = effect.factor @ np.ones(effect.factor.shape[1])
        # The torque of the columns, where they act, is one more column: the measured one's.
        wider = sums.with_columns(
            ("put in",), at, value[:, None], effect.joint, effect.shares
        )
        wrong = replace(sums, products=tuple(map(add_to_torque, wider.products)))
        offer = Offers(right.of(wrong), unspoilt.weights).offer(effect)
        before = unspoilt.offer(effect)
        error = offer.values - value - before.values
        # What the prior of the explanation pulls back is within its own spread.
        covariance = offer.covariance + 1e-12 * np.diag(np.diag(effect.factor) ** 2)
        distance = error @ np.linalg.pinv(covariance, hermitian=True) @ error
        assert distance < chi2.ppf(0.999, len(at)), effect.names
        shown += offer.gain > CLEAR
        assert before.gain < CLEAR, effect.names
    assert shown > 0.4 * len(offered)


def test_velocities_that_torques_hardly_agree_with_say_nothing_of_time(right):
    """Filters of drives make them some percent smaller, as time would that is too long."""
    share, error = weighed_time(right)
    assert abs(share) < 3.0 * error
    evidence = Evidence(np.ones(4), share, lambda: None)
    assert list(time_findings(right, evidence)) == []


def add_to_torque(gram):
    """Return products (2, B, k + 1, k + 1) whose torque has the column before it added."""
    turn = np.delete(np.eye(gram.shape[-1]), -2, axis=1)
    turn[-2, -1] = 1.0
    return turn.T @ gram @ turn


@pytest.mark.slow
def test_deviations_that_the_prior_allows_are_not_named(four_joints):
    """Torque scales that the user declares uncertain are unknowns of the fit."""
    log = replace(four_joints.log, tau=four_joints.log.tau * [1.0, 1.3, 1.0, 1.0])
    for priors, is_named in ((Priors(), True), (Priors(scale=40.0), False)):
        found = findings_of(four_joints.robot, log, priors=priors)
        assert any(f.about is FaultName.TORQUE_SCALE for f in found) is is_named


@pytest.mark.slow
def test_torque_that_nothing_explains_is_said_with_what_is_missing(four_joints):
    noise = np.random.default_rng(0).normal(size=four_joints.log.tau.shape)
    (finding,) = found_in(four_joints, tau=np.cumsum(noise, axis=0))
    assert finding.about in ("model", "unexplained")
    assert "the torques do not fit this model" in finding.text
    assert "of the model's weight" in finding.text and finding.options == ()

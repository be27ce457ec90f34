"""Law: an explanation that is put in is found with its value; where nothing is, none is named."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from robot_sysid.diagnosis.contest import CLEAR, Contest, findings
from robot_sysid.diagnosis.log_checks import low_pass
from robot_sysid.diagnosis.log_fit import LogFit, log_rows
from robot_sysid.estimate.options import EstimationOptions, Priors

OPTIONS = EstimationOptions()


@pytest.fixture(scope="module")
def contest(truth):
    """Return the contest of explanations of a right log."""
    log = LogFit.of(truth.robot, low_pass([truth.log], None), OPTIONS)
    return Contest(log, list)


def test_a_right_log_fits_shows_the_link_and_has_no_explanation(truth, contest):
    assert contest.log.misfit < 0.02 and contest.log.is_plausible
    mass, error = contest.log.last_mass
    assert abs(mass - truth.theta[0]) < 3.0 * error
    recordings = contest.log.fit.recordings
    assert findings(truth.robot, recordings, OPTIONS, np.ones(5), 0.0, list) == []


def test_each_explanation_is_found_with_the_value_that_is_put_in(contest):
    """Where nothing is put in, none is found."""
    right = contest.log.fit
    (recording,) = right.recordings
    rows = contest.log.rows
    shown = 0
    for explanation in contest.offered:
        term = explanation.term
        value = term.prior.factor @ np.ones(len(term.names))
        spoilt = replace(recording)
        added = rows.torque_of(term.names, value)
        spoilt.__dict__["torque"] = recording.torque + added
        wrong = log_rows(right.arm, [spoilt], right.point, [term])
        spoilt_contest = copy(contest)
        spoilt_contest.log = replace(contest.log, rows=wrong)
        score = spoilt_contest.score(explanation)
        unspoilt = contest.score(explanation)
        found, _ = score.values
        at = score.log.fit.at(term.names)
        covariance = score.log.fit.inverse[np.ix_(at, at)]
        error = found - value - unspoilt.values[0]
        distance = error @ np.linalg.solve(covariance, error)
        assert distance < chi2.ppf(0.999, len(at)), term.names
        shown += score.gain > CLEAR
        assert unspoilt.gain < CLEAR
    assert shown > 0.4 * len(contest.offered)


def test_deviations_that_the_prior_allows_are_not_named(truth):
    """Torque scales that the user declares uncertain are unknowns of the fit."""
    log = replace(truth.log, tau=truth.log.tau * [1.0, 1.3, 0.8, 1.2, 1.0])
    recordings = low_pass([log], None)
    declared = EstimationOptions(priors=Priors(scale=40.0))
    for options, is_named in ((OPTIONS, True), (declared, False)):
        found = findings(truth.robot, recordings, options, np.ones(5), 0.0, list)
        assert bool(found) is is_named


def test_torque_that_nothing_explains_is_said(truth):
    noise = 5.0 * np.random.default_rng(0).normal(size=truth.log.tau.shape)
    recordings = low_pass([replace(truth.log, tau=noise)], None)
    names = {
        f.about
        for f in findings(truth.robot, recordings, OPTIONS, np.ones(5), 0.0, list)
    }
    assert names & {"model", "unexplained"}

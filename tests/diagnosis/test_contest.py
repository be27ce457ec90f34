"""The contest of explanations: what it finds in spoilt logs, and nothing in a correct one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.diagnosis.contest import Contest, findings, misfit
from robot_sysid.diagnosis.rows import low_pass
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.question import EstimationOptions


def find(robot, log, **options):
    contest = Contest(robot, low_pass([log], None), EstimationOptions(**options))
    return [finding.name for finding in findings(contest, np.ones(5))]


def test_a_correct_log_fits_shows_the_link_and_has_no_explanation(truth, contest):
    assert misfit(contest.log, contest.posterior) < 0.02
    assert contest.is_plausible(contest.posterior)
    mass, error = contest.last_mass(contest.posterior)
    assert abs(mass - truth.theta[0]) < 3.0 * error
    assert findings(contest, np.ones(5)) == []


def drop_payload(truth):
    """Return the torque if half of the last link goes away halfway."""
    log = truth.log
    thetas = np.zeros_like(truth.robot.thetas)
    thetas[-1] = 0.5 * truth.theta
    zero = np.zeros_like(log.q)
    weight = LinkDynamics(truth.robot).motion(log.q, zero, zero).torque(thetas)
    is_late = log.time > 0.45 * log.time[-1]
    return log.tau - weight * is_late[:, None]


SPOILT = {
    "payload-step": lambda t: {"tau": drop_payload(t)},
    "gravity": lambda t: {"tau": t.log.tau - t.still},
    "torque-scale": lambda t: {"tau": t.log.tau * (1.0 + t.log.time / 30.0)[:, None]},
    "zero": lambda t: {"q": t.log.q + [0.0, 0.15, 0.0, 0.0, 0.0]},
}
"""Name of a check to the quantities of a log that it has to name."""


@pytest.mark.parametrize(("name", "spoil"), SPOILT.items())
def test_the_fault_of_a_spoilt_log_is_named(truth, name, spoil):
    names = find(truth.robot, replace(truth.log, **spoil(truth)))
    assert name in names, names


def test_deviations_that_the_prior_allows_are_not_named(truth):
    """Torque scales that the user declares uncertain are unknowns of the base model."""
    log = replace(truth.log, tau=truth.log.tau * [1.0, 1.3, 0.8, 1.2, 1.0])
    assert find(truth.robot, log)
    assert find(truth.robot, log, scale_uncertainty=40.0) == []

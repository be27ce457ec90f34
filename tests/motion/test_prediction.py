"""What all samples of a motion tell is what least squares then shows."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.dynamics.equations import Equations
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.motion.design.search import draw_trajectories
from robot_sysid.motion.information import criterion, known_arm, predicted_information, spread_of
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks
from tests.support import arms
from tests.support.excitation_arms import design, problem, robot

FULL_FRICTION = FrictionModel(("coulomb", "viscous", "offset", "armature"))


def a_plan(xml, seed=0, **changes):
    some = design(xml, **changes)
    draw = min(draw_trajectories(some, seed, range(6)), key=lambda d: d.score)
    return some.trajectory(draw.x)


def empirical_deviation_of(arm, plan, rate, sigma, draws, seed=0):
    """Spread (10,) of least-squares estimates over noise draws, by the tool's own equations."""
    rng = np.random.default_rng(seed)
    equations = Equations(arm, "chain", (FULL_FRICTION,) * arm.n_joints)
    size = len(equations.names)
    normal, right = np.zeros((size, size)), np.zeros((size, draws))
    for measurement in simulate_inverse(arm, motion_chunks(plan, rate)):
        for (rows, tau), columns in zip(equations.rows(measurement), equations.columns):
            noisy = tau[:, None] + sigma * rng.normal(size=(len(tau), draws))
            normal[np.ix_(columns, columns)] += rows.T @ rows
            right[columns] += rows.T @ noisy
    scale = np.sqrt(np.diag(normal))
    solved = np.linalg.solve(normal / np.outer(scale, scale), right / scale[:, None])
    return (solved / scale[:, None])[:10].std(axis=1, ddof=1)


@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN])
def test_the_information_of_all_samples_is_that_of_monte_carlo(xml):
    some, plan = problem(xml), a_plan(xml)
    known, time = known_arm(some), np.arange(1201) / 200.0
    motion, told = plan.evaluate(time), predicted_information(some, some.sigma, known_arm(some))
    found = told.evaluate(motion.q, motion.qd, motion.qdd).information
    deviation = np.sqrt(np.diag(criterion(some, known).covariance(found)))
    # 1000 draws know a standard deviation to 2.2 %; ten of them stay within 10 %.
    seen = empirical_deviation_of(robot(xml), plan, 200.0, 0.3, 1000)
    assert np.all(np.abs(seen / deviation - 1.0) < 0.10)


def test_the_centre_of_mass_is_that_of_monte_carlo_to_first_order():
    theta, rng = problem(arms.SEVEN).robot.prior.theta, np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(10, 10))
    drawn = rng.multivariate_normal(theta, root @ root.T, size=4000)
    spread = np.sqrt(np.sum(np.var(drawn[:, 1:4] / drawn[:, :1], axis=0)))
    assert spread_of(theta, root @ root.T)[1] == pytest.approx(spread, rel=0.05)

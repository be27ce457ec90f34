"""The contest of explanations: its figure, its laws, and what it finds in spoilt logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.diagnosis.contest import MARGIN, Contest, findings, misfit
from robot_sysid.diagnosis.evidence import Hypotheses
from robot_sysid.diagnosis.relabelling import relabellings, torque_scales
from robot_sysid.diagnosis.rows import low_pass
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.question import EstimationOptions

OPTIONS = EstimationOptions()


def contest_of(robot, log, options=OPTIONS):
    return Contest(robot, low_pass([log], None), options)


def test_a_right_log_fits_tells_the_link_and_has_no_explanation(truth, right):
    assert misfit(right.log, right.posterior) < 0.02 and right.is_plausible(
        right.posterior
    )
    mass, error = right.last_mass(right.posterior)
    assert abs(mass - truth.theta[0]) < 3.0 * error
    assert findings(right, np.ones(5)) == []


def test_the_evidence_is_that_of_a_normal_distribution(right):
    """Against the dense covariance of all rows of one joint after another."""
    base = right.base
    noise = right.posterior.noise
    size = len(base.prior.estimated)
    whole = np.zeros((base.right_sides.size, size))
    for joint in range(5):
        places, rows = base.equations(joint)
        whole[joint * len(rows) : (joint + 1) * len(rows), places] = rows
    expected = []
    used = np.repeat(base.count / len(base.right_sides), len(base.right_sides))
    for precision in base.prior.precisions:
        covariance = whole @ np.linalg.solve(precision, whole.T) + np.diag(
            noise.T.ravel()
        )
        right_side = base.right_sides.T.ravel()
        exponent = right_side @ np.linalg.solve(covariance, right_side)
        size_of = np.linalg.slogdet(covariance)[1] - np.sum(np.log(noise))
        size_of += np.sum(used * np.log(2.0 * np.pi * noise.T.ravel()))
        expected.append(-0.5 * (exponent + size_of))
    mean = np.logaddexp.reduce(expected) - np.log(len(expected))
    assert base.at_noise(noise).log_evidence == pytest.approx(mean, abs=1e-3)


def test_the_transform_keeps_the_size_of_what_is_used(right):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(len(right.log.torque), 2))
    for joint in range(5):
        turned = right.base.transform.of_joint(joint, rows)
        used = rows[right.log.used[:, joint]]
        assert_allclose(np.sum(turned**2, axis=0), np.sum(used**2, axis=0))


def test_columns_that_are_zero_make_no_log_likelier(right):
    nothing = [np.zeros((len(right.base.right_sides), 2))] * 5
    wider = right.base.with_columns(nothing).at_noise(right.posterior.noise)
    assert wider.log_evidence == pytest.approx(right.posterior.log_evidence, abs=1e-6)


def test_every_relabelling_of_torque_is_undone_by_making_it_again(truth, right):
    """Signs, exchanges and the reversed order are their own inverses."""
    for mistake in [m for m in relabellings(truth.robot) if m.motion is None][::3]:
        spoilt = right.log.with_torque(mistake.torque(right.log.torque))
        again = spoilt.with_torque(mistake.torque(spoilt.torque))
        assert_allclose(again.right_sides, right.log.right_sides, atol=1e-9)
        found = Hypotheses(right.log, right.prior).with_torque_of(spoilt)
        assert found.posterior().log_evidence < right.posterior.log_evidence - MARGIN


def test_scaling_all_torques_scales_what_is_found(right):
    scaled = right.log.with_torque(300.0 * right.log.torque)
    one, other = (torque_scales(log, OPTIONS) for log in (right.log, scaled))
    assert_allclose(other.scale, 300.0 * one.scale, rtol=0.02)


def test_scales_of_single_joints_are_found_within_their_errors(truth, right):
    true = np.array([1.3, 1.9, 1.5, 1.7, 1.2])
    spoilt = right.log.with_torque(true * right.log.torque)
    scales = torque_scales(spoilt, OPTIONS)
    off = np.log(scales.scale / true)[scales.identified]
    assert len(off) > 2
    assert off @ np.linalg.solve(scales.covariance, off) < 3.0 * len(off)


def second_half(truth):
    return truth.log.time > 0.45 * truth.log.time[-1]


def dropped(truth):
    """Half a payload goes away halfway."""
    thetas = 0.0 * truth.robot.thetas
    thetas[-1] = 0.5 * truth.theta
    log = truth.log
    zero = np.zeros_like(log.q)
    made = LinkDynamics(truth.robot).motion(log.q, zero, zero).torque(thetas)
    return {"tau": log.tau - made * second_half(truth)[:, None]}


SPOILT = {
    "payload-step": dropped,
    "gravity": lambda t: {"tau": t.log.tau - t.still},
    "torque-scale": lambda t: {"tau": t.log.tau * (1.0 + t.log.time / 30.0)[:, None]},
    "zero": lambda t: {"q": t.log.q + [0.0, 0.15, 0.0, 0.0, 0.0]},
}
"""Name of a check to what spoils a log that it has to name."""


@pytest.mark.parametrize(("name", "spoil"), SPOILT.items())
def test_what_spoils_a_log_is_named(truth, name, spoil):
    contest = contest_of(truth.robot, replace(truth.log, **spoil(truth)))
    names = [each.name for each in findings(contest, np.ones(5))]
    assert name in names, names


def test_what_the_estimate_allows_for_is_not_named(truth):
    """A scale that the user says may be off is an unknown of the base model."""
    wrong = replace(truth.log, tau=truth.log.tau * [1.0, 1.3, 0.8, 1.2, 1.0])
    assert findings(contest_of(truth.robot, wrong), np.ones(5))
    wide = replace(OPTIONS, scale_uncertainty=40.0)
    assert findings(contest_of(truth.robot, wrong, wide), np.ones(5)) == []

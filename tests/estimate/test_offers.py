"""Offered effects: what is said of them is what a fit with their columns finds."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.core_fits import fit_recordings
from rigs.logs.payload_logs import TrueArm, add_torque, four_joint_arm
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.equations.normal import Equations
from robot_sysid.estimate.fit import correlation_times
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.rows import row_chunks
from robot_sysid.estimate.terms import SCALE_DRIFT, ZEROS, ArmTerms, Term, independent
from robot_sysid.records.parameters import Parameter

ROBOT = four_joint_arm()


def log_evidence(equations, weights):
    """Return the log marginal likelihood of equations, but for noise and prior."""
    normal = equations.normal(weights)
    values, inverse = solve(normal, equations.reference)
    change = np.append(-values, 1.0)
    return 0.5 * (np.linalg.slogdet(inverse)[1] - change @ normal @ change)


@pytest.mark.parametrize(("seed", "joint"), [(0, None), (1, 0), (2, 3)])
def test_an_offer_is_the_estimate_with_the_columns_in_the_sums(
    payload_fit, seed, joint
):
    """At any joint or all, with any shares in blocks, also of columns that are there already."""
    rng = np.random.default_rng(seed)
    sums, equations = payload_fit.sums, payload_fit.equations
    weights = payload_fit.weights
    at = rng.choice(len(sums.names), 5, replace=False)
    factor = rng.normal(size=(5, 2))
    shares = rng.normal(size=len(sums.logs))
    names = tuple(sums.names[k] for k in at)
    offer = Offers(payload_fit, weights).offer(Effect(names, factor, joint, shares))
    wide = sums.with_columns(("a", "b"), at, factor, joint, shares)
    term = Term(
        "", (Parameter("a"), Parameter("b")), None, prior=independent(np.ones(2))
    )
    held = np.append(equations.held, np.zeros(2))
    wider = Equations(wide, [*equations.terms, term], held)
    values, inverse = solve(wider.normal(weights), wider.reference)
    covariance = factor @ inverse[-2:, -2:] @ factor.T
    assert_allclose(offer.covariance, covariance, rtol=1e-3, atol=1e-9)
    off = offer.values - factor @ values[-2:]
    assert np.max(np.abs(off) / offer.errors) < 1e-3
    before, inverse = solve(equations.normal(weights), equations.reference)
    off = before + offer.change - values[:-2]
    assert np.max(np.abs(off) / np.sqrt(np.diag(inverse))) < 1e-3
    full = wider.full(values)
    gain = log_evidence(wider, weights) - log_evidence(equations, weights)
    assert offer.gain == pytest.approx(gain, abs=1e-3)
    assert_allclose(offer.squares, wide.squared_residuals(full), rtol=1e-6)
    assert_allclose(offer.successive, wide.successive(full), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("cause", [ZEROS, SCALE_DRIFT])
def test_an_effect_that_is_weighed_is_that_of_a_fit_with_its_own_noise(cause):
    """Both fits have the memory of the residuals that the columns leave."""
    truth = TrueArm(ROBOT, 1, model_error=0.02)
    arm = ArmTerms(ROBOT, loaded=True)
    term = arm.terms[cause]
    term = replace(term, prior=independent(np.full(len(term.names), 0.1)))
    logs = []
    for recording in truth.abba(1, sigma=0.02):
        (rows,) = row_chunks(recording, 1)
        torque = 0.1 * np.sum(term.columns(rows, arm.start()), axis=-1)
        logs.append(add_torque(recording, torque))
    fitted = fit_recordings(ROBOT, logs, loaded=True)
    others = [each for each in fitted.equations.terms if each.cause != cause]
    base = fitted.refit(others)
    base = replace(base, correlation=correlation_times([base.residuals])).refit(others)
    offers = Offers(base)
    offer = offers.weigh(Effect.of(term))
    correlation = offers.correlation(offer.squares, offer.successive)
    same = replace(base, correlation=correlation)
    wider, before = same.refit([*others, term]), same.refit(others)
    at = wider.at(term.names)
    errors = np.sqrt(np.diag(wider.inverse)[at])
    assert np.max(np.abs(offer.values - wider.free[at]) / errors) < 0.6
    assert_allclose(offer.errors, errors, rtol=0.02)
    gain = log_evidence(wider.equations, wider.weights)
    gain -= log_evidence(before.equations, before.weights)
    independent_rows = np.sum(base.sums.counts, axis=0) / correlation
    gain += independent_rows @ np.log(before.noise / wider.noise)
    gain -= np.linalg.slogdet(term.prior.factor)[1]
    assert offer.gain == pytest.approx(gain, abs=1.0) and gain > 100.0

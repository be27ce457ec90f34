"""Laws of nuisances with a prior: Bayes' formula, errors that add up, priors that give way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator, solver
from robot_sysid.estimation.algebra.priors import (
    WIDEST,
    NuisanceGroup,
    WithPriors,
    link_aspects,
    link_factor,
    misfits,
    widened_groups,
    with_prior,
)
from robot_sysid.estimation.algebra.uncertainty import uncertainty
from tests.support.arms import SEEDS, rigid_bodies
from tests.support.estimates import prior_errors
from tests.support.model_files import random_theta

NAMES = (*spatial.PARAMETER_NAMES, "d0", "d1", "d2", "d3", "e0", "e1")
ROWS = 60


def groups_of(rng, size=1.0):
    """Four nuisances of one cause that may widen, two of another that may not."""
    factor = size * (np.eye(4) + 0.3 * rng.normal(size=(4, 4)))
    one = NuisanceGroup(
        "links", NAMES[10:14], rng.normal(size=4), factor, tuple("aabb"), True
    )
    other = NuisanceGroup(
        "scale", NAMES[14:], np.zeros(2), size * np.eye(2), ("x", "y")
    )
    return one, other


def drawn(rng, groups, size=1.0):
    """Nuisances (6,) as their priors say, or ``size`` times as far off."""
    return np.concatenate(
        [g.mean + size * g.factor @ rng.normal(size=len(g.names)) for g in groups]
    )


def information_of(rng, truth, noise=0.1):
    rows = rng.normal(size=(ROWS, 16))
    accumulator = InformationAccumulator(NAMES, ["j"], [np.arange(16)])
    accumulator.add(0, rows, rows @ truth + noise * rng.normal(size=ROWS))
    return accumulator.result(), rows


@given(SEEDS)
def test_the_estimate_is_the_mean_of_the_posterior(seed):
    """x = (Y^T Y / s^2 + P)^-1 (Y^T tau / s^2 + P mean), dense."""
    rng = np.random.default_rng(seed)
    groups = groups_of(rng)
    truth = np.concatenate((rng.normal(size=10), drawn(rng, groups)))
    information, _ = information_of(rng, truth)
    prior = np.zeros((16, 16))
    mean = np.zeros(16)
    for group, part in zip(groups, (slice(10, 14), slice(14, 16))):
        prior[part, part] = np.linalg.inv(group.factor @ group.factor.T)
        mean[part] = group.mean
    matrix, right = information.stacked()
    normal = matrix.T @ matrix / 0.1**2 + prior
    expected = np.linalg.solve(normal, matrix.T @ right / 0.1**2 + prior @ mean)
    found, _ = solver(with_prior(information, groups), np.zeros(16))(np.array([10.0]))
    assert_allclose(found, expected, rtol=1e-6, atol=1e-8)


def test_exact_data_is_solved_as_exactly_under_priors():
    """Of squares alone the first digits were wrong: two columns differ by a hundred thousandth."""
    rng = np.random.default_rng(0)
    groups = groups_of(rng)
    rows = rng.normal(size=(ROWS, 16))
    truth = np.concatenate((rng.normal(size=10), drawn(rng, groups, size=0.0)))
    rows[:, 1] = rows[:, 0] + 1e-5 * rows[:, 1]
    accumulator = InformationAccumulator(NAMES, ["j"], [np.arange(16)])
    accumulator.add(0, rows, rows @ truth)
    found = WithPriors(accumulator.result(), np.array([1e-6])).solve(groups)[0]
    assert_allclose(found, truth, atol=1e-6)


@given(SEEDS)
def test_what_exact_data_does_not_tell_is_as_its_prior_says(seed):
    """A ridge held it elsewhere, and said that it was known: torque scales of long arms."""
    rng = np.random.default_rng(seed)
    groups = groups_of(rng)
    rows = rng.normal(size=(ROWS, 16))
    truth = np.concatenate((rng.normal(size=10), drawn(rng, groups, size=0.0)))
    rows[:, 10] = rows[:, :10] @ rng.normal(size=10)
    accumulator = InformationAccumulator(NAMES, ["j"], [np.arange(16)])
    accumulator.add(0, rows, rows @ truth)
    values, spread, _ = WithPriors(accumulator.result(), np.array([5e-6])).solve(groups)
    known = np.linalg.inv(groups[0].factor @ groups[0].factor.T)
    assert values[10] == pytest.approx(truth[10], abs=1e-3)
    assert spread[10, 10] == pytest.approx(1.0 / known[0, 0], rel=0.2)


@given(SEEDS)
def test_priors_are_as_likely_as_the_data_is_under_them(seed):
    """Of what no plain parameter can explain, the density of the data, dense."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate((rng.normal(size=10), drawn(rng, groups_of(rng))))
    information, _ = information_of(rng, truth)
    matrix, right = information.stacked()
    apart = np.linalg.qr(matrix[:, :10], mode="complete")[0][:, 10:].T
    found = []
    expected = []
    for size in (0.5, 2.0):
        groups = groups_of(np.random.default_rng(seed), size)
        mean = np.concatenate([group.mean for group in groups])
        spread = np.zeros((6, 6))
        for group, part in zip(groups, (slice(0, 4), slice(4, 6))):
            spread[part, part] = group.factor @ group.factor.T
        own = apart @ matrix[:, 10:]
        covariance = own @ spread @ own.T + 0.1**2 * np.eye(len(own))
        density = scipy.stats.multivariate_normal(own @ mean, covariance)
        expected.append(density.logpdf(apart @ right))
        found.append(WithPriors(information, np.array([0.1])).log_evidence(groups)[1])
    assert found[1] - found[0] == pytest.approx(
        expected[1] - expected[0], rel=1e-6, abs=1e-6
    )


@given(SEEDS)
def test_errors_by_cause_add_up_in_squares(seed):
    rng = np.random.default_rng(seed)
    groups = groups_of(rng)
    information = with_prior(information_of(rng, rng.normal(size=16))[0], groups)
    found = uncertainty(information, np.array([10.0]), np.array([0.1]))
    parts = [prior_errors(found, group, NAMES) for group in groups]
    total = np.diag(found.noise) + np.sum(np.square(parts), axis=0)
    assert_allclose(total, found.standard_errors**2, rtol=1e-8)


@given(SEEDS, st.sampled_from([0.1, 1.0, 6.0, 1e3]))
def test_a_prior_is_widened_to_what_the_data_asks_for_and_never_narrowed(seed, size):
    """The data knows each direction well: one that it knows no better than the prior asks less."""
    rng = np.random.default_rng(seed)
    groups = groups_of(rng)
    assume(np.linalg.svd(groups[0].factor)[1][-1] > 10.0 * 0.1 / np.sqrt(ROWS))
    truth = np.concatenate((rng.normal(size=10), drawn(rng, groups, size)))
    information, _ = information_of(rng, truth)
    one, other = widened_groups(information, np.array([0.1]), groups)
    asked = np.linalg.norm(np.linalg.solve(one.factor, truth[10:14] - one.mean)) / 2.0
    assert other.widened == 1.0
    assert 1.0 <= one.widened <= WIDEST
    assert one.widened == pytest.approx(np.clip(asked, 1.0, WIDEST), rel=0.2, abs=0.2)


def test_what_the_data_asks_for_is_named_and_nothing_else():
    rng = np.random.default_rng(1)
    false = 0
    for _ in range(50):
        groups = groups_of(rng)
        truth = np.concatenate((rng.normal(size=10), groups[0].mean, np.zeros(2)))
        false += len(misfits(information_of(rng, truth)[0], np.array([0.1]), groups))
        truth[13] += 5.0
        (found,) = misfits(information_of(rng, truth)[0], np.array([0.1]), groups)
        assert found.cause == "links" and found.asked > 1.0
    # One in a hundred per cause is what the test allows itself.
    assert false <= 4


@given(rigid_bodies(), rigid_bodies(), st.floats(0.001, 0.3))
def test_links_are_known_to_their_share(first, second, share):
    factor = link_factor([first, second], share, [0.3, 0.0])
    covariance = factor @ factor.T
    for theta, start in ((first, 0), (second, 10)):
        own = covariance[start : start + 10, start : start + 10]
        # By itself and with all other links: the root of twice the square.
        assert np.sqrt(own[0, 0]) == pytest.approx(
            np.sqrt(2.0) * share * theta[0], rel=1e-6
        )
        assert np.linalg.eigvalsh(own / np.outer(*[np.sqrt(np.diag(own))] * 2))[0] > 0.0
    together = covariance[0, 10] / np.sqrt(covariance[0, 0] * covariance[10, 10])
    assert together == pytest.approx(0.5, rel=1e-6)


def test_what_one_aspect_contradicts_is_not_lost_among_the_others():
    """Masses alone are off, by six times what was thought; everything else is as it was."""
    rng = np.random.default_rng(0)
    lengths = [0.3, 0.2, 0.1]
    thetas = [random_theta(rng) for _ in lengths]
    names = tuple(f"p{k}" for k in range(30))
    group = NuisanceGroup(
        "links",
        names,
        np.concatenate(thetas),
        link_factor(thetas, 0.05, lengths),
        tuple("abc"[k // 10] for k in range(30)),
    )
    truth = np.concatenate([1.3 * thetas[0], 0.7 * thetas[1], 1.3 * thetas[2]])
    rows = rng.normal(size=(400, 30)) / np.abs(np.concatenate(thetas))
    tau = rows @ truth + 0.5 * rng.normal(size=400)
    accumulator = InformationAccumulator(names, ("j",), (np.arange(30),))
    accumulator.add(0, rows, tau)
    asked = []
    for aspects in (tuple, lambda: link_aspects(thetas, lengths)):
        told = replace(group, aspects=aspects)
        (found,) = misfits(accumulator.result(), np.array([0.5]), (told,))
        asked.append(found.asked)
    assert asked[0] < 3.0 and asked[1] == pytest.approx(6.0, rel=0.2)

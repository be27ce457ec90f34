"""Priors of nuisances and of links: Bayes' formula, errors that add up, priors that widen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.common_scale import with_common
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator, solver
from robot_sysid.estimation.algebra.priors import (
    WIDEST,
    LinkEvidence,
    LinkScales,
    NuisanceGroup,
    WithPriors,
    average_scales,
    independent_prior,
    link_aspects,
    link_factor,
    misfits,
    widened_groups,
    with_prior,
)
from robot_sysid.estimation.algebra.uncertainty import uncertainty
from robot_sysid.estimation.question import EstimationOptions, Priors, Question
from robot_sysid.estimation.unknowns import LINKS, SCALES, Unknowns
from tests.support.arms import SEEDS, rigid_bodies
from tests.support.estimates import prior_errors
from tests.support.model_files import random_theta

NAMES = (*spatial.PARAMETER_NAMES, "d0", "d1", "d2", "d3", "e0", "e1")
ROWS = 60
NOISE = np.array([0.1])
FIRST = slice(10, 14)
SECOND = slice(14, 16)


def random_groups(rng, size=1.0):
    """Return four nuisances of one cause that may widen, two of another that may not."""
    factor = size * (np.eye(4) + 0.3 * rng.normal(size=(4, 4)))
    mean = rng.normal(size=4)
    links = NuisanceGroup("links", NAMES[FIRST], mean, factor, tuple("aabb"), True)
    scales = NuisanceGroup(
        "scale", NAMES[SECOND], np.zeros(2), size * np.eye(2), ("x", "y")
    )
    return links, scales


def random_truth(rng, groups, size=1.0):
    """Return ten random parameters and nuisances drawn from their priors times ``size``."""
    mean, covariance = prior_moments(groups)
    deviation = np.linalg.cholesky(covariance) @ rng.normal(size=6)
    return np.concatenate((rng.normal(size=10), mean + size * deviation))


def prior_moments(groups):
    """Return the prior mean (6,) and covariance (6, 6) of the nuisances."""
    factor = scipy.linalg.block_diag(*[group.factor for group in groups])
    return np.concatenate([group.mean for group in groups]), factor @ factor.T


def information_of(rows, tau, names=NAMES):
    accumulator = InformationAccumulator(names, ["j"], [np.arange(rows.shape[1])])
    accumulator.add(0, rows, tau)
    return accumulator.result()


def noisy_information(rng, truth):
    rows = rng.normal(size=(ROWS, 16))
    return information_of(rows, rows @ truth + NOISE * rng.normal(size=ROWS))


@given(SEEDS)
def test_the_estimate_is_the_mean_of_the_posterior(seed):
    """x = (Y^T Y / s^2 + P)^-1 (Y^T tau / s^2 + P mean), dense."""
    rng = np.random.default_rng(seed)
    groups = random_groups(rng)
    information = noisy_information(rng, random_truth(rng, groups))
    mean, covariance = prior_moments(groups)
    precision = np.zeros((16, 16))
    precision[10:, 10:] = np.linalg.inv(covariance)
    matrix, right = information.equations()
    normal = matrix.T @ matrix / NOISE**2 + precision
    right_side = matrix.T @ right / NOISE**2 + precision[:, 10:] @ mean
    solve = solver(with_prior(information, groups), np.zeros(16))
    values, _ = solve(1.0 / NOISE)
    assert_allclose(values, np.linalg.solve(normal, right_side), rtol=1e-6, atol=1e-8)


def test_exact_data_is_solved_exactly_under_priors():
    """Although two columns differ by a hundred thousandth only, which squares would lose."""
    rng = np.random.default_rng(0)
    groups = random_groups(rng)
    rows = rng.normal(size=(ROWS, 16))
    truth = random_truth(rng, groups, size=0.0)
    rows[:, 1] = rows[:, 0] + 1e-5 * rows[:, 1]
    information = information_of(rows, rows @ truth)
    values = WithPriors(information, np.array([1e-6])).solve(groups)[0]
    assert_allclose(values, truth, atol=1e-6)


@given(SEEDS)
def test_a_confounded_nuisance_has_the_mean_and_variance_of_its_prior(seed):
    """Even if the data is exact: as torque scales of long arms."""
    rng = np.random.default_rng(seed)
    groups = random_groups(rng)
    rows = rng.normal(size=(ROWS, 16))
    truth = random_truth(rng, groups, size=0.0)
    rows[:, 10] = rows[:, :10] @ rng.normal(size=10)
    information = information_of(rows, rows @ truth)
    values, covariance, _ = WithPriors(information, np.array([5e-6])).solve(groups)
    precision = np.linalg.inv(groups[0].factor @ groups[0].factor.T)
    assert values[10] == pytest.approx(truth[10], abs=1e-3)
    assert covariance[10, 10] == pytest.approx(1.0 / precision[0, 0], rel=0.2)


@given(SEEDS)
def test_evidence_is_the_density_of_the_data_under_the_priors(seed):
    """The dense density of the data that no plain parameter can explain."""
    rng = np.random.default_rng(seed)
    information = noisy_information(rng, random_truth(rng, random_groups(rng)))
    matrix, right = information.equations()
    complement = np.linalg.qr(matrix[:, :10], mode="complete")[0][:, 10:].T
    rows = complement @ matrix[:, 10:]
    evidence = []
    expected = []
    for size in (0.5, 2.0):
        groups = random_groups(np.random.default_rng(seed), size)
        mean, covariance = prior_moments(groups)
        data_covariance = rows @ covariance @ rows.T + NOISE**2 * np.eye(len(rows))
        density = scipy.stats.multivariate_normal(rows @ mean, data_covariance)
        expected.append(density.logpdf(complement @ right))
        evidence.append(WithPriors(information, NOISE).log_evidence(groups)[1])
    assert np.diff(evidence) == pytest.approx(np.diff(expected), rel=1e-6, abs=1e-6)


@given(SEEDS)
def test_errors_by_cause_add_up_in_squares(seed):
    rng = np.random.default_rng(seed)
    groups = random_groups(rng)
    information = with_prior(noisy_information(rng, rng.normal(size=16)), groups)
    errors = uncertainty(information, 1.0 / NOISE, NOISE)
    by_cause = [prior_errors(errors, group, NAMES) for group in groups]
    total = np.diag(errors.noise) + np.sum(np.square(by_cause), axis=0)
    assert_allclose(total, errors.standard_errors**2, rtol=1e-8)


@given(SEEDS, st.sampled_from([0.1, 1.0, 6.0, 1e3]))
def test_a_prior_is_widened_as_the_data_requires_and_never_narrowed(seed, size):
    """The data knows each direction well: one that it knows no better than the prior adds less."""
    rng = np.random.default_rng(seed)
    groups = random_groups(rng)
    least_spread = np.linalg.svd(groups[0].factor)[1][-1]
    assume(least_spread > 10.0 * NOISE[0] / np.sqrt(ROWS))
    truth = random_truth(rng, groups, size)
    links, scales = widened_groups(noisy_information(rng, truth), NOISE, groups)
    deviation = np.linalg.solve(links.factor, truth[FIRST] - links.mean)
    required = np.clip(np.linalg.norm(deviation) / 2.0, 1.0, WIDEST)
    assert scales.widened == 1.0
    assert 1.0 <= links.widened <= WIDEST
    assert links.widened == pytest.approx(required, rel=0.2, abs=0.2)


def test_only_priors_that_the_data_contradicts_are_named():
    rng = np.random.default_rng(1)
    false_alarm_count = 0
    for _ in range(50):
        groups = random_groups(rng)
        truth = np.concatenate((rng.normal(size=10), prior_moments(groups)[0]))
        false_alarm_count += len(misfits(noisy_information(rng, truth), NOISE, groups))
        truth[13] += 5.0
        (conflict,) = misfits(noisy_information(rng, truth), NOISE, groups)
        assert conflict.cause == "links" and conflict.deviation > 1.0
    # The test allows itself one in a hundred per cause.
    assert false_alarm_count <= 4


# ---- links


@given(rigid_bodies(), rigid_bodies(), st.floats(0.001, 0.3))
def test_links_are_known_to_their_share(first, second, share):
    factor = link_factor([first, second], share, [0.3, 0.0])
    covariance = factor @ factor.T
    for theta, start in ((first, 0), (second, 10)):
        block = covariance[start : start + 10, start : start + 10]
        spread = np.sqrt(np.diag(block))
        # By itself and with all other links: the root of twice the square.
        expected = np.sqrt(2.0) * share * theta[0]
        assert spread[0] == pytest.approx(expected, rel=1e-6)
        assert np.linalg.eigvalsh(block / np.outer(spread, spread))[0] > 0.0
    correlation = covariance[0, 10] / np.sqrt(covariance[0, 0] * covariance[10, 10])
    assert correlation == pytest.approx(0.5, rel=1e-6)


def test_a_conflict_of_one_aspect_is_not_lost_among_the_others():
    """Masses alone are wrong, by six times their prior; everything else is as in the model."""
    rng = np.random.default_rng(0)
    lengths = [0.3, 0.2, 0.1]
    thetas = [random_theta(rng) for _ in lengths]
    mean = np.concatenate(thetas)
    names = tuple(f"p{k}" for k in range(30))
    factor = link_factor(thetas, 0.05, lengths)
    group = NuisanceGroup("links", names, mean, factor, tuple(np.repeat([*"abc"], 10)))
    rows = rng.normal(size=(400, 30)) / np.abs(mean)
    truth = np.repeat([1.3, 0.7, 1.3], 10) * mean
    tau = rows @ truth + 0.5 * rng.normal(size=400)
    information = information_of(rows, tau, names)
    widening = []
    for aspects in (tuple, lambda: link_aspects(thetas, lengths)):
        groups = (replace(group, aspects=aspects),)
        (conflict,) = misfits(information, np.array([0.5]), groups)
        widening.append(conflict.deviation)
    assert widening[0] < 3.0 and widening[1] == pytest.approx(6.0, rel=0.2)


N_LINKS = 4
USUAL = LinkScales(2.0, 1.0, 1.0)


def link_evidence(seed, scales, noise=1e-3):
    """Return (evidence, rows, data) of all directions of links whose errors have these scales."""
    rng = np.random.default_rng(seed)
    scale = scales.of_directions(N_LINKS)
    rows = rng.standard_normal((3 * len(scale), len(scale)))
    data = rows @ (scale * rng.standard_normal(len(scale)))
    data += noise * rng.standard_normal(len(data))
    gram = rows.T @ rows / noise**2
    return LinkEvidence(N_LINKS, gram, rows.T @ data / noise**2), rows, data


@given(SEEDS)
def test_the_likelihood_of_link_scales_is_that_of_the_data(seed):
    """Differences are those of a Gaussian of covariance noise^2 + Y S S Y'."""
    noise = 0.3
    evidence, rows, data = link_evidence(seed, USUAL, noise)
    likelihoods = []
    expected = []
    for scales in (USUAL, LinkScales(4.0, 0.5, 2.0)):
        scale = scales.of_directions(N_LINKS)
        likelihoods.append(evidence.log_likelihood(scale))
        covariance = noise**2 * np.eye(len(rows)) + (rows * scale**2) @ rows.T
        log_determinant = np.linalg.slogdet(covariance)[1]
        exponent = data @ np.linalg.solve(covariance, data)
        expected.append(-0.5 * (exponent + log_determinant))
    difference = np.diff(likelihoods)[0] - np.diff(expected)[0]
    assert abs(difference) < 1e-6 * abs(expected[0])


@pytest.mark.parametrize(
    "scales", [LinkScales(2.0, 0.5, 4.0), LinkScales(8.0, 4.0, 1.0)]
)
@given(seed=SEEDS)
def test_link_scales_that_the_data_shows_are_found(seed, scales):
    average = average_scales(link_evidence(seed, scales)[0])
    for aspect in ("centre_of_mass", "inertia"):
        assert 0.5 < getattr(average, aspect) / getattr(scales, aspect) < 2.1, aspect


def test_link_scales_without_data_are_the_usual_ones():
    size = 10 * N_LINKS + 2
    evidence = LinkEvidence(N_LINKS, np.zeros((size, size)), np.zeros(size))
    scales = average_scales(evidence)
    assert 4.0 < scales.mass < 6.0
    assert 1.5 < scales.centre_of_mass < 3.0


# ---- a scale that all torques share

JOINTS = [f"scale[{k}]" for k in range(3)]
MASSES = ["mass", "other mass"]
SCALED_NAMES = (*MASSES, *JOINTS)


def mass_and_scale_priors():
    """Return priors without and with a common scale.

    Masses are known to 6 and 4 %, torque scales to 2 %, and to 15 % in common.
    """
    masses = independent_prior(LINKS, MASSES, MASSES, np.array([0.06, 0.04]))
    scales = independent_prior(SCALES, JOINTS, JOINTS, 0.02)
    return (masses, scales), (masses, with_common(scales, 0.15))


def precision_of(groups):
    rows = [group.covariance_rows(SCALED_NAMES, np.eye(5)) for group in groups]
    return np.vstack(rows).T @ np.vstack(rows)


@pytest.mark.parametrize(
    ("question", "expected"),
    [
        (Question(EstimationOptions()), True),
        (Question(EstimationOptions(), loaded=True), False),
        (Question(EstimationOptions(priors=Priors(scale=2.0))), False),
    ],
    ids=["link", "payload", "scales are given"],
)
def test_a_common_scale_is_possible_where_links_show_it_and_scales_are_not_given(
    question, expected
):
    empty = np.zeros(0)
    groups = mass_and_scale_priors()[0]
    unknowns = Unknowns(SCALED_NAMES, np.arange(5), empty, groups, empty, empty, {})
    assert unknowns.may_be_scaled(question) is expected
    assert not replace(unknowns, groups=groups[1:]).may_be_scaled(question)

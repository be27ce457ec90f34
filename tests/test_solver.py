"""Laws of the solver: exact recovery, prior kept where nothing shows, scaling, order of joints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.autocorrelation import collect_residuals
from robot_sysid.estimation.algebra.information import InformationAccumulator, combined
from robot_sysid.estimation.algebra.least_squares import least_squares
from robot_sysid.estimation.algebra.nuisances import NuisanceGroup, with_prior
from robot_sysid.estimation.algebra.uncertainty import joint_space
from robot_sysid.estimation.verdict import of_own_simulation
from robot_sysid.records import Identifiability, SquareRootInformation
from robot_sysid.results.record import Verdict
from robot_sysid.solver import identify_parameters
from tests.support import results
from tests.support.estimates import METHODS, identified
from tests.support.synthetic_data import (
    arm_equations,
    information_of,
    joint_rows,
    noisy_samples,
    random_body,
    terminal_information,
)

SEEDS = st.integers(0, 2**32 - 1)


def noisy_arm(seed, noise=0.1):
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng)
    truth = np.concatenate((random_body(rng), rng.uniform(0.1, 1.0, 6)))
    return information_of(equations, names, truth, noise, rng), truth, rng


@given(SEEDS)
def test_noise_free_data_is_recovered(seed):
    information, truth, rng = noisy_arm(seed, noise=0.0)
    estimate = identify_parameters(information, rng.normal(size=16))
    np.testing.assert_allclose(estimate.values, truth, rtol=0.0, atol=1e-10)
    assert estimate.rmse < 1e-12


@given(SEEDS)
def test_where_the_data_shows_nothing_the_prior_stays_exactly(seed):
    rng = np.random.default_rng(seed)
    truth = np.append(random_body(rng), [0.4, 0.1])
    prior = np.append(random_body(rng), [0.0, 0.0])
    values = identify_parameters(terminal_information(rng, truth), prior).values
    assert values[0] == prior[0]
    assert values[3] == prior[3]
    assert values[4] + values[7] == pytest.approx(prior[4] + prior[7], rel=1e-12)
    seen = [1, 2, 5, 6, 8, 9, 10, 11]
    np.testing.assert_allclose(values[seen], truth[seen], rtol=0.0, atol=1e-11)
    assert values[4] - values[7] == pytest.approx(truth[4] - truth[7], abs=1e-11)


@given(SEEDS, st.floats(1e-3, 1e3))
def test_scaling_all_torques_scales_the_estimate(seed, factor):
    information, _, rng = noisy_arm(seed)
    prior = rng.normal(size=16)
    accumulator = InformationAccumulator(
        information.names,
        [j.joint for j in information.joints],
        [j.columns for j in information.joints],
    )
    for k, joint in enumerate(information.joints):
        accumulator.add(k, joint.triangle[:, :-1], factor * joint.triangle[:, -1])
    plain = identify_parameters(information, prior)
    scaled = identify_parameters(accumulator.result(), factor * prior)
    np.testing.assert_allclose(scaled.values, factor * plain.values, rtol=1e-9, atol=1e-12 * factor)


@given(SEEDS, st.permutations(range(3)))
def test_the_order_of_joints_does_not_matter(seed, order):
    information, _, rng = noisy_arm(seed)
    shuffled = SquareRootInformation(information.names, tuple(information.joints[k] for k in order))
    prior = rng.normal(size=16)
    one = identify_parameters(information, prior)
    other = identify_parameters(shuffled, prior)
    np.testing.assert_allclose(other.values, one.values, rtol=0.0, atol=1e-11)
    assert other.rmse == pytest.approx(one.rmse, rel=1e-12)


def test_rmse_is_that_of_the_samples():
    rng = np.random.default_rng(5)
    equations, names = arm_equations(rng, joints=2)
    taus = [rng.normal(size=60), rng.normal(size=60)]
    accumulator = InformationAccumulator(names, ["joint0", "joint1"], [c for _, c in equations])
    for j, (rows, _) in enumerate(equations):
        accumulator.add(j, rows, taus[j])
    estimate = identify_parameters(accumulator.result(), np.zeros(14))
    for j, (rows, columns) in enumerate(equations):
        residual = rows @ estimate.values[columns] - taus[j]
        expected = np.sqrt(np.mean(residual**2))
        assert estimate.rmse_per_joint[f"joint{j}"] == pytest.approx(expected, rel=1e-10)
    overall = np.sqrt(np.mean(np.square(list(estimate.rmse_per_joint.values()))))
    assert estimate.rmse == pytest.approx(overall, rel=1e-10)


def test_rows_of_one_joint_in_any_order_give_the_same_estimate():
    rng = np.random.default_rng(7)
    rows, tau = joint_rows(rng, 50), rng.normal(size=50)
    names = tuple(f"p{k}" for k in range(12))
    results = []
    for order in (np.arange(50), rng.permutation(50)):
        accumulator = InformationAccumulator(names, ["joint0"], [np.arange(12)])
        accumulator.add(0, rows[order], tau[order])
        results.append(identify_parameters(accumulator.result(), np.zeros(12)).values)
    np.testing.assert_allclose(results[1], results[0], rtol=0.0, atol=1e-11)


@given(SEEDS, st.integers(2, 9))
def test_a_log_played_again_tells_no_more_than_once(seed, count):
    """The same numbers over and over, counted once: values and errors of a single time."""
    once, _, _ = noisy_arm(seed)
    prior = np.zeros(len(once.names))
    again = combined([once] * count)
    first = identified(once, prior, "wls")
    found = identified(again, prior, "wls", inflation=np.full(3, float(count)))
    np.testing.assert_allclose(found.standard_errors, first.standard_errors, rtol=0.2)
    scale = np.abs(first.values) + first.standard_errors
    assert np.all(np.abs(found.values - first.values) < 0.2 * scale)
    for joint, samples in first.effective_samples.items():
        assert found.effective_samples[joint] == pytest.approx(samples)
        assert found.noise_per_joint[joint] == pytest.approx(first.noise_per_joint[joint], rel=0.2)


@given(SEEDS)
def test_an_estimate_carries_what_it_was_made_of(seed):
    samples, names, _, rng = noisy_samples(seed, noises=(0.1, 0.2, 0.3), count=40)
    estimate = identify_parameters(samples.information(names), rng.normal(size=16))
    joints = ("joint0", "joint1", "joint2")
    assert (estimate.names, estimate.method) == (names, "ols")
    assert estimate.samples == dict.fromkeys(joints, 40)
    assert not estimate.constrained
    assert estimate.error_budget == {}
    assert estimate.identifiability.rank == 12
    for kept in (estimate.rmse_per_joint, estimate.noise_per_joint, estimate.effective_samples):
        assert tuple(kept) == joints
    residuals = [rows @ estimate.values[c] - tau
                 for (rows, c), tau in zip(samples.equations, samples.torques)]  # fmt: skip
    rmse = [np.sqrt(np.mean(r**2)) for r in residuals]
    assert list(estimate.rmse_per_joint.values()) == pytest.approx(rmse, rel=1e-9)
    assert estimate.rmse == pytest.approx(np.sqrt(np.mean(np.square(rmse))), rel=1e-9)
    assert estimate.effective_samples == dict.fromkeys(joints, 40.0)


@given(SEEDS, st.booleans(), st.floats(1.0, 9.0))
def test_samples_that_count_less_make_errors_larger_by_the_root(seed, coloured, less):
    samples, names, _, rng = noisy_samples(seed, count=40)
    information, prior = samples.information(names), rng.normal(size=16)
    source = samples if coloured else None
    plain, again, fewer = (
        identified(information, prior, samples=source, inflation=inflation)
        for inflation in (None, np.ones(3), np.full(3, less))
    )
    np.testing.assert_array_equal(again.standard_errors, plain.standard_errors)
    np.testing.assert_allclose(fewer.values, plain.values, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(
        fewer.standard_errors, np.sqrt(less) * plain.standard_errors, rtol=1e-6
    )
    np.testing.assert_allclose(fewer.noise_errors, np.sqrt(less) * plain.noise_errors, rtol=1e-6)
    for joint, count in plain.effective_samples.items():
        assert fewer.effective_samples[joint] == pytest.approx(count / less, rel=1e-6)
        noise = plain.noise_per_joint[joint]
        assert fewer.noise_per_joint[joint] == pytest.approx(noise, rel=1e-9)


@given(SEEDS, st.sampled_from(["ols", "wls"]))
def test_what_a_pass_over_the_samples_left_serves_as_well_as_they_do(seed, method):
    """Noise differs from joint to joint, and something was known of the last parameter."""
    samples, names, truth, rng = noisy_samples(seed, noises=(0.1, 0.3, 0.9), count=100)
    known = NuisanceGroup("known", names[-1:], truth[-1:], np.array([[0.2]]), ("joint2",))
    information, prior = samples.information(names), rng.normal(size=16)
    equations = METHODS[method](with_prior(information, [known]), prior)
    weights = 1.0 / equations.noise
    values = least_squares(equations.information, prior, weights)
    root = joint_space(equations.information, weights).inverse_root()
    left = collect_residuals(information, samples, values, root, weights)
    one, other, white = (
        identified(information, prior, method, nuisances=[known], **how)
        for how in ({"samples": samples}, {"residuals": left}, {})
    )
    np.testing.assert_allclose(other.standard_errors, one.standard_errors, rtol=1e-9)
    assert other.effective_samples == pytest.approx(one.effective_samples, rel=1e-9)
    ratio = white.noise_errors / one.noise_errors
    assert np.max(np.abs(ratio - 1.0)) > 1e-6
    if method == "wls":
        # The noise is white, which a hundred samples show to within a factor.
        assert np.all((ratio > 0.2) & (ratio < 5.0))


@given(SEEDS)
def test_covariance_of_weighted_joints_is_the_inverse_of_what_they_tell(seed):
    samples, names, _, rng = noisy_samples(seed, noises=(0.1, 0.3, 0.9), count=40)
    estimate = identified(samples.information(names), rng.normal(size=16), "wls")
    told = np.zeros((16, 16))
    for (rows, columns), noise in zip(samples.equations, estimate.noise_per_joint.values()):
        told[np.ix_(columns, columns)] += rows.T @ rows / noise**2
    scale = np.outer(estimate.standard_errors, estimate.standard_errors)
    expected = np.linalg.inv(told) / scale
    np.testing.assert_allclose(estimate.covariance / scale, expected, rtol=0.0, atol=1e-6)


def test_one_equation_has_its_residual():
    accumulator = InformationAccumulator(tuple("abcdefghijkl"), ["held"], [[]])
    accumulator.add(0, np.zeros((1, 0)), np.array([3.0]))
    assert identify_parameters(accumulator.result(), np.zeros(12)).rmse == pytest.approx(3.0)


def test_noise_of_a_joint_without_samples_is_not_told():
    rng = np.random.default_rng(8)
    accumulator = InformationAccumulator(
        tuple(f"p{k}" for k in range(12)), ["used", "unused"], [np.arange(12), np.arange(2)]
    )
    accumulator.add(0, joint_rows(rng, 50), rng.normal(size=50))
    estimate = identify_parameters(accumulator.result(), np.zeros(12))
    assert tuple(estimate.noise_per_joint) == ("used",)
    assert estimate.samples == {"used": 50, "unused": 0}
    assert estimate.rmse_per_joint["unused"] == 0.0


def test_no_samples_at_all_leave_the_prior_and_no_residual():
    information, _, rng = noisy_arm(0)
    accumulator = InformationAccumulator(
        information.names, ["joint0"], [information.joints[0].columns]
    )
    prior = rng.normal(size=16)
    estimate = identify_parameters(accumulator.result(), prior)
    np.testing.assert_array_equal(estimate.values, prior)
    assert estimate.rmse == 0.0


@given(SEEDS, st.lists(st.floats(1e-3, 1.0), min_size=2, max_size=2))
def test_squares_of_the_causes_add_up_to_that_of_the_whole_error(seed, spreads):
    """Two nuisances behind the link's parameters, each known beforehand with a cause of its own."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng)
    names = (*names, "scale[joint0]", "zero[joint2]")
    for j, column in ((0, 16), (2, 17)):
        rows, columns = equations[j]
        equations[j] = (
            np.column_stack((rows, rng.normal(size=len(rows)))), np.append(columns, column),
        )  # fmt: skip
    truth = np.concatenate((random_body(rng), rng.uniform(0.1, 1.0, 6), spreads))
    information = information_of(equations, names, truth, 0.1, rng)
    groups = [
        NuisanceGroup(cause, (name,), np.zeros(1), np.array([[spread]]), (name,))
        for cause, name, spread in zip(("scales", "zeros"), names[16:], spreads)
    ]
    estimate = identified(information, np.zeros(18), nuisances=groups)
    assert tuple(estimate.error_budget) == ("scales", "zeros")
    assert len(estimate.names) == 18
    assert len(estimate.identifiability.identified) == 16
    squares = sum(part**2 for part in estimate.error_budget.values()) + estimate.noise_errors**2
    np.testing.assert_allclose(squares, estimate.standard_errors**2, rtol=1e-9)
    assert np.all(estimate.standard_errors[16:] <= np.array(spreads) * (1.0 + 1e-9))


# --- possible bodies ----------------------------------------------------------------------------


@given(SEEDS, st.floats(0.0, 30.0), st.booleans())
def test_a_body_that_has_to_be_possible_is_and_a_possible_one_stays(seed, noise, terminal):
    """A thin body under heavy noise, seen whole or by its own joint alone: law 9."""
    rng = np.random.default_rng(seed)
    truth = np.append(random_body(rng, 0.1), rng.uniform(0.1, 1.0, 2 if terminal else 6))
    prior = np.append(random_body(rng), np.zeros(len(truth) - 10))
    if terminal:
        information = terminal_information(rng, truth, noise=noise)
    else:
        information = information_of(*arm_equations(rng), truth, noise, rng)
    plain, found = (identify_parameters(information, prior, own) for own in (False, True))
    wrong = not spatial.is_consistent(plain.values[:10])
    assert found.constrained is wrong and not plain.constrained
    assert spatial.is_consistent(found.values[:10])
    if not wrong:
        np.testing.assert_array_equal(found.values, plain.values)


def test_data_at_rest_gives_the_prior_or_its_nearest_possible_body():
    body, names = random_body(np.random.default_rng(0)), tuple("abcdefghij")
    accumulator = InformationAccumulator(names, ["held"], [np.arange(10)])
    accumulator.add(0, np.zeros((20, 10)), np.zeros(20))
    information = accumulator.result()
    found = identify_parameters(information, body, possible=True)
    np.testing.assert_array_equal(found.values, body)
    repaired = identify_parameters(information, -body, possible=True)
    assert spatial.is_consistent(repaired.values)


POSSIBLE = spatial.theta_from_com(1.0, np.zeros(3), np.eye(3))


@pytest.mark.parametrize(
    ("scale", "error", "rank", "expected"),
    [
        (1.0, 0.49, 12, Verdict.OK),
        (1.0, 0.51, 12, Verdict.TOO_WEAK),
        (1.0, 0.51, 11, Verdict.TOO_WEAK),
        (1.0, 0.49, 11, Verdict.PARTLY_FROM_MODEL),
        (1.0, np.inf, 11, Verdict.PARTLY_FROM_MODEL),
        # An error that a scale would not show is never too large.
        (1e-9, 0.9e-6, 12, Verdict.OK),
        (1e-9, 1.1e-6, 12, Verdict.TOO_WEAK),
        (-1.0, 0.0, 12, Verdict.INCONSISTENT),
        (-1.0, 9.0, 11, Verdict.INCONSISTENT),
    ],
)
def test_the_verdict_on_an_own_simulation_says_what_is_wrong_first(scale, error, rank, expected):
    estimate = results.estimate(
        values=np.append(scale * POSSIBLE, np.zeros(4)),
        standard_errors=np.append(error, np.zeros(13)),
        identifiability=Identifiability(rank, 12, 1.0, 1.0, (True,) * 14, ()),
    )
    assert of_own_simulation(estimate) is expected

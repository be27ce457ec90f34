"""Laws of the solver: exact recovery, prior kept where nothing shows, scaling, order of joints."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import SEEDS, random_theta
from rigs.arms.synthetic_data import arm_equations, sums_of, terminal_sums
from robot_sysid import spatial
from robot_sysid.solver import identify_parameters


def noisy_arm(seed, noise=0.1, count=60):
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, count=count)
    truth = np.concatenate((random_theta(rng), rng.uniform(0.1, 1.0, 6)))
    return sums_of(equations, names, truth, noise, rng), truth, rng


@given(SEEDS)
def test_noise_free_data_is_recovered(seed):
    sums, truth, rng = noisy_arm(seed, noise=0.0)
    estimate = identify_parameters(sums, rng.normal(size=16))
    assert_allclose(estimate.values, truth, rtol=0.0, atol=1e-10)
    assert estimate.quality.rmse < 1e-12


@given(SEEDS)
def test_where_the_data_shows_nothing_the_prior_stays_exactly(seed):
    rng = np.random.default_rng(seed)
    truth = np.append(random_theta(rng), [0.4, 0.1])
    prior = np.append(random_theta(rng), [0.0, 0.0])
    values = identify_parameters(terminal_sums(rng, truth), prior).values
    assert values[0] == prior[0]
    assert values[3] == prior[3]
    assert values[4] + values[7] == pytest.approx(prior[4] + prior[7], rel=1e-12)
    identified = [1, 2, 5, 6, 8, 9, 10, 11]
    assert_allclose(values[identified], truth[identified], rtol=0.0, atol=1e-11)
    assert values[4] - values[7] == pytest.approx(truth[4] - truth[7], abs=1e-11)


@given(SEEDS, st.floats(1e-3, 1e3))
def test_scaling_all_torques_scales_the_estimate(seed, factor):
    sums, _, rng = noisy_arm(seed)
    prior = rng.normal(size=16)
    scaled = replace(sums, triangles=sums.triangles * np.append(np.ones(16), factor))
    expected = factor * identify_parameters(sums, prior).values
    values = identify_parameters(scaled, factor * prior).values
    assert_allclose(values, expected, rtol=1e-9, atol=1e-12 * factor)


@given(SEEDS, st.permutations(range(3)))
def test_the_order_of_joints_does_not_matter(seed, order):
    sums, _, rng = noisy_arm(seed)
    triangles = sums.triangles[list(order)]
    shuffled = replace(sums, triangles=triangles)
    prior = rng.normal(size=16)
    one = identify_parameters(sums, prior)
    other = identify_parameters(shuffled, prior)
    assert_allclose(other.values, one.values, rtol=0.0, atol=1e-11)
    assert other.quality.rmse == pytest.approx(one.quality.rmse, rel=1e-12)


@given(SEEDS)
def test_an_estimate_carries_what_it_was_made_of(seed):
    sums, _, rng = noisy_arm(seed, noise=(0.1, 0.2, 0.3), count=40)
    estimate = identify_parameters(sums, rng.normal(size=16))
    joints = ("joint0", "joint1", "joint2")
    quality = estimate.quality
    assert quality.samples_per_joint == dict.fromkeys(joints, 40)
    assert quality.n_base_params == 12
    for fixed in (quality.rmse_per_joint, quality.noise_per_joint):
        assert tuple(fixed) == joints
    residuals = sums.triangles @ np.append(-estimate.values, 1.0)
    rmse = np.linalg.norm(residuals, axis=1) / np.sqrt(40.0)
    assert list(quality.rmse_per_joint.values()) == pytest.approx(list(rmse), rel=1e-9)
    assert quality.rmse == pytest.approx(np.sqrt(np.mean(np.square(rmse))), rel=1e-9)


# --- possible bodies ----------------------------------------------------------------------------


@given(SEEDS, st.floats(0.0, 30.0), st.booleans())
@example(1033080, 0.0, True)
def test_a_body_that_has_to_be_possible_is_and_a_possible_one_stays(
    seed, noise, terminal
):
    """A thin body under heavy noise, seen whole or by its own joint alone: law 9."""
    rng = np.random.default_rng(seed)
    body = random_theta(rng, spread=0.1)
    truth = np.append(body, rng.uniform(0.1, 1.0, 2 if terminal else 6))
    prior = np.append(random_theta(rng), np.zeros(len(truth) - 10))
    if terminal:
        sums = terminal_sums(rng, truth, noise=noise)
    else:
        sums = sums_of(*arm_equations(rng), truth, noise, rng)
    plain, estimate = (
        identify_parameters(sums, prior, possible) for possible in (False, True)
    )
    is_impossible = not spatial.is_consistent(plain.values[:10])
    assert np.any(estimate.values != plain.values) == is_impossible
    assert spatial.is_consistent(estimate.values[:10])
    if not is_impossible:
        assert_array_equal(estimate.values, plain.values)


def test_data_at_rest_gives_the_prior_or_its_nearest_possible_body():
    body = random_theta(np.random.default_rng(0))
    sums = sums_of([(np.zeros((20, 10)), np.arange(10))], "abcdefghij", np.zeros(10))
    estimate = identify_parameters(sums, body, possible=True)
    assert_array_equal(estimate.values, body)
    repaired = identify_parameters(sums, -body, possible=True)
    assert spatial.is_consistent(repaired.values)

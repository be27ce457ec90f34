"""What is expected of a file is the mean of many fits of it, and its derivative is exact."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms.small_arms import SEEDS
from robot_sysid.expected.file_errors import FileErrors

SIZE = 7


def drawn(seed, rows=30, noise=0.5):
    """Return errors of a file that holds some of seven unknowns, and rows of a recording."""
    rng = default_rng(seed)
    judged = rng.normal(size=(20, SIZE))
    in_file = np.arange(SIZE) < rng.integers(1, SIZE)
    recorded = rng.normal(size=(rows, SIZE)) / noise
    return FileErrors.at_once(judged.T @ judged, rng.permutation(in_file)), recorded


def squares(errors, information):
    """Return the expected squares of a file's error."""
    return np.vdot(errors.elsewhere, errors.covariance(information))


@given(SEEDS)
def test_the_value_is_half_the_logarithm_of_the_squares(seed):
    errors, rows = drawn(seed)
    information = rows.T @ rows + np.eye(SIZE)
    value, _ = errors.value_and_weight(information)
    ratio = squares(errors, information) / errors.before
    assert value == pytest.approx(0.5 * np.log(ratio), rel=1e-9, abs=1e-12)


@given(SEEDS)
def test_the_derivative_equals_differences(seed):
    errors, rows = drawn(seed)
    information = rows.T @ rows + np.eye(SIZE)
    direction = default_rng(seed + 1).normal(size=(SIZE, SIZE))
    direction = direction + direction.T
    _, weight = errors.value_and_weight(information)
    step = 1e-5 * direction
    ahead, _ = errors.value_and_weight(information + step)
    behind, _ = errors.value_and_weight(information - step)
    slope = -0.5 * np.vdot(weight, direction)
    size = np.linalg.norm(weight) * np.linalg.norm(direction)
    assert (ahead - behind) / 2e-5 == pytest.approx(slope, rel=1e-5, abs=1e-7 * size)
    assert_allclose(weight, weight.T, atol=1e-12 * np.max(np.abs(weight)))


def in_two_steps(errors):
    """Return the errors of a file whose first term is that of the fit of all."""
    refitted = errors.in_file.copy()
    refitted[np.argmax(refitted)] = False
    return replace(errors, refitted=refitted)


@pytest.mark.parametrize("steps", [lambda errors: errors, in_two_steps])
@pytest.mark.parametrize("seed", range(4))
def test_expected_squares_are_the_mean_of_many_files(seed, steps):
    """Arms and noise are drawn, a file is fitted to each recording with the priors of its terms."""
    errors, rows = drawn(seed, rows=9)
    errors = steps(errors)
    rng = default_rng([seed, 1])
    count = 20_000
    truth = rng.normal(size=(SIZE, count))
    torque = rows @ truth + rng.normal(size=(len(rows), count))

    file = np.zeros_like(truth)
    first = errors.in_file & ~errors.refitted
    file[first] = fit(rows, torque)[first]
    left = torque - rows @ file
    file[errors.refitted] = fit(rows[:, errors.refitted], left)

    wrong = truth - file
    found = np.sum(wrong * (errors.elsewhere @ wrong), axis=0)
    expected = squares(errors, rows.T @ rows + np.eye(SIZE))
    spread = np.std(found) / np.sqrt(count)
    assert abs(np.mean(found) - expected) < 4.0 * spread


def fit(rows, torque):
    """Return the solution with a prior of unit variance."""
    return np.linalg.solve(rows.T @ rows + np.eye(rows.shape[1]), rows.T @ torque)


def test_friction_that_cannot_be_negative_is_off_by_no_more_than_itself():
    """Of a recording without noise that shows the other unknown ten times as the file's own."""
    information = np.eye(2) + 1e6 * np.array([[1.0, 10.0], [10.0, 100.0]])
    in_file = np.array([True, False])
    free = FileErrors.at_once(np.eye(2), in_file)
    held = replace(free, bounded=in_file)
    assert squares(free, information) == pytest.approx(101.0, rel=1e-3)
    assert squares(held, information) == pytest.approx(2.0, rel=1e-3)
    # What stays below its own size is as it is without bounds.
    small = np.eye(2) + 1e6 * np.array([[1.0, 0.5], [0.5, 0.25]])
    assert squares(held, small) == squares(free, small)


@given(SEEDS)
def test_a_file_without_a_recording_is_as_wrong_as_the_model(seed):
    errors, _ = drawn(seed)
    assert squares(errors, np.eye(SIZE)) == pytest.approx(errors.before)
    value, _ = errors.value_and_weight(np.eye(SIZE))
    assert value == pytest.approx(0.0, abs=1e-12)


@given(SEEDS)
def test_a_file_that_holds_everything_becomes_right_with_more_rows(seed):
    errors, rows = drawn(seed)
    complete = FileErrors.at_once(errors.elsewhere, np.ones(SIZE, dtype=bool))
    left = [
        squares(complete, many * rows.T @ rows + np.eye(SIZE))
        for many in (1.0, 1e3, 1e6)
    ]
    assert left[0] > left[1] > left[2]
    assert left[2] < 1e-4 * complete.before


@given(SEEDS)
def test_what_a_file_does_not_hold_is_left_whatever_is_recorded(seed):
    errors, rows = drawn(seed)
    empty = FileErrors.at_once(errors.elsewhere, np.zeros(SIZE, dtype=bool))
    information = rows.T @ rows + np.eye(SIZE)
    assert squares(empty, information) == pytest.approx(empty.before)


@given(SEEDS)
def test_the_order_of_unknowns_does_not_matter(seed):
    errors, rows = drawn(seed)
    order = default_rng(seed + 1).permutation(SIZE)
    moved = FileErrors.at_once(
        errors.elsewhere[np.ix_(order, order)], errors.in_file[order]
    )
    information = rows.T @ rows + np.eye(SIZE)
    value, weight = errors.value_and_weight(information)
    again, weight_again = moved.value_and_weight(information[np.ix_(order, order)])
    assert again == pytest.approx(value, rel=1e-9, abs=1e-12)
    assert_allclose(weight_again, weight[np.ix_(order, order)], rtol=1e-6, atol=1e-10)

"""Laws of the design criteria: gradients, monotony, invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.design.criteria import CRITERIA
from tests.arms import SEEDS
from tests.excitation_arms import slope

NAMES = st.sampled_from(sorted(CRITERIA))


def information(rng, size=5):
    factor = rng.normal(size=(size + 3, size))
    return factor.T @ factor


@given(NAMES, SEEDS)
def test_gradient_equals_differences(name, seed):
    rng = np.random.default_rng(seed)
    matrix, direction = information(rng), rng.normal(size=(5, 5))
    direction += direction.T
    size = np.linalg.eigvalsh(matrix)[0]
    value = slope(lambda m: CRITERIA[name](m)[0], matrix, direction, 1e-5 * size)
    exact = np.sum(CRITERIA[name](matrix)[1] * direction)
    assert value == pytest.approx(exact, rel=1e-4, abs=1e-6 / size)


@given(st.sampled_from(["A", "D"]), SEEDS)
def test_more_information_is_never_worse(name, seed):
    rng = np.random.default_rng(seed)
    matrix, row = information(rng), rng.normal(size=5)
    more = matrix + np.outer(row, row)
    assert CRITERIA[name](more)[0] <= CRITERIA[name](matrix)[0] + 1e-12


@given(st.sampled_from(["A", "D"]), SEEDS, st.floats(0.1, 10.0))
def test_twice_the_noise_is_twice_the_value(name, seed, factor):
    matrix = information(np.random.default_rng(seed))
    change = CRITERIA[name](matrix / factor**2)[0] - CRITERIA[name](matrix)[0]
    assert change == pytest.approx(np.log(factor), abs=1e-9)


@given(SEEDS)
def test_condition_ignores_units_and_noise(seed):
    rng = np.random.default_rng(seed)
    matrix, units = information(rng), np.diag(rng.uniform(0.1, 10.0, size=5))
    value = CRITERIA["cond"](matrix)[0]
    assert CRITERIA["cond"](7.0 * units @ matrix @ units)[0] == pytest.approx(value, abs=1e-8)
    assert value >= 0.0


def test_a_is_the_root_of_the_summed_variances():
    matrix = np.diag([4.0, 25.0])
    assert np.exp(CRITERIA["A"](matrix)[0]) == pytest.approx(np.sqrt(0.25 + 0.04), abs=1e-14)


@pytest.mark.parametrize("name", sorted(CRITERIA))
@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 1.0, np.nan])])
def test_blind_information_is_infinitely_bad(name, matrix):
    value, gradient = CRITERIA[name](matrix)
    assert value == np.inf
    assert np.array_equal(gradient, np.zeros((3, 3)))

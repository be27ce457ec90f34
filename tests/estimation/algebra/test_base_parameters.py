"""Base parameters: the space they span, their names, and what elimination keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.estimation.algebra.identifiability import base_combinations, essential


@given(seed=st.integers(0, 2**31 - 1), rank=st.integers(1, 6))
def test_the_leading_columns_times_the_combinations_are_the_regressor(seed, rank):
    rng = np.random.default_rng(seed)
    regressor = rng.normal(size=(30, rank)) @ rng.normal(size=(rank, 9))
    found = base_combinations(regressor, np.ones(9))
    assert found.rank == rank
    assert regressor[:, found.leading] @ found.matrix == pytest.approx(
        regressor, abs=1e-3
    )


def test_combinations_are_named_after_their_first_parameter():
    a, b, c = np.random.default_rng(0).normal(size=(3, 20))
    regressor = np.column_stack((2.0 * a, b, a, np.zeros(20), c, -c))
    found = base_combinations(regressor, np.ones(6))
    names = found.names(["m1", "h", "m2", "nothing", "I", "J"])
    assert names == ("m1 + 0.5*m2", "h", "I - J")


@given(seed=st.integers(0, 2**31 - 1))
def test_rounding_does_not_choose_among_columns_that_are_alike(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 20))
    regressor = np.column_stack((a, -a, b, a + b, b))
    found = base_combinations(
        regressor * rng.normal(1.0, 1e-14, regressor.shape), np.ones(5)
    )
    again = base_combinations(regressor, np.ones(5))
    assert found.leading.tolist() == again.leading.tolist()
    assert found.matrix == pytest.approx(again.matrix, abs=1e-9)


def test_elimination_keeps_what_the_data_needs():
    rng = np.random.default_rng(3)
    base = rng.normal(size=(400, 4))
    right = base @ np.array([5.0, 1e-6, -3.0, 0.0]) + 0.1 * rng.normal(size=400)
    nuisance = rng.normal(size=(400, 2))
    assert essential(base, nuisance, right).tolist()[0::2] == [True, True]
    assert not np.any(essential(base, nuisance, right)[1::2])


def test_what_is_known_well_stays_beside_what_is_known_far_better():
    rng = np.random.default_rng(5)
    base = rng.normal(size=(400, 2))
    right = base @ np.array([1000.0, 1.0]) + rng.normal(size=400)
    assert essential(base, rng.normal(size=(400, 1)), right).tolist() == [True, True]


def test_elimination_lets_nuisances_explain_what_they_can():
    rng = np.random.default_rng(4)
    shared = rng.normal(size=(200, 1))
    base = np.column_stack(
        (shared + 1e-4 * rng.normal(size=(200, 1)), rng.normal(size=200))
    )
    right = shared[:, 0] + 2.0 * base[:, 1] + 0.01 * rng.normal(size=200)
    assert essential(base, shared, right).tolist() == [False, True]

"""Laws of square-root information: chunked QR is one-shot QR, residuals come out of triangles."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.estimation.information import InformationAccumulator, update_triangle

SEEDS = st.integers(0, 2**32 - 1)
COLUMNS = 5


def with_positive_diagonal(triangle):
    """A triangle is unique up to the signs of its rows."""
    signs = np.where(np.diag(triangle) < 0.0, -1.0, 1.0)
    return signs[:, None] * triangle


@st.composite
def tall_matrices(draw):
    """Rows of very different sizes, some columns nearly the same."""
    rng = np.random.default_rng(draw(SEEDS))
    rows = rng.normal(size=(draw(st.integers(1, 60)), COLUMNS))
    rows *= 10.0 ** rng.uniform(-3.0, 3.0, size=(len(rows), 1))
    rows[:, 1] = rows[:, 0] + draw(st.sampled_from([1e-6, 1.0])) * rows[:, 1]
    return rows


@given(tall_matrices(), st.lists(st.integers(0, 60), max_size=6))
def test_chunked_triangle_is_the_one_shot_triangle(rows, cuts):
    triangle = np.zeros((COLUMNS, COLUMNS))
    for part in np.split(rows, sorted(min(cut, len(rows)) for cut in cuts)):
        triangle = update_triangle(triangle, part)
    once = update_triangle(np.zeros((COLUMNS, COLUMNS)), rows)
    size = np.max(np.abs(once))
    np.testing.assert_allclose(triangle.T @ triangle, once.T @ once, rtol=0.0, atol=1e-13 * size**2)
    if len(rows) >= COLUMNS and np.linalg.cond(rows) < 1e6:
        np.testing.assert_allclose(
            with_positive_diagonal(triangle), with_positive_diagonal(once), atol=1e-9 * size
        )


@given(SEEDS, st.integers(1, 4))
def test_triangle_gives_the_residual_of_all_rows(seed, chunks):
    rng = np.random.default_rng(seed)
    columns = rng.permutation(6)[:4]
    accumulator = InformationAccumulator(tuple("abcdef"), ["j"], [columns])
    values, expected = rng.normal(size=6), 0.0
    for _ in range(chunks):
        rows, tau = rng.normal(size=(20, 4)), rng.normal(size=20)
        accumulator.add(0, rows, tau)
        expected += np.sum((rows @ values[columns] - tau) ** 2)
    information = accumulator.result()
    assert information.n_samples == 20 * chunks
    np.testing.assert_allclose(information.squared_residuals(values), [expected], rtol=1e-12)
    matrix, right = information.stacked()
    np.testing.assert_allclose(np.sum((matrix @ values - right) ** 2), expected, rtol=1e-12)


@given(SEEDS)
def test_stacked_equations_have_the_solution_of_all_rows(seed):
    rng = np.random.default_rng(seed)
    accumulator = InformationAccumulator(tuple("abcd"), ["i", "j"], [np.arange(4), np.arange(4)])
    blocks = [(rng.normal(size=(30, 4)), rng.normal(size=30)) for _ in range(2)]
    for index, (rows, tau) in enumerate(blocks):
        accumulator.add(index, rows, tau)
    weights = rng.uniform(0.5, 2.0, size=2)
    full = np.vstack([w * rows for w, (rows, _) in zip(weights, blocks)])
    right = np.concatenate([w * tau for w, (_, tau) in zip(weights, blocks)])
    expected = np.linalg.lstsq(full, right, rcond=None)[0]
    actual = np.linalg.lstsq(*accumulator.result().stacked(weights), rcond=None)[0]
    np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_no_rows_are_no_information():
    accumulator = InformationAccumulator(("a",), ["j"], [np.arange(1)])
    information = accumulator.result()
    assert information.n_samples == 0
    assert not np.any(information.stacked()[0])

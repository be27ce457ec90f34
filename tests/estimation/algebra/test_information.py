"""Laws of square-root information: chunked QR is one-shot QR, residuals come out of triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.estimation.algebra.least_squares import (
    InformationAccumulator,
    combine,
    restrict,
    update_triangle,
)

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


@given(tall_matrices(), st.lists(st.integers(0, 60), max_size=6), SEEDS)
def test_rows_in_any_order_and_chunks_have_the_one_shot_triangle(rows, cuts, seed):
    triangle = np.zeros((COLUMNS, COLUMNS))
    mixed = np.random.default_rng(seed).permutation(rows)
    for part in np.split(mixed, sorted(min(cut, len(rows)) for cut in cuts)):
        triangle = update_triangle(triangle, part)
    once = update_triangle(np.zeros((COLUMNS, COLUMNS)), rows)
    size = np.max(np.abs(once))
    assert_allclose(
        triangle.T @ triangle, once.T @ once, rtol=0.0, atol=1e-13 * size**2
    )
    if len(rows) >= COLUMNS and np.linalg.cond(rows) < 1e6:
        assert_allclose(
            with_positive_diagonal(triangle),
            with_positive_diagonal(once),
            atol=1e-9 * size,
        )


@given(SEEDS, st.integers(1, 4))
def test_triangle_gives_the_residual_of_all_rows(seed, chunks):
    rng = np.random.default_rng(seed)
    columns = rng.permutation(6)[:4]
    accumulator = InformationAccumulator(tuple("abcdef"), ["j"], [columns])
    values = rng.normal(size=6)
    expected = 0.0
    for _ in range(chunks):
        rows = rng.normal(size=(20, 4))
        tau = rng.normal(size=20)
        accumulator.add(0, rows, tau)
        expected += np.sum((rows @ values[columns] - tau) ** 2)
    information = accumulator.result()
    assert information.n_samples == 20 * chunks
    assert_allclose(information.squared_residuals(values), [expected], rtol=1e-12)
    matrix, right = information.stacked()
    assert_allclose(np.sum((matrix @ values - right) ** 2), expected, rtol=1e-12)


NAMES = tuple("abcdef")


def filled(columns, blocks):
    """Information of two joints, per block one (joint number, rows, tau)."""
    accumulator = InformationAccumulator(NAMES, ["i", "j"], columns)
    for block in blocks:
        accumulator.add(*block)
    return accumulator.result()


def random_blocks(rng, columns, count):
    sizes = rng.integers(0, 20, count)
    joints = rng.integers(0, 2, count)
    return [
        (j, rng.normal(size=(n, len(columns[j]))), rng.normal(size=n))
        for j, n in zip(joints, sizes)
    ]


@given(SEEDS, st.integers(1, 4))
def test_parts_together_are_the_information_of_all_rows(seed, count):
    """What was known before the data is the same in each part, and counts once."""
    rng = np.random.default_rng(seed)
    columns = [rng.permutation(6)[:3], rng.permutation(6)[:4]]
    known = rng.normal(size=(2, 7))
    blocks = [random_blocks(rng, columns, 3) for _ in range(count)]
    together = combine([replace(filled(columns, part), prior=known) for part in blocks])
    whole = filled(columns, sum(blocks, []))
    assert together.names == NAMES
    assert_array_equal(together.prior, known)
    for joint, expected in zip(together.joints, whole.joints):
        assert (joint.joint, joint.n_samples) == (expected.joint, expected.n_samples)
        assert_array_equal(joint.columns, expected.columns)
        normal, other = (t.T @ t for t in (joint.triangle, expected.triangle))
        assert_allclose(normal, other, rtol=0.0, atol=1e-12 * (1.0 + np.max(other)))
    assert combine([whole]).prior is None


@given(SEEDS, st.permutations(range(6)), st.integers(1, 6))
def test_restricting_holds_the_other_parameters_at_zero(seed, order, count):
    rng = np.random.default_rng(seed)
    columns = [rng.permutation(6)[:3], rng.permutation(6)]
    information = filled(columns, random_blocks(rng, columns, 5))
    kept = sorted(order[:count])
    smaller = restrict(information, [NAMES[k] for k in order[:count]])
    assert smaller.names == tuple(NAMES[k] for k in kept)
    values = np.zeros(6)
    values[kept] = rng.normal(size=count)
    assert_allclose(
        smaller.squared_residuals(values[kept]),
        information.squared_residuals(values),
        rtol=1e-11,
    )
    for joint, before in zip(smaller.joints, information.joints):
        assert (joint.joint, joint.n_samples) == (before.joint, before.n_samples)

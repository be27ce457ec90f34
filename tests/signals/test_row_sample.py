"""A bounded sample of rows: the same in whatever order logs are added, and as telling as all."""

from __future__ import annotations

from functools import reduce
from operator import add

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.signals import row_sample
from robot_sysid.signals.row_sample import RowSample, sampled
from tests.signals.test_repetition import inflation, motion, repeated
from tests.support.arms import SEEDS

TRUTH = np.array([1.0, 2.0, 3.0])


def parts_of(motions, samples):
    """A sample of each motion; the numbers of logs are any different ones."""
    left = np.split(samples.tau - samples.rows @ TRUTH, len(motions))
    return [sampled(m, e[:, None], 7 + k) for k, (m, e) in enumerate(zip(motions, left))]


def equal(one: RowSample, other: RowSample) -> bool:
    names = ("drawn", "log", "place", "q", "qd", "qdd", "moved", "residual", "total")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@given(SEEDS, st.integers(3, 30))
def test_order_and_brackets_do_not_matter(seed, count):
    rng = np.random.default_rng(seed)
    parts = parts_of(*repeated(count, rng.normal(size=count * 150)))
    half = count // 2
    ends = reduce(add, parts[:half]) + reduce(add, parts[half:])
    anyhow = reduce(add, [parts[k] for k in rng.permutation(count)])
    whole = reduce(add, parts)
    assert equal(whole, ends) and equal(whole, anyhow)
    assert (whole.total, len(whole.drawn)) == (150 * count, min(150 * count, 2000))


@given(SEEDS, st.integers(2, 12))
def test_all_rows_say_what_a_pass_over_them_says(seed, count):
    rng = np.random.default_rng(seed)
    shared = np.tile(rng.normal(size=150), count) + rng.normal(size=150 * count)
    motions, samples = repeated(count, shared)
    found = reduce(add, parts_of(motions, samples)).inflation()
    assert found == pytest.approx(inflation(motions, samples), rel=0.05)


@pytest.mark.slow
@given(SEEDS, st.booleans())
def test_a_part_of_very_many_rows_still_tells_repetition(seed, comes_again):
    rng, count = np.random.default_rng(seed), 40
    one = rng.normal(size=150)
    noise = np.tile(one, count) if comes_again else rng.normal(size=150 * count)
    found = reduce(add, parts_of(*repeated(count, noise))).inflation()[0]
    assert 0.75 * count < found < 1.25 * count if comes_again else 1.0 <= found < 0.1 * count


def test_the_same_log_twice_is_refused(monkeypatch):
    monkeypatch.setattr(row_sample, "MOST_ROWS", 50)
    one, same = (sampled(motion(), np.zeros((150, 1)), 3) for _ in range(2))
    with pytest.raises(InputError, match="add each log once"):
        _ = one + same


def test_some_of_the_motion_is_motion_of_the_log():
    whole = motion()
    some = sampled(whole, np.zeros((150, 1)), 3).motion(20)
    rows = [int(np.flatnonzero((whole.q == q).all(axis=1))[0]) for q in some.q]
    assert len(set(rows)) == 20
    np.testing.assert_array_equal(some.qdd, whole.qdd[rows])

"""Gaps split a log; a long log is thinned behind a low-pass, whatever its blocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.records import Measurement
from robot_sysid.signals import resampling as pieces
from robot_sysid.signals.resampling import Thinning, piece_note, pieces_of


def log(time: np.ndarray) -> Measurement:
    q = np.column_stack((np.sin(time), np.cos(0.7 * time)))
    return Measurement(time, q, None, 2.0 * q)


@given(
    st.lists(
        st.tuples(st.floats(0.1, 12.0), st.floats(0.6, 5.0)), min_size=1, max_size=5
    )
)
def test_pieces_are_what_lies_between_gaps(parts):
    start = 0.0
    times = []
    for length, gap in parts:
        times.append(start + np.arange(0.0, length, 0.01))
        start = float(times[-1][-1]) + gap
    whole = log(np.concatenate(times))
    found = pieces_of(whole)
    long = [time for time in times if time[-1] - time[0] >= pieces.SHORTEST]
    if not long:
        assert len(found) == 1 and found[0] is whole
        return
    assert [len(piece) for piece in found] == [len(time) for time in long]
    for piece, time in zip(found, long):
        np.testing.assert_array_equal(piece.time, time)
    assert bool(piece_note(whole, found)) == (len(times) > 1)


def test_a_long_log_is_cut_into_equal_parts(monkeypatch):
    monkeypatch.setattr(pieces, "MOST_ROWS", 1000)
    whole = log(np.arange(0.0, 25.0, 0.01))
    found = pieces_of(whole)
    assert [len(piece) for piece in found] == [833, 833, 834]
    assert "its length splits the log into 3 pieces" in piece_note(whole, found)[0]


def test_of_hours_the_minutes_that_move_are_taken():
    time = np.arange(0.0, 7200.0, 0.1)
    moves = (time > 3000.0) & (time < 3600.0)
    q = np.where(moves, np.sin(time), 1e-4 * np.sin(time))[:, None]
    found = pieces_of(Measurement(time, q, None, q))
    assert 500.0 < sum(np.ptp(piece.time) for piece in found) < 800.0
    assert all(2900.0 < piece.time[0] < 3700.0 for piece in found)
    always = pieces_of(log(time))
    assert sum(np.ptp(piece.time) for piece in always) == pytest.approx(
        pieces.MOST_TIME, rel=0.1
    )
    assert always[0].time[0] == 0.0 and always[-1].time[-1] == time[-1]


@given(st.lists(st.integers(1, 900), max_size=4))
def test_thinning_does_not_depend_on_the_blocks(cuts):
    time = np.arange(4000) / 1000.0
    rows = np.column_stack((np.arange(4000), time, np.sin(3.0 * time)))
    whole = Thinning(8, 1e-3).push(rows)
    other = Thinning(8, 1e-3)
    blocks = np.split(rows, np.cumsum(cuts))
    np.testing.assert_allclose(
        np.concatenate([other.push(block) for block in blocks]),
        whole,
        rtol=0,
        atol=1e-12,
    )
    assert 440 < len(whole) < 500
    np.testing.assert_allclose(
        whole[:, 2], np.sin(3.0 * whole[:, 1]), rtol=0, atol=1e-4
    )
    assert np.allclose(np.diff(whole[:, 1]), 8e-3)


def test_thinning_does_not_reach_over_a_gap():
    time = np.concatenate((np.arange(2000), 5000 + np.arange(2000))) / 1000.0
    rows = np.column_stack((np.arange(4000), time, np.where(time < 3.0, 1.0, -1.0)))
    thinned = Thinning(8, 1e-3).push(rows)
    np.testing.assert_allclose(np.abs(thinned[:, 2]), 1.0, atol=1e-12)
    assert not np.any((thinned[:, 1] > 2.0) & (thinned[:, 1] < 5.0))


def test_a_log_that_is_long_enough_is_thinned_to_what_is_needed():
    time = np.arange(1000) / 1000.0
    assert Thinning.of(time, pieces.MOST_KEPT).every == 1
    assert Thinning.of(time, 4.0 * pieces.MOST_KEPT).every == 4
    assert Thinning.of(time, 1e9).every == 1000 // pieces.LEAST_RATE
    assert Thinning.of(np.arange(100) / 20.0, 1e9).every == 1

"""Residuals that come again with the motion count once, new ones every time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.estimation.information import InformationAccumulator
from robot_sysid.records import Motion
from robot_sysid.signals.repetition import visits
from tests.support.arms import SEEDS

COUNT = 150


def motion(phase: float = 0.0, rate: float = 15.0) -> Motion:
    """One joint pair that passes each state once."""
    time = phase / rate + np.arange(COUNT) / rate
    frequency = np.array([1.3, 2.9])
    angle = frequency * time[:, None] + np.array([0.0, 1.0])
    return Motion(time, np.sin(angle), frequency * np.cos(angle), -(frequency**2) * np.sin(angle))


class Samples:
    """One joint's equations with three parameters."""

    def __init__(self, rows, tau):
        self.rows, self.tau = rows, tau
        accumulator = InformationAccumulator(("a", "b", "c"), ("one",), [np.arange(3)])
        used = np.isfinite(tau)
        accumulator.add(0, rows[used], tau[used])
        self.information = accumulator.result()

    def __iter__(self):
        yield 0, self.rows, self.tau


def repeated(count, noise, phase=0.0):
    motions = [motion(phase * k) for k in range(count)]
    rows = np.concatenate([np.column_stack((m.q, m.qd[:, 0])) for m in motions])
    return motions, Samples(rows, rows @ np.array([1.0, 2.0, 3.0]) + noise)


def inflation(motions, samples):
    return visits(motions).inflation(samples.information, samples, np.array([1.0, 2.0, 3.0]))


@given(SEEDS, st.integers(2, 12))
def test_the_same_residuals_again_count_once(seed, count):
    rng = np.random.default_rng(seed)
    motions, samples = repeated(count, np.tile(rng.normal(size=COUNT), count))
    assert inflation(motions, samples) == pytest.approx(count, rel=1e-9)


@given(SEEDS, st.integers(2, 12))
def test_new_residuals_count_every_time(seed, count):
    rng = np.random.default_rng(seed)
    found = inflation(*repeated(count, rng.normal(size=count * COUNT)))
    # The sum of count - 1 others per row, COUNT rows: six standard deviations.
    assert found <= 1.0 + 6.0 * np.sqrt((count - 1) / COUNT)


def test_a_passage_that_falls_between_the_rows_of_another_is_found():
    """Rows follow each other at twice the cut-off: what lies between two rows is band-limited."""
    factors = []
    for seed in range(20):
        fine = np.random.default_rng(seed).normal(size=COUNT)
        between = np.sinc(np.arange(COUNT)[:, None] + 0.5 - np.arange(COUNT)) @ fine
        motions, samples = repeated(2, np.concatenate((fine, between)), phase=0.5)
        factors.append(inflation(motions, samples))
    assert np.mean(factors) == pytest.approx(2.0, abs=0.3)


def test_motion_that_does_not_repeat_is_left_alone():
    motions, samples = repeated(1, np.ones(COUNT))
    assert visits(motions).repeats < 1.0 and inflation(motions, samples) == 1.0


def test_rows_that_are_not_used_do_not_count():
    rng = np.random.default_rng(2)
    noise = np.tile(rng.normal(size=COUNT), 3)
    noise[: COUNT // 2] = np.nan
    found = inflation(*repeated(3, noise))
    assert 2.0 < found < 3.0

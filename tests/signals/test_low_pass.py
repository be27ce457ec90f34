"""The low-pass: one linear filter for both sides of an equation, with a pass and a stop band."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.signals.low_pass import Decimator, design_low_pass
from tests.support.swing import seconds


@given(st.floats(1.0, 60.0), st.lists(st.integers(1, 90), min_size=1, max_size=12), st.integers(0))
def test_chunks_of_any_size_give_the_same_decimated_samples(cutoff, sizes, seed):
    low_pass = design_low_pass(cutoff, 200.0)
    values = np.random.default_rng(seed).normal(size=(sum(sizes) + 500, 2, 3))
    stream = Decimator(low_pass)
    cuts = [0, *np.cumsum(sizes), len(values)]
    pieces = [stream.push(values[a:b]) for a, b in zip(cuts, cuts[1:])]
    np.testing.assert_array_equal(np.concatenate(pieces), low_pass.decimated(values))
    every = low_pass.filtered(values)[:: low_pass.step]
    np.testing.assert_allclose(low_pass.decimated(values), every, rtol=0.0, atol=1e-12)
    assert len(low_pass.centres(len(values))) == len(every)


@given(st.floats(1.0, 60.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_a_straight_line_passes_unchanged(cutoff, start, slope):
    low_pass = design_low_pass(cutoff, 200.0)
    line = start + slope * seconds(5.0, 200.0)
    inner = line[low_pass.half_width : len(line) - low_pass.half_width]
    np.testing.assert_allclose(low_pass.filtered(line), inner, rtol=0.0, atol=1e-11)


@given(st.integers(0, 2**32), st.floats(2.0, 60.0))
def test_an_equation_survives_the_filter(seed, cutoff):
    """Y theta = tau stays exact when rows and torque pass the same filter."""
    rng = np.random.default_rng(seed)
    rows, theta = rng.normal(size=(700, 4)), rng.normal(size=4)
    low_pass = design_low_pass(cutoff, 200.0)
    both = low_pass.decimated(rows) @ theta - low_pass.decimated(rows @ theta)
    assert np.max(np.abs(both)) < 1e-12


@given(st.floats(1.0, 60.0), st.floats(0.0, 1.0), st.floats(0.0, 6.0))
def test_pass_band_and_stop_band_keep_their_promise(cutoff, where, phase):
    rate = 200.0
    low_pass = design_low_pass(cutoff, rate)
    time = seconds(12.0, rate)
    half = low_pass.half_width
    slow = np.sin(2.0 * np.pi * 0.4 * cutoff * where * time + phase)
    assert np.max(np.abs(low_pass.filtered(slow) - slow[half : len(slow) - half])) < 1e-4
    stop = 1.6 * cutoff + where * max(0.0, 0.49 * rate - 1.6 * cutoff)
    assert np.max(np.abs(low_pass.filtered(np.sin(2.0 * np.pi * stop * time + phase)))) < 1e-4


@given(st.floats(90.0, 150.0), st.floats(2.0, 50.0), st.floats(0.0, 1.0), st.floats(0.0, 6.0))
def test_the_pass_band_is_as_flat_as_it_is_asked_for(attenuation, cutoff, where, phase):
    low_pass = design_low_pass(cutoff, 200.0, attenuation)
    time = seconds(12.0, 200.0)
    slow = np.sin(2.0 * np.pi * 0.4 * cutoff * where * time + phase)
    half = low_pass.half_width
    off = np.max(np.abs(low_pass.filtered(slow) - slow[half : len(slow) - half]))
    # Kaiser's formulas are approximate for short kernels.
    assert off < 10.0 ** (-(attenuation - 10.0) / 20.0)


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 61.0, np.nan])
def test_a_cutoff_outside_the_sample_rate_is_refused(cutoff):
    with pytest.raises(InputError, match="between 0 and 60 Hz"):
        design_low_pass(cutoff, 200.0)

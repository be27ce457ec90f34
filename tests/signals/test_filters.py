"""A pass and a stop band, derivatives exact for polynomials, shifts for band-limited signals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.errors import InputError
from robot_sysid.signals.filters import (
    FINE_REACH,
    REACH,
    Decimator,
    design_low_pass,
    first_derivative,
    second_derivative,
    shift_samples,
)
from tests.support.swing import Swing, seconds


@given(
    st.floats(1.0, 60.0),
    st.lists(st.integers(1, 90), min_size=1, max_size=12),
    st.integers(0),
)
def test_chunks_of_any_size_give_the_same_decimated_samples(cutoff, sizes, seed):
    low_pass = design_low_pass(cutoff, 200.0)
    values = default_rng(seed).normal(size=(sum(sizes) + 500, 2, 3))
    stream = Decimator(low_pass)
    cuts = [0, *np.cumsum(sizes), len(values)]
    pieces = [stream.push(values[a:b]) for a, b in zip(cuts, cuts[1:])]
    assert_array_equal(np.concatenate(pieces), low_pass.decimate(values))
    every = low_pass.filter(values)[:: low_pass.step]
    assert_allclose(low_pass.decimate(values), every, rtol=0.0, atol=1e-12)
    assert len(low_pass.centres(len(values))) == len(every)


@given(
    st.floats(90.0, 150.0),
    st.floats(2.0, 50.0),
    st.floats(0.0, 1.0),
    st.floats(0.0, 6.0),
)
def test_pass_band_and_stop_band_keep_the_attenuation(
    attenuation, cutoff, position, phase
):
    low_pass = design_low_pass(cutoff, 200.0, attenuation)
    time = seconds(12.0, 200.0)
    half = low_pass.half_width
    slow = np.sin(2.0 * np.pi * 0.4 * cutoff * position * time + phase)
    distortion = np.max(np.abs(low_pass.filter(slow) - slow[half : len(slow) - half]))
    # Kaiser's formulas are approximate for short kernels.
    bound = 10.0 ** (-(attenuation - 10.0) / 20.0)
    stop = 1.6 * cutoff + position * max(0.0, 98.0 - 1.6 * cutoff)
    fast = np.sin(2.0 * np.pi * stop * time + phase)
    leakage = np.max(np.abs(low_pass.filter(fast)))
    assert distortion < bound and leakage < bound
    with pytest.raises(InputError, match="between 0 and 60 Hz"):
        design_low_pass(60.0 + cutoff, 200.0)


@given(
    st.sampled_from([REACH, FINE_REACH]), st.lists(st.floats(-1.0, 1.0), min_size=17)
)
def test_derivatives_are_exact_for_polynomials_of_their_order(reach, coefficients):
    polynomial = np.polynomial.Polynomial(coefficients[: 2 * reach + 1])
    time = seconds(2.0, 20.0) - 1.0
    inner = time[reach:-reach]
    for function, order in ((first_derivative, 1), (second_derivative, 2)):
        expected = polynomial.deriv(order)(inner)
        assert_allclose(function(polynomial(time), 20.0, reach), expected, atol=5e-9)


@given(st.floats(-40.0, 40.0), st.integers(0, 1000))
def test_a_shift_evaluates_the_signal_at_later_instants(samples, seed):
    swing = Swing(seed, np.array([1.0, 7.0, 23.0]))
    rate = 100.0
    time = seconds(6.0, rate)
    shifted, first = shift_samples(swing.q(time), samples)
    expected = swing.q(time[first : first + len(shifted)] + samples / rate)
    assert_allclose(shifted, expected, rtol=0.0, atol=2e-5)

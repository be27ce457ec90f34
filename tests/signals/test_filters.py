"""A pass and a stop band, derivatives exact for polynomials."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.logs.swing import seconds
from robot_sysid.errors import InputError
from robot_sysid.signals.filters import REACH, derivatives, design_low_pass


@given(st.floats(1.0, 60.0), st.integers(0, 900), st.integers(0))
def test_decimated_samples_are_every_so_many_filtered_ones(cutoff, count, seed):
    low_pass = design_low_pass(cutoff, 200.0)
    values = default_rng(seed).normal(size=(count, 2, 3))
    every = replace(low_pass, step=1).decimate(values)[:: low_pass.step]
    assert_allclose(low_pass.decimate(values), every, rtol=0.0, atol=1e-12)


@given(st.floats(2.0, 50.0), st.floats(0.0, 1.0), st.floats(0.0, 6.0))
def test_pass_band_and_stop_band_keep_the_attenuation(cutoff, position, phase):
    low_pass = replace(design_low_pass(cutoff, 200.0), step=1)
    time = seconds(12.0, 200.0)
    half = low_pass.half_width
    slow = np.sin(2.0 * np.pi * 0.4 * cutoff * position * time + phase)
    distortion = np.max(np.abs(low_pass.decimate(slow) - slow[half : len(slow) - half]))
    stop = 1.6 * cutoff + position * max(0.0, 98.0 - 1.6 * cutoff)
    fast = np.sin(2.0 * np.pi * stop * time + phase)
    leakage = np.max(np.abs(low_pass.decimate(fast)))
    assert distortion < 1e-4 and leakage < 1e-4
    with pytest.raises(InputError, match="between 0.001 and 60 Hz"):
        design_low_pass(60.0 + cutoff, 200.0)


@given(st.lists(st.floats(-1.0, 1.0), min_size=17))
def test_derivatives_are_exact_for_polynomials_of_their_order(coefficients):
    polynomial = np.polynomial.Polynomial(coefficients[: 2 * REACH + 1])
    time = seconds(2.0, 20.0) - 1.0
    inner = time[REACH:-REACH]
    computed = derivatives(polynomial(time), 20.0)
    for order, derivative in enumerate(computed, start=1):
        expected = polynomial.deriv(order)(inner)
        assert_allclose(derivative, expected, atol=5e-9)

"""Derivatives exact for polynomials, shifts exact for band-limited signals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.signals.differences import (
    FINE_REACH,
    REACH,
    advanced,
    first_derivative,
    second_derivative,
)
from robot_sysid.signals.low_pass import design_low_pass
from tests.support.swing import Swing, seconds


@given(st.sampled_from([REACH, FINE_REACH]), st.lists(st.floats(-1.0, 1.0), min_size=17))
def test_derivatives_are_exact_for_polynomials_of_their_order(reach, coefficients):
    polynomial = np.polynomial.Polynomial(coefficients[: 2 * reach + 1])
    time = seconds(2.0, 20.0) - 1.0
    inner = time[reach:-reach]
    for function, order in ((first_derivative, 1), (second_derivative, 2)):
        expected = polynomial.deriv(order)(inner)
        np.testing.assert_allclose(function(polynomial(time), 20.0, reach), expected, atol=5e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_a_high_rate_does_not_make_rounding_large(order):
    """What is left of the positions' own rounding is as fast as the samples are."""
    swing, rate = Swing(), 20000.0
    function = (first_derivative, second_derivative)[order - 1]
    true = swing.q(seconds(2.0, rate), order)[FINE_REACH:-FINE_REACH]
    wrong = function(swing.q(seconds(2.0, rate)), rate, FINE_REACH) - true
    left = design_low_pass(12.0, rate).filtered(wrong)
    assert np.max(np.abs(left)) < 2e-11 * np.max(np.abs(true))


@given(st.floats(-40.0, 40.0), st.integers(0, 1000))
def test_a_shift_evaluates_the_signal_at_later_instants(samples, seed):
    swing, rate = Swing(seed, np.array([1.0, 7.0, 23.0])), 100.0
    time = seconds(6.0, rate)
    shifted, first = advanced(swing.q(time), samples)
    expected = swing.q(time[first : first + len(shifted)] + samples / rate)
    np.testing.assert_allclose(shifted, expected, rtol=0.0, atol=2e-5)


@given(st.integers(-50, 50), st.integers(0, 2**32))
def test_whole_samples_are_shifted_without_loss(samples, seed):
    noise = np.random.default_rng(seed).normal(size=300)
    shifted, first = advanced(noise, float(samples))
    start = first + samples
    np.testing.assert_allclose(shifted, noise[start : start + len(shifted)], atol=1e-14)

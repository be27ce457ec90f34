"""Friction bases: linear in their coefficients, odd in velocity, named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.friction import TERMS, friction_terms
from robot_sysid.errors import InputError

VELOCITIES = arrays(float, 12, elements=st.floats(-20.0, 20.0, allow_nan=False))
SIGNALS = arrays(float, 12, elements=st.floats(-50.0, 50.0, allow_nan=False))


@given(VELOCITIES, SIGNALS, SIGNALS)
def test_reversed_motion_reverses_every_torque_except_the_offset(qd, qdd, load):
    for term, column in TERMS.items():
        sign = 1.0 if term == "offset" else -1.0
        assert_array_equal(column(-qd, -qdd, load), sign * column(qd, qdd, load))


@given(VELOCITIES, SIGNALS, SIGNALS)
def test_terms_with_a_sign_brake_the_motion(qd, qdd, load):
    """Power of each dissipative term is >= 0 for a coefficient >= 0."""
    for term in ("coulomb", "viscous", "sqrt", "stribeck", "load"):
        assert np.all(TERMS[term](qd, qdd, load) * qd >= 0.0)


def test_columns_at_hand_computed_values():
    motion = np.array([[-4.0, 0.1], [3.0, 5.0], [2.0, -7.0]])
    columns = np.stack([column(*motion) for column in TERMS.values()], axis=1)
    coulomb_to_sqrt = [[-1.0, -4.0, 1.0, 3.0, -2.0], [1.0, 0.1, 1.0, 5.0, np.sqrt(0.1)]]
    assert_allclose(columns[:, :5], coulomb_to_sqrt, rtol=1e-15)
    assert_allclose(columns[:, 5], [0.0, np.exp(-1.0)], rtol=1e-12, atol=1e-80)
    assert_array_equal(columns[:, 6], [-2.0, 7.0])
    assert_allclose(columns[:, 7], [-1.0, np.tanh(2.0)], rtol=1e-12)


def test_a_leading_plus_adds_to_the_default():
    expected = ("coulomb", "viscous", "offset", "armature", "sqrt")
    assert friction_terms("+armature+sqrt") == expected


@pytest.mark.parametrize(
    "name", ["colomb-viscous", "", "coulomb--viscous", "+", "auto"]
)
def test_an_unknown_name_lists_the_valid_ones(name):
    with pytest.raises(
        InputError, match="coulomb, viscous, offset, armature, sqrt, stribeck"
    ):
        friction_terms(name)

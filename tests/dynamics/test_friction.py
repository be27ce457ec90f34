"""Friction bases: linear in their coefficients, odd in velocity, named."""

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import SEEDS
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.errors import InputError
from robot_sysid.estimate.options import friction_terms


def torque(name, qd, qdd, load):
    """Torque per unit of a term's parameter."""
    return TERMS[name].torque(np.sign(qd), qd, qdd, load)


@given(SEEDS)
def test_reversed_motion_reverses_every_torque_except_the_offset(seed):
    """Terms with a sign brake: the power of a coefficient >= 0 is >= 0."""
    qd, qdd, load = 10.0 * np.random.default_rng(seed).normal(size=(3, 12))
    qd[0] = 0.0
    for name in TERMS:
        forward = torque(name, qd, qdd, load)
        sign = 1.0 if name == "offset" else -1.0
        assert_array_equal(torque(name, -qd, -qdd, load), sign * forward)
        if name in ("coulomb", "viscous", "sqrt", "stribeck", "load"):
            assert np.all(forward * qd >= 0.0)


def test_torques_at_hand_computed_values():
    motion = np.array([[-4.0, 0.1], [3.0, 5.0], [2.0, -7.0]])
    for name, *expected in (
        ("coulomb", -1.0, 1.0),
        ("viscous", -4.0, 0.1),
        ("offset", 1.0, 1.0),
        ("armature", 3.0, 5.0),
        ("sqrt", -2.0, np.sqrt(0.1)),
        ("stribeck", 0.0, np.exp(-1.0)),
        ("load", -2.0, 7.0),
        ("sigmoid", -1.0, np.tanh(2.0)),
    ):
        assert_allclose(torque(name, *motion), expected, rtol=1e-12, atol=1e-80)


def test_a_leading_plus_adds_to_the_default():
    expected = ("coulomb", "viscous", "offset", "armature", "sqrt")
    assert friction_terms("+armature+sqrt") == expected


@pytest.mark.parametrize(
    "name", ["colomb-viscous", "", "coulomb--viscous", "+", "auto"]
)
def test_an_unknown_name_lists_the_valid_ones(name):
    with pytest.raises(
        InputError, match="coulomb, viscous, offset, armature, sqrt, fading_fast"
    ):
        friction_terms(name)

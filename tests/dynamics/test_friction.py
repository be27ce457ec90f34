"""Friction bases: linear in their coefficients, odd in velocity, named."""

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import SEEDS
from robot_sysid.dynamics.friction import (
    BEND,
    TERMS,
    polynomial,
    stated_top,
    top_speeds,
)
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
        if TERMS[name].is_friction and TERMS[name].lower == 0.0:
            # A bend brakes up to the speed at which it is flat.
            braking = np.abs(qd) < (3.0 if TERMS[name].over_top else np.inf)
            assert np.all((forward * qd)[braking] >= 0.0)


def test_no_term_is_another_one():
    qd = np.linspace(-0.5, 0.5, 41)
    qdd, load = np.random.default_rng(0).normal(size=(2, len(qd)))
    columns = np.stack([torque(name, qd, qdd, load) for name in TERMS])
    columns /= np.linalg.norm(columns, axis=1, keepdims=True)
    alike = np.abs(columns @ columns.T) - np.eye(len(columns))
    assert np.max(alike) < 1.0 - 1e-4


def test_torques_at_hand_computed_values():
    motion = np.array([[-4.0, 0.1], [3.0, 5.0], [2.0, -7.0]])
    for name, *expected in (
        ("coulomb", -1.0, 1.0),
        ("viscous", -4.0, 0.1),
        ("offset", 1.0, 1.0),
        ("armature", 3.0, 5.0),
        ("bend", -28.0, 0.271),
        ("quadratic", -16.0, 0.01),
        ("cubic", -64.0, 0.001),
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
        InputError, match="coulomb, viscous, offset, armature, bend, sqrt, fading_fast"
    ):
        friction_terms(name)


@given(SEEDS)
def test_friction_that_bends_never_falls_and_is_what_a_polynomial_makes(seed):
    """Flat at its top, steepest at rest, whatever the size; so is the damping of a file."""
    rng = np.random.default_rng(seed)
    top, bend, viscous = rng.uniform(0.1, 10.0, 3)
    speed = np.linspace(-3.0 * top, 3.0 * top, 601)
    still = 0.0 * speed
    curve = bend * BEND.of_state(np.sign(speed), speed, still, still, top)
    assert np.min(np.diff(curve)) > -1e-12 * bend
    assert np.argmin(np.diff(curve[300:])) in range(99, 102)
    linear, quadratic, cubic = polynomial(viscous, bend, top)
    damping = linear * speed + quadratic * speed * np.abs(speed) + cubic * speed**3
    assert_allclose(damping, curve + viscous * speed, atol=1e-12 * np.max(damping))
    stated = (np.array([number]) for number in (linear, quadratic, cubic))
    assert stated_top(*stated) == pytest.approx(top, rel=1e-12)


def test_only_friction_that_flattens_and_nowhere_falls_is_a_bend():
    linear = np.ones(3)
    quadratic = np.array([0.0, 0.2, -3.0])
    cubic = np.array([0.0, 0.1, 1.0])
    assert_array_equal(stated_top(linear, quadratic, cubic), 0.0)


def test_friction_is_flat_beyond_the_logs_speeds_and_those_of_the_arm():
    fastest = np.array([1.0, 0.1, 0.1])
    limits = np.array([2.0, 2.0, np.inf])
    assert_allclose(top_speeds(fastest, limits), [1.25, 0.8, 1.0])

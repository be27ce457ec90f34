"""What a file gets of a joint's friction: bounded, proven or left, and told."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.identify.arm.model_friction import (
    LINEAR,
    OFFSET,
    POLYNOMIAL,
    _bends,
    _bounded,
    _notes,
    _Rows,
    _unproven,
    _with_offset,
)
from robot_sysid.records.whole_arm import FrictionCurve, HeldFriction
from tests.support import arms

SPEED = np.tile(np.sin(np.linspace(0.0, 12.0, 400)), 5) * np.linspace(0.2, 2.0, 2000)
BLOCKS = np.repeat(np.arange(5), 400)
OWN = {"coulomb": 1.0, "viscous": 2.0, "armature": 0.1}


def rows_of(noise=0.01, **terms):
    """A joint with these terms."""
    model = friction_model("-".join(POLYNOMIAL))
    columns = dict(zip(POLYNOMIAL, model.columns(SPEED, SPEED, SPEED).T))
    found = sum(value * columns[term] for term, value in terms.items())
    torque = found + noise * np.random.default_rng(1).normal(size=len(SPEED))
    return _Rows(columns, found, torque, np.zeros(len(SPEED)), BLOCKS)


def test_values_and_errors_are_those_of_least_squares():
    values, errors = _bounded(rows_of(coulomb=0.5, viscous=0.3), LINEAR)
    for term, true in (("coulomb", 0.5), ("viscous", 0.3)):
        assert values[term] == pytest.approx(true, abs=4.0 * errors[term])
        assert 0.0 < errors[term] < 1e-3


def test_a_negative_value_becomes_zero_and_the_rest_is_fitted_with_it():
    rows = rows_of(coulomb=0.5, viscous=-0.2)
    values, _ = _bounded(rows, LINEAR)
    sign = rows.columns["coulomb"]
    assert values["viscous"] == 0.0
    assert values["coulomb"] == pytest.approx(float(sign @ rows.torque / (sign @ sign)))
    assert "negative; 0 is written" in " ".join(_notes("j", {**OWN, **values}, OWN, OWN, ()))


def test_a_value_that_is_held_changes_the_others():
    values, _ = _bounded(rows_of(coulomb=0.5, viscous=0.3), LINEAR, {"viscous": 0.0})
    assert set(values) == {"coulomb"} and values["coulomb"] > 0.55


def test_the_polynomial_is_taken_where_it_predicts_what_was_not_fitted():
    assert _bends(rows_of(coulomb=0.5, viscous=0.3, cubic=0.2))
    assert not _bends(rows_of(coulomb=0.5, viscous=0.3))
    # Friction that bends downwards asks for a coefficient that no file may have.
    assert not _bends(rows_of(coulomb=0.5, viscous=0.3, quadratic=-0.1))


@pytest.mark.parametrize(
    ("found", "error", "own", "is_left"),
    [
        (0.01, 0.02, 0.0, True),
        (0.01, 0.02, 0.03, True),
        # Zero within the error, but the file's own is far outside: the file is wrong.
        (0.0, 0.02, 10.0, False),
        (0.1, 0.02, 0.1, False),
    ],
)
def test_what_is_not_proven_is_left(found, error, own, is_left):
    left = list(_unproven({"coulomb": found}, {"coulomb": error}, {"coulomb": own}, True))
    assert bool(left) == is_left
    if is_left:
        (note,) = _notes("j", {"coulomb": found}, {"coulomb": error}, {"coulomb": own}, left)
        assert "not proven, so that the model's own stays: coulomb" in note


def test_rotor_inertia_that_was_not_sought_is_left():
    assert list(_unproven({"armature": 0.0}, {"armature": 0.0}, {"armature": 0.5}, False))


NO_CURVE = FrictionCurve(*[np.zeros(0)] * 6)


@pytest.mark.parametrize(
    ("joint", "missing", "why"),
    [
        ("", {OFFSET: -0.3, "left_over_rms": 0.1}, None),
        ("", {OFFSET: 0.6}, "would creep by itself"),
        ('stiffness="2"', {OFFSET: 0.3}, "spring is the model's own"),
        ("", {"left_over_rms": 0.1}, None),
    ],
)
def test_an_offset_is_held_where_coulomb_friction_is_larger(joint, missing, why):
    robot = arms.robot_of(arms.serial_arm((arms.Z, arms.Y), joint=f'range="-2 2" {joint}'))
    before = HeldFriction({"coulomb": 0.5}, {"coulomb": 0.01}, (), missing, NO_CURVE)
    held = _with_offset(robot, 1, before, 0.02)
    assert ("offset" in held.values) == (OFFSET in missing and why is None)
    if "offset" in held.values:
        assert held.written("offset") == missing[OFFSET] and held.words("offset") == "-0.3 ± 0.02"
        assert set(held.missing) == set(missing) - {OFFSET}
    elif why is not None:
        assert why in held.notes[0] and held.missing == missing

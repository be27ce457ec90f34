"""Identified friction as a model file holds it: what was found, or what comes nearest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.output.joint_friction import friction_changes
from robot_sysid.records import JointFriction, Motion
from tests.support.results import VALUES, estimate, found, own_simulation, with_value

SPEEDS = np.random.default_rng(0).uniform(-2.0, 2.0, (400, 2))
MOTION = Motion(np.arange(400.0), np.zeros((400, 2)), SPEEDS, np.zeros((400, 2)))


def numbers(result):
    changes, notes = friction_changes(result, MOTION)
    assert notes == ()
    return {change.label: (change.frictionloss, change.damping) for change in changes}


def test_coulomb_and_viscous_friction_are_written_as_found():
    written = numbers(found())
    assert written["j5"] == pytest.approx((0.5, 0.2))
    assert written["j6"] == pytest.approx((0.4, 0.1))


def test_what_was_not_estimated_or_not_seen_keeps_the_models():
    assert numbers(found(data=own_simulation())) == {}
    assert numbers(found(friction_model="none")) == {}
    assert set(numbers(found(with_value("viscous[j5]", 0.1, np.inf)))) == {"j6"}


@pytest.mark.parametrize(
    ("own", "value", "error", "written"),
    [
        (0.8, 0.3, 0.6, None),
        (0.0, 0.3, 0.6, None),
        (0.8, 0.3, 0.2, 0.3),
        (0.4, 0.0, 0.1, 0.0),
        (0.4, 0.41, 0.05, 0.41),
    ],
)
def test_what_is_known_too_badly_to_be_better_stays_the_models(own, value, error, written):
    friction = JointFriction(np.array([0.5, own]), np.array([0.2, 0.1]))
    result = found(with_value("coulomb[j6]", value, error), model_friction=friction)
    coulomb, viscous = numbers(result)["j6"]
    assert coulomb == (None if written is None else pytest.approx(written, abs=1e-9))
    assert viscous == pytest.approx(0.1)


@given(st.floats(-1.0, 0.0))
def test_no_joint_drives_itself(coulomb):
    values = numbers(found(with_value("coulomb[j6]", coulomb, 0.1)))["j6"]
    assert min(values) >= 0.0


def named(terms, more):
    """The same result with more friction terms in every joint."""
    names = (*estimate().names, *(f"{term}[{joint}]" for term in terms for joint in ("j5", "j6")))
    size = len(names)
    result = estimate(
        names=names,
        values=np.append(VALUES, more),
        standard_errors=np.full(size, 0.01),
        data_share=np.ones(size),
    )
    return found(result, friction_model="-".join(("coulomb", "viscous", *terms)))


def test_offset_and_rotor_are_no_friction():
    written = numbers(named(("offset", "armature"), [3.0, 3.0, 0.2, 0.2]))
    assert written["j6"] == pytest.approx((0.4, 0.1))


def test_a_curved_friction_is_met_as_well_as_two_numbers_can():
    """Breakaway of 0.2 N·m at 0.1 rad/s raises the Coulomb friction a little, not by 0.2."""
    coulomb, viscous = numbers(named(("stribeck",), [0.2, 0.2]))["j6"]
    assert 0.4 < coulomb < 0.5 and 0.05 < viscous < 0.1
    qd = SPEEDS[:, 1]
    wanted = 0.4 * np.sign(qd) + 0.1 * qd + 0.2 * np.sign(qd) * np.exp(-((qd / 0.1) ** 2))
    columns = np.column_stack((np.sign(qd), qd))
    best = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    assert (coulomb, viscous) == pytest.approx(tuple(best))


def test_friction_that_grows_with_the_load_is_said_not_to_fit():
    changes, notes = friction_changes(named(("load",), [0.02, 0.02]), MOTION)
    assert changes == () and "the model's is kept" in notes[0]

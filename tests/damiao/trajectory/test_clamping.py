"""Clamping to the motors' limits, and what is said about it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.trajectory.clamping import ClampTally, rating_warnings

TYPES = st.lists(st.sampled_from(sorted(MOTORS)), min_size=1, max_size=4)
RATED = [name for name, spec in MOTORS.items() if spec.peak_torque is not None]


@st.composite
def motions(draw):
    """Motors, and (q, qd, tau) that now and then exceed their limits, as one array."""
    names = draw(TYPES)
    joints = damiao_joints(names, len(names))
    rows = draw(st.integers(1, 12))
    shares = hnp.arrays(float, (3, rows, len(joints)), elements=st.floats(-3.0, 3.0))
    return joints, draw(shares) * np.array([joint.spec.limits for joint in joints]).T[:, None, :]


@given(motions())
def test_what_comes_out_is_inside_the_limits_and_as_near_as_it_can_be(case):
    joints, asked = case
    limits = np.array([joint.spec.limits for joint in joints]).T[:, None, :]
    tally = ClampTally(joints)
    given_out = np.array(tally.clamp(*asked))
    assert np.all(np.abs(given_out) <= limits)
    inside = np.abs(asked) <= limits
    np.testing.assert_array_equal(given_out[inside], asked[inside])
    np.testing.assert_array_equal(np.abs(given_out) == limits, np.abs(asked) >= limits)
    changed = np.count_nonzero(np.any(~inside, axis=0), axis=0)
    np.testing.assert_allclose(tally.clamped_percent, 100.0 * changed / asked.shape[1], rtol=1e-12)


@given(motions())
def test_peaks_are_those_that_were_asked_for_not_those_that_are_left(case):
    joints, asked = case
    tally = ClampTally(joints)
    tally.clamp(*asked)
    np.testing.assert_array_equal(tally.peak_velocity, np.abs(asked[1]).max(axis=0))
    np.testing.assert_array_equal(tally.peak_torque, np.abs(asked[2]).max(axis=0))


@given(motions(), st.data())
def test_pieces_add_up_to_the_whole(case, data):
    joints, asked = case
    cut = data.draw(st.integers(1, asked.shape[1]))
    whole, pieces = ClampTally(joints), ClampTally(joints)
    whole.clamp(*asked)
    for piece in (asked[:, :cut], asked[:, cut:]):
        if piece.shape[1]:
            pieces.clamp(*piece)
    assert pieces.samples == whole.samples
    for name in ("clamped", "peak_velocity", "peak_torque"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))
    assert list(pieces.warnings(None)) == list(whole.warnings(None))


@pytest.mark.parametrize("name", RATED)
def test_a_torque_beyond_the_peak_is_told_with_its_own_value(name):
    """Some types can be told no more than their peak torque; that must not hide the excess."""
    spec = MOTORS[name]
    asked = 2.0 * max(spec.torque_limit, spec.peak_torque)
    tally = ClampTally(damiao_joints([name], 1))
    tally.clamp(np.zeros((1, 1)), np.zeros((1, 1)), np.full((1, 1), asked))
    clamped, rating = tally.warnings(None)
    assert clamped.startswith("motor 1: 100.00 % of the samples were clamped")
    assert rating == (
        f"motor 1: {asked:.2f} N m exceeds the peak torque of a {name}, {spec.peak_torque:g} N m; "
        "it cannot follow"
    )


@pytest.mark.parametrize("name", RATED)
def test_each_rating_has_its_own_sentence(name):
    (joint,), spec = damiao_joints([name], 1), MOTORS[name]
    between = 0.5 * (spec.rated_torque + spec.peak_torque)
    for torque, words in (
        (spec.rated_torque, []),
        (between, [f"{between:.2f} N m exceeds the rated torque"]),
        (spec.peak_torque, [f"{spec.peak_torque:.2f} N m exceeds the rated torque"]),
        (1.01 * spec.peak_torque, ["exceeds the peak torque"]),
    ):
        said = list(rating_warnings(joint, 0.0, torque))
        assert len(said) == len(words)
        assert all(word in line and line.startswith("motor 1: ") for word, line in zip(words, said))


@pytest.mark.parametrize("name", [n for n, spec in MOTORS.items() if spec.no_load_rpm])
@pytest.mark.parametrize("supply", [None, 24.0, 48.0])
def test_a_speed_beyond_the_no_load_speed_is_told(name, supply):
    (joint,), spec = damiao_joints([name], 1), MOTORS[name]
    top = spec.no_load_speed(supply)
    assert list(rating_warnings(joint, top, 0.0, supply)) == []
    (line,) = rating_warnings(joint, 1.01 * top, 0.0, supply)
    assert f"exceeds the no-load speed of a {name} at {supply or spec.supply:g} V" in line

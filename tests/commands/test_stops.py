"""Zeros from end stops, and what counts as a stop while a person pushes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.commands.motors.stops import (
    HELD_LOOKS,
    HELD_WITHIN,
    SPAN_TOLERANCE,
    Extremes,
    StopZero,
)
from robot_sysid.damiao.joints import DamiaoJoint, Mounting

ANGLE = st.floats(-3.0, 3.0)


def motor_angles(joint, q):
    """Return where a joint's motor is at angles q [rad] of the joint."""
    return Mounting.of([joint]).signals(np.array(q), 0.0, 0.0)[0]


@given(
    lower=ANGLE,
    span=st.floats(0.2, 6.0),
    direction=st.sampled_from([1, -1]),
    offset=ANGLE,
    give=st.floats(-0.1, 0.1),
)
def test_stops_that_give_way_alike_show_the_zero(lower, span, direction, offset, give):
    """However the motor is mounted; the difference of both stops is what the spans differ by."""
    upper = lower + span
    joint = DamiaoJoint("", 1, 0x11, "", direction, offset)
    ends = np.sort(motor_angles(joint, [lower - give, upper + give]))
    zero = StopZero(*ends, lower, upper, direction)
    assert zero.offset == pytest.approx(offset, abs=1e-12)
    assert zero.excess == pytest.approx(2.0 * give, abs=1e-12)
    assert zero.doubt == pytest.approx(abs(give), abs=1e-12)
    if abs(abs(give) - 0.5 * SPAN_TOLERANCE) > 1e-9:
        assert zero.agrees == (abs(give) < 0.5 * SPAN_TOLERANCE)


@given(give=st.floats(-0.1, 0.1), direction=st.sampled_from([1, -1]))
def test_a_stop_that_gives_way_alone_moves_the_zero_by_no_more_than_the_doubt(
    give, direction
):
    joint = DamiaoJoint("", 1, 0x11, "", direction, 0.4)
    ends = np.sort(motor_angles(joint, [-1.0, 2.0 + give]))
    zero = StopZero(*ends, -1.0, 2.0, direction)
    assert abs(zero.offset - 0.4) <= zero.doubt + 1e-12


def followed(*looks):
    """Return the extremes of one motor after looks at these angles [rad]."""
    extremes = Extremes(1)
    for angle in looks:
        extremes.follow(np.array([angle]))
    return extremes.lowest[0], extremes.highest[0]


@given(
    place=st.integers(0, 2 * HELD_LOOKS),
    damage=st.floats(-12.5, 12.5).filter(lambda angle: abs(angle) > HELD_WITHIN),
)
def test_a_damaged_sample_is_no_stop(place, damage):
    looks = [0.0] * HELD_LOOKS + [1.0] * HELD_LOOKS
    looks.insert(place, looks[min(place, len(looks) - 1)] + damage)
    # Held once more behind it, as a person holds for many looks.
    lowest, highest = followed(*looks, *[0.0] * HELD_LOOKS, *[1.0] * HELD_LOOKS)
    assert lowest == pytest.approx(0.0) and highest == pytest.approx(1.0)


def test_an_angle_at_which_nothing_is_held_is_no_stop():
    """An arm that swings through, or that stays for too short a time."""
    swing = np.sin(np.linspace(0.0, 2.0 * np.pi, 12))
    assert followed(*swing) == (np.inf, -np.inf)
    assert followed(*[1.0] * (HELD_LOOKS - 1)) == (np.inf, -np.inf)
    assert followed(*[1.0] * HELD_LOOKS) == (1.0, 1.0)


def test_a_joint_that_was_held_nowhere_has_no_zero():
    extremes = Extremes(2)
    assert extremes.spans.tolist() == [0.0, 0.0]
    zero = StopZero(extremes.lowest[0], extremes.highest[0], -1.0, 1.0, 1)
    assert not zero.was_reached and not zero.agrees

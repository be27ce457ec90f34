"""Which limits a motion exceeds, and what is said."""

from __future__ import annotations

import numpy as np

from rigs.damiao_rig import swing, trajectory_of
from robot_sysid.damiao.preflight import StatedLimits, limit_checks
from robot_sysid.records import Limits


def excesses(trajectory, speed, limits):
    """What a motion does beyond limits, in words."""
    stated = [StatedLimits(limits, "your limit", "slower")]
    return [remark.text for remark in limit_checks(trajectory, speed, stated)]


def test_a_users_limits_hold_at_the_speed_that_is_played():
    swinging = trajectory_of(swing(2, rate=100.0))
    for speed in (0.5, 1.0):
        shaken = speed**2 * np.abs(swinging.qdd).max(axis=0)
        # Four digits of the velocities make 0.01 rad/s^2 of it.
        limits = Limits(acceleration=shaken - [0.02, 0.0])
        (finding,) = excesses(swinging, speed, limits)
        assert finding.startswith("motor 1: acceleration ")


def test_a_position_is_stated_with_its_sign():
    """Also below a range that does not include zero."""
    swinging = trajectory_of(swing(2, amplitude=-0.5))
    ranges = Limits(np.array([-0.3, -0.6]), np.array([-0.1, 0.1]))
    (finding,) = excesses(swinging, 0.5, ranges)
    words = "motor 1: position -0.5 rad is beyond your limit, -0.3, at 2.00 s; slower"
    assert finding == words

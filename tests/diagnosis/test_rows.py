"""Rows of a log for the diagnosis: linear in the torque."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from robot_sysid.diagnosis.rows import rms


def test_right_sides_are_linear_in_the_torque(contest):
    """Two torques and their sum: what the model needs at prior values stays out of it."""
    log = contest.log
    zero = log.with_torque(0.0 * log.torque).right_sides
    double = log.with_torque(2.0 * log.torque).right_sides
    assert_allclose(double - zero, 2.0 * (log.right_sides - zero), atol=1e-9)


def test_rms_is_that_of_each_column():
    values = np.array([[3.0, 0.0], [-3.0, 2.0]])
    assert_allclose(rms(values), [3.0, np.sqrt(2.0)])

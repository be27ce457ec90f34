"""What a fit leaves unexplained is told from the errors of sensors."""

import pytest

from robot_sysid.estimate.trust import odd_joints

TORQUE = {"first": 1e3, "second": 1e3, "last": 1.0}


@pytest.mark.parametrize(
    ("share", "others", "is_odd"),
    [(0.5, 0.1, True), (0.5, 1.5, False), (1.1, 1.5, True)],
)
def test_slow_errors_no_larger_than_other_sensors_are_no_misfit(share, others, is_odd):
    """Of the last joint, as shares of its torque; more than its torque is no sensor's error."""
    noise = {"first": others, "second": others, "last": share}
    odd = [*odd_joints(noise, TORQUE, dict.fromkeys(TORQUE, 0.1))]
    assert [each.joint for each in odd] == ["last"] * is_odd
    assert not [*odd_joints(noise, TORQUE, dict.fromkeys(TORQUE, 0.8))]

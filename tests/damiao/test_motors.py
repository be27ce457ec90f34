"""The motor table."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.protocol.motors import MOTORS, matching_types, motor_spec
from robot_sysid.errors import InputError

# Type, then what scales its frames: position [rad], speed [rad/s], torque [N m].
LIMITS = {
    "DM4310": (12.5, 30, 10),
    "DM4340": (12.5, 10, 28),
    "DM4340_48V": (12.5, 20, 28),
    "DM6006": (12.5, 45, 12),
    "DM8006": (12.5, 45, 20),
    "DM10010L": (12.5, 25, 200),
    "DM8009": (12.5, 45, 54),
    "DM3507": (12.566, 50, 5),
    "DM4310_48V": (12.5, 50, 10),
    "DM6248": (12.566, 20, 120),
    "DM10010": (12.5, 20, 200),
    "DMH3510": (12.5, 280, 1),
    "DMH6215": (12.5, 45, 10),
    "DMS3519": (12.5, 2000, 2),
    "DMG6220": (12.5, 45, 10),
}


def test_every_type_has_its_limits_and_finds_itself_by_them():
    assert {name: spec.limits for name, spec in MOTORS.items()} == LIMITS
    assert list(MOTORS)[:7] == list(LIMITS)[:7]
    for name, spec in MOTORS.items():
        assert 0 < spec.rated_torque < spec.peak_torque
        assert name in matching_types(spec.limits)


def test_an_unknown_type_lists_the_valid_ones():
    with pytest.raises(InputError, match="unknown Damiao motor type 'no such type'") as caught:
        motor_spec("no such type")
    assert all(name in str(caught.value) for name in MOTORS)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([], "--export-damiao requires at least one --motor-type"),
        (["DM4340"] * 3, "--motor-type was given 3 times but the chain has 7 joints"),
        (["DM4340"], "--motor-type was given once but the chain has 7 joints"),
    ],
)
def test_motor_types_have_to_match_the_chain(names, words):
    with pytest.raises(InputError, match=words):
        damiao_joints(names, 7)

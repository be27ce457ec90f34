"""The motor table."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.motors import MOTORS, matching_types, motor_spec, motor_specs
from robot_sysid.errors import InputError


def test_all_fifteen_types_are_there_and_the_seven_common_ones_come_first():
    assert len(MOTORS) == 15
    assert list(MOTORS)[:7] == [
        "DM4310", "DM4340", "DM4340_48V", "DM6006", "DM8006", "DM10010L", "DM8009",
    ]  # fmt: skip


def test_an_unknown_type_lists_the_valid_ones():
    with pytest.raises(InputError, match="unknown Damiao motor type 'DM9999'") as caught:
        motor_spec("DM9999")
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
        motor_specs(names, 7)


@pytest.mark.parametrize("name", list(MOTORS))
def test_ratings_are_ordered_and_every_type_finds_itself_by_its_limits(name):
    spec = MOTORS[name]
    assert 0 < spec.rated_torque < spec.peak_torque
    assert name in matching_types(spec.limits)
    assert min(spec.limits) > 0


def test_no_load_speed_follows_the_supply_voltage():
    rpm = 2 * np.pi / 60
    spec = MOTORS["DM4340"]
    assert spec.no_load_speed() == pytest.approx(52 * rpm)
    assert spec.no_load_speed(48.0) == pytest.approx(100 * rpm)
    assert spec.no_load_speed(36.0) == pytest.approx(76 * rpm)
    assert spec.no_load_speed(12.0) == pytest.approx(26 * rpm)
    assert MOTORS["DMH3510"].no_load_speed() is None

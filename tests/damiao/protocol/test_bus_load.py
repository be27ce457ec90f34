"""Bus-load arithmetic."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.protocol.bus_load import (
    BusTiming,
    bus_load,
    default_rate,
    highest_rate,
    suggested_rate,
)

CLASSIC, FD = BusTiming(), BusTiming(fd=True)


@pytest.mark.parametrize(
    ("motors", "classic", "fast"),
    [(1, 2593, 6184), (4, 648, 1546), (6, 432, 1031), (7, 370, 883), (8, 324, 773), (14, 185, 442)],
)
def test_highest_rates_at_seventy_percent(motors, classic, fast):
    assert highest_rate(motors, CLASSIC) == pytest.approx(classic, abs=0.6)
    assert highest_rate(motors, FD) == pytest.approx(fast, abs=0.6)


def test_frame_times():
    assert CLASSIC.frame_time == pytest.approx(135e-6)
    assert FD.frame_time == pytest.approx(56.6e-6)
    assert BusTiming(True, 1e6, 2e6).frame_time == pytest.approx(90.5e-6)
    assert BusTiming(True, 1e6, 1e6).frame_time == pytest.approx(147e-6)


def test_load_of_seven_motors():
    assert bus_load(7, 250.0, CLASSIC) == pytest.approx(0.4725)
    assert bus_load(7, 500.0, CLASSIC) == pytest.approx(0.945)
    assert bus_load(7, 500.0, FD) == pytest.approx(0.396, abs=5e-4)


def test_load_at_the_highest_rate_is_the_limit():
    for motors in range(1, 16):
        assert bus_load(motors, highest_rate(motors, FD), FD) == pytest.approx(0.7)


def test_defaults_fit_the_bus():
    assert default_rate(7, CLASSIC) == 250.0
    assert default_rate(7, FD) == 500.0
    for motors in range(1, 16):
        for timing in (CLASSIC, FD):
            assert bus_load(motors, default_rate(motors, timing), timing) <= 0.7
            assert bus_load(motors, suggested_rate(motors, timing), timing) <= 0.7

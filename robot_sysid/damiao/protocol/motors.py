"""The Damiao motor types: how their CAN frames are scaled, and what the motors can do.

The scaling limits PMAX, VMAX, TMAX are only how numbers are packed into frames; they are not what a
motor can deliver. That is what the ratings say. The scaling is stored in each motor and can be
changed there, so this table serves the export and the comparison with the registers; on a bus the
register values are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from robot_sysid.errors import InputError

RPM = 2.0 * pi / 60.0
"""One revolution per minute [rad/s]."""
# Relative; PMAX of two types is 12.5 and 12.566, five times as far apart.
_AGREEMENT = 1e-3


@dataclass(frozen=True)
class MotorSpec:
    """One motor type, from the maker's data sheets; all quantities are at the output shaft.

    Attributes:
        limits: PMAX [rad], VMAX [rad/s], TMAX [N m].
        rated_torque: torque the motor can hold for good [N m].
        peak_torque: torque it reaches for a short time [N m].
        gear_ratio: motor turns per output turn.
        supply: supply voltage the type is usually run at [V].
        no_load_rpm: its speed without load at that voltage [rev/min], None where unknown.
        rotor: inertia of its rotor times the gear ratio squared [kg m^2], 0 where unknown.
    """

    name: str
    limits: tuple[float, float, float]
    rated_torque: float
    peak_torque: float
    gear_ratio: float
    supply: float = 24.0
    no_load_rpm: float | None = None
    rotor: float = 0.0
    note: str = ""


_SPECS = (
    MotorSpec("DM4310", (12.5, 30.0, 10.0), 3.0, 7.0, 10.0, 24.0, 200.0, 0.0018),
    MotorSpec("DM4340", (12.5, 10.0, 28.0), 9.0, 27.0, 40.0, 24.0, 52.0, 0.032),
    MotorSpec("DM4340_48V", (12.5, 20.0, 28.0), 9.0, 27.0, 40.0, 48.0, 100.0, 0.032),
    MotorSpec("DM6006", (12.5, 45.0, 12.0), 4.0, 12.0, 6.0, 24.0, 240.0, 0.0021),
    MotorSpec("DM8006", (12.5, 45.0, 20.0), 8.0, 20.0, 6.0, 24.0, 200.0, 0.0041),
    MotorSpec("DM10010L", (12.5, 25.0, 200.0), 40.0, 120.0, 10.0, 24.0, 100.0, 0.056),
    MotorSpec("DM8009", (12.5, 45.0, 54.0), 20.0, 40.0, 9.0, 24.0, 160.0, 0.0158),
    MotorSpec("DM3507", (12.566, 50.0, 5.0), 0.8, 3.0, 7.0, 24.0, 460.0, 0.00043),
    MotorSpec(
        *("DM4310_48V", (12.5, 50.0, 10.0), 3.0, 7.0, 10.0, 48.0, 400.0, 0.0018),
        note="the maker's sources disagree about VMAX (30 or 50 rad/s)",
    ),
    MotorSpec("DM6248", (12.566, 20.0, 120.0), 30.0, 97.0, 48.0, 48.0, None, 0.124),
    MotorSpec("DM10010", (12.5, 20.0, 200.0), 40.0, 150.0, 10.0, 48.0, 150.0, 0.055),
    MotorSpec("DMH3510", (12.5, 280.0, 1.0), 0.18, 0.45, 1.0),
    MotorSpec("DMH6215", (12.5, 45.0, 10.0), 1.0, 2.0, 1.0),
    MotorSpec(
        *("DMS3519", (12.5, 2000.0, 2.0), 3.5, 7.8, 19.2),
        note="its TMAX is below the motor's rated torque and its VMAX leaves steps of 1 rad/s: "
        "compare with the registers before using torques or velocities",
    ),
    MotorSpec("DMG6220", (12.5, 45.0, 10.0), 1.3, 2.7, 1.0),
)
MOTORS = {spec.name: spec for spec in _SPECS}


def motor_spec(name: str) -> MotorSpec:
    """Return the type called ``name``, or raise InputError listing the valid ones."""
    try:
        return MOTORS[name]
    except KeyError:
        valid = ", ".join(MOTORS)
        raise InputError(
            f"unknown Damiao motor type {name!r}; valid types: {valid}"
        ) from None


def matching_types(limits: tuple[float, float, float]) -> tuple[str, ...]:
    """Return the names of the types whose (PMAX, VMAX, TMAX) [rad, rad/s, N m] agree."""
    return tuple(spec.name for spec in _SPECS if limits_agree(spec.limits, limits))


def limits_agree(
    expected: tuple[float, float, float], found: tuple[float, float, float]
) -> bool:
    """Tell whether two (PMAX, VMAX, TMAX) agree to a tenth of a percent."""
    return all(abs(a - b) <= _AGREEMENT * abs(a) for a, b in zip(expected, found))

"""How to play a trajectory, and when to stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao.protocol.codec import KD_MAX, KP_MAX
from robot_sysid.damiao.protocol.motors import MotorSpec
from robot_sysid.errors import InputError
from robot_sysid.records import Array


@dataclass(frozen=True)
class PlaySettings:
    """Gains, speeds and limits of a run.

    Attributes:
        kp, kd: (n,) gains [N m/rad, N m s/rad]; kd > 0.
        rate: control cycles per second [Hz].
        speed: 1 plays as recorded, less plays slower.
        ramp_time: how long the gains take to rise [s]; short, because meanwhile the arm sinks under
            whatever load the feed-forward torque does not know.
        approach_time: least duration of the way to the first point [s].
        approach_speed: highest joint speed on the way to the first point [rad/s].
        rest_time: how long the arm is held still before and after moving [s].
        start_tolerance: how far a joint may be from the first point [rad].
        max_tracking_error: [rad].
        start_temperature, max_temperature: before and while playing [deg C].
        max_missed: unanswered commands in a row that stop the run.
        max_lateness: lateness of a cycle that stops the run [s].
        deceleration: of a controlled stop [rad/s^2].
        max_bus_load: share of the bus.
    """

    kp: Array
    kd: Array
    rate: float = 250.0
    speed: float = 1.0
    ramp_time: float = 0.3
    approach_time: float = 1.0
    approach_speed: float = 0.2
    rest_time: float = 0.5
    start_tolerance: float = 0.5
    max_tracking_error: float = 0.2
    start_temperature: float = 60.0
    max_temperature: float = 80.0
    max_missed: int = 3
    max_lateness: float = 0.02
    deceleration: float = 10.0
    max_bus_load: float = 0.7

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.all(np.isfinite(value)) or np.any(np.asarray(value) < 0.0):
                raise InputError(f"--{name.replace('_', '-')} must be a positive number")
        if np.any(self.kd <= 0.0) or np.any(self.kd > KD_MAX):
            raise InputError(f"--kd must be above 0 and at most {KD_MAX:g} N m s/rad")
        if np.any(self.kp > KP_MAX):
            raise InputError(f"--kp must be at most {KP_MAX:g} N m/rad")
        if not 0.0 < self.speed <= 1.0:
            raise InputError("--speed must be above 0 and at most 1")
        if min(self.rate, self.approach_speed, self.deceleration, self.max_missed) <= 0.0:
            raise InputError("--rate, --approach-speed and --max-missed must be above 0")

    @property
    def period(self) -> float:
        """Length of a control cycle [s]."""
        return 1.0 / self.rate


def default_gains(specs: Sequence[MotorSpec]) -> tuple[Array, Array]:
    """Return (kp, kd) that suit each motor type: a quarter of a radian asks for rated torque."""
    rated = np.array([s.rated_torque or 0.3 * s.torque_limit for s in specs])
    kp = np.minimum(4.0 * rated, KP_MAX)
    return kp, np.clip(0.05 * kp, 0.05, KD_MAX)


def per_joint(values: Sequence[float] | None, default: Array, option: str) -> Array:
    """Return one value per joint from none (defaults), one (for all) or n given ones."""
    if not values:
        return default
    if len(values) not in (1, len(default)):
        raise InputError(
            f"{option} was given {len(values)} values but there are {len(default)} joints: "
            "give one for all or one per joint"
        )
    return np.full(len(default), values[0]) if len(values) == 1 else np.array(values, dtype=float)

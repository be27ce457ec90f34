"""Which model plays the real arm, and how good its sensors are: options, each checked once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robot_sysid.records.options import OptionRecord, PerJoint, not_negative, option

LONGEST_DELAY = 1.0
"""Longest torque delay that is accepted [s]; more is surely a slip of the unit."""


def _plausible_delay(value: float) -> str | None:
    if value > LONGEST_DELAY:
        return (
            f"is given in seconds and may be at most {LONGEST_DELAY:g} (got {value:g})"
        )
    return not_negative(value)


@dataclass(frozen=True)
class SimulatedArmOptions(OptionRecord):
    """The model that plays the real arm, and how good its sensors are."""

    plant_model: Path | None = option(
        None, "model that plays the real arm and makes the torques", "TRUTH.xml"
    )
    noise_torque: PerJoint = option(
        0.0,
        "standard deviation of the torque noise, one number or one per joint",
        "S [N·m] >= 0",
    )
    encoder_resolution: float = option(0.0, "step of the encoders", "R [rad] >= 0")
    torque_delay: float = option(
        0.0, "how much the measured torque lags", "S [s]", check=_plausible_delay
    )
    save_measurements: Path | None = option(
        None, "write the measurements in the form that --measurements reads", "FILE"
    )

    @property
    def is_noisy(self) -> bool:
        """Whether anything of what the sensors report is drawn at random."""
        noise = self.noise_torque
        return any(noise) if isinstance(noise, tuple) else noise != 0.0

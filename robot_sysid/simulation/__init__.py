"""A simulated arm that plays the real one: the options that choose it. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from robot_sysid.records.option_fields import OptionRecord, PathUse, PerJoint, option


@dataclass(frozen=True)
class SimulatedArmOptions(OptionRecord):
    """The model that plays the real arm, and the errors of its sensors.

    Attributes:
        plant_model: MJCF or URDF file of the arm that makes the torques; None for no such arm.
        noise_torque: standard deviation of the torque noise, one number or one per joint [N m].
        encoder_resolution: step of the measured positions [rad or m]; 0 for exact ones.
        save_measurements: CSV file to write the measurements to.
    """

    plant_model: Optional[Path] = option(
        None, "model in place of the real arm, which makes the torques", "TRUTH.xml"
    )
    noise_torque: PerJoint = option(
        0.0,
        "standard deviation of the torque noise, one number or one per joint",
        "S [N·m] >= 0",
    )
    encoder_resolution: float = option(0.0, "step of the encoders", "R [rad] >= 0")
    save_measurements: Optional[Path] = option(
        None,
        "write the simulated measurements as a log",
        "FILE",
        path_use=PathUse.WRITES,
    )

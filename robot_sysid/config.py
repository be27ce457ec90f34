"""What a run was asked to do: one frozen record, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import InputError


def require_positive(value: float, option: str) -> None:
    """Raise InputError unless a number is positive and finite."""
    if not (value > 0.0 and math.isfinite(value)):
        raise InputError(f"{option} must be positive (got {value:g})")


@dataclass(frozen=True)
class SysidConfig:
    """Options of one identification; defaults are those of the command line.

    Attributes:
        model: MJCF or URDF file.
        mesh_dir: folder of the meshes; None takes what the model says.
        duration: trajectory length [s].
        sample_rate: samples per second [Hz].
        friction: whether to identify the terminal joint's friction.
        output_dir: folder of the results.
        export_damiao: whether to write a trajectory for Damiao motors.
        motor_types: Damiao motor type per chain joint.
        seed: of the random trajectory; None draws a fresh one.
        joint: terminal joint; None finds it.
        torques: "chain" or "terminal".
        max_velocity: speed limit of hinge joints [rad/s].
    """

    model: Path
    mesh_dir: Path | None = None
    duration: float = 15.0
    sample_rate: float = 1000.0
    friction: bool = True
    output_dir: Path = Path("sysid_output")
    export_damiao: bool = False
    motor_types: tuple[str, ...] = ()
    seed: int | None = None
    joint: str | None = None
    torques: str = "chain"
    max_velocity: float = 2.0

    def __post_init__(self) -> None:
        require_positive(self.duration, "--duration")
        require_positive(self.sample_rate, "--sample-rate")
        require_positive(self.max_velocity, "--max-velocity")
        if self.duration * self.sample_rate < 1.0:
            raise InputError(
                "--duration times --sample-rate gives less than two samples; raise one of them"
            )
        if self.seed is not None and self.seed < 0:
            raise InputError(f"--seed must not be negative (got {self.seed})")
        if self.export_damiao and not self.motor_types:
            raise InputError(
                "--export-damiao requires at least one --motor-type, one per joint of the chain"
            )
        if self.motor_types and not self.export_damiao:
            raise InputError("--motor-type is only used together with --export-damiao; add it")

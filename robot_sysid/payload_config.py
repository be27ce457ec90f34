"""What finding a payload was asked to do: the stages' records in one, checked once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid.config import NEEDS, ModelOptions, OutputOptions, configured
from robot_sysid.errors import InputError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.excitation.options import ExcitationOptions, LimitOptions
from robot_sysid.identify.payload.options import PayloadOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.records.atomic_files import refuse_overwriting
from robot_sysid.records.options import given_options
from robot_sysid.records.results import MODEL_NAMES, PARAMS_NAME
from robot_sysid.simulation.sensors import SimulatedArmOptions
from robot_sysid.trajectory import TrajectoryOptions

CARD_NAME = "payload_card.txt"
"""Name of the file for controllers."""
MOVING = ("cutoff", "velocity_deadband", "friction_model")
"""Keys of options that poses at rest have no use for."""


@dataclass(frozen=True)
class PayloadConfig:
    """Options of one payload; defaults are those of the command line."""

    model: ModelOptions
    payload: PayloadOptions
    log: LogOptions = LogOptions()
    estimation: EstimationOptions = EstimationOptions()
    output: OutputOptions = OutputOptions()
    trajectory: TrajectoryOptions = TrajectoryOptions()
    excitation: ExcitationOptions = ExcitationOptions()
    limits: LimitOptions = LimitOptions()
    arm: SimulatedArmOptions = SimulatedArmOptions()

    def __post_init__(self) -> None:
        self._check_needs()
        logs, options = self.log, self.payload
        factors = (logs.torque_scale, logs.torque_constants)
        read: tuple[Any, ...] = (self.model.path, *options.empty, *options.loaded)
        read = (*read, options.empty_model, options.loaded_model, logs.columns)
        read = (*read, *(path for path in factors if isinstance(path, Path)), self.trajectory.file)
        refuse_overwriting(read, self._written())

    def _check_needs(self) -> None:
        """Refuse options that would have no effect."""
        from_logs = bool(self.payload.empty)
        if self.output.bundle and self.payload.known_mass is not None:
            raise InputError("--bundle is about a written model; --known-mass writes none")
        if from_logs:
            for record in (self.trajectory, self.excitation, self.limits, self.arm):
                for given in given_options(record):
                    raise InputError(
                        f"{given.flag} is about a simulation; it needs --empty-model and "
                        "--loaded-model, logs bring their own motion"
                    )
        else:
            for given in given_options(self.log):
                raise InputError(f"{given.flag} describes logs; give --empty and --loaded")
        fixed = self.trajectory.file is not None and not self.arm.is_noisy
        if fixed and self.trajectory.seed is not None:
            raise InputError(f"--seed {NEEDS['draw']}")
        for given in given_options(self.excitation):
            if given.needs == "design" and self.excitation.kind != "optimal":
                raise InputError(f"{given.flag} {NEEDS['design']}")
        for given in given_options(self.estimation) if self.payload.static else ():
            if given.key in MOVING:
                raise InputError(f"{given.flag} is about motion; --static uses poses at rest")

    def _written(self) -> Iterator[tuple[str, Path]]:
        """Yield the files that a run writes, each with the option that names it."""
        for name in (PARAMS_NAME, CARD_NAME, *MODEL_NAMES.values()):
            yield "--output-dir", self.output.output_dir / name
        if self.payload.save_torque_scale is not None:
            yield "--save-torque-scale", self.payload.save_torque_scale


def payload_config_from(path: Path, **values: Any) -> PayloadConfig:
    """Return the configuration of one payload on an arm's model file.

    Args:
        path: MJCF or URDF file.
        values: options by their keys, ``known_mass=1.0`` for --known-mass.

    Raises:
        InputError: an option is unknown, its value cannot be used, or it does not go with another.
    """
    return configured(PayloadConfig, path, values)

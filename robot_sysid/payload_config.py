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
from robot_sysid.logs.options import LogOptions
from robot_sysid.records.atomic_files import refuse_overwriting
from robot_sysid.records.options import OptionRecord, given_options, option
from robot_sysid.records.results import CARD_NAME, MODEL_NAMES, PARAMS_NAME
from robot_sysid.simulation.sensors import SimulatedArmOptions
from robot_sysid.trajectory import TrajectoryOptions

MOVING = ("cutoff", "velocity_deadband", "friction_model")
"""Keys of options that poses at rest have no use for."""


EMPTY, LOADED = "A", "B"
"""Letters of ``--order``."""


@dataclass(frozen=True)
class PayloadOptions(OptionRecord):
    """Which recordings are empty and which are loaded, and what is wanted of the payload."""

    empty: tuple[Path, ...] = option((), "logs of the arm without the payload", "LOG", several=True)
    loaded: tuple[Path, ...] = option((), "logs of the arm with the payload", "LOG", several=True)
    empty_model: Path | None = option(
        None, "instead of logs: model that plays the arm without the payload", "XML"
    )
    loaded_model: Path | None = option(
        None, "instead of logs: model that plays the arm with the payload", "XML"
    )
    order: str | None = option(
        None,
        "order in which the logs were recorded, A for the next empty one and B for the next "
        "loaded one, such as ABBA; a drift of friction is then estimated",
        "LETTERS",
        usual="from the logs' clock, where they share one",
    )
    flange: str | None = option(
        None,
        "frame of the payload: a site or body fixed to the terminal body, or x,y,z in metres",
        "FRAME",
        usual="found by its name, else the terminal body's",
    )
    as_body: str | None = option(
        None,
        "write the payload as a welded body of this name instead of merging it into the terminal "
        "link",
        "NAME",
    )
    known_mass: float | None = option(
        None,
        "the payload is a weight of this mass: estimate each joint's torque scale with it",
        "KG [kg] > 0",
    )
    scale_prior: float | None = option(
        None,
        "with --known-mass, how far each joint's torque scale may be off",
        "P [%] > 0",
        usual="3",
    )
    save_torque_scale: Path | None = option(
        None, "with --known-mass, write the scales as a file for --torque-scale", "FILE"
    )
    static: bool = option(
        False, "use resting poses only, each approached from both sides: mass and centre of mass"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        logs = bool(self.empty or self.loaded)
        models = self.empty_model is not None or self.loaded_model is not None
        if logs and models:
            raise InputError("logs and --empty-model, --loaded-model exclude each other")
        if logs and not (self.empty and self.loaded):
            missing = "--empty" if self.loaded else "--loaded"
            raise InputError(
                f"{missing} is missing: a payload is found from the difference between logs "
                "without and with it"
            )
        if not logs and (self.empty_model is None or self.loaded_model is None):
            raise InputError(
                "give --empty LOG... and --loaded LOG..., or --empty-model and --loaded-model "
                "to simulate both"
            )
        self._check_order()
        for flag, given in (
            ("--scale-prior", self.scale_prior),
            ("--save-torque-scale", self.save_torque_scale),
        ):
            if given is not None and self.known_mass is None:
                raise InputError(f"{flag} is about torque scales; add --known-mass KG")
        if self.known_mass is not None and self.as_body is not None:
            raise InputError("--known-mass writes no model; leave --as-body out")

    def _check_order(self) -> None:
        if self.order is None:
            return
        wanted = EMPTY * len(self.empty) + LOADED * len(self.loaded)
        if sorted(self.order) != sorted(wanted):
            raise InputError(
                f"--order {self.order}: needs {len(self.empty)} times A (the empty logs) and "
                f"{len(self.loaded)} times B (the loaded ones), such as {wanted}"
            )


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
        for given in given_options(self.output) if self.payload.known_mass is not None else ():
            if given.key in ("bundle", "write_offset") or given.key.startswith("keep_"):
                raise InputError(f"{given.flag} is about a written model; --known-mass writes none")
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

"""What a run was asked to do: one frozen record of the stages' records, checked once.

One record for an identification, another for finding a payload.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_type_hints

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.motion.options import ExcitationOptions, LimitOptions, PoseOptions
from robot_sysid.records.atomic_files import refuse_overwriting
from robot_sysid.records.options import (
    OptionRecord,
    folder,
    given_options,
    option,
    record_from,
    refuse_unknown,
    whole_number,
)
from robot_sysid.records.results import CARD_NAME, DAMIAO_NAME, MODEL_NAMES, PARAMS_NAME, PLAN_NAME
from robot_sysid.simulation.sensors import SimulatedArmOptions
from robot_sysid.trajectory import TrajectoryOptions, require_countable

Config = TypeVar("Config")


@dataclass(frozen=True)
class ModelOptions(OptionRecord):
    """Which arm, and which of its joints is the terminal one.

    Attributes:
        path: MJCF or URDF file.
    """

    path: Path = Path()
    mesh_dir: Path | None = option(None, "folder of the mesh files", usual="what the model says")
    joint: str | None = option(None, "terminal joint", "NAME", usual="found automatically")
    keyframe: str | None = option(
        None,
        "keyframe in which the arm is at rest, where motions start",
        "NAME",
        usual="home, or the only one",
    )


@dataclass(frozen=True)
class OutputOptions(OptionRecord):
    """Where results go."""

    NEEDS: ClassVar[str] = "measured"
    output_dir: Path = option(
        Path("sysid_output"), "folder for the results", "DIR", parse=folder, needs=""
    )
    keep_friction: bool = option(
        False, "leave the friction of the model's joints as it is", needs="friction"
    )
    keep_rotors: bool = option(False, "leave the rotor inertia of the model's joints as it is")
    keep_gravity: bool = option(False, "leave the model's gravity as it is")
    keep_links: bool = option(False, "leave all links but the terminal one as they are")
    write_offset: bool = option(
        False,
        "also write the offset of each joint's friction (unequal in the two directions), as a soft "
        "spring that is tensioned far away",
        needs="friction",
    )
    links: bool = option(False, "print every link, not only the last one")
    bundle: bool = option(
        False,
        "also write the updated model with its meshes and textures into DIR/bundle, to send it",
        needs="estimate",
    )
    report: bool = option(
        False, "also write report.html, a page with figures of the result", needs="estimate"
    )
    plots: bool = option(False, "also write the report's figures as PNG and SVG", needs="estimate")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.write_offset and self.keep_friction:
            raise InputError("--write-offset is about friction; leave --keep-friction off")

    @property
    def kept(self) -> tuple[str, ...]:
        """Parts of the model that stay as they are, see ``estimation.file_fit``."""
        parts = ("friction", "rotors", "gravity", "links")
        return tuple(part for part in parts if getattr(self, f"keep_{part}"))


@dataclass(frozen=True)
class MotorOptions(OptionRecord):
    """The trajectory as a file for Damiao motors."""

    NEEDS: ClassVar[str] = "motors"
    export_damiao: bool = option(
        False, "also write the trajectory for Damiao motors", needs="motion"
    )
    motor_type: tuple[str, ...] = option(
        (), "Damiao motor type, such as DM4340; once per joint, base first", "TYPE", repeats=True
    )
    can_id: tuple[int, ...] = option(
        (),
        "CAN id of a motor; once per joint, base first",
        "ID",
        parse=whole_number,
        repeats=True,
        usual="1, 2, 3, ...",
    )
    master_id: tuple[int, ...] = option(
        (),
        "id on which a motor answers; once per joint, base first",
        "ID",
        parse=whole_number,
        repeats=True,
        usual="CAN id + 0x10",
    )
    damiao_rate: float | None = option(
        None, "rows per second in the file", "HZ [Hz] > 0", usual="the sample rate"
    )
    supply: float | None = option(
        None,
        "supply voltage that the motors' no-load speeds are compared at",
        "V [V] > 0",
        usual="by type",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.export_damiao and not self.motor_type:
            raise InputError(
                "--export-damiao requires at least one --motor-type, one per joint of the chain"
            )


NEEDS = {
    "motion": "is about a trajectory; a log brings its own motion",
    "new motion": "is about a new trajectory; a log or --trajectory brings its own",
    "draw": "has nothing to draw: logs, --trajectory and --for friction bring their own motion, "
    "and no noise is simulated",
    "design": "is about a designed trajectory; add --excitation optimal",
    "estimate": "is about an estimate; --plan-only stops before it",
    "friction": "is about identified friction; add --measurements or --plant-model, without "
    "--no-friction",
    "measured": "needs --measurements or --plant-model",
    "log": "describes a log; add --measurements LOG.csv",
    "servos": "is about servos found from commands; add --torque-from position-error",
    "plant": "belongs to a simulated plant; add --plant-model (the model file itself will do)",
    "plant or plan": "belongs to a simulated plant or a plan; add --plant-model (the model file "
    "itself will do) or --plan-only",
    "plan": "says what a plan is for; add --plan-only, or use robot-sysid plan",
    "payload plan": "is about finding a payload; add --for payload",
    "static plan": "is about resting poses; add --static",
    "prior": "is about a prior; add --prior entropic",
    "motors": "is only used together with --export-damiao; add it",
}
"""What an option needs, to the end of the sentence that is said where it is not there."""


@dataclass(frozen=True)
class SysidConfig:
    """Options of one identification; defaults are those of the command line."""

    model: ModelOptions
    trajectory: TrajectoryOptions = TrajectoryOptions()
    excitation: ExcitationOptions = ExcitationOptions()
    limits: LimitOptions = LimitOptions()
    log: LogOptions = LogOptions()
    arm: SimulatedArmOptions = SimulatedArmOptions()
    estimation: EstimationOptions = EstimationOptions()
    output: OutputOptions = OutputOptions()
    motors: MotorOptions = MotorOptions()
    poses: PoseOptions = PoseOptions()

    def __post_init__(self) -> None:
        self._check_pairs()
        refuse_overwriting(_read_by(self), self._written())
        there = self._what_there_is()
        for record in (getattr(self, each.name) for each in fields(self)):
            for given in given_options(record):
                if given.needs and not there[given.needs]:
                    raise InputError(f"{given.flag} {NEEDS[given.needs]}")
        if self.estimation.method == "robust" and not self.is_measured:
            raise InputError(f"--method robust {NEEDS['measured']}")
        if self.excitation.kind == "optimal":
            self.excitation.basis(self.trajectory.duration)
        if self.motors.damiao_rate is not None:
            length = self.trajectory.duration / self.trajectory.speed
            require_countable(length, self.motors.damiao_rate, "--damiao-rate")

    @property
    def is_measured(self) -> bool:
        """Whether the data comes from a log or a plant instead of the model itself."""
        return bool(self.log.measurements) or self.arm.plant_model is not None

    @property
    def plan_file(self) -> Path | None:
        """Where the trajectory is written, or None."""
        usual = self.output.output_dir / PLAN_NAME if self.trajectory.plan_only else None
        return self.trajectory.save or usual

    def _check_pairs(self) -> None:
        plan, estimation, logs = self.trajectory, self.estimation, self.log.measurements
        has_file, optimal = plan.file is not None, self.excitation.kind == "optimal"
        timed = has_file or plan.duration != TrajectoryOptions.duration or optimal
        poses = "--static" if self.poses.static else "--for friction"
        plays = self.log.verify_rollout and bool(logs)
        copied = self.arm.save_measurements is not None
        exclude = {
            ("--measurements", "--plant-model"): logs and self.arm.plant_model is not None,
            ("--trajectory", "--excitation optimal"): has_file and optimal,
            (poses, "--trajectory, --duration and --excitation optimal"): (
                self.poses.sets_its_time and timed
            ),
            ("--consistency off", "--prior entropic"): (
                estimation.consistency == "off" and estimation.prior == "entropic"
            ),
            ("--verify-rollout", "--torques terminal"): plays and estimation.torques == "terminal",
            ("--save-measurements", "several --measurements"): copied and len(logs) > 1,
        }
        for (first, second), both in exclude.items():
            if both:
                raise InputError(f"{first} and {second} exclude each other; choose one")

    def _written(self) -> Iterator[tuple[str, Path]]:
        """Yield the files that a run writes, each with the option that names it."""
        if self.arm.save_measurements is not None:
            yield "--save-measurements", self.arm.save_measurements
        if self.plan_file is not None:
            yield "--save-trajectory", self.plan_file
            yield "the CSV file beside --save-trajectory", self.plan_file.with_suffix(".csv")
        names = [] if self.trajectory.plan_only else [PARAMS_NAME, *MODEL_NAMES.values()]
        names += [DAMIAO_NAME] if self.motors.export_damiao else []
        yield from (("--output-dir", self.output.output_dir / name) for name in names)

    def _what_there_is(self) -> Mapping[str, bool]:
        log, plan_only = bool(self.log.measurements), self.trajectory.plan_only
        plant = self.arm.plant_model is not None
        optimal = self.excitation.kind == "optimal"
        fixed = self.trajectory.file is not None or self.poses.purpose == "friction"
        return {
            "motion": not log,
            "new motion": not log and self.trajectory.file is None,
            "draw": not log and not fixed or plant and self.arm.is_noisy,
            "design": optimal,
            "estimate": not plan_only,
            "friction": self.is_measured and not plan_only and not self.estimation.no_friction,
            "measured": self.is_measured,
            "log": log,
            "servos": self.estimation.torque_from is not None,
            "plant": plant,
            "plant or plan": plant or plan_only or optimal,
            "plan": plan_only,
            "payload plan": self.poses.purpose == "payload",
            "static plan": self.poses.static,
            "prior": self.estimation.prior != "none",
            "motors": self.motors.export_damiao,
        }


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
        wanted = EMPTY * len(self.empty) + LOADED * len(self.loaded)
        if self.order is not None and sorted(self.order) != sorted(wanted):
            raise InputError(
                f"--order {self.order}: needs {len(self.empty)} times A (the empty logs) and "
                f"{len(self.loaded)} times B (the loaded ones), such as {wanted}"
            )
        for flag, given in (
            ("--scale-prior", self.scale_prior),
            ("--save-torque-scale", self.save_torque_scale),
        ):
            if given is not None and self.known_mass is None:
                raise InputError(f"{flag} is about torque scales; add --known-mass KG")
        if self.known_mass is not None and self.as_body is not None:
            raise InputError("--known-mass writes no model; leave --as-body out")


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
        given = self.payload
        models = (given.empty_model, given.loaded_model)
        read = (*_read_by(self), *given.empty, *given.loaded, *models)
        refuse_overwriting(read, self._written())

    def _check_needs(self) -> None:
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
        for name in (PARAMS_NAME, CARD_NAME, *MODEL_NAMES.values()):
            yield "--output-dir", self.output.output_dir / name
        if self.payload.save_torque_scale is not None:
            yield "--save-torque-scale", self.payload.save_torque_scale


def _read_by(config: SysidConfig | PayloadConfig) -> tuple[Path | None, ...]:
    """Return the files that a run reads and must not write over."""
    log = config.log
    factors = (each for each in (log.torque_scale, log.torque_constants) if isinstance(each, Path))
    models = (config.model.path, config.arm.plant_model, config.trajectory.file)
    return (*models, *log.measurements, log.validation_measurements, log.columns, *factors)


def config_from(path: Path, **values: Any) -> SysidConfig:
    """Return the configuration of a run on one model file.

    Args:
        path: MJCF or URDF file.
        values: options by their keys, ``max_velocity=1.0`` for --max-velocity.

    Raises:
        InputError: an option is unknown, its value cannot be used, or it does not go with another.
    """
    return _configured(SysidConfig, path, values)


def payload_config_from(path: Path, **values: Any) -> PayloadConfig:
    """Return the configuration of one payload on an arm's model file, see ``config_from``."""
    return _configured(PayloadConfig, path, values)


def _configured(kind: type[Config], path: Path, values: Mapping[str, Any]) -> Config:
    """Return a record of option records; arguments and errors as in ``config_from``."""
    records = get_type_hints(kind)
    refuse_unknown(values, *records.values())
    made = {name: record_from(record, values) for name, record in records.items()}
    return kind(**{**made, "model": replace(made["model"], path=Path(path))})

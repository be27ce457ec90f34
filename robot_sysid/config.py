"""What a run was asked to do: one frozen record of the stages' records, checked once.

One record for an identification, another for finding a payload.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from robot_sysid.errors import InputError
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion.plan_options import ExcitationOptions, LimitOptions, PoseOptions
from robot_sysid.records import file_access, option_fields
from robot_sysid.records.option_fields import (
    Option,
    OptionRecord,
    TrajectoryOptions,
    option,
    parse_folder,
)
from robot_sysid.records.torque_scale import SCALE, joint_factors
from robot_sysid.simulation import SimulatedArmOptions

AnyConfig = TypeVar("AnyConfig", bound="Config")
EMPTY = "A"
LOADED = "B"
"""Letters of ``--order``."""


@dataclass(frozen=True)
class OutputOptions(OptionRecord):
    """Where results go, and what of the model stays as it is (see ``estimation.file_fit``).

    No result replaces ``config``, the file that the options come from.
    """

    config: Path | None = None
    output_dir: Path = option(
        Path("sysid_output"), "folder for the results", "DIR", parse=parse_folder
    )
    keep: tuple[str, ...] = option(
        (),
        "leave this of the model as it is: friction or rotor inertia of its joints, gravity, or "
        "all links but the terminal one; may be repeated",
        choices=("friction", "rotors", "gravity", "links"),
        repeats=True,
    )
    links: bool = option(False, "print every link, not only the last one")
    bundle: bool = option(
        False,
        "also write the updated model with its meshes and textures into DIR/bundle, to send it",
    )
    report: bool = option(
        False, "also write report.html, a page with figures of the result"
    )
    plots: bool = option(False, "also write the report's figures as PNG and SVG")


_ID: dict[str, Any] = {
    "value": "ID",
    "parse": option_fields.parse_whole_number,
    "repeats": True,
}


@dataclass(frozen=True)
class MotorOptions(OptionRecord):
    """The trajectory as a file for Damiao motors."""

    export_damiao: bool = option(False, "also write the trajectory for Damiao motors")
    motor_type: tuple[str, ...] = option(
        (),
        "Damiao motor, one per joint, base first; motions keep its peak",
        "TYPE",
        repeats=True,
    )
    can_id: tuple[int, ...] = option(
        (),
        "CAN id of a motor; once per joint, base first",
        default_text="1, 2, 3, ...",
        **_ID,
    )
    master_id: tuple[int, ...] = option(
        (),
        "id on which a motor answers; once per joint, base first",
        default_text="CAN id + 0x10",
        **_ID,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.export_damiao and not self.motor_type:
            raise InputError(
                "--export-damiao requires at least one --motor-type, one per joint of the chain"
            )


def _given(
    *records: Any, only: tuple[str, ...] = (), but: tuple[str, ...] = ()
) -> list[Option]:
    """Return the options of records that were given: of some keys, or of all but some."""
    given = [each for record in records for each in option_fields.given_options(record)]
    return [
        each for each in given if each.key not in but and (not only or each.key in only)
    ]


@dataclass(frozen=True)
class Config:
    """What an identification and finding a payload are both asked."""

    model: ModelOptions
    log: LogOptions = LogOptions()
    estimation: EstimationOptions = EstimationOptions()
    output: OutputOptions = OutputOptions()

    @classmethod
    def of(cls: type[AnyConfig], path: Path, **values: Any) -> AnyConfig:
        """Return the configuration of a run on a model file: ``cutoff=8.0`` for an option.

        InputError where one is unknown, its value cannot be used, or it does not go with another.
        """
        records = get_type_hints(cls)
        option_fields.refuse_unknown(values, option_fields.keys_of(*records.values()))
        made = {
            name: option_fields.record_from(record, values)
            for name, record in records.items()
        }
        return cls(**{**made, "model": replace(made["model"], path=Path(path))})

    def __post_init__(self) -> None:
        for both, first, second in self._pairs():
            if both:
                raise InputError(f"{first} and {second} exclude each other; choose one")
        file_access.refuse_overwriting(self.read_files(), self._written())
        for needed, why, useless in self._groups():
            if not needed and useless:
                raise InputError(f"{useless[0].flag} {why}")

    def _pairs(self) -> Iterator[tuple[bool, str, str]]:
        """Yield (whether both were given, one option, another that excludes it)."""
        yield from ()

    def _groups(self) -> Iterator[tuple[bool, str, list[Option]]]:
        """Yield (whether this run uses a group, why it does not, what was given of the group)."""
        yield from ()

    def calibrated(self: AnyConfig, joint_names: Sequence[str]) -> AnyConfig:
        """Return the configuration with torque scales as sure as the file that they come from says.

        What the user says of them counts before that.
        """
        given = self.log.torque_scale
        if not isinstance(given, Path):
            return self
        scale, error = joint_factors(given, joint_names, SCALE)
        own = tuple((100.0 * error / scale).tolist())
        if self.estimation.scale_uncertainty is not None or not all(map(isfinite, own)):
            return self
        return replace(self, estimation=replace(self.estimation, scale_uncertainty=own))

    def read_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over."""
        log = self.log
        factors = (log.torque_scale, log.torque_constants)
        files = (each for each in factors if isinstance(each, Path))
        models = (self.output.config, self.model.path)
        return (
            *models,
            *log.measurements,
            log.validation_measurements,
            log.columns,
            *files,
        )

    def _written(self) -> Iterator[tuple[str, Path]]:
        """Yield the files that a run writes, each with the option that names it."""
        results = file_access.PARAMS_NAME, file_access.SERVO_NAME
        for name in (*results, *file_access.MODEL_NAMES.values()):
            yield "--output-dir", self.output.output_dir / name


OF_TORQUE = (
    "report",
    "plots",
    "keep",
    "links",
    "torque_scale",
    "torque_constants",
    "save_measurements",
)
"""Keys of options that mean nothing where no torque was measured."""
PREDICTED = (
    "torques",
    "noise_torque",
    "link_uncertainty",
    "scale_uncertainty",
    "zero_uncertainty",
    "gravity_uncertainty",
    "delay_uncertainty",
    "friction_uncertainty",
)
"""Keys of the estimate's options from which a plan says what it promises."""
PLANNED = {"excitation": "optimal", "plan_only": True}
"""What a plan does where a user does not say otherwise."""


@dataclass(frozen=True)
class SysidConfig(Config):
    """Options of one identification; defaults are those of the command line."""

    trajectory: TrajectoryOptions = TrajectoryOptions()
    excitation: ExcitationOptions = ExcitationOptions()
    limits: LimitOptions = LimitOptions()
    arm: SimulatedArmOptions = SimulatedArmOptions()
    motors: MotorOptions = MotorOptions()
    poses: PoseOptions = PoseOptions()

    @classmethod
    def of_plan(cls, path: Path, **values: Any) -> SysidConfig:
        """Return the configuration of a plan; where no motion is given, one is designed."""
        rests = values.get("static") or values.get("for_") == "friction"
        usual = {} if values.get("trajectory") or rests else PLANNED
        return cls.of(path, **{**usual, **values, "plan_only": True})

    @property
    def is_measured(self) -> bool:
        """Whether the data comes from a log or a plant instead of the model itself."""
        return bool(self.log.measurements) or self.arm.plant_model is not None

    @property
    def plan_file(self) -> Path | None:
        """Where the trajectory is written, or None."""
        usual = self.output.output_dir / file_access.PLAN_NAME
        return self.trajectory.save or (usual if self.trajectory.plan_only else None)

    @property
    def words(self) -> tuple[list[str], list[str]]:
        """Words of a command line: which arm it is, and limits that its motors have to keep."""
        from robot_sysid.damiao.trajectory import LIMITS

        model = self.model
        limits = self.limits
        given = {each.key for each in option_fields.given_options(limits)}.intersection(
            LIMITS
        )
        kept = option_fields.command_arguments(
            {key: getattr(limits, key) for key in given}, limits
        )
        return [
            str(model.path),
            *option_fields.command_arguments(vars(model), model),
        ], kept

    def seeded(self) -> SysidConfig:
        """Return the configuration with a seed, where something is random."""
        if self.trajectory.seed is not None or not self._is_drawn():
            return self
        import secrets

        return replace(
            self, trajectory=replace(self.trajectory, seed=secrets.randbelow(2**31))
        )

    def _pairs(self) -> Iterator[tuple[bool, str, str]]:
        plan = self.trajectory
        logs = self.log.measurements
        torques = self.estimation.torques
        has_plant = self.arm.plant_model is not None
        copied = self.arm.save_measurements is not None
        yield bool(logs) and has_plant, "--measurements", "--plant-model"
        optimal = self.excitation.kind == "optimal"
        is_from_file = plan.file is not None
        has_duration = plan.duration != TrajectoryOptions.duration
        poses = "--static" if self.poses.static else "--for friction"
        fixed = "--trajectory, --duration and --excitation optimal"
        timed = is_from_file or has_duration or optimal
        yield self.poses.sets_its_time and timed, poses, fixed
        played = self.log.verify_rollout and bool(logs)
        yield played and torques == "terminal", "--verify-rollout", "--torques terminal"
        yield copied and len(logs) > 1, "--save-measurements", "several --measurements"
        kept = "friction" in self.output.keep
        unsought = self.estimation.no_friction
        yield kept and unsought, "--keep friction", "--no-friction"
        yield is_from_file and optimal, "--trajectory", "--excitation optimal"
        yield is_from_file and has_duration, "--trajectory", "--duration"

    def _groups(self) -> Iterator[tuple[bool, str, list[Option]]]:
        log = bool(self.log.measurements)
        plan = self.trajectory.plan_only
        motion = (self.trajectory, self.excitation, self.limits, self.motors)
        yield not log, "is about a motion; a log brings its own", _given(*motion)
        about_log = [*_given(self.log), *_given(self.estimation, only=("torque_from",))]
        yield log, "describes a log; add --measurements LOG.csv", about_log
        estimate = "is about an estimate; a plan stops before it"
        of_torque = _given(self.estimation, only=("no_friction",))
        files = ("bundle", "report", "plots", "plant_model", "save_measurements")
        of_files = _given(self.output, self.arm, only=files)
        yield not plan, estimate, [*of_torque, *of_files]
        plant = "belongs to a simulated plant; add --plant-model (the model file itself will do)"
        simulated = self.arm.plant_model is not None
        yield (
            simulated,
            plant,
            _given(self.arm, but=("save_measurements", "noise_torque")),
        )
        # A motion is judged for this noise.
        judged = simulated or plan or self.excitation.kind == "optimal"
        yield judged, plant, _given(self.arm, only=("noise_torque",))
        measured = "is about measured torques; add --measurements or --plant-model"
        kept = _given(self.output, only=("keep", "links"))
        # These two count for simulated torques of the model itself as well.
        fitted = _given(self.estimation, but=("torques", "no_friction"))
        yield self.is_measured, measured, [*fitted, *kept]
        servos = self.estimation.torque_from is not None
        torque = _given(self.output, self.log, self.arm, only=OF_TORQUE)
        yield (
            not servos,
            "is about measured torques; leave it off with --torque-from",
            torque,
        )
        yield plan, "says what a plan is for; use robot-sysid plan", _given(self.poses)
        resting = self.poses.static and self.poses.purpose == "payload"
        rests = "is about resting poses; add --for payload and --static"
        yield resting, rests, _given(self.poses, but=("for_",))
        motors = "is only used together with --export-damiao; add it"
        yield self.motors.export_damiao, motors, _given(self.motors)
        designed = self.excitation.kind == "optimal"
        yield (
            designed,
            "is about a design; add --excitation optimal",
            _given(self.excitation),
        )
        fixed = "has nothing to draw: the motion is given, and no noise is simulated"
        yield self._is_drawn(), fixed, _given(self.trajectory, only=("seed",))

    def _is_drawn(self) -> bool:
        """Tell whether anything of the run is random."""
        fixed = self.trajectory.file is not None or self.poses.purpose == "friction"
        noisy = self.arm.plant_model is not None and self.arm.is_noisy
        return not self.log.measurements and (noisy or not fixed)

    def read_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over."""
        return (*super().read_files(), self.arm.plant_model, self.trajectory.file)

    def _written(self) -> Iterator[tuple[str, Path]]:
        if self.arm.save_measurements is not None:
            yield "--save-measurements", self.arm.save_measurements
        if self.plan_file is not None:
            yield "--save-trajectory", self.plan_file
            yield (
                "the CSV file beside --save-trajectory",
                self.plan_file.with_suffix(".csv"),
            )
        if self.motors.export_damiao:
            yield "--output-dir", self.output.output_dir / file_access.DAMIAO_NAME
        if not self.trajectory.plan_only:
            yield from super()._written()


@dataclass(frozen=True)
class PayloadOptions(OptionRecord):
    """Which recordings are empty and which are loaded, and what is wanted of the payload."""

    empty: tuple[Path, ...] = option(
        (), "logs of the arm without the payload", "LOG", takes_many=True
    )
    loaded: tuple[Path, ...] = option(
        (), "logs of the arm with the payload", "LOG", takes_many=True
    )
    order: str | None = option(
        None,
        "order in which the logs were recorded, A for the next empty one and B for the next "
        "loaded one, such as ABBA; a drift of friction is then estimated",
        "LETTERS",
        default_text="from the logs' clock, where they share one",
    )
    flange: str | None = option(
        None,
        "frame of the payload: a site or body fixed to the terminal body, or x,y,z in metres",
        "FRAME",
        default_text="found by its name, else the terminal body's",
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
    save_torque_scale: Path | None = option(
        None, "with --known-mass, write the scales as a file for --torque-scale", "FILE"
    )
    static: bool = option(
        False,
        "use resting poses only, each approached from both sides: mass and centre of mass",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.empty and self.loaded):
            missing = "--loaded LOG..." if self.empty else "--empty LOG..."
            raise InputError(
                f"{missing} is missing: a payload is found from the difference between logs "
                "without and with it"
            )
        wanted = EMPTY * len(self.empty) + LOADED * len(self.loaded)
        if self.order is not None and sorted(self.order) != sorted(wanted):
            raise InputError(
                f"--order {self.order}: needs {len(self.empty)} times A (the empty logs) and "
                f"{len(self.loaded)} times B (the loaded ones), such as {wanted}"
            )
        if self.save_torque_scale is not None and self.known_mass is None:
            raise InputError(
                "--save-torque-scale is about torque scales; add --known-mass KG"
            )
        if self.known_mass is not None and self.as_body is not None:
            raise InputError("--known-mass writes no model; leave --as-body out")


@dataclass(frozen=True)
class PayloadConfig(Config):
    """Options of one payload; defaults are those of the command line."""

    payload: PayloadOptions = field(default_factory=PayloadOptions)

    def _pairs(self) -> Iterator[tuple[bool, str, str]]:
        exact = self.estimation.scale_uncertainty in (0.0, (0.0,))
        yield (
            self.payload.known_mass is not None and exact,
            "--known-mass",
            "--scale-uncertainty 0",
        )

    def _groups(self) -> Iterator[tuple[bool, str, list[Option]]]:
        file = "is about a written model; --known-mass writes none"
        yield (
            self.payload.known_mass is None,
            file,
            _given(self.output, only=("bundle", "keep")),
        )
        moving = _given(self.estimation, only=("cutoff", "friction_model"))
        yield (
            not self.payload.static,
            "is about motion; --static uses poses at rest",
            moving,
        )

    def read_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over."""
        return (*super().read_files(), *self.payload.empty, *self.payload.loaded)

    def _written(self) -> Iterator[tuple[str, Path]]:
        yield "--output-dir", self.output.output_dir / file_access.CARD_NAME
        if self.payload.save_torque_scale is not None:
            yield "--save-torque-scale", self.payload.save_torque_scale
        yield from super()._written()

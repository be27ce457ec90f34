"""All options of a run: frozen records that hold those of the stages and check them together.

``SysidConfig`` holds the options of an identification or a plan, ``PayloadConfig`` those of the
identification of a payload.
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
from robot_sysid.motion import (
    EMPTY,
    LOADED,
    ExcitationOptions,
    LimitOptions,
    PoseOptions,
)
from robot_sysid.records import file_access, option_fields
from robot_sysid.records.controllers import AUTO, CHOICES
from robot_sysid.records.option_fields import (
    SCALE,
    Option,
    OptionRecord,
    TrajectoryOptions,
    joint_factors,
    option,
    parse_folder,
)
from robot_sysid.simulation import SimulatedArmOptions

AnyConfig = TypeVar("AnyConfig", bound="Config")


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


_ID: dict[str, Any] = {
    "value": "ID",
    "parse": option_fields.parse_whole_number,
    "repeats": True,
}
"""Arguments of ``option`` that both options on CAN ids share."""


@dataclass(frozen=True)
class MotorOptions(OptionRecord):
    """Whether the trajectory is written for Damiao motors, and which they are."""

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


def _set_options(
    *records: Any, only: tuple[str, ...] = (), leave_out: tuple[str, ...] = ()
) -> list[Option]:
    """Return the options of option records that are not at their default.

    Args:
        records: option records, such as ``LogOptions``.
        only: keys of the options to return; empty for all.
        leave_out: keys of options not to return.
    """
    set_options = []
    for record in records:
        for set_option in option_fields.given_options(record):
            key = set_option.key
            if key not in leave_out and (not only or key in only):
                set_options.append(set_option)
    return set_options


@dataclass(frozen=True)
class Config:
    """Options that an identification of an arm and one of a payload share, checked together.

    Attributes:
        model: the model file.
        log: the recordings, and how they are read.
        estimation: how the parameters are estimated.
        output: files to write.
    """

    model: ModelOptions
    log: LogOptions = LogOptions()
    estimation: EstimationOptions = EstimationOptions()
    output: OutputOptions = OutputOptions()

    @classmethod
    def of(cls: type[AnyConfig], path: Path, **values: Any) -> AnyConfig:
        """Return the configuration of a run.

        Args:
            path: the model file.
            values: key of an option of any of the records to its value.

        Raises:
            InputError: an option is unknown, its value cannot be used, or it does not go with
                another one.
        """
        record_types = get_type_hints(cls)
        known_keys = option_fields.keys_of(*record_types.values())
        option_fields.refuse_unknown(values, known_keys)
        records: dict[str, Any] = {}
        for name, record_type in record_types.items():
            records[name] = option_fields.record_from(record_type, values)
        records["model"] = replace(records["model"], path=Path(path))
        return cls(**records)

    def __post_init__(self) -> None:
        """Raise InputError for options that exclude each other or have no use in this run.

        An output file that would replace an input file raises InputError, too.
        """
        for are_both_set, first, second in self._exclusive_options():
            if are_both_set:
                raise InputError(f"{first} and {second} exclude each other; choose one")
        file_access.refuse_overwriting(self.input_files(), self._output_files())
        for is_used, reason, set_options in self._option_uses():
            if not is_used and set_options:
                raise InputError(f"{set_options[0].flag} {reason}")

    def _exclusive_options(self) -> Iterator[tuple[bool, str, str]]:
        """Yield (whether both are set, an option, another option that excludes it).

        There are none here: subclasses override this method.
        """
        yield from ()

    def _option_uses(self) -> Iterator[tuple[bool, str, list[Option]]]:
        """Yield (whether this run uses a group of options, why not, those of it that are set).

        There are none here: subclasses override this method.
        """
        yield from ()

    def with_scale_uncertainty(
        self: AnyConfig, joint_names: Sequence[str]
    ) -> AnyConfig:
        """Return the configuration with the scale uncertainty that a torque scale file states.

        It is a percentage per joint. An uncertainty that the user sets, and a file without errors,
        change nothing. ``joint_names`` are those of the chain (n,).
        """
        path = self.log.torque_scale
        if not isinstance(path, Path):
            return self
        scale, error = joint_factors(path, joint_names, SCALE)
        percentages = tuple((100.0 * error / scale).tolist())
        is_set = self.estimation.scale_uncertainty is not None
        if is_set or not all(map(isfinite, percentages)):
            return self
        estimation = replace(self.estimation, scale_uncertainty=percentages)
        return replace(self, estimation=estimation)

    def input_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over; None stands for no file."""
        log = self.log
        factors = (log.torque_scale, log.torque_constants)
        scale_files = [path for path in factors if isinstance(path, Path)]
        return (
            self.output.config,
            self.model.path,
            *log.measurements,
            log.validation_measurements,
            log.columns,
            *scale_files,
        )

    def _output_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option that has a file written, path) of each file that might replace an input."""
        names = [file_access.PARAMS_NAME, file_access.SERVO_NAME]
        names += file_access.MODEL_NAMES.values()
        for name in names:
            yield "--output-dir", self.output.output_dir / name


TORQUE_KEYS = (
    "report",
    "keep",
    "links",
    "torque_scale",
    "torque_constants",
    "save_measurements",
)
"""Keys of options that have no effect where no torque was measured."""
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
"""Keys of the options from which a plan predicts the errors of an estimate."""
PLANNED = {"excitation": "optimal", "plan_only": True}
"""Defaults of a plan's options, by key."""


@dataclass(frozen=True)
class SysidConfig(Config):
    """Options of one identification or plan; defaults are those of the command line."""

    trajectory: TrajectoryOptions = TrajectoryOptions()
    excitation: ExcitationOptions = ExcitationOptions()
    limits: LimitOptions = LimitOptions()
    arm: SimulatedArmOptions = SimulatedArmOptions()
    motors: MotorOptions = MotorOptions()
    poses: PoseOptions = PoseOptions()

    @classmethod
    def of_plan(cls, path: Path, **values: Any) -> SysidConfig:
        """Return the configuration of a plan.

        A motion is designed, unless the options name a trajectory, ask for resting poses or plan
        for friction. Arguments and errors are those of ``of``.
        """
        sets_poses = values.get("static") or values.get("for_") == "friction"
        defaults = {} if values.get("trajectory") or sets_poses else PLANNED
        return cls.of(path, **{**defaults, **values, "plan_only": True})

    @property
    def is_measured(self) -> bool:
        """Whether the data comes from a log or a plant instead of the model itself."""
        return bool(self.log.measurements) or self.arm.plant_model is not None

    @property
    def plan_file(self) -> Path | None:
        """The file that the trajectory is written to, or None."""
        if self.trajectory.save or not self.trajectory.plan_only:
            return self.trajectory.save
        return self.output.output_dir / file_access.PLAN_NAME

    def limit_words(self) -> list[str]:
        """Return the options on limits that motors have too, as words of a command line."""
        from robot_sysid.damiao.trajectory import LIMITS

        return option_fields.given_arguments(self.limits, LIMITS)

    def with_seed(self) -> SysidConfig:
        """Return the configuration with a seed, drawn where the run needs one and none is set."""
        if self.trajectory.seed is not None or not self._is_random():
            return self
        import secrets

        trajectory = replace(self.trajectory, seed=secrets.randbelow(2**31))
        return replace(self, trajectory=trajectory)

    def _is_random(self) -> bool:
        """Return whether the run draws a motion or noise, so that it needs a seed."""
        is_fixed = self.trajectory.file is not None or self.poses.purpose == "friction"
        is_noisy = self.arm.plant_model is not None and self.arm.is_noisy
        return not self.log.measurements and (is_noisy or not is_fixed)

    def _exclusive_options(self) -> Iterator[tuple[bool, str, str]]:
        """Yield (whether both are set, an option, another option that excludes it)."""
        plan = self.trajectory
        logs = self.log.measurements
        has_plant = self.arm.plant_model is not None
        yield bool(logs) and has_plant, "--measurements", "--plant-model"
        is_designed = self.excitation.kind == "optimal"
        is_from_file = plan.file is not None
        has_duration = plan.duration != TrajectoryOptions.duration
        yield (
            self.poses.sets_its_time and (is_from_file or has_duration or is_designed),
            "--static" if self.poses.static else "--for friction",
            "--trajectory, --duration and --excitation optimal",
        )
        plays_logs = self.log.verify_rollout and bool(logs)
        is_terminal = self.estimation.torques == "terminal"
        yield plays_logs and is_terminal, "--verify-rollout", "--torques terminal"
        saves = self.arm.save_measurements is not None
        yield saves and len(logs) > 1, "--save-measurements", "several --measurements"
        keeps_friction = "friction" in self.output.keep
        no_friction = self.estimation.no_friction
        yield keeps_friction and no_friction, "--keep friction", "--no-friction"
        yield is_from_file and is_designed, "--trajectory", "--excitation optimal"
        yield is_from_file and has_duration, "--trajectory", "--duration"

    def _option_uses(self) -> Iterator[tuple[bool, str, list[Option]]]:
        """Yield (whether this run uses a group of options, why not, those of it that are set)."""
        yield from self._data_option_uses()
        yield from self._motion_option_uses()

    def _data_option_uses(self) -> Iterator[tuple[bool, str, list[Option]]]:
        """Yield (whether this run uses a group of options, why not, those of it that are set).

        The groups are the options on logs, simulated plants, the estimate and its results.
        """
        has_log = bool(self.log.measurements)
        is_plan = self.trajectory.plan_only
        is_designed = self.excitation.kind == "optimal"
        has_plant = self.arm.plant_model is not None
        yield (
            not has_log,
            "is about a motion; a log brings its own",
            _set_options(self.trajectory, self.excitation, self.limits, self.motors),
        )
        yield (
            has_log,
            "describes a log; add --measurements LOG.csv",
            _set_options(self.log)
            + _set_options(self.estimation, only=("torque_from",)),
        )
        files = ("bundle", "report", "plant_model", "save_measurements")
        yield (
            not is_plan,
            "is about an estimate; a plan stops before it",
            _set_options(
                self.estimation, self.output, self.arm, only=("no_friction", *files)
            ),
        )
        needs_plant = (
            "belongs to a simulated plant; add --plant-model (the model file itself "
            "will do)"
        )
        yield (
            has_plant,
            needs_plant,
            _set_options(self.arm, leave_out=("save_measurements", "noise_torque")),
        )
        # A plan or a design predicts errors of the estimate for this noise.
        yield (
            has_plant or is_plan or is_designed,
            needs_plant,
            _set_options(self.arm, only=("noise_torque",)),
        )
        # The two options left out also apply to torques simulated with the model itself.
        yield (
            self.is_measured,
            "is about measured torques; add --measurements or --plant-model",
            _set_options(self.estimation, leave_out=("torques", "no_friction"))
            + _set_options(self.output, only=("keep", "links")),
        )
        yield (
            self.estimation.torque_from is None,
            "is about measured torques; leave it off with --torque-from",
            _set_options(self.output, self.log, self.arm, only=TORQUE_KEYS),
        )

    def _motion_option_uses(self) -> Iterator[tuple[bool, str, list[Option]]]:
        """Yield (whether this run uses a group of options, why not, those of it that are set).

        The groups are the options on a motion: its purpose, motors, design and seed.
        """
        yield (
            self.trajectory.plan_only,
            "says what a plan is for; use robot-sysid plan",
            _set_options(self.poses),
        )
        yield (
            self.poses.static and self.poses.purpose == "payload",
            "is about resting poses; add --for payload and --static",
            _set_options(self.poses, leave_out=("for_",)),
        )
        yield (
            self.motors.export_damiao,
            "is only used together with --export-damiao; add it",
            _set_options(self.motors),
        )
        yield (
            self.excitation.kind == "optimal",
            "is about a design; add --excitation optimal",
            _set_options(self.excitation),
        )
        yield (
            self._is_random(),
            "has nothing to draw: the motion is given, and no noise is simulated",
            _set_options(self.trajectory, only=("seed",)),
        )

    def input_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over."""
        return (*super().input_files(), self.arm.plant_model, self.trajectory.file)

    def _output_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option that has a file written, path) of each file that might replace an input."""
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
            yield from super()._output_files()


@dataclass(frozen=True)
class PayloadOptions(OptionRecord):
    """Recordings without and with a payload, and what is estimated and written of it."""

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
    cards: str = option(
        AUTO,
        "whose card of the payload is written: that of this arm's controller, found by the names "
        "in its model, those of all, or the one that is named",
        choices=CHOICES,
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
        letters = EMPTY * len(self.empty) + LOADED * len(self.loaded)
        if self.order is not None and sorted(self.order) != sorted(letters):
            raise InputError(
                f"--order {self.order}: needs {len(self.empty)} times A (the empty logs) and "
                f"{len(self.loaded)} times B (the loaded ones), such as {letters}"
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

    def _exclusive_options(self) -> Iterator[tuple[bool, str, str]]:
        """Yield (whether both are set, an option, another option that excludes it)."""
        is_exact = self.estimation.scale_uncertainty in (0.0, (0.0,))
        yield (
            self.payload.known_mass is not None and is_exact,
            "--known-mass",
            "--scale-uncertainty 0",
        )

    def _option_uses(self) -> Iterator[tuple[bool, str, list[Option]]]:
        """Yield (whether this run uses a group of options, why not, those of it that are set)."""
        yield (
            self.payload.known_mass is None,
            "is about a written model; --known-mass writes none",
            _set_options(self.output, only=("bundle", "keep")),
        )
        yield (
            not self.payload.static,
            "is about motion; --static uses poses at rest",
            _set_options(self.estimation, only=("cutoff", "friction_model")),
        )

    def input_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over."""
        return (*super().input_files(), *self.payload.empty, *self.payload.loaded)

    def _output_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option that has a file written, path) of each file that might replace an input."""
        yield "--output-dir", self.output.output_dir / file_access.CARD_NAME
        if self.payload.save_torque_scale is not None:
            yield "--save-torque-scale", self.payload.save_torque_scale
        yield from super()._output_files()

"""The options of each command: one frozen record per command, made of those of the stages.

What a command has no use for, its record does not have: the parser, the keywords of the Python
functions and the tables in the documentation all come from these records.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import Any, ClassVar, Optional, TypeVar

from robot_sysid.errors import InputError
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.logs import FittedLogOptions, LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion import SERVOS, AimOptions, ExcitationOptions, LimitOptions
from robot_sysid.records import file_access, option_fields
from robot_sysid.records.controllers import ALL, AUTO, CHOICES, DRIVERS, SIMULATORS
from robot_sysid.records.option_fields import (
    SCALE,
    Option,
    OptionRecord,
    PathUse,
    TrajectoryOptions,
    joint_factors,
    option,
    options_of,
    parse_folder,
    shared_error,
)
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.wording import option_name

AnyConfig = TypeVar("AnyConfig", bound="Config")
AnyMotionConfig = TypeVar("AnyMotionConfig", bound="MotionConfig")


@dataclass(frozen=True)
class OutputOptions(OptionRecord):
    """Where files go, what is drawn and printed of the result, and what it is to be.

    No file replaces ``config``, the file that the options come from.
    """

    config: Optional[Path] = None
    output_dir: Path = option(
        Path("sysid_output"),
        "folder for the results",
        "DIR",
        parse=parse_folder,
        path_use=PathUse.FOLDER,
    )
    report: bool = option(
        False, "also write report.html, a page with figures of the result"
    )
    links: bool = option(False, "print every link, not only the last one")
    torque_from: Optional[str] = option(
        None,
        "no torque was measured: find servos, friction and rotor inertia from commanded and "
        "measured positions",
        choices=("position-error",),
        default_text="measured torques",
    )


@dataclass(frozen=True)
class MotorOptions(OptionRecord):
    """Whether the trajectory is written for Damiao motors, which they are, and how mounted."""

    export_damiao: bool = option(
        False,
        "also write the trajectory for Damiao motors; {motor_type} alone does so, too",
    )
    motor_type: tuple[str, ...] = option(
        (),
        "Damiao motor, one per joint, base first; motions keep its peak",
        "TYPE",
        repeats=True,
    )
    joint_map: Optional[Path] = option(
        None,
        "how each joint's motor is mounted (see: motors map); the commands on motors that are "
        "printed have it",
        "FILE",
    )

    @property
    def are_stated(self) -> bool:
        """Whether motors are stated, so that the trajectory is written for them."""
        return bool(self.motor_type)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.export_damiao and not self.motor_type:
            raise InputError(
                f"{option_name('export_damiao')} requires at least one "
                f"{option_name('motor_type')}; state one per joint of the chain, base first"
            )
        if self.joint_map is not None and not self.motor_type:
            raise InputError(
                f"{option_name('joint_map')} is about motors; add {option_name('motor_type')}"
            )


@dataclass(frozen=True)
class Config:
    """Options of a command: base class of all.

    Attributes:
        model: the model file.
        output: files to write.
        left_out: keys of options of its records that the command does not have.
        result_names: names of files that its result may have.
    """

    model: ModelOptions = ModelOptions()
    output: OutputOptions = OutputOptions()
    left_out: ClassVar[tuple[str, ...]] = ("keyframe", "links", "torque_from")
    result_names: ClassVar[tuple[str, ...]] = (
        *file_access.RESULT_NAMES,
        file_access.DATA_NAME,
    )

    @classmethod
    def records(cls) -> dict[str, Any]:
        """Return the default of each record of options that the command has, by attribute."""
        entries = [entry for entry in fields(cls) if "fixed" not in entry.metadata]
        return {entry.name: entry.default for entry in entries}

    @classmethod
    def options(cls) -> dict[str, list[Option]]:
        """Return the options that the command has, by the attribute of their record."""
        options = {}
        for name, record in cls.records().items():
            of_record = options_of(record).values()
            options[name] = [each for each in of_record if each.key not in cls.left_out]
        return options

    @classmethod
    def option_keys(cls) -> set[str]:
        """Return the keys of the options that the command has."""
        return {stated.key for stated in chain(*cls.options().values())}

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
        option_fields.refuse_unknown(values, cls.option_keys())
        records = {}
        for name, record in cls.records().items():
            records[name] = option_fields.record_from(type(record), values)
        records["model"] = replace(records["model"], path=Path(path))
        return cls(**records)

    def __post_init__(self) -> None:
        """Raise InputError where an output file would replace an input file, or a path is no text.

        The settings of a run have all of them, in UTF-8.
        """
        for use in PathUse:
            for _, path in self._files(use):
                file_access.require_utf8(path)
        file_access.refuse_overwriting(self.input_files(), self.written_files())

    def input_files(self) -> tuple[Path | None, ...]:
        """Return the files that a run reads and must not write over; None stands for no file."""
        files = [path for _, path in self._files(PathUse.READS)]
        return (self.model.path, self.output.config, *files)

    def _files(self, use: PathUse) -> Iterator[tuple[Option, Path]]:
        """Yield (option, path) of each file that an option names for one use."""
        for record in vars(self).values():
            for name, stated in options_of(record).items():
                value = getattr(record, name)
                value = value.file if isinstance(value, Priors) else value
                leaves = option_fields.leaves(value) if stated.path_use is use else ()
                yield from ((stated, leaf) for leaf in leaves if isinstance(leaf, Path))

    def written_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option that has a file written, path) of each file that the command may write.

        Those of results are all there may be: which of them it will be, the run finds out.
        """
        yield from self.folder_files()
        yield from self.named_files()
        if self.output.report:
            path = self.output.output_dir / file_access.REPORT_NAME
            yield file_access.FOLDER_OPTION, path
        settings = self.settings_file
        if settings is not None:
            is_in_folder = settings.parent == self.output.output_dir
            beside = f"the settings beside {option_name('save_trajectory')}"
            yield file_access.FOLDER_OPTION if is_in_folder else beside, settings

    def folder_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option, path) of each file that writing the result puts into its folder."""
        for name in self.result_names:
            yield file_access.FOLDER_OPTION, self.output.output_dir / name

    def named_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option, path) of each file whose name an option states, and of those beside it."""
        for stated, path in self._files(PathUse.WRITES):
            yield stated.name, path

    @property
    def settings_file(self) -> Path | None:
        """The file that repeats the run; None where it would replace that of its own --config."""
        path = self._settings_path()
        config = self.output.config
        is_own = config is not None and path.resolve() == config.resolve()
        return None if is_own else path

    def _settings_path(self) -> Path:
        return self.output.output_dir / file_access.RUN_NAME


def _fixed_record(record: OptionRecord) -> Any:
    """Return the dataclass field of a record of options that the command does not have."""
    return field(default=record, metadata={"fixed": True})


@dataclass(frozen=True)
class MotionConfig(Config):
    """Options of a command that plans or draws a motion: base class.

    Attributes:
        trajectory: duration, sample rate, speed and files of the motion.
        excitation: how a motion is designed.
        aim: what the motion is for.
        limits: that it keeps.
        estimation: which torques will be used, and how.
        motors: that it is written for.
    """

    trajectory: TrajectoryOptions = TrajectoryOptions()
    excitation: ExcitationOptions = _fixed_record(ExcitationOptions(kind="sines"))
    # Without a plan's options, of a self-test, the terminal link is what is identified.
    aim: AimOptions = _fixed_record(AimOptions(purpose="link"))
    limits: LimitOptions = _fixed_record(LimitOptions())
    estimation: EstimationOptions = EstimationOptions()
    motors: MotorOptions = MotorOptions()

    def __post_init__(self) -> None:
        super().__post_init__()
        is_timed = self.trajectory.duration != TrajectoryOptions.duration
        if is_timed and self.trajectory.file is not None:
            raise InputError(
                f"{option_name('trajectory')} and {option_name('duration')} exclude each other"
            )

    @property
    def plan_file(self) -> Path | None:
        """The file that the trajectory is written to, or None."""
        return self.trajectory.save

    def with_seed(self: AnyMotionConfig) -> AnyMotionConfig:
        """Return the configuration with a seed, drawn where the run needs one and none is set."""
        if self.trajectory.seed is not None or not self._is_random():
            return self
        import secrets

        trajectory = replace(self.trajectory, seed=secrets.randbelow(2**31))
        return replace(self, trajectory=trajectory)

    def _is_random(self) -> bool:
        """Return whether the run draws a motion or noise, so that it needs a seed."""
        return self.trajectory.file is None

    def named_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option, path) of each file whose name an option states, and of those beside it."""
        path = self.plan_file
        if path is not None:
            yield (
                f"the CSV file beside {option_name('save_trajectory')}",
                path.with_suffix(".csv"),
            )
            if self.trajectory.save is None:
                yield file_access.FOLDER_OPTION, path
        if path is not None and self.aim.purpose == SERVOS:
            yield option_name("for_", SERVOS), path.with_name(file_access.GOALS_NAME)
        yield from super().named_files()

    def folder_files(self) -> Iterator[tuple[str, Path]]:
        """Yield (option, path) of each file that goes to the folder of results."""
        if self.motors.are_stated:
            folder = self.output.output_dir
            yield file_access.FOLDER_OPTION, folder / file_access.DAMIAO_NAME
            yield file_access.FOLDER_OPTION, folder / file_access.DAMIAO_WEIGHT_NAME
        yield from super().folder_files()


@dataclass(frozen=True)
class SelfTestConfig(MotionConfig):
    """Options of ``robot-sysid MODEL``, an identification of a simulated arm."""

    arm: SimulatedArmOptions = SimulatedArmOptions()
    left_out: ClassVar[tuple[str, ...]] = (
        "friction_model",
        "priors",
        "keep",
        # A plan prints commands on motors; a self-test does not.
        "joint_map",
        *Config.left_out,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # Measurements are written of the model itself, too.
        of_plant = replace(self.arm, save_measurements=None)
        for key in option_fields.given_values(of_plant):
            if self.arm.plant_model is None:
                raise InputError(
                    f"{option_name(key)} belongs to a simulated plant; add "
                    f"{option_name('plant_model')} (the model file itself will do)"
                )

    def _is_random(self) -> bool:
        """Return whether the run draws a motion or noise, so that it needs a seed."""
        return self.arm.noise_torque != 0.0 or super()._is_random()


@dataclass(frozen=True)
class PlanConfig(MotionConfig):
    """Options of ``plan``."""

    excitation: ExcitationOptions = ExcitationOptions()
    aim: AimOptions = AimOptions()
    limits: LimitOptions = LimitOptions()
    left_out: ClassVar[tuple[str, ...]] = (
        "links",
        "torque_from",
        "report",
        "no_friction",
        "friction_model",
        "keep",
    )
    result_names: ClassVar[tuple[str, ...]] = ()

    @property
    def plan_file(self) -> Path:
        """The file that the trajectory is written to."""
        return self.trajectory.save or self.output.output_dir / file_access.PLAN_NAME

    def _settings_path(self) -> Path:
        return self.plan_file.with_suffix(".toml")


@dataclass(frozen=True)
class LogConfig(Config):
    """Options of a command that estimates from logs: base class.

    Attributes:
        log: how logs are read.
        estimation: how the parameters are estimated.
    """

    log: LogOptions = LogOptions()
    estimation: EstimationOptions = EstimationOptions()


@dataclass(frozen=True)
class CardOptions(OptionRecord):
    """For which software the identified arm is written beside the model."""

    cards: Optional[str] = option(
        None,
        "also write the numbers of the model as a file for this simulator, for all of them, or for "
        "the software of this arm",
        choices=(ALL, *SIMULATORS, *DRIVERS),
        default_text="none",
    )


@dataclass(frozen=True)
class IdentifyConfig(LogConfig):
    """Options of ``identify``."""

    log: FittedLogOptions = FittedLogOptions()
    cards: CardOptions = CardOptions()
    left_out: ClassVar[tuple[str, ...]] = ("keyframe",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.output.torque_from is None:
            if self.log.servo_setting:
                raise InputError(
                    f"{option_name('servo_setting')} is about servos; add --torque-from "
                    "position-error at the command line"
                )
            return
        useless = [*option_fields.given_values(self.estimation)]
        if self.log.torque_scale is not None:
            useless.append("torque_scale")
        if self.log.torque_constants is not None:
            useless.append("torque_constants")
        if self.output.links:
            useless.append("links")
        if self.output.report:
            useless.append("report")
        for key in useless:
            raise InputError(
                f"{option_name(key)} is about measured torques; leave it off with --torque-from"
            )


def with_scale_prior(
    estimation: EstimationOptions, log: LogOptions, joint_names: Sequence[str]
) -> EstimationOptions:
    """Return options of an estimate with the priors of scales that torque scales state.

    Of a file it is a percentage per joint, and of rough factors one of what all share. A prior that
    the user sets, and factors without errors, change nothing. ``joint_names`` are those of the
    chain (n,).
    """
    common = 100.0 * shared_error(log.torque_scale)
    if common and not estimation.priors.common_scale:
        priors = replace(estimation.priors, common_scale=common)
        estimation = replace(estimation, priors=priors)
    if not isinstance(log.torque_scale, Path):
        return estimation
    scale, error = joint_factors(log.torque_scale, joint_names, SCALE)
    percentages = tuple((100.0 * error / scale).tolist())
    priors = estimation.priors
    if priors.scale is not None or not all(map(isfinite, percentages)):
        return estimation
    return replace(estimation, priors=replace(priors, scale=percentages))


@dataclass(frozen=True)
class CheckConfig(IdentifyConfig):
    """Options of ``check``, which writes nothing: its model may be a result."""

    def written_files(self) -> Iterator[tuple[str, Path]]:
        """Yield nothing."""
        yield from ()


@dataclass(frozen=True)
class PayloadOptions(OptionRecord):
    """Recordings without and with a payload, and what is estimated and written of it."""

    empty: tuple[Path, ...] = option(
        (), "logs of the arm without the payload", "LOG", takes_many=True
    )
    loaded: tuple[Path, ...] = option(
        (), "logs of the arm with the payload", "LOG", takes_many=True
    )
    order: Optional[str] = option(
        None,
        "order in which the logs were recorded, A for the next empty one and B for the next "
        "loaded one, such as ABBA; a drift of friction is then estimated",
        "LETTERS",
        default_text="from the logs' clock, where they share one",
    )
    flange: Optional[str] = option(
        None,
        "frame of the payload: a site or body fixed to the terminal body, or x,y,z in metres",
        "FRAME",
        default_text="found by its name, else the terminal body's",
    )
    as_body: Optional[str] = option(
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
    known_mass: Optional[float] = option(
        None,
        "the payload is a weight of this mass: estimate each joint's torque scale with it",
        "KG [kg] > 0",
    )
    save_torque_scale: Optional[Path] = option(
        None,
        "with {known_mass}, write the scales as a file for {torque_scale}",
        "FILE",
        path_use=PathUse.WRITES,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.save_torque_scale is not None and self.known_mass is None:
            raise InputError(
                f"{option_name('save_torque_scale')} is about torque scales; add "
                f"{option_name('known_mass', 'KG')}"
            )
        if self.known_mass is not None and self.as_body is not None:
            raise InputError(
                f"{option_name('known_mass')} writes no model; leave out "
                f"{option_name('as_body')}"
            )


@dataclass(frozen=True)
class PayloadConfig(LogConfig):
    """Options of ``payload``."""

    payload: PayloadOptions = PayloadOptions()
    left_out: ClassVar[tuple[str, ...]] = ("torques", "no_friction", *Config.left_out)

    def __post_init__(self) -> None:
        self._require_both()
        super().__post_init__()
        is_exact = self.estimation.priors.scale in (0.0, (0.0,))
        if self.payload.known_mass is not None and is_exact:
            raise InputError(
                f"{option_name('known_mass')} estimates torque scales, and a prior of scale 0 "
                "leaves them no room; choose one"
            )

    def _require_both(self) -> None:
        """Raise InputError, with what can be done with logs of one kind, unless both are there."""
        payload = self.payload
        if payload.empty and payload.loaded:
            return
        missing = option_name("loaded" if payload.empty else "empty", "LOG...")
        logs = payload.empty or payload.loaded
        identify = ["identify", *map(str, (self.model.path, *logs))]
        raise InputError(
            f"{missing} is missing: a payload is weighed by the difference between logs without "
            "and with it. Logs of one kind show the last link with all that is on it; identify "
            "says what that is beyond the model, as far as the model's other links are right",
            command_lines=[identify] if logs else [],
        )

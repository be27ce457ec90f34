"""The functions of the face: the commands' pipeline, with arrays in and nothing printed.

Of many logs on many machines, what each log says is a record that adds; a result follows from the
sum.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import reduce
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Union

import numpy as np

from robot_sysid.api.keywords import Model, arm_of, path_of, python_words, with_keywords
from robot_sysid.api.results import Identified, PlanResult, one_thread
from robot_sysid.config import PLANNED, Config, PayloadConfig, SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.estimation import sums
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.result import result_of
from robot_sysid.estimation.sums import LogInformation
from robot_sysid.log_pipeline import checked
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import MeasurementLog, open_log
from robot_sysid.logs.table import LogTable, arrays_table
from robot_sysid.model import ModelOptions
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.outcome import Analysis
from robot_sysid.pipeline import analysed, designed, load, predict, promise
from robot_sysid.records import Measurement, RobotModel, Traces
from robot_sysid.records.options import record_from
from robot_sysid.records.progress import Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from robot_sysid.api import keyword_types as types


class Frame(Protocol):
    """What a data frame of pandas, polars or anything else is asked for."""

    @property
    def columns(self) -> Any:
        """Names of its columns."""

    def __getitem__(self, name: Any, /) -> Any: ...


Log = Union[
    str, "os.PathLike[str]", Mapping[str, Any], Frame, Measurement, MeasurementLog
]
"""A path; arrays time (N,), q, tau and perhaps qd (N, n) by these or like names [s, rad, N m,
rad/s]; a data frame with a column per joint and quantity; or a log that was read."""
_ADDED = Path("added information")


def _log(log: Log) -> Any:
    """Return a log as something that ``logs.reader.open_log`` takes."""
    if isinstance(log, (MeasurementLog, LogTable)):
        return log
    if isinstance(log, (str, os.PathLike)):
        return Path(log)
    if isinstance(log, Measurement):
        log = {name: getattr(log, name) for name in ("time", "q", "qd", "tau")}
    elif hasattr(log, "columns") and hasattr(log, "__getitem__"):
        log = {column: log[column] for column in log.columns}
    if not isinstance(log, Mapping):
        known = "a path, arrays by name, a data frame or a Measurement"
        raise InputError(f"a log is {known}, not {type(log).__name__}")
    arrays = {str(name): np.asarray(v) for name, v in log.items() if v is not None}
    return arrays_table(Path("arrays"), "arrays in memory", arrays)


def _logs(**given: Any) -> dict[str, tuple[Any, ...]]:
    """Return one log or several of each option that was given as a tuple."""
    several = {k: v if isinstance(v, (list, tuple)) else (v,) for k, v in given.items()}
    return {k: tuple(map(_log, v)) for k, v in several.items() if given[k] is not None}


class _Notes(Progress):
    """Keeps what the commands print as notes."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, *messages: str) -> None:
        self.notes += map(python_words, messages)


@contextmanager
def _quietly() -> Iterator[_Notes]:
    """Work in one thread; keep notes and MuJoCo's warnings from being printed or written."""
    notes = _Notes()
    with one_thread(), warnings_as_notes(notes):
        yield notes


def _answered(config: Config) -> Identified:
    with _quietly() as notes:
        robot = load(config, notes)
        analysis = analysed(config, robot, notes)
    return Identified(robot, analysis, config, tuple(notes.notes))


@with_keywords()
def read_log(
    log: Log, model: Model | RobotModel, **options: Unpack[types.ReadLogKeywords]
) -> MeasurementLog:
    """Recognise, check and read a log of an arm.

    Args:
        log: see ``api.calls.Log``.
        model: the arm, whose joints' names and limits the log is checked against.
        options: what ``LogOptions`` takes, such as ``columns`` or ``units="deg,Nm"``.

    Returns:
        The log: ``samples`` with time (N,) [s], q, tau (N, n) [rad, N m], ``columns`` and
        ``notes``.

    Raises:
        InputError: it cannot be read, is ambiguous or cannot be what it seems to be.
    """
    robot = model if isinstance(model, RobotModel) else arm_of(model, {})
    return open_log(robot, _log(log), record_from(LogOptions, options))


@with_keywords()
def identify(
    model: Model,
    log: Log | Sequence[Log] | None = None,
    *,
    validation: Log | None = None,
    **options: Unpack[types.IdentifyKeywords],
) -> Identified:
    """Identify an arm: its terminal link, every other link, and its joints' friction.

    The equations and the estimate are explained in docs/method.md with their sources.

    Args:
        model: MJCF or URDF file.
        log: one log of the real arm or several (see ``api.calls.Log``); None simulates the model
            itself, or the ``plant_model`` among the options.
        validation: a log to test the result on.
        options: every option of the command, ``keep="gravity"`` for --keep gravity.

    Returns:
        The result, whether or not it may be trusted: see its ``failure``.

    Raises:
        InputError: an option, the model or a log cannot be used; says why.
    """
    values = {**options, **_logs(measurements=log)}
    if validation is not None:
        values["validation_measurements"] = _log(validation)
    return _answered(SysidConfig.of(path_of(model), **values))


@with_keywords(**PLANNED)
def plan(model: Model, **options: Unpack[types.PlanKeywords]) -> PlanResult:
    """Design a trajectory, or check one that was saved, and say what it promises.

    Args:
        model: MJCF or URDF file.
        options: every option of ``robot-sysid plan``, such as ``duration=15.0``, ``seed=1``,
            ``max_velocity=1.0`` or ``excitation="sines"``; like there, the motion is designed
            (``excitation="optimal"``); ``excitation_time_budget=60.0`` goes on for a minute.

    Raises:
        InputError: an option or the model cannot be used.
    """
    config = SysidConfig.of_plan(path_of(model), **options)
    with _quietly() as notes:
        robot = load(config, notes)
        made, _ = designed(config, robot, notes)
        lines = tuple(map(python_words, promise(config, made, predict(config, made))))
    return PlanResult(config, robot, made, lines, tuple(notes.notes))


@with_keywords()
def payload(
    model: Model,
    empty: Log | Sequence[Log],
    loaded: Log | Sequence[Log],
    **options: Unpack[types.PayloadKeywords],
) -> Identified:
    """Identify a payload from the difference between recordings without and with it.

    Args:
        model: MJCF or URDF file of the arm.
        empty: one recording without the payload or several, see ``api.calls.Log``.
        loaded: one with it or several.
        options: every option of ``robot-sysid payload``, such as ``order="ABBA"`` or
            ``flange="tool0"``.

    Raises:
        InputError: an option, the model or a recording cannot be used.
    """
    logs = _logs(empty=empty, loaded=loaded)
    return _answered(PayloadConfig.of(path_of(model), **{**options, **logs}))


@with_keywords()
def information(
    model: Model,
    log: Log | Sequence[Log],
    *,
    around: LogInformation | None = None,
    **options: Unpack[types.InformationKeywords],
) -> LogInformation:
    """Return what one log or several say of the terminal link, as a record that adds (``+``).

    For all equations [Y tau] = Q R of a joint it holds R, and sums over lags of residuals: its size
    does not grow with the log (Bierman, "Factorization Methods for Discrete Sequential
    Estimation", 1977, ch. IV).

    Args:
        model: MJCF or URDF file.
        log: see ``api.calls.Log``.
        around: the sum of a first round over all logs, for the second round.
        options: those of ``identify`` that tell how a log is read and fitted. ``cutoff`` [Hz] is
            needed; what would be chosen from all logs together is refused.

    Raises:
        InputError: an option, the model or the log cannot be used, or does not add.
    """
    values = {**options, **_logs(measurements=log)}
    robot = arm_of(model, values)
    logs = record_from(LogOptions, values)
    chosen = sums.settled_options(record_from(EstimationOptions, values))
    config = SysidConfig(ModelOptions(path_of(model)), log=logs, estimation=chosen)
    config = config.calibrated(robot.joint_names)
    found = []
    with _quietly() as notes:
        for path in logs.measurements:
            read = open_log(robot, path, logs, notes)
            checked(config, robot, [read], notes)
            how = config.estimation, around, read.notes
            found += [sums.log_information(robot, read.pieces, *how)]
    return reduce(add, found)


@with_keywords()
def identify_from(
    model: Model,
    found: LogInformation,
    *,
    validation: LogInformation | None = None,
    **options: Unpack[types.IdentifyFromKeywords],
) -> Identified:
    """Identify the terminal link from the sum of what logs say.

    Args:
        model: MJCF or URDF file.
        found: the sum of a second round.
        validation: the sum of other logs in that round, to test the result on.
        options: ``joint``, ``mesh_dir`` and ``keyframe``, as they were given to ``information``.

    Raises:
        InputError: it is the sum of a first round, or was made with another model.
    """
    for each in (found, validation):
        if not isinstance(each, (LogInformation, type(None))) or found is None:
            raise InputError(
                f"a sum of rs.information is needed, not {type(each).__name__}"
            )
    robot = arm_of(model, options)
    arm = record_from(ModelOptions, options)
    logs = LogOptions(measurements=(_ADDED,))
    config = SysidConfig(arm, log=logs, estimation=found.settled.estimation)
    with _quietly() as notes:
        answer = sums.answer_from(robot, found, validation)
        analysis = Analysis(
            result_of(answer, found.origin), found.checkpoints, _no_traces, answer
        )
    return Identified(robot, analysis, config, (*found.notes, *notes.notes))


def _no_traces() -> Traces:
    raise InputError(
        "added information holds no samples, so there are no torques to draw; identify one of the "
        "logs to see them"
    )

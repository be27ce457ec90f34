"""The Python functions: the commands' pipeline with arrays as input, and nothing printed."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Union

import numpy as np

from robot_sysid.api.keywords import with_keywords, with_options_of
from robot_sysid.api.results import PlanResult, Result, one_thread
from robot_sysid.config import (
    CheckConfig,
    Config,
    IdentifyConfig,
    PayloadConfig,
    PlanConfig,
    SelfTestConfig,
)
from robot_sysid.dynamics.friction import COULOMB, ROTOR, VISCOUS
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics, link_names
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.arrays import arrays_table
from robot_sysid.logs.reader import open_logs
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.titles import read_title
from robot_sysid.model import OF_LOG, ModelOptions
from robot_sysid.model.compilation import (
    InMemory,
    file_of,
    is_in_memory,
    warnings_as_notes,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline import stages
from robot_sysid.pipeline.comparison import Check, check_log
from robot_sysid.pipeline.motions import design_motion
from robot_sysid.pipeline.planning import predict_plan
from robot_sysid.pipeline.stages import load_arm
from robot_sysid.records import Array, Motion, Recording, RobotModel, checked_array
from robot_sysid.records.file_access import claim
from robot_sysid.records.messages import Progress, says
from robot_sysid.records.option_fields import given_values, options_of_all, record_from

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from typing_extensions import Unpack

    from robot_sysid.api.keyword_types import (
        CheckKeywords,
        IdentifyKeywords,
        PayloadKeywords,
        PlanKeywords,
        ReadLogKeywords,
        RegressorKeywords,
        SelfTestKeywords,
    )


Model = Union[str, "os.PathLike[str]", InMemory]
"""Path of an MJCF or URDF file, or a model of MuJoCo's."""


def path_of(model: Model) -> Path:
    """Return the file of a model; an MjSpec is first written to a file by MuJoCo.

    Raises:
        InputError: it is no model, or cannot be written.
    """
    if is_in_memory(model):
        return file_of(model)
    if not isinstance(model, (str, os.PathLike)):
        valid = "the path of an MJCF or URDF file, or a mujoco.MjSpec"
        raise InputError(f"a model is {valid}, not {type(model).__name__}")
    return Path(model)


def arm_of(model: Model, values: Mapping[str, Any]) -> RobotModel:
    """Return the arm in a model; ``values`` are keywords, of which ``ModelOptions`` are used.

    Raises:
        InputError: it is no model, or cannot be read.
    """
    options = record_from(ModelOptions, values)
    source = model if is_in_memory(model) else path_of(model)
    return load_robot_model(source, **given_values(options))


class Frame(Protocol):
    """The part of a data frame, of pandas, polars or another library, that is used."""

    @property
    def columns(self) -> Any:
        """Names of its columns."""

    def __getitem__(self, name: Any, /) -> Any: ...


Log = Union[str, "os.PathLike[str]", Mapping[str, Any], Frame, Recording]
"""A path; arrays time (N,), q, tau and perhaps qd (N, n) by these or like names [s, rad, N m,
rad/s]; a data frame with a column per joint and quantity; or a log that was read."""


def _log_source(log: Any) -> Any:
    """Return a log as a path, table or open log, which ``logs.reader.open_logs`` takes.

    InputError where it is none of the types of ``Log``.
    """
    if isinstance(log, LogTable) or (isinstance(log, Recording) and log.columns):
        return log
    if isinstance(log, Recording):
        log = {name: getattr(log, name) for name in ("time", "q", "qd", "tau")}
    elif isinstance(log, (str, os.PathLike)):
        return Path(log)
    elif hasattr(log, "columns") and hasattr(log, "__getitem__"):
        log = {column: log[column] for column in log.columns}
    if not isinstance(log, Mapping):
        valid = "a path, arrays by name, a data frame or a Recording"
        raise InputError(f"a log is {valid}, not {type(log).__name__}")
    arrays = {}
    for name, values in log.items():
        if values is None:
            continue
        if isinstance(values, np.ma.MaskedArray):
            # What is masked is missing.
            values = np.ma.filled(values.astype(float), np.nan)
        try:
            # NumPy before 1.24 only warns of rows that differ.
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                arrays[str(name)] = np.asarray(values)
        except (ValueError, Warning):
            raise InputError(f"{name} is no array: its rows differ in length") from None
    table = arrays_table(Path("arrays"), "arrays in memory", arrays)
    quantities = {read_title(t).quantity_beside_name for t in table.titles}
    for name, array in arrays.items():
        quantity = read_title(name).quantity
        if quantity is not None and quantity not in quantities:
            raise InputError(
                f"{name} ({array.dtype}, shape {array.shape}) holds no real numbers with a row "
                "for each time"
            )
    return table


def _log_sources(logs: Log | Sequence[Log]) -> tuple[Any, ...]:
    """Return one log, or each of several, as something that ``logs.reader.open_logs`` takes."""
    several = logs if isinstance(logs, (list, tuple)) else (logs,)
    return tuple(map(_log_source, several))


def _without_samples(logs: Sequence[Any]) -> tuple[Any, ...]:
    """Return logs without their samples: a result needs their names and how they were read."""
    kept: list[Any] = []
    for log in logs:
        if isinstance(log, LogTable):
            kept.append(log.without_rows())
        elif isinstance(log, Recording):
            kept.append(log[:0])
        else:
            kept.append(log)
    return tuple(kept)


def _config_of_result(config: Config) -> Config:
    """Return the options of a result, whose logs in memory are left out."""
    if isinstance(config, IdentifyConfig):
        log = replace(
            config.log,
            measurements=_without_samples(config.log.measurements),
            validation_measurements=_without_samples(
                config.log.validation_measurements
            ),
        )
        return replace(config, log=log)
    if isinstance(config, PayloadConfig):
        payload = replace(
            config.payload,
            empty=_without_samples(config.payload.empty),
            loaded=_without_samples(config.payload.loaded),
        )
        return replace(config, payload=payload)
    return config


class _Notes(Progress):
    """Collects the notes that a command would print."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, *messages: str) -> None:
        """Add messages to ``notes``."""
        self.notes += messages


@contextmanager
def _quietly() -> Iterator[_Notes]:
    """Run a block in one thread; yield its notes and MuJoCo's warnings instead of printing them."""
    notes = _Notes()
    with one_thread(), warnings_as_notes(notes):
        yield notes


def _run_quietly(config: IdentifyConfig | PayloadConfig | SelfTestConfig) -> Result:
    """Identify with the options of a config, without printing; the notes are in the result."""
    with _quietly() as notes, claim(config.named_files(), notes.note):
        robot = load_arm(config, notes)
        result, _ = stages.identify(config, robot, notes)
    texts = [remark.text for remark in result.remarks]
    notes_on_logs = says(note for note in notes.notes if note not in texts)
    fields = {**vars(result), "remarks": (*result.remarks, *notes_on_logs)}
    return Result(**fields, config=_config_of_result(config))


@with_keywords(options_of_all(LogOptions))
def read_log(
    log: Log | Sequence[Log],
    model: Model | RobotModel,
    **options: Unpack[ReadLogKeywords],
) -> Recording:
    """Recognise, check and read a log of an arm.

    Args:
        log: see ``robot_sysid.Log``; a file of its positions and one of its torques are a list.
        model: the arm, whose joints' names and limits the log is checked against.
        options: what ``LogOptions`` takes, such as ``columns`` or ``units="deg,ms"``.

    Returns:
        The log: time (N,) [s], q, tau (N, n) [rad, N m], ``columns`` and ``notes``.

    Raises:
        InputError: it cannot be read, is ambiguous or cannot be what it seems to be.
    """
    robot = model if isinstance(model, RobotModel) else arm_of(model, {})
    logs = open_logs(robot, _log_sources(log), record_from(LogOptions, options))
    if len(logs) != 1:
        raise InputError(f"{len(logs)} logs are given: read them one by one")
    return logs[0]


@with_options_of(IdentifyConfig)
def identify(
    model: Model,
    log: Log | Sequence[Log],
    *,
    validation_measurements: Log | Sequence[Log] | None = None,
    **options: Unpack[IdentifyKeywords],
) -> Result:
    """Identify an arm: its terminal link, every other link, and its joints' friction.

    The equations and the estimate are explained in docs/method.md with their sources.

    Args:
        model: path of an MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        log: one log of the real arm or several (see ``robot_sysid.Log``).
        validation_measurements: one log to test the result on, or several.
        options: every option of the command, ``keep="gravity"`` for --keep gravity; ``priors`` may
            also be a mapping.

    Returns:
        The result, whether or not it may be trusted: see its ``failure``.

    Raises:
        InputError: an option, the model or a log cannot be used; says why.
    """
    values = {**options, "measurements": _log_sources(log)}
    if not values["measurements"]:
        raise InputError("the list of logs is empty; give at least one log")
    if validation_measurements is not None:
        values["validation_measurements"] = _log_sources(validation_measurements)
    return _run_quietly(IdentifyConfig.of(path_of(model), **values))


@with_options_of(SelfTestConfig)
def self_test(model: Model, **options: Unpack[SelfTestKeywords]) -> Result:
    """Identify an arm from a simulation of its model, or of another model that plays the arm.

    Args:
        model: path of an MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        options: every option of ``robot-sysid MODEL``, such as ``plant_model="truth.xml"``.

    Raises:
        InputError: an option or a model cannot be used.
    """
    return _run_quietly(SelfTestConfig.of(path_of(model), **options))


@with_options_of(PlanConfig)
def plan(model: Model, **options: Unpack[PlanKeywords]) -> PlanResult:
    """Design a trajectory, or check one that was saved, and predict an identification from it.

    Args:
        model: path of an MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        options: every option of ``robot-sysid plan``, such as ``duration=15.0``, ``seed=1``,
            ``max_velocity=1.0`` or ``excitation="sines"``. The default, as in the command, is a
            designed motion (``excitation="optimal"``); ``excitation_time_budget=5.0`` searches
            for at most five seconds.

    Raises:
        InputError: an option or the model cannot be used.
    """
    config = PlanConfig.of(path_of(model), **options)
    with _quietly() as notes:
        robot = load_arm(config, notes)
        checked = design_motion(config, robot, notes)
        printed = tuple(predict_plan(config, checked)[1])
    return PlanResult(config, robot, checked, printed, tuple(notes.notes))


@with_options_of(PayloadConfig)
def payload(
    model: Model,
    empty: Log | Sequence[Log],
    loaded: Log | Sequence[Log],
    **options: Unpack[PayloadKeywords],
) -> Result:
    """Identify a payload from the difference between recordings without and with it.

    Args:
        model: path of an MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        empty: one recording without the payload or several, see ``robot_sysid.Log``.
        loaded: one recording with the payload or several.
        options: every option of ``robot-sysid payload``, such as ``order="ABBA"`` or
            ``flange="tool0"``.

    Raises:
        InputError: an option, the model or a recording cannot be used.
    """
    values = {**options, "empty": _log_sources(empty), "loaded": _log_sources(loaded)}
    return _run_quietly(PayloadConfig.of(path_of(model), **values))


@with_keywords(
    (*options_of_all(ModelOptions, only=OF_LOG), *options_of_all(LogOptions))
)
def check(
    model: Model,
    log: Log | Sequence[Log],
    since: Log | Sequence[Log] = (),
    same_day: bool = False,
    **options: Unpack[CheckKeywords],
) -> Check:
    """Tell whether an arm is what it was, or what its model says: load, friction, zeros, sensors.

    Args:
        model: path of an MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        log: of any motion, such as of a task, see ``robot_sysid.Log``; or several.
        since: an earlier log, or several; or the path of the folder of a run of ``identify``, or of
            ``payload``, of which the logs without the payload count. By default the log is compared
            with the model.
        same_day: whether both logs are of one day, with the gears as warm: smaller changes of
            friction are then named.
        options: what ``ModelOptions`` and ``LogOptions`` take; those of logs are for ``log`` alone.

    Returns:
        What has changed, whether anything has, and from which size on it would have been named.

    Raises:
        InputError: a log cannot be used, is of another arm, or shows nothing.
        SysidError: there is a doubt that is not accepted.
    """
    values = {**options, "measurements": _log_sources(log)}
    with _quietly() as notes:
        config = CheckConfig.of(path_of(model), **values)
        return check_log(config, _log_sources(since), notes, same_day)


@dataclass(frozen=True, repr=False)
class Regressor:
    """The regressor of an arm's joint torques at N samples; a pair of Y and tau.

    Attributes:
        Y: (N, n, p) columns of the parameters in each joint's torque; (n, p) of one instant.
        tau: (N, n) torque of the model itself [N m; N of slides]; (n,) of one instant.
        theta: (p,) the model's own parameters, in the order of the columns.
        names: (p,) of the parameters: "m(link1)" to "Izz(link1)" of each link with mass from base
            to terminal (inertia about the body's ORIGIN), then "armature[joint1]",
            "viscous[joint1]" and "coulomb[joint1]" of each joint.
    """

    Y: Array
    tau: Array
    theta: Array
    names: tuple[str, ...]

    def __iter__(self) -> Iterator[Array]:
        return iter((self.Y, self.tau))

    def __repr__(self) -> str:
        return f"<Regressor Y {self.Y.shape}, tau {self.tau.shape}, {len(self.names)} parameters>"


@with_keywords(options_of_all(ModelOptions))
def joint_torque_regressor(
    model: Model,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    **options: Unpack[RegressorKeywords],
) -> Regressor:
    """Return the regressor Y of all parameters of an arm, and the torque tau of its model.

    Y theta = tau: recursive Newton-Euler (Lynch and Park, "Modern Robotics", 2017, eq. 8.50 to
    8.53) is linear in each link's ten parameters; a joint adds armature qdd + viscous qd + coulomb
    sign(qd). tau is MuJoCo's inverse dynamics with that friction; it also holds the model's
    springs, tendons and actuators, which have no columns: tau - Y theta is their torque.

    Args:
        model: path of an MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        q: (N, n) positions of the chain joints [rad], or (n,) of one instant.
        qd: their velocities [rad/s].
        qdd: their accelerations [rad/s^2].
        options: ``joint``, ``mesh_dir`` and ``keyframe``, as of ``identify``.

    Raises:
        InputError: the model cannot be used, or the arrays do not fit it.
    """
    robot = arm_of(model, options)
    signals = [np.atleast_2d(np.asarray(s, dtype=float)) for s in (q, qd, qdd)]
    checked_array(signals[0], (None, robot.n_joints), "q")
    motion = Motion(np.zeros(len(signals[0])), *signals)
    link_indices = [k for k, link in enumerate(robot.links) if link.has_mass]
    columns = [LinkDynamics(robot).motion(*signals).columns(link_indices)]
    theta = [robot.thetas[link_indices].ravel()]
    names: list[str] = []
    for k in link_indices:
        names += link_names(robot, k)
    direction = np.sign(motion.qd)
    for term in (ROTOR, VISCOUS, COULOMB):
        factor = term.torque(direction, motion.qd, motion.qdd, 0.0 * direction)
        columns.append(np.eye(robot.n_joints) * factor[:, None])
        theta.append(term.stated_value(robot))
        names += map(term.key_of, robot.joint_names)
    Y = np.concatenate(columns, axis=-1)
    tau = ArmDynamics(robot)(motion)
    if np.ndim(q) == 1:
        Y = Y[0]
        tau = tau[0]
    return Regressor(Y, tau, np.concatenate(theta), tuple(names))

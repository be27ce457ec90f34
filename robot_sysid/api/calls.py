"""The functions of the face: the commands' pipelines, with arrays in and nothing printed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Union

from robot_sysid.api.arrays import Log, as_log, as_logs
from robot_sysid.api.planned import PlanResult
from robot_sysid.api.results import ArmResult, LinkResult, PayloadResult
from robot_sysid.api.threads import one_thread
from robot_sysid.config import ModelOptions, config_from
from robot_sysid.errors import InputError
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.identify.arm.run import identify_arm as run_arm
from robot_sysid.identify.simulated import CHECKPOINTS
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import MeasurementLog, open_log
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.parser import load_robot_model as load
from robot_sysid.payload import load as payload_load
from robot_sysid.payload import weighed
from robot_sysid.payload_config import payload_config_from
from robot_sysid.pipeline import analysed, designed, promise
from robot_sysid.pipeline import load as link_load
from robot_sysid.records import RobotModel
from robot_sysid.records.options import record_from, refuse_unknown
from robot_sysid.records.progress import Progress

Model = Union[str, "os.PathLike[str]"]
"""Path of an MJCF or URDF file."""
_PATHS = (
    *("mesh_dir", "columns", "torque_scale", "torque_constants", "plant_model", "coupling"),
    *("trajectory", "empty_model", "loaded_model", "save_measurements", "save_trajectory"),
    *("append", "save_torque_scale"),
)


class _Notes(Progress):
    """Keeps what the commands print as notes."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)


@contextmanager
def quietly() -> Iterator[_Notes]:
    """Work in one thread; keep notes and MuJoCo's warnings from being printed or written."""
    notes = _Notes()
    with one_thread(), warnings_as_notes(notes):
        yield notes


def load_robot_model(
    model: Model, *, joint: str | None = None, mesh_dir: Model | None = None, **options: Any
) -> RobotModel:
    """Load an MJCF or URDF file and find the arm in it.

    Args:
        model: the file.
        joint: name of the terminal joint; None finds it.
        mesh_dir: folder of the meshes; None takes what the file says.
        options: ``max_velocity`` [rad/s] and ``keyframe``, see ``parser.load_robot_model``.

    Raises:
        ModelError: the file cannot be used.
        AmbiguousJointError: several joints could be the terminal one.
    """
    return load(Path(model), None if mesh_dir is None else Path(mesh_dir), joint, **options)


def read_log(log: Log, model: Model | RobotModel, **options: Any) -> MeasurementLog:
    """Recognise, check and read a log of an arm.

    Args:
        log: see ``api.arrays.Log``.
        model: the arm, whose joints' names and limits the log is checked against.
        options: what ``LogOptions`` takes, such as ``columns`` or ``units="deg,Nm"``.

    Returns:
        The log: ``samples`` with time (N,) [s], q, tau (N, n) [rad, N m], ``columns`` and
        ``notes``.

    Raises:
        InputError: it cannot be read, is ambiguous or cannot be what it seems to be.
    """
    robot = model if isinstance(model, RobotModel) else load_robot_model(model)
    refuse_unknown(options, LogOptions)
    return open_log(robot, as_log(log), record_from(LogOptions, options))


def identify(
    model: Model,
    log: Log | Sequence[Log] | None = None,
    *,
    validation: Log | None = None,
    **options: Any,
) -> LinkResult:
    """Identify the terminal link of an arm: tau = Y theta, solved by least squares.

    Y and the estimate are explained in docs/method.md with their sources.

    Args:
        model: MJCF or URDF file.
        log: one log of the real arm or several (see ``api.arrays.Log``); None simulates the model
            itself, or the ``plant_model`` among the options.
        validation: a log to test the result on.
        options: every option of the command, ``friction_model="auto"`` for --friction-model auto.

    Returns:
        The result, whether or not it may be trusted: see its ``failure``.

    Raises:
        InputError: an option, the model or a log cannot be used; says why.
    """
    values = plain(options)
    if log is not None:
        values["measurements"] = as_logs(log)
    if validation is not None:
        values["validation_measurements"] = as_log(validation)
    config = config_from(Path(model), **values)
    if config.trajectory.plan_only:
        raise InputError("plan_only designs a motion; call plan instead")
    with quietly() as notes:
        robot = link_load(config, notes)
        analysis, _ = analysed(config, robot, notes)
    return LinkResult(config, robot, analysis, tuple(notes.notes))


def plan(model: Model, **options: Any) -> PlanResult:
    """Design a trajectory, or check one that was saved, and say what it promises.

    Args:
        model: MJCF or URDF file.
        options: every option of ``robot-sysid plan``, such as ``duration=15.0``, ``seed=1``,
            ``max_velocity=1.0`` or ``excitation="sines"``; like there, the motion is designed
            (``excitation="optimal"``) for up to ``excitation_time_budget=60.0`` seconds.

    Raises:
        InputError: an option or the model cannot be used.
    """
    usual = {} if {"trajectory", "static"} & options.keys() else {"excitation": "optimal"}
    config = config_from(Path(model), **{**usual, **plain(options), "plan_only": True})
    with quietly() as notes:
        robot = link_load(config, notes)
        checked, _ = designed(config, robot, notes)
        lines = tuple(promise(config, robot, checked))
    return PlanResult(config, robot, checked, lines, tuple(notes.notes))


def payload(
    model: Model,
    empty: Log | Sequence[Log] | None = None,
    loaded: Log | Sequence[Log] | None = None,
    **options: Any,
) -> PayloadResult:
    """Identify a payload from the difference between recordings without and with it.

    Args:
        model: MJCF or URDF file of the arm.
        empty: one recording without the payload or several, see ``api.arrays.Log``.
        loaded: one with it or several.
        options: every option of ``robot-sysid payload``, such as ``order="ABBA"`` or
            ``flange="tool0"``; ``empty_model`` and ``loaded_model`` simulate the recordings.

    Raises:
        InputError: an option, the model or a recording cannot be used.
    """
    values = plain(options)
    values.update({} if empty is None else {"empty": as_logs(empty)})
    values.update({} if loaded is None else {"loaded": as_logs(loaded)})
    config = payload_config_from(Path(model), **values)
    with quietly() as notes:
        robot = payload_load(config, notes)
        found, motion, traces = weighed(config, robot, notes)
    return PayloadResult(config, robot, found, motion, traces, tuple(notes.notes))


def identify_arm(
    model: Model, logs: Log | Sequence[Log], *, validation: Log | None = None, **options: Any
) -> ArmResult:
    """Identify every link of an arm, with friction and rotor inertia of every joint.

    Args:
        model: MJCF or URDF file.
        logs: one log or several, see ``api.arrays.Log``.
        validation: a log to test the result on.
        options: every option of ``robot-sysid arm``, such as ``model_weight=1.0``.

    Raises:
        InputError: an option, the model or a log cannot be used.
    """
    values = {**plain(options), "measurements": as_logs(logs)}
    if validation is not None:
        values["validation_measurements"] = as_log(validation)
    if values.pop("verify_rollout", False):
        raise InputError(
            "verify_rollout plays written models; it needs the command robot-sysid arm"
        )
    if values.get("torque_from"):
        raise InputError("torque_from searches for servos; it needs the command robot-sysid arm")
    refuse_unknown(values, ModelOptions, LogOptions, ArmOptions)
    chosen = record_from(ModelOptions, values)
    place = chosen.mesh_dir, chosen.joint
    with quietly() as notes:
        robot = load(Path(model), *place, keyframe=chosen.keyframe)
        asked = record_from(LogOptions, values), record_from(ArmOptions, values)
        found, fit, signals = run_arm(robot, *asked, notes)
        motion = signals[0].motion(signals[0].spread(CHECKPOINTS))
    made = motion, lambda: fit.traces(robot, signals), chosen.mesh_dir
    return ArmResult(robot, found, *made, tuple(notes.notes))


def plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with paths as paths and lists as tuples."""
    values = dict(options)
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = tuple(value)
        elif name in _PATHS and isinstance(value, str) and not _is_list(value):
            values[name] = Path(value)
    return values


def _is_list(text: str) -> bool:
    """Whether a text is numbers, as ``torque_scale="1.0,1.1"``."""
    return all(part.replace(".", "", 1).strip().isdigit() for part in text.split(","))

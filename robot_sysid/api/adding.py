"""Many logs, many machines: what each log says as a record that adds, and the result of the sum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

from robot_sysid.api.calls import LINK_FILES, Log, Model, as_logs, quietly
from robot_sysid.api.results import Identified
from robot_sysid.config import ModelOptions, SysidConfig
from robot_sysid.core.result import result_of
from robot_sysid.core.sums import LogInformation, answer_from, log_information, settled_options
from robot_sysid.errors import InputError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import open_log
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline import Analysis, checked
from robot_sysid.records import RobotModel
from robot_sysid.records.data import Traces
from robot_sysid.records.options import record_from, refuse_unknown

_ADDED = Path("added information")
_NOT_HERE = ("measurements", "append", "validation_measurements", "verify_rollout", "torque_from")


def information(
    model: Model, log: Log | Sequence[Log], *, around: LogInformation | None = None, **options: Any
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
    for name in _NOT_HERE:
        if name in options:
            raise InputError(f"{name} is not for information, which holds one log or several alike")
    robot, logs, chosen = _settled(model, {**options, "measurements": as_logs(log)})
    config = SysidConfig(ModelOptions(Path(model)), log=logs, estimation=settled_options(chosen))
    found = []
    with quietly() as notes:
        for path in logs.measurements:
            read = open_log(robot, path, logs, notes)
            checked(config, robot, [read], notes)
            told = robot, read.pieces, config.estimation, around, read.notes
            found.append(log_information(*told))
    return reduce(add, found)


def identify_from(
    model: Model, found: LogInformation, *, validation: LogInformation | None = None, **options: Any
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
    refuse_unknown(options, ModelOptions)
    robot, *_ = _settled(model, options)
    arm, logs = record_from(ModelOptions, options), LogOptions(measurements=(_ADDED,))
    config = SysidConfig(arm, log=logs, estimation=found.settled.estimation)
    with quietly() as notes:
        answer = answer_from(robot, found, validation)
        result = result_of(answer, found.origin)
    analysis = Analysis(result, found.checkpoints, _no_traces, answer)
    return Identified(robot, analysis, config, LINK_FILES, (*found.notes, *notes.notes))


def _no_traces() -> Traces:
    raise InputError(
        "added information holds no samples, so there are no torques to draw; identify one of the "
        "logs to see them"
    )


def _settled(
    model: Model, values: Mapping[str, Any]
) -> tuple[RobotModel, LogOptions, EstimationOptions]:
    """Return the arm, its logs and how they are fitted."""
    refuse_unknown(values, ModelOptions, LogOptions, EstimationOptions)
    chosen = record_from(ModelOptions, values)
    robot = load_robot_model(model, chosen.mesh_dir, chosen.joint, keyframe=chosen.keyframe)
    return robot, record_from(LogOptions, values), record_from(EstimationOptions, values)

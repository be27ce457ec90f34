"""The logs of an earlier run, to be used again together with new ones."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.records import RobotModel


def earlier_logs(params: Path, robot: RobotModel) -> tuple[Path, ...]:
    """Return the logs that an earlier run used, read off its params.json.

    Information adds: the estimate from old and new logs together is the same as if all had been
    recorded at once.

    Args:
        params: the earlier run's params.json.
        robot: the arm of this run.

    Raises:
        InputError: the file is none of an identification from logs, it was made with another model,
            or a log is no longer there.
    """
    content = _content(params)
    logs = content.get("logs")
    if not isinstance(logs, list) or not logs or not all(isinstance(log, str) for log in logs):
        raise InputError(
            f"{params}: no identification from logs, so there is nothing to add to; give the "
            "params.json of a run with --measurements"
        )
    model = content.get("model")
    if not isinstance(model, dict) or model.get("sha256") != robot.sha256:
        raise InputError(
            f"{params} was made with another model than {robot.path}; give the same model file, or "
            "all logs with --measurements"
        )
    missing = [log for log in logs if not os.path.exists(log)]
    if missing:
        raise InputError(f"{params}: its log {missing[0]} is no longer there; put it back")
    return tuple(Path(log) for log in logs)


def _content(path: Path) -> dict[str, Any]:
    content = read_json(path, "give the params.json of an earlier run")
    if not isinstance(content, dict):
        raise InputError(f"{path} is no params.json: it holds no names and values")
    return content

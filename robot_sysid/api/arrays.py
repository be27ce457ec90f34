"""Logs as Python programs have them: paths, arrays by name, data frames, logs already read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Union

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.formats.table import ArrayTable, titled_arrays
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Measurement

Log = Union[str, "os.PathLike[str]", Mapping[str, Any], Measurement, MeasurementLog, Any]
"""A path; arrays time (N,), q, tau and perhaps qd (N, n) by these or like names [s, rad, N m,
rad/s]; a data frame with a column per joint and quantity; or a log that was read."""
IN_MEMORY = Path("arrays")


def as_log(log: Log) -> Any:
    """Return a log as something that ``logs.reader.open_log`` takes.

    Raises:
        InputError: it is none of the forms that are known.
    """
    if isinstance(log, (MeasurementLog, ArrayTable)):
        return log
    if isinstance(log, (str, os.PathLike)):
        return Path(log)
    if isinstance(log, Measurement):
        given = {name: getattr(log, name) for name in ("time", "q", "qd", "tau")}
        return _table({name: values for name, values in given.items() if values is not None})
    if isinstance(log, Mapping):
        return _table(log)
    if hasattr(log, "columns") and hasattr(log, "__getitem__"):
        return _table({str(column): log[column] for column in log.columns})
    raise InputError(
        f"a log is a path, arrays by name, a data frame or a Measurement, not {type(log).__name__}"
    )


def as_logs(logs: Any) -> tuple[Any, ...]:
    """Return one log or several as a tuple, each by ``as_log``."""
    several = isinstance(logs, (list, tuple))
    return tuple(as_log(log) for log in (logs if several else (logs,)))


def _table(columns: Mapping[str, Any]) -> ArrayTable:
    arrays = {str(name): np.asarray(values) for name, values in columns.items()}
    titles, cells = titled_arrays(IN_MEMORY, arrays)
    return ArrayTable(IN_MEMORY, "arrays in memory", titles, (cells,))

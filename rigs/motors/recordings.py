"""Reading a motor recording back, complete or cut short."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.records import Array


@dataclass(frozen=True)
class MotorLog:
    """A recording of motors, read back.

    Attributes:
        head: the comment lines, without their mark.
        ending: how the run ended.
        columns: title to (N,) values; NaN where a joint did not answer.
    """

    head: tuple[str, ...]
    ending: str
    columns: Mapping[str, Array]

    def joint_values(self, what):
        """Return (N, n) values of, for instance, "pos" or "cmd_tau"."""
        names = [name for name in self.columns if name.partition("_")[2] == what]
        return np.stack([self.columns[name] for name in names], axis=1)


def read_recording(path):
    """Return the recording in a file."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    comments = [line[2:] for line in lines if line.startswith("# ")]
    rows = [line for line in lines if line and line[0] != "#"]
    table = np.atleast_1d(np.genfromtxt(rows, delimiter=",", names=True))
    assert table.dtype.names[0] == "time"
    begin, _, ending = comments[-1].partition("end: ")
    columns = {name: table[name] for name in table.dtype.names}
    return MotorLog(tuple(comments), "cut short" if begin else ending, columns)

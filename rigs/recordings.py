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
        head: the comment lines above the rows, without their mark.
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
    rows = [line for line in lines if line and not line.startswith("#")]
    head = [line[2:] for line in lines[: lines.index(rows[0])]]
    ending = (
        lines[-1][len("# end: ") :] if lines[-1].startswith("# end: ") else "cut short"
    )
    table = np.array([[float(c or "nan") for c in row.split(",")] for row in rows[1:]])
    titles = rows[0].split(",")
    assert titles[0] == "time"
    table = table.reshape(-1, len(titles))
    return MotorLog(tuple(head), ending, dict(zip(titles, table.T)))

"""A finished run, loaded from its folder, and the signals that it leaves for its report.

A log of any length leaves at most 2000 instants in report_data.npz.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.table import as_input_errors
from robot_sysid.records import ITSELF, SIGNAL_NAMES, Array, Traces
from robot_sysid.records.file_access import (
    DATA_NAME,
    PARAMS_NAME,
    RESULT_NAMES,
    SERVO_NAME,
    read_json,
    write_atomically,
)
from robot_sysid.results.content import SCHEMA_VERSION
from robot_sysid.results.lines import last_lines
from robot_sysid.results.record import PAYLOAD
from robot_sysid.results.schema import form_fault
from robot_sysid.results.table import ORIGIN, rows_of

MOST_INSTANTS = 2000
"""Number of instants that are saved: no figure has more pixels across."""
# Version of the format of report_data.npz; a file of another version is not read.
_VERSION = 3


def save_data(folder: Path, traces: Traces, result: str) -> None:
    """Write report_data.npz, from which the figures of a run can be drawn later.

    Args:
        folder: folder of the run.
        traces: signals of the run's joints at all instants.
        result: SHA-256 hash of the run's params.json, by which the two files are matched.

    Raises:
        InputError: the file cannot be written.
    """
    count = len(traces.time)
    chosen = np.linspace(0, count - 1, min(count, MOST_INSTANTS)).round().astype(int)
    # The time starts anew with each log: here one log follows the other, a second apart.
    steps = np.diff(traces.time, prepend=traces.time[:1])
    time = np.cumsum(np.where(steps < 0.0, 1.0, steps))
    arrays = {
        name: getattr(traces, name)[chosen].astype(np.float32) for name in SIGNAL_NAMES
    }
    buffer = BytesIO()
    np.savez_compressed(
        buffer,
        version=_VERSION,
        result=result,
        joints=traces.joints,
        is_slide=traces.is_slide,
        time=time[chosen],
        **arrays,
    )
    write_atomically(folder / DATA_NAME, buffer.getvalue())


def load_data(path: Path, result: str) -> Traces:
    """Return the signals of a file that ``save_data`` made for the params.json of a hash.

    Raises InputError if there is no such file, it is damaged, or of another version or run.
    """
    with as_input_errors(path, "the data of a report"):
        content = np.load(BytesIO(path.read_bytes()))
        if content["version"] != _VERSION or content["result"] != result:
            raise InputError(f"{path} belongs to another run or version")
        signals = {name: content[name].astype(float) for name in SIGNAL_NAMES}
        return Traces(
            joints=tuple(map(str, content["joints"])),
            is_slide=tuple(map(bool, content["is_slide"])),
            time=content["time"].astype(float),
            **signals,
        )


@dataclass(frozen=True)
class Run:
    """A finished run, loaded from its folder.

    Attributes:
        folder: folder that the run wrote to.
        content: content of params.json.
        traces: signals to draw; None if they cannot be read, and of a self-test.
        missing: one sentence on why they cannot be read; "" otherwise.
        printed: last lines of the console of a run that has just ended; () of an earlier one.
    """

    folder: Path
    content: Mapping[str, Any]
    traces: Traces | None = None
    missing: str = ""
    printed: tuple[str, ...] = ()

    @property
    def verdict(self) -> tuple[str, ...]:
        """The verdict, which of the folder's files to use and, of a run just ended, the next step.

        A folder that was copied or moved has its files where it is now. The command that a run
        printed next was one for where that ran. Whoever wrote the folder, no text of it becomes a
        command, and no file of another folder is named.
        """
        if self.printed:
            return self.printed
        file = self.content["file"]
        first = [file["name"]] if file and file["name"] in RESULT_NAMES else []
        names = dict.fromkeys((*first, *RESULT_NAMES))
        files = [self.folder / name for name in names if (self.folder / name).is_file()]
        return tuple(last_lines(self.content, files, None))

    @property
    def bodies(self) -> list[str]:
        """Names of the bodies in the rows, first the one that was asked for."""
        terminal = self.content["body_name"]
        if self.content["payload"] is not None:
            return [PAYLOAD, terminal, f"{terminal} with payload"]
        links = [r["of"] for r in self.content["quantities"] if r["name"] == "Ixx"]
        return list(dict.fromkeys([terminal, *links]))

    def theta(self, body: str, column: str) -> Array | None:
        """Return the parameters (10,) of a body in a column of its rows; None where it has none.

        Args:
            body: of ``bodies``.
            column: "model" or "value".
        """
        rows = {row["name"]: row[column] for row in rows_of(self.content, body)}
        theta = [rows[name] for name in ORIGIN]
        return None if None in theta else np.array(theta, dtype=float)


def _missing_row(content: Mapping[str, Any]) -> str:
    """Return which row of a body that has an inertia is missing; "" for none."""
    names: dict[str, set[str]] = {}
    for row in content["quantities"]:
        names.setdefault(row["of"], set()).add(row["name"])
    for body, there in names.items():
        missing = [name for name in ORIGIN if name not in there]
        if missing and ORIGIN[-1] in there:
            return f"{body} has no row {missing[0]}"
    return ""


def fingerprint(folder: Path) -> str:
    """Return the SHA-256 hash of the params.json in a folder."""
    return hashlib.sha256((folder / PARAMS_NAME).read_bytes()).hexdigest()


def load_run(folder: Path) -> Run:
    """Return the run whose files are in a folder.

    Raises InputError if params.json is missing, damaged or of another version.
    """
    path = folder / PARAMS_NAME
    remedy = "identify again"
    if not path.is_file():
        servos = folder / SERVO_NAME
        if servos.is_file():
            raise InputError(f"there is no page about servos; {servos} has all numbers")
        raise InputError(
            f"{folder} holds no result: there is no {PARAMS_NAME}; give the folder that a run "
            "wrote to"
        )
    content = read_json(path, remedy)
    if not isinstance(content, dict):
        raise InputError(f"{path} is no result of this program; {remedy}")
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{path} has schema_version {version!r:.20}, and this program reads {SCHEMA_VERSION}; "
            f"{remedy}"
        )
    fault = form_fault(content, "params") or _missing_row(content)
    if fault:
        raise InputError(f"{path} is no whole result: {fault}; {remedy}")
    run = Run(folder, content)
    if content.get("source") == ITSELF:
        return run
    try:
        return replace(run, traces=load_data(folder / DATA_NAME, fingerprint(folder)))
    except InputError as error:
        return replace(run, missing=f"Torques cannot be drawn: {error}; {remedy}.")

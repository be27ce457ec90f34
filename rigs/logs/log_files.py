"""Small logs for tests: a smooth motion of a few joints, written as the test wants it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import savgol_filter

from rigs.arms import small_arms
from rigs.files.refusals import refused
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_logs
from robot_sysid.logs.table import LATER, LogTable, make_table
from robot_sysid.records import Limits, Recording, RobotModel

JOINTS = ("base", "elbow", "wrist")
TITLES = ("time", "q1", "q2", "q3", "tau1", "tau2", "tau3")


def motion(n: int = 400, rate: float = 200.0) -> Recording:
    """Three joints swinging within 1 rad, with exact velocity."""
    time = np.arange(n) / rate
    omega = 2.0 * np.pi * np.array([0.5, 0.7, 1.1])
    phase = np.outer(time, omega) + [0.3, 0.9, 0.1]
    tau = np.sin(3.0 * phase) + [1.0, 2.0, 3.0]
    return Recording(time, 0.9 * np.sin(phase), 0.9 * omega * np.cos(phase), tau)


def table(data: Recording) -> np.ndarray:
    """Columns time, positions, torques."""
    return np.column_stack((data.time, data.q, data.tau))


def write(
    path: Path,
    rows: np.ndarray | Sequence[Sequence[object]],
    titles: Sequence[str] = TITLES,
    separator: str = ",",
) -> Path:
    """Write titles and rows; floats with every digit."""
    lines = [separator.join(titles)] if titles else []
    lines += [separator.join(_text(cell) for cell in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def blocks_of(path: Path) -> dict[str, dict[str, list[str]]]:
    """Return name to key to values of the blocks of a text (see tests/logs/heads.txt)."""
    blocks: dict[str, dict[str, list[str]]] = {}
    text = re.sub(r"(?m)^#.*\n", "", path.read_text())
    for line in re.sub(r"\n +", " ", text).splitlines():
        key, _, value = line.partition(": ")
        if line.startswith("["):
            block = blocks[line.strip("[]")] = {}
        elif line:
            block.setdefault(key, []).append(value)
    return blocks


def signals_of(log: Recording) -> dict[str, np.ndarray]:
    """What logs hold, in SI units and in others."""
    assert log.qd is not None
    time = log.time[:, None]
    smooth = savgol_filter(log.q, 31, 3, axis=0)
    gripper = 0.3 + 0.1 * np.sin(log.time)
    return {
        "t": time,
        "ms": 1e3 * time,
        "row": np.arange(len(time))[:, None],
        "q": log.q,
        "qd": log.qd,
        "tau": log.tau,
        "deg": np.degrees(log.q),
        "deg/s": np.degrees(log.qd),
        "whole turn": np.degrees(log.q) % 360.0,
        "2 pi": log.q % (2.0 * np.pi),
        "cdeg": 100.0 * np.degrees(log.q) + 1e-3,
        "ticks": 2048.0 + np.round(4096 / (2.0 * np.pi) * log.q),
        "heat": log.tau + 40.0,
        "warm": 0.0 * log.tau + 40.0 * np.eye(log.tau.shape[1])[1],
        "zeros": 0.0 * log.tau,
        "soll": np.degrees(log.q) + 0.01,
        "steps in us": np.full_like(time, 1e6 * (log.time[1] - log.time[0])),
        "mrad": 1e3 * log.q,
        "mA": 1e3 * log.tau,
        # Commanded positions that measured ones follow, or that have no noise.
        "earlier": np.vstack((log.q[5:], np.tile(log.q[-1], (5, 1)))),
        "smooth": smooth,
        "filtered": np.vstack((np.tile(smooth[0], (5, 1)), smooth[:-5])),
        # What lay in memory that was never written.
        "unwritten": np.where(log.q > 0.4, 1e235, log.q),
        "q, gripper": np.column_stack((log.q, gripper)),
        "tau, gripper": np.column_stack((log.tau, gripper)),
        "heat, gripper": np.column_stack((log.tau + 40.0, gripper)),
    }


def write_signals(path: Path, log: Recording, signals: Mapping[str, str]) -> Path:
    """Write what a log holds below other titles; without titles where one is empty or has a #.

    ``signals`` is title to name of ``signals_of``; "{}" stands for the joint's number from 1.
    """
    values = signals_of(log)
    titles = []
    for title, name in signals.items():
        for joint in range(values[name].shape[1]):
            titles.append(title.format(joint + 1, name=f"joint{joint}"))
    rows = np.hstack([values[name] for name in signals.values()])
    return write(path, rows, () if "#q1" in titles else titles)


def limits(reach: float = 2.0, count: int = 3) -> Limits:
    """Symmetric limits of some joints."""
    full = np.full(count, reach)
    return Limits(-full, full, 10.0)


def arm_of(
    names: Sequence[str],
    joint_limits: Limits | None = None,
    is_slide: Sequence[bool] = (),
) -> RobotModel:
    """An arm with such joints; hinges without limits where nothing else is said."""
    count = len(names)
    return replace(
        _serial_robot(count),
        joint_names=tuple(names),
        limits=joint_limits or limits(np.inf, count),
        is_slide=np.array(is_slide or [False] * count),
    )


@cache
def _serial_robot(count: int) -> RobotModel:
    """An arm of as many joints."""
    return small_arms.robot_of(small_arms.serial_arm((small_arms.Y,) * count))


def _text(cell: object) -> str:
    return repr(float(cell)) if isinstance(cell, float) else str(cell)


def open_log(robot: RobotModel, source: Any, *options: Any) -> Recording:
    """Read one log, with options or none, and with a progress."""
    (log,) = open_logs(robot, [source], *(options or [LogOptions()]))
    return log


def titles_alone(titles: Sequence[str], first_row: Sequence[str] = ()) -> LogTable:
    """A log of which only the titles matter."""
    columns = [(title, LATER) for title in titles]
    return make_table(Path("log"), "", columns, first_row=tuple(first_row))


def read_measurements(
    source: Path | LogTable,
    joint_names: Sequence[str],
    limits: Limits | None = None,
    is_slide: Sequence[bool] = (),
    **options: Any,
) -> Recording:
    """Read a log with options such as columns or units."""
    return open_log(
        arm_of(joint_names, limits, is_slide), source, LogOptions(**options)
    )


def assert_refused(
    message: str, path: Path, joint_names: Sequence[str] = JOINTS, **options: Any
) -> str:
    """Assert that a log is refused in one line that matches, and return the line."""
    with refused(message) as caught:
        read_measurements(path, joint_names, **options)
    return str(caught.value)


def assert_read(
    source: Path | LogTable,
    expected: Recording,
    names: Sequence[str] = ("q", "tau"),
    atol: float = 0.0,
    **options: Any,
) -> Recording:
    """Assert that a log of JOINTS is read with these samples, and return it."""
    log = read_measurements(source, JOINTS, **options)
    assert_samples(expected, log, names, atol)
    return log


def read_table(
    folder: Path, rows: Any, titles: Sequence[str] = TITLES, **options: Any
) -> Recording:
    """Write rows as a log of JOINTS and read it with options."""
    return read_measurements(write(folder / "log.csv", rows, titles), JOINTS, **options)


def notes_of(log: Recording) -> str:
    """The notes beyond the layout and the columns."""
    return " | ".join(log.notes[1:])


def assert_samples(
    expected: Recording,
    samples: Recording,
    names: Sequence[str] = ("time", "q", "qd", "tau", "qdd", "joint_time"),
    atol: float = 0.0,
) -> None:
    """Compare the arrays of two recordings; one that is None must be None in both."""
    for name in names:
        array = getattr(expected, name)
        if array is None:
            assert getattr(samples, name) is None, name
        else:
            np.testing.assert_allclose(
                getattr(samples, name), array, rtol=0.0, atol=atol, err_msg=name
            )

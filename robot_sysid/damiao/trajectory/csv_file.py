"""The trajectory file that Damiao motors play: written in a stream, read back, its extremes.

::

    # motor_type=DM4340,can_id=1,mode=MIT          one line per joint, base to terminal
    time,j0_pos,j0_vel,j0_tau,j1_pos,...           s, rad, rad/s, N m
    0.000,0.0000,0.0000,0.0000,0.0000,...

A joint whose replies do not come on CAN id + 0x10 has ``,master_id=...`` appended to its line.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

import numpy as np

from robot_sysid.damiao.protocol.bus_load import PLANNING_LIMIT, BusTiming, bus_load, suggested_rate
from robot_sysid.damiao.protocol.joints import MASTER_ID_OFFSET, DamiaoJoint, damiao_joints
from robot_sysid.damiao.protocol.motors import motor_spec
from robot_sysid.damiao.trajectory.clamping import ClampTally
from robot_sysid.damiao.trajectory.velocity_column import Mismatch, VelocityColumns
from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.atomic_files import whole_file

_PAIR = re.compile(r"\s*([a-z_]+)\s*=\s*([^,\s]+)\s*")

MotionChunk = tuple[Array, Array, Array, Array]
"""Time (N,), position, velocity, feed-forward torque (N, n) [s, rad, rad/s, N m]."""


@dataclass(frozen=True)
class DamiaoExportReport:
    """What the export did.

    Attributes:
        joints: the motors, base to terminal.
        clamped_percent: (n,) share of samples per joint with a clamped value [%].
        warnings: one sentence each.
    """

    joints: tuple[DamiaoJoint, ...]
    clamped_percent: Array
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class DamiaoTrajectory:
    """A trajectory file, read lazily.

    Attributes:
        path: the file.
        joints: its motors, base to terminal.
        first_data_line: number of lines before the first row.
    """

    path: Path
    joints: tuple[DamiaoJoint, ...]
    first_data_line: int

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joints)

    def chunks(self, rows: int = 4096) -> Iterator[MotionChunk]:
        """Yield the rows, at most ``rows`` at a time; raise InputError at one that is malformed."""
        last, line = -np.inf, self.first_data_line
        with _opened(self.path) as file:
            lines = islice(file, line, None)
            while text := list(islice(lines, rows)):
                table = _table(text, self.path, line, 1 + 3 * self.n_joints)
                if len(table):
                    _check_time(table[:, 0], last, self.path, line)
                    last = float(table[-1, 0])
                    yield table[:, 0], table[:, 1::3], table[:, 2::3], table[:, 3::3]
                line += len(text)


def export_damiao_trajectory(
    motion_chunks: Iterable[MotionChunk],
    motor_types: Sequence[str],
    path_or_file: str | os.PathLike[str] | TextIO,
    can_ids: Sequence[int] | None = None,
    master_ids: Sequence[int] | None = None,
    supply: float | None = None,
    joint_names: Sequence[str] = (),
) -> DamiaoExportReport:
    """Write a trajectory for Damiao motors, clamped to what their frames can carry.

    The chunks are written as they come, so a long trajectory needs no memory; a path gets its file
    only once everything is written.

    Args:
        motion_chunks: the motion, see ``MotionChunk``.
        motor_types, can_ids, master_ids: see ``damiao_joints``.
        path_or_file: where to write.
        supply: voltage that the no-load speeds are compared at [V]; None takes each type's own.
        joint_names: of the joints in the model, for the warnings.

    Raises:
        InputError: motor types or ids do not fit, no samples, or values that are not finite.
    """
    chunks = iter(motion_chunks)
    first = next(chunks, None)
    if first is None or len(first[0]) == 0:
        raise InputError("the trajectory to export has no samples")
    joints = damiao_joints(motor_types, np.shape(first[1])[1], can_ids, master_ids, joint_names)
    tally = ClampTally(joints)
    # Milliseconds where all moments are on their grid.
    decimals = 3 if np.all(np.abs(first[0] - np.round(first[0], 3)) < 1e-9) else 6
    with whole_file(path_or_file) as file:
        file.write(_head(joints))
        for chunk in chain([first], chunks):
            file.write(_rows(chunk, tally, decimals))
    warnings = (*tally.warnings(supply), *_rate_warnings(first[0], len(joints)))
    return DamiaoExportReport(joints, tally.clamped_percent, warnings)


def read_damiao_trajectory(path: str | os.PathLike[str]) -> DamiaoTrajectory:
    """Read the head of a trajectory file; rows come from its ``chunks``.

    Raises:
        InputError: the file cannot be read or is not a trajectory file, with the line number.
    """
    path = Path(path)
    joints: list[DamiaoJoint] = []
    with _opened(path) as file:
        for number, line in enumerate(file, start=1):
            if not line.startswith("#"):
                _check_columns(line, len(joints), path, number)
                return DamiaoTrajectory(path, tuple(joints), number)
            if "motor_type" in line:
                joints.append(_parse_joint(line, path, number))
    raise InputError(f"{path} has no column line; it is not a Damiao trajectory")


def _head(joints: Sequence[DamiaoJoint]) -> str:
    lines = []
    for joint in joints:
        line = f"# motor_type={joint.motor_type},can_id={joint.can_id},mode=MIT"
        if joint.master_id != joint.can_id + MASTER_ID_OFFSET:
            line += f",master_id={joint.master_id}"
        lines.append(line)
    lines.append(",".join(["time", *trajectory_columns(len(joints))]))
    return "\n".join(lines) + "\n"


def trajectory_columns(n_joints: int) -> list[str]:
    """Return j0_pos, j0_vel, j0_tau, j1_pos, ... for n joints."""
    return [f"j{j}_{what}" for j in range(n_joints) for what in ("pos", "vel", "tau")]


def _rows(chunk: MotionChunk, tally: ClampTally, decimals: int) -> str:
    time, q, qd, tau = (np.asarray(x, dtype=float) for x in chunk)
    n = len(tally.joints)
    if time.ndim != 1 or not q.shape == qd.shape == tau.shape == (len(time), n):
        raise InputError(f"motion chunks must be (N,), (N, {n}), (N, {n}), (N, {n}) arrays")
    if not all(np.all(np.isfinite(x)) for x in (time, q, qd, tau)):
        raise InputError("the trajectory to export contains values that are not finite")
    q, qd, tau = tally.clamp(q, qd, tau)
    table = np.empty((len(time), 1 + 3 * n))
    table[:, 0] = time
    for offset, values in enumerate((q, qd, tau)):
        table[:, 1 + offset :: 3] = values
    # Adding zero turns the -0.0 that rounding leaves into 0.0.
    table[:, 1:] = np.round(table[:, 1:], 4) + 0.0
    row = ",".join([f"%.{decimals}f"] + ["%.4f"] * (3 * n)) + "\n"
    return (row * len(time)) % tuple(table.ravel())


def _rate_warnings(time: Array, n_joints: int) -> Iterator[str]:
    if len(time) < 2:
        return
    rate = 1.0 / float(np.median(np.diff(time)))
    classic, fast = BusTiming(), BusTiming(fd=True)
    load = bus_load(n_joints, rate, classic)
    if load > PLANNING_LIMIT:
        fits, fits_fd = suggested_rate(n_joints, classic), suggested_rate(n_joints, fast)
        yield (
            f"{rate:g} Hz would fill {100 * load:.0f} % of a classic CAN bus "
            f"({100 * bus_load(n_joints, rate, fast):.0f} % of CAN-FD): play the file at "
            f"{fits:g} Hz (CAN-FD: {fits_fd:g} Hz), or export it with --damiao-rate {fits:g}"
        )


def _parse_joint(line: str, path: Path, number: int) -> DamiaoJoint:
    pairs = dict(_PAIR.findall(line.lstrip("# ")))
    try:
        can_id = int(pairs["can_id"], 0)
        master_id = int(pairs.get("master_id", str(can_id + MASTER_ID_OFFSET)), 0)
        motor_type, mode = motor_spec(pairs["motor_type"]).name, pairs["mode"]
    except InputError as error:
        raise InputError(f"{path}, line {number}: {error}") from None
    except (KeyError, ValueError):
        raise InputError(
            f"{path}, line {number}: expected '# motor_type=TYPE,can_id=NUMBER,mode=MIT'"
        ) from None
    if mode != "MIT":
        raise InputError(f"{path}, line {number}: mode {mode!r} cannot be played, only MIT")
    return DamiaoJoint(motor_type, can_id, master_id)


def _check_columns(line: str, n_joints: int, path: Path, number: int) -> None:
    if n_joints == 0:
        raise InputError(f"{path} has no '# motor_type=...' lines; it is not a Damiao trajectory")
    names = [name.strip() for name in line.strip().split(",")]
    if names != ["time", *trajectory_columns(n_joints)]:
        raise InputError(
            f"{path}, line {number}: expected the columns time,j0_pos,j0_vel,j0_tau,... for "
            f"{n_joints} joints"
        )


def _table(text: list[str], path: Path, before: int, width: int) -> Array:
    filled = [line for line in text if line.strip()]
    if not filled:
        return np.empty((0, width))
    table = _finite_rows(filled, width)
    if table is None:
        lines = enumerate(text, start=before + 1)
        bad = next(n for n, line in lines if line.strip() and _finite_rows([line], width) is None)
        raise InputError(f"{path}, line {bad}: expected {width} finite numbers")
    return table


def _finite_rows(lines: list[str], width: int) -> Array | None:
    """Return the numbers (N, width) of lines, or None where they are no such rows."""
    if any("_" in line for line in lines):
        # NumPy before 1.23 reads 1_0 as 10, as Python does.
        return None
    try:
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    except ValueError:
        return None
    fits = table.shape == (len(lines), width) and np.all(np.isfinite(table))
    return np.asarray(table) if fits else None


def _check_time(time: Array, last: float, path: Path, before: int) -> None:
    falling = np.flatnonzero(np.diff(time, prepend=last) <= 0.0)
    if len(falling):
        raise InputError(
            f"{path}, near line {before + int(falling[0]) + 1}: time does not increase"
        )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    try:
        with open(path, encoding="utf-8-sig") as file:
            yield file
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file") from None


@dataclass(frozen=True)
class TrajectoryScan:
    """What a trajectory asks of the motors.

    Attributes:
        duration: from first to last row [s].
        first: (n,) first position [rad].
        end_velocity: (n,) larger of the speeds at the first and the last row [rad/s].
        lowest, highest: (n,) extreme positions [rad].
        peak_velocity, peak_torque: (n,) largest magnitudes.
        peak_step: (n,) largest position change per time between two rows [rad/s].
        mismatch: where the velocity column does not say how the positions change, or None.
    """

    duration: float
    first: Array
    end_velocity: Array
    lowest: Array
    highest: Array
    peak_velocity: Array
    peak_torque: Array
    peak_step: Array
    mismatch: Mismatch | None = None


def scan_trajectory(trajectory: DamiaoTrajectory) -> TrajectoryScan:
    """Return the extremes of a trajectory file; memory does not grow with its length.

    Raises:
        InputError: a row is malformed, or there are fewer than two.
    """
    peaks, lowest, highest = np.zeros((3, trajectory.n_joints)), np.inf, -np.inf
    columns = VelocityColumns(trajectory.first_data_line + 1)
    samples, last_time, last_q = 0, np.empty(0), np.empty((0, trajectory.n_joints))
    for time, q, qd, tau in trajectory.chunks():
        if samples == 0:
            start, first, first_speed = time[0], q[0], qd[0]
        steps = np.diff(q, axis=0, prepend=last_q) / np.diff(time, prepend=last_time)[:, None]
        largest = [np.abs(x).max(axis=0, initial=0.0) for x in (qd, tau, steps)]
        peaks = np.maximum(peaks, largest)
        lowest, highest = np.minimum(lowest, q.min(axis=0)), np.maximum(highest, q.max(axis=0))
        columns.add(time, q, qd)
        samples += len(time)
        last_time, last_q, last_speed = time[-1:], q[-1:], qd[-1]
    if samples < 2:
        raise InputError(f"{trajectory.path} needs at least two rows to be played")
    end_velocity = np.maximum(np.abs(first_speed), np.abs(last_speed))
    return TrajectoryScan(
        last_time[0] - start,
        first,
        end_velocity,
        np.asarray(lowest),
        np.asarray(highest),
        *(peaks[0], peaks[1], peaks[2]),
        mismatch=columns.mismatch,
    )

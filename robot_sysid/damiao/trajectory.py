"""The trajectory file that Damiao motors play: written in a stream, read back, its extremes.

::

    # motor_type=DM4340,can_id=1,mode=MIT          one line per joint, base to terminal
    time,j0_pos,j0_vel,j0_tau,j1_pos,...           s, rad, rad/s, N m
    0.000,0.0000,0.0000,0.0000,0.0000,...

A joint whose replies do not come on CAN id + 0x10 has ``,master_id=...`` appended to its line.

Values are kept within the motors' limits, and what had to change is told.

Does the velocity column say how the positions change? A motor is told both; where they disagree it
follows neither. Two comparisons, because rounded positions hide much from row to row and next to
nothing over a longer time:

row      each velocity lies among the slopes of the positions around it
window   over a tenth of a second, what the velocities add up to is how far the positions came

A difference quotient instead of the derivative (half a row early or late) passes both.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from robot_sysid.damiao.protocol.frames import PLANNING_LIMIT, BusTiming, bus_load, suggested_rate
from robot_sysid.damiao.protocol.joints import MASTER_ID_OFFSET, DamiaoJoint, damiao_joints
from robot_sysid.damiao.protocol.motors import RPM, motor_spec
from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.atomic_files import whole_file

_PAIR = re.compile(r"\s*([a-z_]+)\s*=\s*([^,\s]+)\s*")

MotionChunk = tuple[Array, Array, Array, Array]
"""Time (N,), position, velocity, feed-forward torque (N, n) [s, rad, rad/s, N m]."""


@dataclass(frozen=True)
class DamiaoExportReport:
    """What the export did; per joint, which share of samples has a clamped value [%]."""

    joints: tuple[DamiaoJoint, ...]
    clamped_percent: Array
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class DamiaoTrajectory:
    """A trajectory file, read lazily; ``first_data_line`` counts the lines before its rows."""

    path: Path
    joints: tuple[DamiaoJoint, ...]
    first_data_line: int

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joints)

    def chunks(self, rows: int = 4096) -> Iterator[MotionChunk]:
        """Yield the rows, at most ``rows`` at a time; raise InputError at one that is malformed."""
        last, width = -np.inf, 1 + 3 * self.n_joints
        with _opened(self.path) as file:
            numbered = islice(enumerate(file, start=1), self.first_data_line, None)
            filled = ((number, line) for number, line in numbered if line.strip())
            while piece := list(islice(filled, rows)):
                table = _table(piece, width, self.path)
                for row in np.flatnonzero(np.diff(table[:, 0], prepend=last) <= 0.0)[:1]:
                    where = f"{self.path}, near line {piece[row][0]}"
                    raise InputError(f"{where}: time does not increase")
                last = float(table[-1, 0])
                yield table[:, 0], table[:, 1::3], table[:, 2::3], table[:, 3::3]


def export_damiao_trajectory(
    motion_chunks: Iterable[MotionChunk],
    motor_types: Sequence[str],
    path_or_file: str | os.PathLike[str] | TextIO,
    can_ids: Sequence[int] | None = None,
    master_ids: Sequence[int] | None = None,
    joint_names: Sequence[str] = (),
) -> DamiaoExportReport:
    """Write a trajectory for Damiao motors, clamped to what their frames can carry.

    The chunks are written as they come, so a long trajectory needs no memory; a path gets its file
    only once everything is written.

    Args:
        motion_chunks: the motion, see ``MotionChunk``.
        motor_types, can_ids, master_ids: see ``damiao_joints``.
        path_or_file: where to write.
        joint_names: of the joints in the model, for the warnings.

    Raises:
        InputError: motor types or ids do not fit, no samples, or values that are not finite.
    """
    chunks = iter(motion_chunks)
    first = next(chunks, None)
    if first is None or len(first[0]) == 0:
        raise InputError("the trajectory to export has no samples")
    joints = damiao_joints(motor_types, np.shape(first[1])[1], can_ids, master_ids, joint_names)
    limits = np.array([joint.spec.limits for joint in joints]).T[:, None]
    rows, (changed, peak_velocity, peak_torque) = 0, np.zeros((3, len(joints)))
    # Milliseconds where all moments are on their grid.
    decimals = 3 if np.all(np.abs(first[0] - np.round(first[0], 3)) < 1e-9) else 6
    with whole_file(path_or_file) as file:
        file.write(_head(joints))
        for chunk in chain([first], chunks):
            asked = _checked(chunk, len(joints))
            inside = np.clip(asked, -limits, limits)
            changed += np.any(inside != asked, axis=0).sum(axis=0)
            peak_velocity = np.maximum(peak_velocity, np.abs(asked[1]).max(axis=0, initial=0.0))
            peak_torque = np.maximum(peak_torque, np.abs(asked[2]).max(axis=0, initial=0.0))
            rows += len(chunk[0])
            file.write(_rows(chunk[0], inside, decimals))
    percent = 100.0 * changed / rows
    peaks = zip(joints, percent, peak_velocity, peak_torque)
    warnings = (*_warnings(peaks), *_rate_warnings(first[0], len(joints)))
    return DamiaoExportReport(joints, percent, warnings)


def _head(joints: Sequence[DamiaoJoint]) -> str:
    lines = [
        f"# motor_type={j.motor_type},can_id={j.can_id},mode=MIT"
        + ("" if j.master_id == j.can_id + MASTER_ID_OFFSET else f",master_id={j.master_id}")
        for j in joints
    ]
    return "\n".join([*lines, ",".join(["time", *trajectory_columns(len(joints))])]) + "\n"


def trajectory_columns(n_joints: int) -> list[str]:
    """Return j0_pos, j0_vel, j0_tau, j1_pos, ... for n joints."""
    return [f"j{j}_{what}" for j in range(n_joints) for what in ("pos", "vel", "tau")]


def _checked(chunk: MotionChunk, n: int) -> Array:
    """Return position, velocity and torque (3, N, n) of a chunk that can be written."""
    time, *signals = (np.asarray(x, dtype=float) for x in chunk)
    if time.ndim != 1 or any(x.shape != (len(time), n) for x in signals):
        raise InputError(f"motion chunks must be (N,), (N, {n}), (N, {n}), (N, {n}) arrays")
    if not all(np.all(np.isfinite(x)) for x in (time, *signals)):
        raise InputError("the trajectory to export contains values that are not finite")
    return np.stack(signals)


def _rows(time: Array, values: Array, decimals: int) -> str:
    # Adding zero turns the -0.0 that rounding leaves into 0.0.
    cells = np.round(values.transpose(1, 2, 0).reshape(len(time), -1), 4) + 0.0
    row = ",".join([f"%.{decimals}f"] + ["%.4f"] * cells.shape[1]) + "\n"
    return (row * len(time)) % tuple(np.column_stack([time, cells]).ravel())


def _warnings(peaks: Iterable[tuple[DamiaoJoint, float, float, float]]) -> Iterator[str]:
    """Yield a sentence per joint and limit or rating that what was asked for exceeds."""
    for joint, percent, velocity, torque in peaks:
        if percent:
            yield (
                f"{joint.label}: {percent:.2f} % of the samples were clamped to the limits of a "
                f"{joint.motor_type}; use a stronger motor or a slower trajectory"
            )
        yield from rating_warnings(joint, velocity, torque)


def rating_warnings(joint: DamiaoJoint, velocity: float, torque: float) -> Iterator[str]:
    """Yield a sentence for each rating of a motor that a peak velocity or torque exceeds."""
    spec = joint.spec
    for limit, name, remedy in (
        (spec.peak_torque, "peak", "it cannot follow"),
        (spec.rated_torque, "rated", "fine for a moment, too hot for long"),
    ):
        if torque > limit:
            yield (
                f"{joint.label}: {torque:.2f} N m exceeds the {name} torque of a {spec.name}, "
                f"{limit:g} N m; {remedy}"
            )
            break
    if spec.no_load_rpm is not None and velocity > spec.no_load_rpm * RPM:
        yield (
            f"{joint.label}: {velocity:.2f} rad/s ({velocity / RPM:.0f} rpm) exceeds the no-load "
            f"speed of a {spec.name} at {spec.supply:g} V, {spec.no_load_rpm * RPM:.2f} rad/s; "
            "it cannot follow"
        )


def read_damiao_trajectory(path: str | os.PathLike[str]) -> DamiaoTrajectory:
    """Read the head of a trajectory file, or raise InputError; rows come from its ``chunks``."""
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
    if [name.strip() for name in line.split(",")] != ["time", *trajectory_columns(n_joints)]:
        raise InputError(
            f"{path}, line {number}: expected the columns time,j0_pos,j0_vel,j0_tau,... for "
            f"{n_joints} joints"
        )


def _table(piece: Sequence[tuple[int, str]], width: int, path: Path) -> Array:
    """Return the numbers (N, width) of numbered lines, or raise InputError naming a bad one."""
    lines = [line for _, line in piece]
    # NumPy before 1.23 reads 1_0 as 10, as Python does.
    if not any("_" in line for line in lines):
        with contextlib.suppress(ValueError):
            table = np.loadtxt(lines, delimiter=",", ndmin=2)
            if table.shape == (len(lines), width) and np.all(np.isfinite(table)):
                return np.asarray(table)
    if len(piece) == 1:
        raise InputError(f"{path}, line {piece[0][0]}: expected {width} finite numbers")
    return np.vstack([_table([each], width, path) for each in piece])


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
    """What a trajectory asks of the motors; arrays are (n,) [rad, rad/s, N m].

    ``end_velocity`` is the larger of the speeds at the first and the last row, ``peak_step`` the
    largest position change per time between two rows [rad/s]; ``mismatch`` is where the velocity
    column does not say how the positions change, or None.
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
    """Return the extremes of a trajectory file; memory does not grow with its length."""
    peaks, lowest, highest = np.zeros((3, trajectory.n_joints)), np.inf, -np.inf
    columns = VelocityColumns(trajectory.first_data_line + 1)
    samples, last_time, last_q = 0, np.empty(0), np.empty((0, trajectory.n_joints))
    for time, q, qd, tau in trajectory.chunks():
        if samples == 0:
            start, first, first_speed = time[0], q[0], qd[0]
        steps = np.diff(q, axis=0, prepend=last_q) / np.diff(time, prepend=last_time)[:, None]
        peaks = np.maximum(peaks, [np.abs(x).max(axis=0, initial=0.0) for x in (qd, tau, steps)])
        lowest, highest = np.minimum(lowest, q.min(axis=0)), np.maximum(highest, q.max(axis=0))
        columns.add(time, q, qd)
        samples += len(time)
        last_time, last_q, last_speed = time[-1:], q[-1:], qd[-1]
    if samples < 2:
        raise InputError(f"{trajectory.path} needs at least two rows to be played")
    end_velocity = np.maximum(np.abs(first_speed), np.abs(last_speed))
    extremes = np.asarray(lowest), np.asarray(highest), peaks[0], peaks[1], peaks[2]
    return TrajectoryScan(last_time[0] - start, first, end_velocity, *extremes, columns.mismatch)


# Numbers with four decimals, as the export writes them, are this far from what was meant.
_ROUNDING = 0.5e-4
# A tenth of a second hides 1e-4 rad of rounding behind 1e-3 rad/s and is short beside a swing.
_WINDOW, _LEAST_ROWS = 0.1, 4
# Rows on either side whose slopes count as around: a difference quotient is half a row early or
# late, and one more row is room for where the motion bends.
_AROUND = 2


class Mismatch(NamedTuple):
    """Where the velocity column is wrong: line, without empty ones, and joint, from 0.

    It states a velocity, and the positions show another [rad/s].
    """

    line: int
    joint: int
    stated: float
    shown: float


class VelocityColumns:
    """Compares the velocity columns with the positions, up to the first mismatch."""

    def __init__(self, first_line: int = 1) -> None:
        self.mismatch: Mismatch | None = None
        self._rows: Array | None = None
        self._first_line, self._begun = first_line, False

    def add(self, time: Array, q: Array, qd: Array) -> None:
        """Add rows (N,), (N, n), (N, n) [s, rad, rad/s]."""
        if self.mismatch is not None:
            return
        table = np.hstack([time[:, None], q, qd])
        self._rows = table if self._rows is None else np.vstack([self._rows, table])
        time, (q, qd) = self._rows[:, 0], np.split(self._rows[:, 1:], 2, axis=1)
        found = None
        if len(time) > 1:
            step = np.diff(time)[:, None]
            slope, first = np.diff(q, axis=0) / step, _AROUND if self._begun else 0
            wrong = chain(_rows_off(step, slope, qd, first), _windows_off(time, q, qd, slope))
            found = next(wrong, None)
        self._begun = True
        if found is not None:
            self.mismatch = found._replace(line=found.line + self._first_line)
        # The end of this chunk is the beginning of the windows that reach into the next one.
        kept = int(np.searchsorted(time, time[-1] - 2.0 * _WINDOW))
        kept = max(min(kept, len(time) - 2 * _LEAST_ROWS), 0)
        self._rows, self._first_line = self._rows[kept:], self._first_line + kept


def _rows_off(step: Array, slope: Array, qd: Array, first: int) -> Iterator[Mismatch]:
    # Rows without neighbours were compared before, or will be with the next chunk.
    padded = np.pad(slope, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND, axis=0)
    low, high = around.min(axis=-1), around.max(axis=-1)
    # Two rounded positions, of the slope and of what it is compared with, over the shortest step.
    steps = np.pad(step, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    shortest = np.lib.stride_tricks.sliding_window_view(steps, 2 * _AROUND, axis=0).min(axis=-1)
    slack = 4.0 * _ROUNDING / shortest + _ROUNDING + (high - low)
    off = np.maximum(low - slack - qd, qd - high - slack)
    off[:first] = off[len(off) - _AROUND :] = 0.0
    for row, joint in np.argwhere(off > 0.0)[:1]:
        shown = slope[min(row, len(slope) - 1), joint]
        yield Mismatch(int(row), int(joint), float(qd[row, joint]), float(shown))


def _windows_off(time: Array, q: Array, qd: Array, slope: Array) -> Iterator[Mismatch]:
    step = np.diff(time)[:, None]
    longest = float(np.max(step))
    ends = np.searchsorted(time, time + max(_WINDOW, _LEAST_ROWS * longest))
    starts = np.flatnonzero(ends < len(slope))
    ends = ends[starts]
    way = _summed(0.5 * (qd[1:] + qd[:-1]) * step)
    came, said = q[ends] - q[starts], way[ends] - way[starts]
    turns = _summed(np.abs(np.diff(qd, axis=0)))
    # Half a row early or late, and a fifth more; then what trapezoids leave out where it bends.
    before = np.vstack([slope[:1], slope])
    sped_up = [np.abs(each[ends] - each[starts]) for each in (slope, before)]
    shifted = 0.6 * longest * np.maximum(*sped_up) + 2.0 * _ROUNDING
    bent = longest / 6.0 * (turns[ends] - turns[starts])
    length = (time[ends] - time[starts])[:, None]
    allowed = shifted + bent + 2.0 * _ROUNDING + _ROUNDING * length
    for k, j in np.argwhere(np.abs(came - said) > allowed * (1.0 + 1e-9))[:1]:
        span = float(length[k, 0])
        yield Mismatch(int(starts[k]), int(j), float(said[k, j]) / span, float(came[k, j]) / span)


def _summed(parts: Array) -> Array:
    """Return the sums (N, n) of the first 0, 1, ... of (N - 1, n) parts."""
    return np.vstack([np.zeros(parts.shape[1]), np.cumsum(parts, axis=0)])


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
            f"{fits:g} Hz (CAN-FD: {fits_fd:g} Hz), or export it with --sample-rate {fits:g}"
        )

"""The trajectory file that Damiao motors play: written in a stream, read back, looked at.

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
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robot_sysid.damiao.joints import (
    MASTER_ID_OFFSET,
    RPM,
    DamiaoJoint,
    damiao_joints,
    motor_spec,
)
from robot_sysid.damiao.protocol import (
    PLANNING_LIMIT,
    BusTiming,
    bus_load,
    suggested_rate,
)
from robot_sysid.errors import InputError
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.records import Array
from robot_sysid.records.atomic_files import whole_file
from robot_sysid.records.options import per_joint
from robot_sysid.special_files import refuse_special_file

_PAIR = re.compile(r"\s*([a-z_]+)\s*=\s*([^,\s]+)\s*")

MotionChunk = tuple[Array, Array, Array, Array]
"""Time (N,), position, velocity, feed-forward torque (N, n) [s, rad, rad/s, N m]."""


@dataclass(frozen=True)
class DamiaoExportReport:
    """What the export did; per joint, which share of samples has a clamped value [%]."""

    joints: tuple[DamiaoJoint, ...]
    clamped_percent: Array
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class DamiaoTrajectory:
    """A trajectory file: time (N,), q, qd, tau (N, n) [s, rad, rad/s, N m], each row's ``line``.

    Of two files it is ``both``: recordings call columns by the joints' names then.
    """

    path: Path
    joints: tuple[DamiaoJoint, ...]
    line: NDArray[np.int64]
    time: Array
    q: Array
    qd: Array
    tau: Array
    both: bool = False

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joints)


def export_damiao_trajectory(
    motion_chunks: Iterable[MotionChunk],
    motor_types: Sequence[str],
    path_or_file: str | os.PathLike[str] | TextIO,
    can_ids: Sequence[int] | None = None,
    master_ids: Sequence[int] | None = None,
    joint_names: Sequence[str] = (),
) -> DamiaoExportReport:
    """Write a trajectory for Damiao motors, clamped to what their frames can carry.

    The chunks are written as they come; a path gets its file only once everything is written. For
    types, ids and names see ``damiao_joints``. InputError where they do not fit, without samples,
    or with values that are not finite.
    """
    chunks = iter(motion_chunks)
    first = next(chunks, None)
    if first is None or len(first[0]) == 0:
        raise InputError("the trajectory to export has no samples")
    joints = damiao_joints(
        motor_types, np.shape(first[1])[1], can_ids, master_ids, joint_names
    )
    limits = np.array([joint.spec.limits for joint in joints]).T[:, None]
    rows = 0
    (changed, peak_velocity, peak_torque) = np.zeros((3, len(joints)))
    # Milliseconds where all moments are on their grid.
    decimals = 3 if np.all(np.abs(first[0] - np.round(first[0], 3)) < 1e-9) else 6
    with whole_file(path_or_file) as file:
        file.write(_head(joints))
        for chunk in chain([first], chunks):
            asked = _checked(chunk, len(joints))
            inside = np.clip(asked, -limits, limits)
            changed += np.any(inside != asked, axis=0).sum(axis=0)
            peak_velocity = np.maximum(
                peak_velocity, np.abs(asked[1]).max(axis=0, initial=0.0)
            )
            peak_torque = np.maximum(
                peak_torque, np.abs(asked[2]).max(axis=0, initial=0.0)
            )
            rows += len(chunk[0])
            file.write(_rows(chunk[0], inside, decimals))
    percent = 100.0 * changed / rows
    warnings = []
    for joint, share, velocity, torque in zip(
        joints, percent, peak_velocity, peak_torque
    ):
        if share:
            warnings.append(
                f"{joint.label}: {share:.2f} % of the samples were clamped to the limits of a "
                f"{joint.motor_type}; use a stronger motor or a slower trajectory"
            )
        warnings += rating_warnings(joint, velocity, torque)
    warnings += _rate_warnings(first[0], len(joints))
    return DamiaoExportReport(joints, percent, tuple(warnings))


def _head(joints: Sequence[DamiaoJoint]) -> str:
    lines = [
        f"# motor_type={j.motor_type},can_id={j.can_id},mode=MIT"
        + (
            ""
            if j.master_id == j.can_id + MASTER_ID_OFFSET
            else f",master_id={j.master_id}"
        )
        for j in joints
    ]
    return (
        "\n".join([*lines, ",".join(["time", *trajectory_columns(len(joints))])]) + "\n"
    )


def trajectory_columns(n_joints: int) -> list[str]:
    """Return j0_pos, j0_vel, j0_tau, j1_pos, ... for n joints."""
    return [f"j{j}_{what}" for j in range(n_joints) for what in ("pos", "vel", "tau")]


def _checked(chunk: MotionChunk, n: int) -> Array:
    """Return position, velocity and torque (3, N, n) of a chunk that can be written."""
    time, *signals = (np.asarray(x, dtype=float) for x in chunk)
    if time.ndim != 1 or any(x.shape != (len(time), n) for x in signals):
        raise InputError(
            f"motion chunks must be (N,), (N, {n}), (N, {n}), (N, {n}) arrays"
        )
    if not all(np.all(np.isfinite(x)) for x in (time, *signals)):
        raise InputError("the trajectory to export contains values that are not finite")
    return np.stack(signals)


def _rows(time: Array, values: Array, decimals: int) -> str:
    # Adding zero turns the -0.0 that rounding leaves into 0.0.
    cells = np.round(values.transpose(1, 2, 0).reshape(len(time), -1), 4) + 0.0
    row = ",".join([f"%.{decimals}f"] + ["%.4f"] * cells.shape[1]) + "\n"
    return (row * len(time)) % tuple(np.column_stack([time, cells]).ravel())


CANNOT_FOLLOW = "it cannot follow"
"""How a sentence about a motor ends that cannot do what a motion asks."""


def rating_warnings(
    joint: DamiaoJoint, velocity: float, torque: float
) -> Iterator[str]:
    """Yield a sentence for each rating of a motor that a peak velocity or torque exceeds."""
    spec = joint.spec
    for limit, name, remedy in (
        (spec.peak_torque, "peak", CANNOT_FOLLOW),
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
            f"{CANNOT_FOLLOW}"
        )


# Accelerations so near to each other compare torques between which a load hardly changes [s].
_MOMENT = 0.1


def rotor_problems(
    played: DamiaoTrajectory, speed: float, doubt: Array
) -> Iterator[str]:
    """Yield which joints cannot follow, played at a share of their speed: known without a model.

    A motor turns its own rotor at least. Where that takes more than the ``doubt`` (n,) [N m] from
    where a joint accelerates most to the opposite within a moment, half of it is in the torque that
    is fed forward: less is that of another motion.
    """
    time = played.time
    shaken = np.gradient(played.qd, played.time, axis=0)
    for joint, own, tau, unsure in zip(played.joints, shaken.T, played.tau.T, doubt):
        peak = int(np.argmax(np.abs(own)))
        sign = np.sign(own[peak])
        far = np.abs(time - time[peak]) > _MOMENT
        other = int(np.argmin(np.where(far, np.inf, sign * own)))
        takes = speed**2 * joint.spec.rotor * abs(own[peak] - own[other])
        fed = sign * (tau[peak] - tau[other])
        if takes > 2.0 * unsure and fed < 0.5 * takes:
            yield (
                f"{joint.label}: at {time[peak] - time[0]:.2f} s it is to turn with "
                f"{speed**2 * own[peak]:.0f} rad/s^2; its rotor alone takes {takes:.1f} N m to and "
                f"fro, and the file feeds forward {fed:.1f}, the torque of another motion; "
                f"{CANNOT_FOLLOW}, export it again"
            )


def read_damiao_trajectory(path: str | os.PathLike[str]) -> DamiaoTrajectory:
    """Read a trajectory file, or raise InputError, which names the line that is wrong."""
    path = Path(path)
    refuse_special_file(path, "give a trajectory file")
    joints: list[DamiaoJoint] = []
    try:
        with open(path, encoding="utf-8-sig") as file:
            lines = file.readlines()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file") from None
    for number, line in enumerate(lines, start=1):
        if not line.startswith("#"):
            break
        if "motor_type" in line:
            joints.append(_parse_joint(line, path, number))
    else:
        raise InputError(f"{path} has no column line; it is not a Damiao trajectory")
    n = len(joints)
    if n == 0:
        raise InputError(
            f"{path} has no '# motor_type=...' lines; it is not a Damiao trajectory"
        )
    if [name.strip() for name in line.split(",")] != ["time", *trajectory_columns(n)]:
        expected = f"expected the columns time,j0_pos,j0_vel,j0_tau,... for {n} joints"
        raise InputError(f"{path}, line {number}: {expected}")
    filled = [
        (k, row) for k, row in enumerate(lines[number:], number + 1) if row.strip()
    ]
    width = 1 + 3 * n
    table = np.array([_numbers(row, width, path, k) for k, row in filled]).reshape(
        -1, width
    )
    numbers = np.array([k for k, _ in filled], int)
    time = table[:, 0].copy()
    for row in np.flatnonzero(np.diff(time) <= 0.0)[:1]:
        raise InputError(
            f"{path}, near line {numbers[row + 1]}: time does not increase"
        )
    q, qd, tau = (table[:, k::3] for k in (1, 2, 3))
    return DamiaoTrajectory(path, tuple(joints), numbers, time, q, qd, tau)


def together(first: DamiaoTrajectory, second: DamiaoTrajectory) -> DamiaoTrajectory:
    """Return two trajectories as one, begun at the same time; the shorter one holds its end."""
    files = first, second
    times = [each.time - each.time[0] for each in files]
    longer = int(times[1][-1] > times[0][-1])
    time = _merged(times)

    def joined(name: str) -> Array:
        columns = [column for each in files for column in getattr(each, name).T]
        own = [each_time for each, each_time in zip(files, times) for _ in each.joints]
        return np.stack([np.interp(time, *pair) for pair in zip(own, columns)], axis=1)

    line = np.interp(time, times[longer], files[longer].line).astype(int)
    q, qd, tau = (joined(name) for name in ("q", "qd", "tau"))
    joints = first.joints + second.joints
    return DamiaoTrajectory(first.path, joints, line, time, q, qd, tau, both=True)


def _merged(times: Sequence[Array]) -> Array:
    """Return all moments, but those that are nearly the same only once.

    Two that rounding keeps apart would make any slope of the ways between them, and any slack.
    """
    least = 0.5 * min(np.diff(each).min(initial=np.inf) for each in times)
    kept = [0.0]
    for moment in np.union1d(*times):
        if moment - kept[-1] >= least:
            kept.append(moment)
    # The last one stays: files end at rest there.
    kept[-1] = max(each[-1] for each in times)
    return np.array(kept)


def _numbers(line: str, width: int, path: Path, number: int) -> list[float]:
    """Return the numbers in a line, or raise InputError unless there are so many."""
    with contextlib.suppress(ValueError):
        row = [*map(float, line.partition("#")[0].split(","))]
        # Python takes 1_0 for 10.
        if len(row) == width and "_" not in line and math.isfinite(sum(row)):
            return row
    raise InputError(f"{path}, line {number}: expected {width} finite numbers")


def _parse_joint(line: str, path: Path, number: int) -> DamiaoJoint:
    pairs = dict(_PAIR.findall(line.lstrip("# ")))
    try:
        can_id = int(pairs["can_id"], 0)
        master_id = int(pairs.get("master_id", str(can_id + MASTER_ID_OFFSET)), 0)
        motor_type = motor_spec(pairs["motor_type"]).name
        mode = pairs["mode"]
    except InputError as error:
        raise InputError(f"{path}, line {number}: {error}") from None
    except (KeyError, ValueError):
        raise InputError(
            f"{path}, line {number}: expected '# motor_type=TYPE,can_id=NUMBER,mode=MIT'"
        ) from None
    if mode != "MIT":
        raise InputError(
            f"{path}, line {number}: mode {mode!r} cannot be played, only MIT"
        )
    return DamiaoJoint(motor_type, can_id, master_id)


NO_LIMITS = LimitOptions(max_velocity=1e6, clearance=0.0, below_base=True)
"""What a run obeys where nothing else is asked for: 1e6 rad/s is none."""
MODEL_LIMITS = "workspace", "keep_out", "clearance"
LIMITS = ("max_velocity", "max_acceleration", "max_torque", *MODEL_LIMITS)
"""Which of a motion's limits hold for all that a run moves."""


def limit_excesses(
    trajectory: DamiaoTrajectory, speed: float, limits: LimitOptions
) -> Iterator[str]:
    """Yield a sentence for each limit that a trajectory, played at a share of its speed, breaks."""
    step = np.diff(trajectory.time)
    # The fourth decimal of two velocities makes this much acceleration.
    printed = 2.0 * _ROUNDING / step.min()
    shaken = np.gradient(trajectory.qd, trajectory.time, axis=0)
    for values, most, unit, flag, slack in (
        (
            speed * trajectory.qd,
            limits.max_velocity,
            "rad/s",
            "--max-velocity",
            _ROUNDING,
        ),
        (
            speed**2 * shaken,
            limits.max_acceleration,
            "rad/s^2",
            "--max-acceleration",
            printed,
        ),
        (trajectory.tau, limits.max_torque, "N m", "--max-torque", _ROUNDING),
    ):
        tops = per_joint(np.inf if most is None else most, trajectory.n_joints, flag)
        largest = np.abs(values).max(axis=0)
        for j in np.flatnonzero(largest > tops + slack).tolist():
            name = trajectory.joints[j].label
            yield f"{name}: {largest[j]:.4g} {unit} is beyond {flag} {tops[j]:g}"


# Numbers with four decimals, as the export writes them, are this far from what was meant.
_ROUNDING = 0.5e-4
# A tenth of a second hides 1e-4 rad of rounding behind 1e-3 rad/s and is short beside a swing.
_WINDOW = 0.1
_LEAST_ROWS = 4
# Rows on either side whose slopes count as around: a difference quotient is half a row early or
# late, and one more row is room for where the motion bends.
_AROUND = 2


class Mismatch(NamedTuple):
    """Where the velocity column states a velocity, and the positions show another [rad/s]."""

    row: int
    joint: int
    stated: float
    shown: float


def velocity_mismatch(time: Array, q: Array, qd: Array) -> Mismatch | None:
    """Return where velocities (N, n) first differ from the positions' changes, or None."""
    step = np.diff(time)[:, None]
    slope = np.diff(q, axis=0) / step
    return next(
        chain(_rows_off(step, slope, qd), _windows_off(time, q, qd, slope)), None
    )


def _rows_off(step: Array, slope: Array, qd: Array) -> Iterator[Mismatch]:
    padded = (
        np.pad(each, ((_AROUND, _AROUND), (0, 0)), mode="edge")
        for each in (slope, step)
    )
    slopes, steps = (sliding_window_view(each, 2 * _AROUND, axis=0) for each in padded)
    low = slopes.min(axis=-1)
    high = slopes.max(axis=-1)
    # Two rounded positions, of the slope and of what it is compared with, over the shortest step.
    slack = 4.0 * _ROUNDING / steps.min(axis=-1) + _ROUNDING + (high - low)
    off = np.maximum(low - slack - qd, qd - high - slack)
    # The last rows have no slopes behind them.
    off[len(off) - _AROUND :] = 0.0
    for row, joint in np.argwhere(off > 0.0)[:1]:
        yield Mismatch(
            int(row), int(joint), float(qd[row, joint]), float(slope[row, joint])
        )


def _windows_off(time: Array, q: Array, qd: Array, slope: Array) -> Iterator[Mismatch]:
    step = np.diff(time)[:, None]
    rows = np.arange(len(time))
    ends = np.maximum(np.searchsorted(time, time + _WINDOW), rows + _LEAST_ROWS)
    starts = np.flatnonzero(ends < len(slope))
    if not len(starts):
        return
    ends = ends[starts]
    # The longest step of each window and of the rows beside it.
    beside = np.pad(step[:, 0], 1, mode="edge")
    spans = np.column_stack([starts, ends + 2]).ravel()
    longest = np.maximum.reduceat(beside, spans)[::2, None]
    parts = 0.5 * (qd[1:] + qd[:-1]) * step, np.abs(np.diff(qd, axis=0))
    way, turns = (np.cumsum(np.insert(each, 0, 0.0, axis=0), axis=0) for each in parts)
    came = q[ends] - q[starts]
    said = way[ends] - way[starts]
    # Half a row early or late, and a fifth more; then what trapezoids leave out where it bends.
    before = np.vstack([slope[:1], slope])
    sped_up = [np.abs(each[ends] - each[starts]) for each in (slope, before)]
    shifted = 0.6 * longest * np.maximum(*sped_up) + 2.0 * _ROUNDING
    bent = longest / 6.0 * (turns[ends] - turns[starts])
    length = (time[ends] - time[starts])[:, None]
    allowed = shifted + bent + 2.0 * _ROUNDING + _ROUNDING * length
    for k, j in np.argwhere(np.abs(came - said) > allowed * (1.0 + 1e-9))[:1]:
        span = float(length[k, 0])
        yield Mismatch(
            int(starts[k]), int(j), float(said[k, j]) / span, float(came[k, j]) / span
        )


def _rate_warnings(time: Array, n_joints: int) -> Iterator[str]:
    if len(time) < 2:
        return
    rate = 1.0 / float(np.median(np.diff(time)))
    classic = BusTiming()
    fast = BusTiming(fd=True)
    load = bus_load(n_joints, rate, classic)
    if load > PLANNING_LIMIT:
        fits = suggested_rate(n_joints, classic)
        fits_fd = suggested_rate(n_joints, fast)
        yield (
            f"{rate:g} Hz would fill {100 * load:.0f} % of a classic CAN bus "
            f"({100 * bus_load(n_joints, rate, fast):.0f} % of CAN-FD): play the file at "
            f"{fits:g} Hz (CAN-FD: {fits_fd:g} Hz), or export it with --sample-rate {fits:g}"
        )

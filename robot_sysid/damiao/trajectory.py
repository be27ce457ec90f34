"""The trajectory file that Damiao motors play: exported in a stream, read, compared with limits.

::

    # motor_type=DM4340,can_id=1,mode=MIT          one line per joint, base to terminal
    time,j0_pos,j0_vel,j0_tau,j1_pos,...           s, rad, rad/s, N m
    0.000,0.0000,0.0000,0.0000,0.0000,...

A joint whose replies do not come on CAN id + 0x10 has ``,master_id=...`` appended to its line.

The export clamps values to the motors' limits and reports the share of samples that it clamped.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.joints import MASTER_ID_OFFSET, RPM, DamiaoJoint, motor_spec
from robot_sysid.errors import InputError
from robot_sysid.motion import LimitOptions
from robot_sysid.records import LIMITED, Array, Limits
from robot_sysid.records.file_access import read_text

if TYPE_CHECKING:
    from robot_sysid.pipeline.motors import MotionChunk

# A name and a value in a comment line of a file.
_PAIR = re.compile(r"\s*([a-z_]+)\s*=\s*([^,\s]+)\s*")

ROUNDING = 0.5e-4
"""Largest rounding error of a number with four decimals, as the export writes it."""


@dataclass(frozen=True)
class DamiaoExportReport:
    """Result of the export of a trajectory with n joints.

    Attributes:
        clamped_percent: share (n,) of each joint's samples that have a clamped value [%].
        warnings: sentences about ratings and clamped samples.
    """

    clamped_percent: Array
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class DamiaoTrajectory:
    """Trajectory of n joints at N moments, as read from a file.

    Attributes:
        path: file from which the trajectory was read.
        joints: joints with their motors, base to terminal.
        time: increasing times (N,) of the rows [s].
        q: positions (N, n) [rad].
        qd: velocities (N, n) [rad/s].
        tau: feed-forward torques (N, n) [N m].
    """

    path: Path
    joints: tuple[DamiaoJoint, ...]
    time: Array
    q: Array
    qd: Array
    tau: Array

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joints)

    def rows_at(self, time: Array) -> NDArray[np.int64]:
        """Return the index (K,) of the row before each of the file's times (K,) or one time [s]."""
        row = np.searchsorted(self.time, time) - 1
        return np.clip(row, 0, len(self.time) - 2)

    def sampled(self, time: Array) -> list[Array]:
        """Return q, qd, tau (K, n) on the straight lines between rows at the file's times (K,) [s].

        They are (n,) each for one time. Motors are sent what stands on these lines. Outside of the
        file its first or last row holds.
        """
        row = self.rows_at(time)
        since = (time - self.time[row]) / (self.time[row + 1] - self.time[row])
        share = np.clip(since, 0.0, 1.0)[..., None]
        return [
            signal[row] + share * (signal[row + 1] - signal[row])
            for signal in (self.q, self.qd, self.tau)
        ]

    @property
    def qdd(self) -> Array:
        """Accelerations (N, n), the gradient of the velocities over the file's time [rad/s^2]."""
        return np.gradient(self.qd, self.time, axis=0)

    @property
    def slopes(self) -> Array:
        """Slopes (N - 1, n) of the positions over the file's time, from row to row [rad/s]."""
        return np.diff(self.q, axis=0) / np.diff(self.time)[:, None]


def export_damiao_trajectory(
    motion_chunks: Iterable[MotionChunk], joints: tuple[DamiaoJoint, ...], file: TextIO
) -> DamiaoExportReport:
    """Write a trajectory for Damiao motors, clamped to the limits of their frames; return a report.

    Args:
        motion_chunks: successive pieces of the motion in joint space: time, position, velocity and
            torque. They are written one after the other.
        joints: the n joints with their motors, base to terminal.
        file: to write to.

    Raises:
        InputError: there are no samples, or a value is not finite.
    """
    chunks = iter(motion_chunks)
    first = next(chunks, None)
    if first is None or len(first[0]) == 0:
        raise InputError("the trajectory to export has no samples")
    # Greatest position, velocity and torque (3, 1, n) that frames can carry.
    limits = np.array([joint.spec.limits for joint in joints]).T[:, None]
    n_rows = 0
    n_clamped = np.zeros(len(joints))
    peaks = np.zeros((3, len(joints)))
    # Milliseconds where all times of the first chunk are whole ones, else microseconds.
    decimals = 3 if np.all(np.abs(first[0] - np.round(first[0], 3)) < 1e-9) else 6
    file.write(_head(joints))
    for chunk in chain([first], chunks):
        # Position, velocity and torque (3, N, n).
        signals = np.stack(chunk[1:])
        if not np.all(np.isfinite(signals)):
            raise InputError("the trajectory to export has values that are not finite")
        clamped = np.clip(signals, -limits, limits)
        n_clamped += np.any(clamped != signals, axis=0).sum(axis=0)
        peaks = np.maximum(peaks, np.abs(signals).max(axis=1, initial=0.0))
        n_rows += len(chunk[0])
        file.write(_rows(chunk[0], clamped, decimals))
    percent = 100.0 * n_clamped / n_rows
    warnings = []
    for joint, share, velocity, torque in zip(joints, percent, *peaks[1:]):
        if share:
            warnings.append(
                f"{joint.label}: {share:.2f} % of the samples were clamped to the limits of a "
                f"{joint.motor_type}; use a stronger motor or a slower trajectory"
            )
        warnings += rating_warnings(joint, velocity, torque)
    return DamiaoExportReport(percent, tuple(warnings))


def _head(joints: Sequence[DamiaoJoint]) -> str:
    """Return the comment lines and the column line of a trajectory file."""
    head = ""
    for joint in joints:
        head += f"# motor_type={joint.motor_type},can_id={joint.can_id},mode=MIT"
        if joint.master_id != joint.can_id + MASTER_ID_OFFSET:
            head += f",master_id={joint.master_id}"
        head += "\n"
    return head + ",".join(["time", *trajectory_columns(len(joints))]) + "\n"


def trajectory_columns(n_joints: int) -> list[str]:
    """Return the titles j0_pos, j0_vel, j0_tau, j1_pos, ... of the columns of n joints."""
    columns = []
    for j in range(n_joints):
        columns += [f"j{j}_pos", f"j{j}_vel", f"j{j}_tau"]
    return columns


def _rows(time: Array, values: Array, decimals: int) -> str:
    """Return the file's lines of positions, velocities and torques (3, N, n) at times (N,) [s].

    Times have ``decimals`` decimals, all other numbers four.
    """
    # Adding zero turns the -0.0 that rounding leaves into 0.0.
    cells = np.round(values.transpose(1, 2, 0).reshape(len(time), -1), 4) + 0.0
    # One format for all rows at once, because a loop over rows is slow.
    row = ",".join([f"%.{decimals}f"] + ["%.4f"] * cells.shape[1]) + "\n"
    return (row * len(time)) % tuple(np.column_stack([time, cells]).ravel())


CANNOT_FOLLOW = "it cannot follow"
"""End of a sentence about a motor that cannot do what a motion needs."""
WEIGH_FIRST = "weigh the arm with a smaller motion first (see {for_=weight} of plan)"
"""Remedy for an arm that needs more torque than its model says, or than its motors make."""


def rating_warnings(
    joint: DamiaoJoint, velocity: float, torque: float
) -> Iterator[str]:
    """Yield a sentence for each rating of a motor that a motion exceeds.

    ``velocity`` and ``torque`` are the largest magnitudes of the motion [rad/s, N m]. Of the peak
    and the rated torque only the higher one that is exceeded is named.
    """
    spec = joint.spec
    for limit, name, remedy in (
        (spec.peak_torque, "peak", CANNOT_FOLLOW),
        (spec.rated_torque, "rated", "fine for a moment, too hot for long"),
    ):
        if torque > limit:
            yield (
                f"{joint.label}: {torque:.2f} N·m exceeds the {name} torque of a {spec.name}, "
                f"{limit:g} N·m; {remedy}"
            )
            break
    if spec.no_load_rpm is not None and velocity > spec.no_load_rpm * RPM:
        yield (
            f"{joint.label}: {velocity:.2f} rad/s ({velocity / RPM:.0f} rpm) exceeds the no-load "
            f"speed of a {spec.name}, {spec.no_load_rpm * RPM:.2f} rad/s; {CANNOT_FOLLOW}"
        )


def read_damiao_trajectory(path: str | os.PathLike[str]) -> DamiaoTrajectory:
    """Return the trajectory in a file.

    InputError where the file cannot be read or is no trajectory; it names the line that is wrong.
    """
    path = Path(path)
    lines = read_text(path, "give a trajectory file").splitlines()
    # Comment lines, one line of column titles, then one line of numbers per row.
    comments = list(takewhile(lambda line: line.startswith("#"), lines))
    joints = tuple(
        _parse_joint(line, path, number)
        for number, line in enumerate(comments, start=1)
        if "motor_type" in line
    )
    n = len(joints)
    if n == 0 or len(comments) == len(lines):
        raise InputError(
            f"{path} has no '# motor_type=...' lines, or no column line below them; it is not a "
            "Damiao trajectory"
        )
    title_number = len(comments) + 1
    titles = [title.strip() for title in lines[len(comments)].split(",")]
    if titles != ["time", *trajectory_columns(n)]:
        raise InputError(
            f"{path}, line {title_number}: expected the columns time,j0_pos,j0_vel,j0_tau,... for "
            f"{n} joints"
        )
    rows = [line for line in lines[title_number:] if line.strip()]
    try:
        table = np.loadtxt(rows, delimiter=",", ndmin=2) if rows else np.empty((0, 1))
    except ValueError as error:
        raise InputError(f"{path}, below line {title_number}: {error}") from None
    if rows and table.shape[1] != len(titles) or not np.all(np.isfinite(table)):
        raise InputError(
            f"{path}, below line {title_number}: expected {len(titles)} finite numbers per line"
        )
    time = table[:, 0].copy()
    for row in np.flatnonzero(np.diff(time) <= 0.0)[:1]:
        raise InputError(f"{path}: time does not increase after {time[row]:g} s")
    return DamiaoTrajectory(
        path, joints, time, q=table[:, 1::3], qd=table[:, 2::3], tau=table[:, 3::3]
    )


def _parse_joint(line: str, path: Path, number: int) -> DamiaoJoint:
    """Return the joint that a comment line of a file describes.

    InputError where it describes none; it names the file's ``path`` and the ``number`` of the line.
    """
    pairs = dict(_PAIR.findall(line.lstrip("# ")))
    try:
        # Base 0 takes a number like 0x11 too.
        can_id = int(pairs["can_id"], 0)
        master_id = int(pairs.get("master_id", str(can_id + MASTER_ID_OFFSET)), 0)
        motor_type = motor_spec(pairs["motor_type"]).name
        if pairs["mode"] == "MIT":
            return DamiaoJoint(motor_type, can_id, master_id)
    except InputError as error:
        raise InputError(f"{path}, line {number}: {error}") from None
    except (KeyError, ValueError):
        pass
    raise InputError(
        f"{path}, line {number}: expected '# motor_type=TYPE,can_id=NUMBER,mode=MIT'"
    )


NO_LIMITS = LimitOptions(max_velocity=1e6, clearance=0.0, below_base=True)
"""The limits of a run for which the user gives none: 1e6 rad/s stops no motion."""
MODEL_LIMITS = "workspace", "keep_out", "clearance"
"""The limits that can only be compared with a model of the arm."""
LIMITS = ("max_velocity", "max_acceleration", "max_torque", *MODEL_LIMITS)
"""Names of the limits of a motion that hold for all that a run moves."""


def limit_excesses(
    trajectory: DamiaoTrajectory, speed: float, owner: str, limits: Limits
) -> Iterator[str]:
    """Yield a sentence for each joint and each limit that a trajectory exceeds.

    The slope of the positions from row to row counts as a velocity too. What the rounding of the
    file's numbers may make is left to each quantity.

    Args:
        trajectory: with n joints.
        speed: factor of the file's speed at which it is played.
        owner: whose limits they are, in words: "your", "the model's".
        limits: of the joints.
    """
    step = np.diff(trajectory.time)[:, None]
    velocity = np.abs(trajectory.qd)
    slopes = np.abs(trajectory.slopes) - 2.0 * ROUNDING / step
    velocity[:-1] = np.maximum(velocity[:-1], slopes)
    acceleration = speed**2 * trajectory.qdd
    signals = limits.signals(
        trajectory.q, speed * velocity, acceleration, trajectory.tau
    )
    time = (trajectory.time - trajectory.time[0]) / speed
    labels = [joint.label for joint in trajectory.joints]
    rounding = np.full(signals.shape[1], ROUNDING)
    # A velocity is rounded at both ends of a step.
    rounding[2 * len(labels) : 3 * len(labels)] = 2.0 * ROUNDING / step.min()
    for use in limits.uses([(time, signals)], labels, rounding):
        if not use.is_kept:
            value = use.middle + use.value
            limit = use.middle + use.limit
            yield (
                f"{use.owner}: {use.quantity} {value:.4g} {LIMITED[use.quantity]} is beyond "
                f"{owner} limit {limit:g}, at {use.time:.2f} s"
            )


def velocity_mismatch(trajectory: DamiaoTrajectory) -> tuple[int, int, float] | None:
    """Return the first row and the joint of a window over which velocities do not add up to the
    change of position, and by how much they are off [rad/s]; None where there is no such window.

    A motor is commanded both; where they disagree it follows neither. Velocities may be those of
    half a row earlier or later, as a difference quotient has them, and each printed number is
    rounded by ``ROUNDING``.
    """
    time = trajectory.time
    step = np.diff(time)[:, None]
    qd = trajectory.qd
    # Number of rows, at least four, from the begin of a window to its end; a shorter file has one.
    # Over 0.1 s, 1e-4 rad of rounding are 1e-3 rad/s, and a swing takes longer.
    rows = min(max(round(0.1 / np.median(step)), 4), len(time) - 1)
    integral, doubt = np.zeros((2, *qd.shape))
    integral[1:] = np.cumsum(0.5 * (qd[1:] + qd[:-1]) * step, axis=0)
    # Half a row, and a fifth more.
    doubt[1:] = 0.6 * np.cumsum(np.abs(np.diff(qd, axis=0)) * step, axis=0)
    drift = trajectory.q - integral
    duration = (time[rows:] - time[:-rows])[:, None]
    difference = drift[rows:] - drift[:-rows]
    tolerance = doubt[rows:] - doubt[:-rows] + ROUNDING * (4.0 + duration)
    for k, j in np.argwhere(np.abs(difference) > tolerance)[:1]:
        return k, j, difference[k, j] / duration[k, 0]
    return None

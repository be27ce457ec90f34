"""The trajectory file that Damiao motors play: exported in a stream, and read.

::

    # motor_type=DM4340,can_id=1,mode=MIT          one line per joint, base to terminal
    time,j0_pos,j0_vel,j0_tau,j1_pos,...           s, rad, rad/s, N m
    0.000,0.0000,0.0000,0.0000,0.0000,...

Where replies do not come on CAN id + 0x10, ``,master_id=...`` may be appended to a joint's line.

The export clamps values to the motors' limits and returns the share of samples that it clamped.
What carries and accelerates the arm stands in a file beside it (``damiao/weight_file``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.joints import MASTER_ID_OFFSET, DamiaoJoint, motor_spec
from robot_sysid.damiao.weight_file import belongs_to, read_weight, weight_path
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion
from robot_sysid.records.file_access import read_text
from robot_sysid.records.usual_errors import WEIGHT

if TYPE_CHECKING:
    from robot_sysid.pipeline.motors import MotionChunk

# The comment line of a joint: type, CAN id, and master id or nothing.
_JOINT = re.compile(
    r"#\s*motor_type=(\w+),\s*can_id=(\d+),\s*mode=MIT(?:,\s*master_id=(\d+))?\s*"
)

ROUNDING = 0.5e-4
"""Largest rounding error of a number with four decimals, as the export writes it."""


@dataclass(frozen=True, eq=False)
class DamiaoTrajectory:
    """Trajectory of n joints at N moments, as read from a file.

    Attributes:
        path: file from which the trajectory was read.
        joints: joints with their motors, base to terminal.
        time: increasing times (N,) of the rows, from zero on [s].
        q: positions (N, n) [rad].
        qd: velocities (N, n) [rad/s].
        tau: feed-forward torques (N, n) [N m], those of the file's own speed.
        weight: torques (N, n) that carry the arm at rest in each row's pose: gravity and springs,
            no friction [N m]. None where it is not known.
        inertia: torques (N, n) of accelerations, Coriolis and rotors of the file's own motion, no
            friction and no damping [N m]. None where ``weight`` is.
        weight_error: standard errors (N, n) of the weight [N m]. None where no model says them:
            then they are a usual share of it.
        weight_slope: by how much each joint's weight grows as it sinks (n,), at most in the motion
            [N m/rad]. None where ``weight`` is.
        foreign_weight: file beside the trajectory that is not its weight, but that of another one;
            nothing of it is used. None where there is none.
        first_line: number of the file's line that holds the first row; None where it is not known.
    """

    path: Path
    joints: tuple[DamiaoJoint, ...]
    time: Array
    q: Array
    qd: Array
    tau: Array
    weight: Array | None = None
    inertia: Array | None = None
    weight_error: Array | None = None
    weight_slope: Array | None = None
    foreign_weight: Path | None = None
    first_line: int | None = None

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joints)

    def place(self, row: int) -> str:
        """Return where a row stands in words, such as "line 812 (0.804 s)"."""
        moment = f"{self.time[row]:.3f} s"
        if self.first_line is None:
            return moment
        return f"line {self.first_line + row} ({moment})"

    def _rows_at(self, time: Array) -> NDArray[np.int64]:
        """Return the index (K,) of the row before each of some times (K,), or one time [s]."""
        row = self.time.searchsorted(time) - 1
        return np.minimum(np.maximum(row, 0), len(self.time) - 2)

    def state_at(self, time: Array) -> list[Array]:
        """Return q, qd, tau (K, n) on the straight lines between rows at times (K,) [s].

        They are (n,) each for one time. Motors are sent what stands on these lines. Outside of the
        file its first or last row holds.
        """
        return self._on_lines(time, self.q, self.qd, self.tau)

    def _on_lines(self, time: Array, *signals: Array) -> list[Array]:
        """Return signals (N, n) on the straight lines between rows at times (K,), or one time."""
        row = self._rows_at(time)
        since = (time - self.time[row]) / (self.time[row + 1] - self.time[row])
        share = np.minimum(np.maximum(since, 0.0), 1.0)[..., None]
        return [
            signal[row] + share * (signal[row + 1] - signal[row]) for signal in signals
        ]

    def needed_torque(
        self, time: Array | float, speed: float
    ) -> tuple[Array, Array, Array]:
        """Return the torque that the motion needs at a speed, the weight in it and its error.

        All are (n,) [N m].

        Along the same path at a share of the file's speed, torque = weight + speed^2 inertia: the
        pose alone carries, and accelerations and products of velocities shrink with the square.
        Friction and damping are not in it. Where the weight is not known, the torque is that of the
        file, which is right at its own speed alone and stands for the weight there; at another
        speed the weight is NaN.

        Args:
            time: of the file, not of playing it [s]; beyond its ends its first or last row holds.
            speed: factor of the file's velocities.
        """
        moment = np.array(time)
        if self.weight is None or self.inertia is None:
            (torque,) = self._on_lines(moment, self.tau)
            weight = torque if speed >= 1.0 else np.full(self.n_joints, np.nan)
            return torque, weight, WEIGHT * np.abs(weight)
        weight, inertia = self._on_lines(moment, self.weight, self.inertia)
        error = WEIGHT * np.abs(weight)
        if self.weight_error is not None:
            (error,) = self._on_lines(moment, self.weight_error)
        return weight + speed**2 * inertia, weight, error

    def at_speed(self, speed: float) -> DamiaoTrajectory:
        """Return this trajectory with the torques that are fed when it is played at a speed.

        Positions, velocities and times stay those of the file. See ``needed``.
        """
        if self.weight is None or self.inertia is None:
            return self
        return replace(self, tau=self.weight + speed**2 * self.inertia)

    @property
    def qdd(self) -> Array:
        """Accelerations (N, n), the gradient of the velocities over the file's time [rad/s^2]."""
        return np.gradient(self.qd, self.time, axis=0)

    @property
    def slopes(self) -> Array:
        """Slopes (N - 1, n) of the positions over the file's time, from row to row [rad/s]."""
        return np.diff(self.q, axis=0) / np.diff(self.time)[:, None]

    @property
    def duration(self) -> float:
        """Time of the last row [s]."""
        return self.time[-1]

    def evaluate(self, time: Array) -> Motion:
        """Return position and slope (K, n) at times (K,) [s], with zero acceleration."""
        q = self.state_at(time)[0]
        return Motion(time, q, self.slopes[self._rows_at(time)], np.zeros_like(q))


def export_damiao_trajectory(
    motion_chunks: Iterable[MotionChunk], joints: tuple[DamiaoJoint, ...], file: TextIO
) -> Array:
    """Write a trajectory for Damiao motors, clamped to the limits of their frames.

    Args:
        motion_chunks: successive pieces of the motion in joint space: time, position, velocity and
            torque. They are written one after the other.
        joints: the n joints with their motors, base to terminal.
        file: to write to.

    Returns:
        The share (n,) of each joint's samples that have a clamped value [%].

    Raises:
        InputError: a value is not finite.
    """
    for joint in joints:
        file.write(f"# motor_type={joint.motor_type},can_id={joint.can_id},mode=MIT\n")
    file.write(",".join(["time", *trajectory_columns(len(joints))]) + "\n")
    # Greatest position, velocity and torque (3, 1, n) that frames can carry.
    limits = np.array([joint.spec.limits for joint in joints]).T[:, None]
    n_rows = 0
    n_clamped = np.zeros(len(joints))
    formats: list[str] = []
    for time, *motion in motion_chunks:
        # Position, velocity and torque (3, N, n).
        signals = np.stack(motion)
        if not np.all(np.isfinite(signals)):
            raise InputError("the trajectory to export has values that are not finite")
        clamped = np.clip(signals, -limits, limits)
        n_clamped += np.any(clamped != signals, axis=0).sum(axis=0)
        n_rows += len(time)
        if not formats:
            # Milliseconds where all times of the first chunk are whole ones, else microseconds.
            decimals = 3 if np.all(np.abs(time - np.round(time, 3)) < 1e-9) else 6
            formats = [f"%.{decimals}f"] + ["%.4f"] * (3 * len(joints))
        cells = clamped.transpose(1, 2, 0).reshape(len(time), -1)
        # Adding zero turns the -0.0 that rounding leaves into 0.0.
        table = np.column_stack([time, np.round(cells, 4) + 0.0])
        np.savetxt(file, table, formats, delimiter=",")
    return 100.0 * n_clamped / n_rows


def trajectory_columns(n_joints: int) -> list[str]:
    """Return the titles j0_pos, j0_vel, j0_tau, j1_pos, ... of the columns of n joints."""
    columns = []
    for j in range(n_joints):
        columns += [f"j{j}_pos", f"j{j}_vel", f"j{j}_tau"]
    return columns


def read_damiao_trajectory(path: str | os.PathLike[str]) -> DamiaoTrajectory:
    """Return the trajectory in a file, with its weight where that stands beside it.

    InputError where a file cannot be read or is not what it should be; it names the line that is
    wrong.
    """
    trajectory = _read_trajectory(Path(path))
    beside = weight_path(path)
    if not beside.exists():
        return trajectory
    if not belongs_to(beside, trajectory.path):
        return replace(trajectory, foreign_weight=beside)
    weight, inertia, slope = read_weight(
        beside, len(trajectory.time), trajectory.n_joints
    )
    return replace(trajectory, weight=weight, inertia=inertia, weight_slope=slope)


def _read_trajectory(path: Path) -> DamiaoTrajectory:
    """Return the trajectory in a file, without its weight; raises as ``read_damiao_trajectory``."""
    lines = read_text(path, "give a trajectory file").splitlines()
    # Comment lines, one line of column titles, then one line of numbers per row.
    comments = list(takewhile(lambda line: line.startswith("#"), lines))
    joints = tuple(
        _parse_joint(line, f"{path}, line {number}")
        for number, line in enumerate(comments, start=1)
        if "motor_type" in line
    )
    title_number = len(comments) + 1
    if not joints or len(lines) <= title_number:
        raise InputError(
            f"{path} has no '# motor_type=...' lines, or no column line and rows below them; it "
            "is not a Damiao trajectory"
        )
    titles = ["time", *trajectory_columns(len(joints))]
    if [title.strip() for title in lines[len(comments)].split(",")] != titles:
        raise InputError(
            f"{path}, line {title_number}: expected the columns time,j0_pos,j0_vel,j0_tau,... for "
            f"{len(joints)} joints"
        )
    try:
        table = np.loadtxt(lines, delimiter=",", skiprows=title_number, ndmin=2)
    except ValueError as error:
        # Behind the semicolon is advice for programmers.
        reason = str(error).partition(";")[0]
        raise InputError(f"{path}, below line {title_number}: {reason}") from None
    if table.shape[1] != len(titles) or not np.all(np.isfinite(table)):
        raise InputError(
            f"{path}, below line {title_number}: expected {len(titles)} finite numbers per line"
        )
    time = table[:, 0]
    for row in np.flatnonzero(np.diff(time) <= 0.0)[:1]:
        raise InputError(f"{path}: time does not increase after {time[row]:g} s")
    # Blank lines and comments between rows hold none.
    is_dense = len(lines) == title_number + len(time)
    return DamiaoTrajectory(
        path,
        joints,
        time - time[0],
        q=table[:, 1::3],
        qd=table[:, 2::3],
        tau=table[:, 3::3],
        first_line=title_number + 1 if is_dense else None,
    )


def _parse_joint(line: str, where: str) -> DamiaoJoint:
    """Return the joint that a comment line describes; an InputError begins with ``where`` it is."""
    match = _JOINT.fullmatch(line)
    if match is None:
        raise InputError(
            f"{where}: expected '# motor_type=TYPE,can_id=NUMBER,mode=MIT'"
        )
    motor_type, can_id, master_id = match.groups()
    try:
        motor_spec(motor_type)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    default_id = int(can_id) + MASTER_ID_OFFSET
    return DamiaoJoint(motor_type, int(can_id), int(master_id or default_id))

"""One pass over a trajectory file: its extremes, its ends, and whether it jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao.trajectory_csv import DamiaoTrajectory
from robot_sysid.errors import InputError
from robot_sysid.records import Array


@dataclass(frozen=True)
class TrajectoryScan:
    """What a trajectory asks of the motors.

    Attributes:
        samples: number of rows.
        duration: from first to last row [s].
        first: (n,) first position [rad].
        end_velocity: (n,) larger of the speeds at the first and the last row [rad/s].
        peak_position, peak_velocity, peak_torque: (n,) largest magnitudes.
        peak_step: (n,) largest position change per time between two rows [rad/s].
    """

    samples: int
    duration: float
    first: Array
    end_velocity: Array
    peak_position: Array
    peak_velocity: Array
    peak_torque: Array
    peak_step: Array


def scan_trajectory(trajectory: DamiaoTrajectory) -> TrajectoryScan:
    """Return the extremes of a trajectory file; memory does not grow with its length.

    Raises:
        InputError: a row is malformed, or there are fewer than two.
    """
    peaks = np.zeros((4, trajectory.n_joints))
    samples, ends = 0, []
    last: tuple[Array, Array] | None = None
    for time, q, qd, tau in trajectory.chunks():
        if last is None:
            ends = [(time[0], q[0], qd[0])]
        else:
            time_before, q_before = last
            peaks[3] = np.maximum(peaks[3], np.abs(q[0] - q_before) / (time[0] - time_before))
        steps = np.abs(np.diff(q, axis=0)) / np.diff(time)[:, None]
        largest = [np.abs(x).max(axis=0) for x in (q, qd, tau)]
        peaks = np.maximum(peaks, [*largest, steps.max(axis=0, initial=0.0)])
        samples += len(time)
        last = time[-1], q[-1]
        ends[1:] = [(time[-1], q[-1], qd[-1])]
    if samples < 2:
        raise InputError(f"{trajectory.path} needs at least two rows to be played")
    (start, first, first_speed), (stop, _, last_speed) = ends
    end_velocity = np.maximum(np.abs(first_speed), np.abs(last_speed))
    return TrajectoryScan(samples, stop - start, first, end_velocity, *peaks)

"""Checks of a motor trajectory against itself: velocities, steps, times and single torques.

A motor is commanded position, velocity and torque at once. Where they contradict one another it
follows none of them, so that the run is stopped in mid-motion, or the arm is shaken. Nothing but
the file is needed here; what a model says is in ``checks/model``.

A velocity is the slope of the positions up to what makes honest files differ from it: rounding, a
difference quotient in place of the derivative, and rows too far apart for the curve between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robot_sysid.damiao.checks.findings import stop
from robot_sysid.damiao.joints import peak_torques
from robot_sysid.damiao.trajectory import ROUNDING, DamiaoTrajectory
from robot_sysid.records import Array
from robot_sysid.records.messages import Remark

SLOPE_TIMES = (0.02, 0.2)
"""Lengths over which velocities are added up and compared with the change of position [s]: the
shorter one sees single rows, the longer one a false velocity of a slow joint."""
LEAST_ROWS = 4
"""Least number of rows in the longer one, for files with few rows per second."""
POSITION_STEP = 4e-4
"""Disagreement in position that is left to every file [rad]: a step of what motors report
(25 rad / 65535), so that a recorded motion may be played."""
DIFFERENCES = (0.0, 0.5, -0.5)
"""How velocities are made, as the share of a row by which they are early: derivatives and central
differences, forward differences, backward differences."""
CURVATURE_SHARE = 0.5
"""Largest error of adding up velocities between two rows, over the second difference of velocities
there: a twelfth for derivatives, a quarter for central differences and where an acceleration begins
between two rows, a half at the ends of a file of differences."""
COARSEST_DECIMALS = 2
"""Least number of decimals that a file is taken to be rounded to."""
TIME_DECIMALS = 3
"""Decimals of times that are rounded so that steps differ (0.003, 0.007, 0.010 at 300 Hz)."""
COMMON_SPREAD = 0.05
"""Largest relative difference between the joints' factors, and largest share of the slopes that one
factor leaves unexplained, where it is the file's times that are wrong."""

VELOCITY_STEP = 0.5
"""Change of velocity from one row to the next that is a step where it stands alone [rad/s]: with
the default gains, the arm is off its path by a few hundredths of a radian after it."""
STEP_ACCELERATION = 60.0
"""Acceleration from which such a change is one [rad/s^2]: an arm that moves at 2 rad/s takes 0.1 s
and more to come to that speed; in files with few rows per second, a step is a long one."""
STEP_RATIO = 4.0
"""How much larger a step is than the usual change around it: an acceleration that begins is as
large as what follows it."""
STEP_ROWS = 6
"""Rows before and behind a step that it is compared with: three changes belong to a single row that
is aside, so that their median does not."""

BURST_SHARE = 0.4
"""Share of a motor's peak torque by which a torque may be away from the motion's own smooth one.
Without a model the smooth torque is a guess, and planned motions are up to a third of this away."""
TORQUE_WINDOW = 3.0
"""Length in which a torque is compared with the motion [s]. In shorter ones a burst of 0.2 s at an
end of the file is fitted instead of found; in longer ones the pose changes more than a sum of
columns follows."""
WINDOW_ROWS = 200
"""Rows of a window that the smooth torque is fitted to; between them nothing changes."""
ROWS_PER_COLUMN = 3
"""Least number of rows in a window for each coefficient of the smooth torque."""
RCOND = 1e-4
"""Smallest singular value of the window's columns that is used, as a share of the largest: what is
below is rounding of the file."""
ITERATIONS = 15
"""Reweighted least squares steps towards the least sum of absolute errors; ten do not change it."""

EXPORT_AGAIN = "export the file again, with at least four decimals"
"""Remedy for a file whose signals contradict one another."""


def motion_checks(trajectory: DamiaoTrajectory) -> Iterator[Remark]:
    """Yield a stop for each joint whose positions, velocities and torques contradict one another.

    Each names the first row that shows it, and what to do; of each kind there is one per joint.
    """
    mismatches = velocity_mismatches(trajectory)
    factor = common_factor(trajectory) if mismatches else None
    if factor is None:
        for mismatch in mismatches:
            yield stop(
                f"{trajectory.joints[mismatch.joint].label}: the velocity in the file is not the "
                f"slope of its positions at {trajectory.place(mismatch.row)}: in "
                f"{mismatch.duration:.3g} s before they change by {mismatch.slope:.3g} rad/s, and "
                f"its velocities say {mismatch.velocity:.3g}; {EXPORT_AGAIN}"
            )
    else:
        yield stop(
            "velocities in the file are not the slopes of its positions at "
            f"{trajectory.place(min(mismatch.row for mismatch in mismatches))}: its times are "
            f"{1.0 / factor:.2g} of what its velocities say, or all its velocities are "
            f"{1.0 / factor:.2g} of the slopes; {EXPORT_AGAIN}"
        )
    # A false row is named once.
    named = {mismatch.joint for mismatch in mismatches}
    for row, joint, change in velocity_steps(trajectory):
        if joint not in named:
            yield stop(
                f"{trajectory.joints[joint].label}: the speed of its positions changes by "
                f"{change:.3g} rad/s in one row, at {trajectory.place(row)}: a step that does not "
                "follow from the rows around it; plan a smooth motion, or export the file again"
            )
            named.add(joint)
    if named:
        # Without the motion's own signals nothing tells what torque it needs.
        return
    bounds = BURST_SHARE * peak_torques(trajectory.joints)
    for burst in torque_bursts(trajectory, trajectory.tau, bounds):
        yield stop(
            f"{trajectory.joints[burst.joint].label}: the torque in the file is "
            f"{burst.torque:.3g} N·m at {trajectory.place(burst.row)}, where the motion around it "
            f"needs {burst.smooth:.3g}; export the file again"
        )


class VelocityMismatch(NamedTuple):
    """Rows over which a joint's velocities do not add up to the change of its position.

    Attributes:
        joint: index of the joint.
        row: the last of the rows: those before it agree.
        duration: of the rows [s].
        slope: of the positions over these rows [rad/s].
        velocity: mean of the file's over these rows [rad/s].
    """

    joint: int
    row: int
    duration: float
    slope: float
    velocity: float


def velocity_mismatches(trajectory: DamiaoTrajectory) -> list[VelocityMismatch]:
    """Return the first mismatch of each joint that has one, by the shortest rows that show it.

    A file's velocities are derivatives or one kind of differences, that with which they agree best.
    """
    step = np.diff(trajectory.time)
    rows = _window_rows(trajectory.time, SLOPE_TIMES[0], 1)
    # Error (N, n) of the sum of the velocities up to each row [rad].
    doubt = CURVATURE_SHARE / rows**2 * _bend(trajectory, rows) * step[:, None]
    error = np.vstack([np.zeros_like(doubt[:1]), np.cumsum(doubt, axis=0)])
    candidates = [_mismatches_by(trajectory, share, error) for share in DIFFERENCES]
    return min(candidates, key=lambda candidate: candidate[0])[1]


def _mismatches_by(
    trajectory: DamiaoTrajectory, early: float, error: Array
) -> tuple[float, list[VelocityMismatch]]:
    """Return by how much velocities are off in all [rad], and each joint's first mismatch.

    Args:
        trajectory: with N rows and n joints.
        early: share of a row by which velocities are early, see ``DIFFERENCES``.
        error: of the sum of the velocities up to each row (N, n) [rad].
    """
    time = trajectory.time
    q = trajectory.q
    qd = trajectory.qd
    step = np.diff(time)[:, None]
    # Positions (N, n) as the velocities make them.
    weighted = (0.5 + early) * qd[:-1] + (0.5 - early) * qd[1:]
    integral = np.vstack([np.zeros_like(q[:1]), np.cumsum(weighted * step, axis=0)])
    fixed = max(2.0 * _rounding(q), POSITION_STEP)
    # The rounding of a velocity is the same in all rows where a joint moves steadily.
    velocity_rounding = _rounding(qd)
    late = _time_rounding(time)

    excess = 0.0
    mismatches: dict[int, VelocityMismatch] = {}
    shortest = _window_rows(time, SLOPE_TIMES[0], 1)
    longest = _window_rows(time, SLOPE_TIMES[1], LEAST_ROWS)
    for rows in dict.fromkeys((shortest, longest)):
        duration = (time[rows:] - time[:-rows])[:, None]
        moved = q[rows:] - q[:-rows]
        said = integral[rows:] - integral[:-rows]
        tolerance = error[rows:] - error[:-rows] + fixed + velocity_rounding * duration
        if late > 0.0:
            tolerance += 2.0 * late * _window_maxima(np.abs(qd), rows + 1)
        beyond = np.abs(moved - said) - tolerance
        excess += np.sum(np.maximum(beyond, 0.0))
        for joint in np.flatnonzero(np.any(beyond > 0.0, axis=0)):
            row = int(np.argmax(beyond[:, joint] > 0.0))
            found = VelocityMismatch(
                int(joint),
                row + rows,
                duration[row, 0],
                moved[row, joint] / duration[row, 0],
                said[row, joint] / duration[row, 0],
            )
            mismatches.setdefault(int(joint), found)
    return excess, [mismatches[joint] for joint in sorted(mismatches)]


def _bend(trajectory: DamiaoTrajectory, rows: int) -> Array:
    """Return the second difference (N - 1, n) of the speed around each step [rad/s].

    It is taken over some rows, once by the positions and once by the velocities, and the smaller
    one counts: a row that is false in one of them does not excuse itself. Before and behind the
    file the arm stands.
    """
    step = np.diff(trajectory.time)[:, None]
    still = np.zeros((3 * rows, trajectory.n_joints))
    speeds = np.vstack([still, trajectory.qd, still])
    by_velocity = np.abs(
        speeds[2 * rows :] - 2.0 * speeds[rows:-rows] + speeds[: -2 * rows]
    )

    padded_step = np.pad(step, ((3 * rows, 3 * rows), (0, 0)), mode="edge")
    elapsed = np.vstack([np.zeros((1, 1)), np.cumsum(padded_step, axis=0)])
    padded = np.pad(trajectory.q, ((3 * rows, 3 * rows), (0, 0)), mode="edge")
    slopes = (padded[rows:] - padded[:-rows]) / (elapsed[rows:] - elapsed[:-rows])
    by_position = np.abs(
        slopes[2 * rows :] - 2.0 * slopes[rows:-rows] + slopes[: -2 * rows]
    )

    n_steps = len(step)
    # Second differences whose rows have a part in a step, or in one beside it.
    by_velocity = _window_maxima(by_velocity, 4 * rows + 2)
    by_position = _window_maxima(by_position, 3 * rows + 2)
    return np.minimum(by_velocity[:n_steps], by_position[:n_steps])


def _window_rows(time: Array, duration: float, least: int) -> int:
    """Return the rows from the begin of a window of a duration [s] to its end, and at least some.

    A shorter file is one window.
    """
    rows = round(duration / float(np.median(np.diff(time))))
    return min(max(rows, least), len(time) - 1)


def _window_maxima(values: Array, rows: int) -> Array:
    """Return the largest values (N - rows + 1, n) of (N, n) in each window of some rows."""
    from scipy.ndimage import maximum_filter1d

    centred = maximum_filter1d(values, rows, axis=0)
    return centred[rows // 2 : rows // 2 + len(values) - rows + 1]


def _rounding(values: Array) -> float:
    """Return the largest rounding error of values, by the decimals that they are written with."""
    for decimals in range(COARSEST_DECIMALS, 4):
        if np.allclose(values, np.round(values, decimals), rtol=0.0, atol=1e-9):
            return 0.5 * 10.0**-decimals
    return ROUNDING


def _time_rounding(time: Array) -> float:
    """Return the largest rounding error of times (N,) [s]: none where all steps are alike."""
    step = np.diff(time)
    if np.ptp(step) < 1e-9:
        return 0.0
    decimals = TIME_DECIMALS
    if not np.allclose(time, np.round(time, decimals), rtol=0.0, atol=1e-9):
        # As the export writes them.
        decimals = 6
    return 0.5 * 10.0**-decimals


def common_factor(trajectory: DamiaoTrajectory) -> float | None:
    """Return how much faster all positions change than the velocities say, if one factor tells it.

    None where the joints' factors differ, where fewer than two joints move, or where a factor does
    not make velocities the slopes. The slopes are those over at least ``SLOPE_TIMES[0]``.
    """
    time = trajectory.time
    rows = _window_rows(time, SLOPE_TIMES[0], 1)
    duration = (time[rows:] - time[:-rows])[:, None]
    slopes = (trajectory.q[rows:] - trajectory.q[:-rows]) / duration
    means = 0.5 * (trajectory.qd[1:] + trajectory.qd[:-1]) * np.diff(time)[:, None]
    integral = np.vstack([np.zeros_like(means[:1]), np.cumsum(means, axis=0)])
    velocity = (integral[rows:] - integral[:-rows]) / duration
    # Rounding makes this much of a slope and of a velocity.
    least = (POSITION_STEP / np.median(duration)) ** 2
    is_moving = np.mean(slopes**2, axis=0) > least
    is_moving &= np.mean(velocity**2, axis=0) > least
    if np.sum(is_moving) < 2:
        return None
    slopes = slopes[:, is_moving]
    velocity = velocity[:, is_moving]
    factors = np.sum(slopes * velocity, axis=0) / np.sum(velocity**2, axis=0)
    factor = float(np.median(factors))
    left = np.sqrt(np.mean((slopes - factor * velocity) ** 2, axis=0))
    usual = COMMON_SPREAD * np.sqrt(np.mean(slopes**2, axis=0)) + np.sqrt(least)
    is_common = factor > 0.0 and np.all(left < usual)
    is_common = is_common and np.all(np.abs(factors / factor - 1.0) < COMMON_SPREAD)
    return factor if is_common and abs(factor - 1.0) > COMMON_SPREAD else None


def velocity_steps(trajectory: DamiaoTrajectory) -> Iterator[tuple[int, int, float]]:
    """Yield row, joint and size [rad/s] of each joint's largest step of velocity, if it has one.

    The velocities are the slopes of the positions. A change from one row to the next is a step if
    it is ``STEP_RATIO`` times as large as the usual one before it, and as that behind it.
    """
    if len(trajectory.time) < 2 * STEP_ROWS:
        return
    step = np.diff(trajectory.time)[:, None]
    # Change (N - 2, n) at each row but the first and the last one.
    change = np.abs(np.diff(trajectory.slopes, axis=0))
    padded = np.pad(change, ((STEP_ROWS, STEP_ROWS), (0, 0)))
    usual = np.median(sliding_window_view(padded, STEP_ROWS, axis=0), axis=-1)
    before = usual[: len(change)]
    behind = usual[STEP_ROWS + 1 :]
    shorter_step = np.minimum(step[1:], step[:-1])
    # Positions are rounded at both ends of two steps.
    rounding = 4.0 * max(_rounding(trajectory.q), 0.5 * POSITION_STEP) / shorter_step
    least = np.maximum(VELOCITY_STEP, STEP_ACCELERATION * shorter_step) + rounding
    excess = change - np.maximum(STEP_RATIO * np.maximum(before, behind), least)
    for joint in np.flatnonzero(np.any(excess > 0.0, axis=0)):
        row = int(np.argmax(excess[:, joint]))
        yield row + 1, int(joint), float(change[row, joint])


class TorqueBurst(NamedTuple):
    """A joint's torque far from the motion's own smooth one.

    Attributes:
        joint: index of the joint.
        row: where it is farthest.
        torque: of that row [N m].
        smooth: what the motion around it needs there [N m].
    """

    joint: int
    row: int
    torque: float
    smooth: float


def torque_bursts(
    trajectory: DamiaoTrajectory, tau: Array, bounds: Array
) -> Iterator[TorqueBurst]:
    """Yield for each joint where its torque is farthest from the smooth one, if beyond its bound.

    In windows of three seconds a torque is a sum of what it depends on: pose and acceleration of
    all joints, speed and its sign (dry friction turns at turns) of its own. The coefficients are
    those of the least sum of absolute errors: a burst of a tenth of a window does not move them,
    which least squares would.

    Args:
        trajectory: motion of n joints, N rows.
        tau: torques (N, n), those of the file or their difference from a model's [N m].
        bounds: how far each joint's torque (n,) may be away [N m].
    """
    time = trajectory.time
    # How far each torque is beyond its bound in the window that explains it best.
    beyond = np.full_like(tau, np.inf)
    nearest = np.zeros_like(tau)
    last = max(time[-1] - TORQUE_WINDOW, 0.0)
    for begin_time in np.append(np.arange(0.0, last, 0.5 * TORQUE_WINDOW), last):
        begin = int(np.searchsorted(time, begin_time))
        end = int(np.searchsorted(time, begin_time + TORQUE_WINDOW, side="right"))
        rows = slice(begin, end)
        if end - begin < 2:
            continue
        is_far = np.abs(tau[rows] - np.median(tau[rows], axis=0)) > bounds
        for joint in range(trajectory.n_joints):
            torque = tau[rows, joint]
            smooth = None
            if np.any(is_far[:, joint]):
                smooth = _smooth_torque(trajectory, rows, joint, torque)
            if smooth is None:
                beyond[rows, joint] = 0.0
                continue
            # Dry friction and accelerations step at once, and the smooth speed takes its time.
            width = _window_rows(time, SLOPE_TIMES[0], 1) + 1
            padded = np.pad(smooth, width, mode="edge")
            nearby = sliding_window_view(padded, 2 * width + 1)
            explained = np.clip(torque, nearby.min(axis=1), nearby.max(axis=1))
            far = np.abs(torque - explained) - bounds[joint]
            is_better = far < beyond[rows, joint]
            beyond[rows, joint] = np.where(is_better, far, beyond[rows, joint])
            nearest[rows, joint] = np.where(is_better, explained, nearest[rows, joint])
    beyond[~np.isfinite(beyond)] = 0.0
    for joint in map(int, np.flatnonzero(np.any(beyond > 0.0, axis=0))):
        row = int(np.argmax(beyond[:, joint]))
        yield TorqueBurst(joint, row, tau[row, joint], nearest[row, joint])


def _smooth_torque(
    trajectory: DamiaoTrajectory, rows: slice, joint: int, torque: Array
) -> Array | None:
    """Return the smooth torque (K,) of a joint in a window of K rows [N m].

    Where the window has few rows, other joints are left out; None where it has too few.
    """
    q = trajectory.q[rows]
    time = trajectory.time[rows, None]
    # Velocities of differences are rounded to 0.1 rad/s at 1000 Hz: means over 0.02 s are not.
    width = _window_rows(trajectory.time, SLOPE_TIMES[0], 1)
    if width > 1:
        from scipy.ndimage import uniform_filter1d

        qd = uniform_filter1d(trajectory.qd[rows], width, axis=0, mode="nearest")
        qdd = uniform_filter1d(
            np.gradient(qd, time[:, 0], axis=0), width, axis=0, mode="nearest"
        )
    else:
        qd = trajectory.qd[rows]
        qdd = trajectory.qdd[rows]
    own = slice(joint, joint + 1)
    common = [np.ones_like(time), time, qd[:, own], np.sign(qd[:, own])]
    columns = np.hstack([*common, q, qdd])
    if len(columns) < ROWS_PER_COLUMN * columns.shape[1]:
        columns = np.hstack([*common, q[:, own], qdd[:, own]])
    if len(columns) < ROWS_PER_COLUMN * columns.shape[1]:
        return None
    columns[:, 1:] -= columns[:, 1:].mean(axis=0)
    size = np.sqrt(np.mean(columns**2, axis=0))
    columns = columns[:, size > 0.0] / size[size > 0.0]
    thinned = slice(None, None, -(-len(columns) // WINDOW_ROWS))
    A = columns[thinned]
    b = torque[thinned]
    # Errors below this count like it [N m].
    least = 1e-3 * np.max(np.abs(b - np.median(b)))
    weights = np.ones(len(b))
    for _ in range(ITERATIONS):
        x = np.linalg.lstsq(A * weights[:, None], b * weights, rcond=RCOND)[0]
        weights = 1.0 / np.sqrt(np.maximum(np.abs(b - A @ x), least))
    return columns @ x

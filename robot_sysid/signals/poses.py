"""Poses at which an arm rests, each approached from both sides, found in a log.

Dry friction holds an arm at rest with a torque of either sign. Where a pose is approached once from
below and once from above, the mean of both readings has none of it left (to the extent that it is
as large both ways), so that gravity alone remains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement

STILL = 2e-3
"""How far a joint may move while it rests: several steps of a coarse encoder (chosen) [rad]."""
LEAST_REST = 0.9
SETTLING = 0.35
"""Shortest rest that counts, and how much of its beginning and end is left out [s]: a slow start or
stop looks like rest, and friction is that of the motion there."""
WINDOW = 0.1
"""Stretch of time within which it does not move further (chosen) [s]."""
SAME_POSE = 0.02
"""How far apart two rests in the same pose may be (chosen) [rad]."""
APPROACH = 0.3
LEAST_APPROACH = 1e-3
"""Time before a rest in which a joint's direction is taken [s], and its least motion [rad]."""
FEWEST_POSES = 5
"""Fewer say little of mass and centre of mass, four unknowns, and nothing of their errors."""


def resting_poses(
    samples: Measurement, joint_names: Sequence[str]
) -> tuple[Measurement, NDArray[np.bool_]]:
    """Return (the poses of a log, at rest; (K, n) where a joint's friction cancels).

    Raises:
        InputError: there are too few poses that were approached from both sides.
    """
    joints = samples.q.shape[1]
    rests = np.array(list(_rests(samples))).reshape(-1, 1 + 3 * joints)
    time, q, tau, direction = np.split(rests, 1 + joints * np.arange(3), axis=1)
    again = np.max(np.abs(np.diff(q, axis=0)), axis=1) < SAME_POSE
    count = np.count_nonzero(again)
    if count < FEWEST_POSES:
        raise InputError(
            f"the log rests {len(rests)} times, and {count} poses were approached from both "
            f"sides; --static needs {FEWEST_POSES}: play what robot-sysid plan --for payload "
            "--static writes"
        )
    q, tau = (0.5 * (each[:-1] + each[1:])[again] for each in (q, tau))
    tau[(direction[:-1] * direction[1:])[again] >= 0.0] = np.nan
    blind = [
        name
        for name, column in zip(joint_names, tau.T)
        if not np.any(np.isfinite(column))
    ]
    if len(blind) == len(joint_names):
        raise InputError(
            "no joint approaches its poses from both sides; --static needs that"
        )
    still = np.zeros_like(q)
    return Measurement(
        time[:-1][again, 0], q, still, np.nan_to_num(tau), still
    ), np.isfinite(tau)


def _rests(samples: Measurement) -> Iterator[Array]:
    """Yield (1 + 3 n,) of each rest: its time, mean position and torque, direction of approach."""
    time = samples.time
    q = samples.q
    # The ends of each run of samples around which all joints stay within STILL.
    still = np.concatenate(([False], _is_still(time, q), [False])).astype(int)
    for first, last in np.flatnonzero(np.diff(still)).reshape(-1, 2).tolist():
        if time[last - 1] - time[first] < LEAST_REST:
            continue
        inside = np.searchsorted(
            time, [time[first] + SETTLING, time[last - 1] - SETTLING]
        )
        before = int(np.searchsorted(time, time[first] - APPROACH))
        part = slice(int(inside[0]), int(inside[1]) + 1)
        mean = np.mean(q[part], axis=0)
        moved = mean - q[before]
        direction = np.where(np.abs(moved) < LEAST_APPROACH, 0.0, np.sign(moved))
        yield np.hstack(
            [time[first], mean, np.mean(samples.tau[part], axis=0), direction]
        )


def _is_still(time: Array, q: Array) -> NDArray[np.bool_]:
    """Return (N,) whether all joints stay within ``STILL`` around each sample."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    step = float(np.median(np.diff(time)))
    width = max(int(round(WINDOW / step)), 2)
    span = maximum_filter1d(q, width, axis=0) - minimum_filter1d(q, width, axis=0)
    return np.asarray(np.all(span < STILL, axis=1))

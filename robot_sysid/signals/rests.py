"""Poses at rest: their torque without dry friction.

Dry friction holds an arm at rest with a torque of either sign. Where a pose is approached once from
below and once from above, the mean of both torques has none of it left (to the extent that it is
as large both ways), so that gravity alone remains.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement

STILL = 2e-3
"""How far a joint may move while it rests: several steps of a coarse encoder (chosen) [rad]."""
LEAST_REST = 0.9
"""Shortest rest that counts [s]."""
SETTLING = 0.35
"""Time at the beginning and at the end of a rest that is left out [s]: a slow start or stop looks
like rest, and friction is that of the motion there."""
WINDOW = 0.1
"""Stretch of time within which a resting joint moves no further than ``STILL`` (chosen) [s]."""
SAME_POSE = 0.02
"""How far apart two rests in the same pose may be (chosen) [rad]."""
APPROACH = 0.3
"""Time before a rest over which a joint's direction is determined [s]."""
LEAST_APPROACH = 1e-3
"""Motion within ``APPROACH`` below which a joint has no direction of approach [rad]."""
FEWEST_POSES = 5
"""Fewest poses: mass and centre of mass are four unknowns, and their errors need more equations."""


def resting_poses(samples: Measurement) -> tuple[Measurement, NDArray[np.bool_]]:
    """Return (the K poses in which a log rests, (K, n) whether a joint's friction cancels there).

    A pose is two successive rests at nearly equal positions; its torque is the mean of the torques
    of both rests, and zero for joints that approached both rests from one side. Its velocities and
    accelerations are zero.

    Raises:
        InputError: there are fewer than ``FEWEST_POSES`` poses, or no joint approaches a pose from
            both sides.
    """
    n_joints = samples.q.shape[1]
    # Reshaped for a log without rests, of which numpy cannot know the number of columns.
    rests = np.array(list(_rests(samples)))
    rests = rests.reshape(-1, 1 + 3 * n_joints)
    time, q, tau, direction = np.split(rests, 1 + n_joints * np.arange(3), axis=1)
    is_same_pose = np.max(np.abs(np.diff(q, axis=0)), axis=1) < SAME_POSE
    count = np.count_nonzero(is_same_pose)
    if count < FEWEST_POSES:
        raise InputError(
            f"the log rests {len(rests)} times, and {count} poses were approached from both "
            f"sides; --static needs {FEWEST_POSES}: play what robot-sysid plan --for payload "
            "--static writes"
        )
    q = 0.5 * (q[:-1] + q[1:])[is_same_pose]
    tau = 0.5 * (tau[:-1] + tau[1:])[is_same_pose]
    # The joint came from opposite sides.
    is_balanced = (direction[:-1] * direction[1:])[is_same_pose] < 0.0
    is_balanced &= np.isfinite(tau)
    if not np.any(is_balanced):
        raise InputError(
            "no joint approaches its poses from both sides; --static needs that"
        )
    zeros = np.zeros_like(q)
    tau = np.where(is_balanced, tau, 0.0)
    poses = Measurement(time[:-1][is_same_pose, 0], q, zeros, tau, zeros)
    return poses, is_balanced


def _rests(samples: Measurement) -> Iterator[Array]:
    """Yield a row (1 + 3 n,) for each stretch of a log in which the arm rests.

    A row holds the time at which the rest begins [s], the mean position (n,) [rad], the mean torque
    (n,) [N m], and the direction (n,) from which each joint came: 1, -1, or 0 for a joint that had
    hardly moved.
    """
    time = samples.time
    q = samples.q
    # The ends of each run of samples around which all joints stay within STILL.
    is_still = np.concatenate(([False], _is_still(time, q), [False])).astype(int)
    for first, end in np.flatnonzero(np.diff(is_still)).reshape(-1, 2).tolist():
        if time[end - 1] - time[first] < LEAST_REST:
            continue
        settled = [time[first] + SETTLING, time[end - 1] - SETTLING]
        start, stop = np.searchsorted(time, settled).tolist()
        earlier = int(np.searchsorted(time, time[first] - APPROACH))
        resting = slice(start, stop + 1)
        mean = np.mean(q[resting], axis=0)
        moved = mean - q[earlier]
        direction = np.where(np.abs(moved) < LEAST_APPROACH, 0.0, np.sign(moved))
        tau = np.mean(samples.tau[resting], axis=0)
        yield np.hstack([time[first], mean, tau, direction])


def _is_still(time: Array, q: Array) -> NDArray[np.bool_]:
    """Return (N,) whether all joints stay within ``STILL`` around each sample of q (N, n)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    step = float(np.median(np.diff(time)))
    width = max(int(round(WINDOW / step)), 2)
    span = maximum_filter1d(q, width, axis=0) - minimum_filter1d(q, width, axis=0)
    return np.all(span < STILL, axis=1)

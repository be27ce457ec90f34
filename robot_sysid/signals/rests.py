"""Poses at rest: their torque without dry friction.

Dry friction holds an arm at rest with a torque of either sign. Where a pose is approached once from
below and once from above, the mean of both torques has none of it left (to the extent that it is
as large both ways), so that gravity alone remains.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement
from robot_sysid.signals.frozen import true_runs

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
    rests = list(_rests(samples))
    pairs = []
    for first, second in zip(rests, rests[1:]):
        if np.max(np.abs(second.q - first.q)) < SAME_POSE:
            pairs.append((first, second))
    # The joint came from opposite sides.
    is_balanced = np.array([a.direction * b.direction < 0.0 for a, b in pairs])
    if len(pairs) < FEWEST_POSES or not np.any(is_balanced):
        raise InputError(
            f"the log rests {len(rests)} times, twice in succession in {len(pairs)} poses; "
            f"--static needs {FEWEST_POSES} such poses, with joints that approach them from both "
            "sides: play what robot-sysid plan --for payload --static writes"
        )
    time = np.array([first.time for first, _ in pairs])
    q = np.array([0.5 * (first.q + second.q) for first, second in pairs])
    tau = np.array([0.5 * (first.tau + second.tau) for first, second in pairs])
    zeros = np.zeros_like(q)
    tau = np.where(is_balanced, tau, 0.0)
    return Measurement(time, q, zeros, tau, zeros), is_balanced


class Rest(NamedTuple):
    """A stretch of a log in which the arm rests.

    Attributes:
        time: at which it begins [s].
        q: (n,) mean position [rad].
        tau: (n,) mean torque [N m].
        direction: (n,) from which each joint came: 1, -1, or 0 for one that had hardly moved.
    """

    time: float
    q: Array
    tau: Array
    direction: Array


def _rests(samples: Measurement) -> Iterator[Rest]:
    """Yield each stretch of a log in which the arm rests."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    time = samples.time
    q = samples.q
    width = max(round(WINDOW / float(np.median(np.diff(time)))), 2)
    span = maximum_filter1d(q, width, axis=0) - minimum_filter1d(q, width, axis=0)
    for still in true_runs(np.all(span < STILL, axis=1)):
        begin = float(time[still.start])
        end = float(time[still.stop - 1])
        if end - begin < LEAST_REST:
            continue
        earlier, start, stop = np.searchsorted(
            time, (begin - APPROACH, begin + SETTLING, end - SETTLING)
        )
        resting = slice(start, stop + 1)
        mean = np.mean(q[resting], axis=0)
        moved = mean - q[earlier]
        direction = np.where(np.abs(moved) < LEAST_APPROACH, 0.0, np.sign(moved))
        yield Rest(begin, mean, np.mean(samples.tau[resting], axis=0), direction)

"""Where the readings of a joint do not tell which way it moves, as it turns round.

A joint with dry friction does not turn round at once: it stands until its torque has changed by
twice the friction, 20 to 60 ms under a stiff controller. Low-passed positions show a smooth turn
instead, with a speed that has a sign at every moment, and Coulomb friction taken by that sign is
wrong by up to twice its size. The error has the direction of the acceleration at every turn, so it
does not average: in rehearsals on simulated motors it passed for 10 to 90 % more rotor inertia.

The readings themselves tell how long that may have lasted: until one is clearly away from the
outermost one. A joint that turns round without standing is unsure for as long as its reading is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array

CLEARLY_APART = 6.0
"""By how many standard deviations of their noise two readings differ that do not by chance; of
readings that are rounded, by more than one step and less than two (chosen)."""


def turning_samples(readings: Array, qd: Array, noise: Array) -> NDArray[np.bool_]:
    """Return at which samples (N, n) a joint may be standing while it turns round.

    Args:
        readings: (N, n) positions as they were read [rad].
        qd: (N, n) low-passed velocities, whose sign tells the turns [rad/s].
        noise: (n,) standard deviation of the readings [rad].
    """
    found = np.zeros(qd.shape, dtype=bool)
    for joint, (reading, speed) in enumerate(zip(readings.T, qd.T)):
        distance = CLEARLY_APART * noise[joint]
        turns = np.flatnonzero(np.diff(np.sign(speed))) + 1
        edges = [0, *turns.tolist(), len(speed)]
        for start, turn, stop in zip(edges, edges[1:], edges[2:]):
            outward = np.sign(speed[turn - 1] - speed[turn])
            height = outward * reading[start:stop]
            away = np.max(height) - height > distance
            before = np.flatnonzero(away[: turn - start])
            after = np.flatnonzero(away[turn - start :])
            first = start + before[-1] + 1 if len(before) else start
            last = turn + after[0] if len(after) else stop
            found[first:last, joint] = True
    return found

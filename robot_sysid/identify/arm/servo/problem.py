"""The positions that servos would give, against those that were measured: output error.

What is sought is the logarithm of each number over its usual size, softened so that zero is not
far away: gain, damping, friction and rotor inertia of a joint that grow together by the same factor
change little where links and gravity are small beside them, and in logarithms that is a straight
line. A weak pull towards the start keeps what the data does not show where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.identify.arm.servo.commands import MOST_PERIODS, Piece
from robot_sysid.records import Array, RobotModel
from robot_sysid.simulation.rollout.servo import Actuators, Servos, Window, played_servos

STEP = 0.002
"""Time step of the rollouts [s], at most."""
LENGTH = 3.0
"""Length of a window [s]."""
SETTLED = 0.6
"""Beginning of a window that does not count: the state there is known from steps of the encoder."""
PULL = 2.5
"""Standard deviation of the weak pull towards the start: a factor of twelve."""
WIDEST = np.log(100.0)
"""Logarithm of how many times its usual size a number may be."""
SOFT = 0.3
"""Part of its usual size below which steps are no longer shares of a number: zero can be left."""


@dataclass(frozen=True)
class Scale:
    """How a vector of unknowns stands for servos.

    Attributes:
        start: where the search starts.
        size: servos whose numbers are usual sizes.
        free: (4 n + 1,) which of the numbers are sought.
    """

    start: Servos
    size: Servos
    free: NDArray[np.bool_]

    def unknowns(self, servos: Servos) -> Array:
        """Return the vector (p,) of some servos."""
        values = servos.vector() / self.size.vector()
        values[:-1] = np.log(values[:-1] + SOFT)
        return values[self.free]

    def servos(self, unknowns: Array) -> Servos:
        """Return what a vector (p,) stands for."""
        whole = np.zeros(len(self.free))
        whole[self.free] = unknowns
        whole[:-1] = np.maximum(np.exp(whole[:-1]) - SOFT, 0.0)
        return Servos.of(np.where(self.free, whole * self.size.vector(), self.start.vector()))

    def derivative(self, servos: Servos) -> Array:
        """Return (p,) how much each number changes where its unknown changes by one."""
        size = self.size.vector()
        size[:-1] = servos.vector()[:-1] + SOFT * size[:-1]
        return size[self.free]

    def bounds(self, longest: float) -> tuple[Array, Array]:
        """Return the least and largest unknowns (p,), with a longest delay [s]."""
        count = len(self.free)
        lower, upper = np.full(count, np.log(SOFT)), np.full(count, WIDEST)
        lower[-1], upper[-1] = 0.0, longest / self.size.delay
        return lower[self.free], upper[self.free]

    @property
    def pull(self) -> Array:
        """Standard deviation (p,) of the weak pull towards the start."""
        return np.full(int(np.count_nonzero(self.free)), PULL)


@dataclass(frozen=True)
class Problem:
    """Windows of logs, and what happens in them.

    Attributes:
        robot: the arm.
        actuators: what drives it.
        windows: where rollouts start.
        measured: per window, (times after the start (m,), positions (m, n)) that count.
        sigma: (n,) size of each joint's error [rad].
        length: of a window [s].
    """

    robot: RobotModel
    actuators: Actuators
    windows: tuple[Window, ...]
    measured: tuple[tuple[Array, Array], ...]
    sigma: Array
    length: float = LENGTH

    @property
    def edges(self) -> Array:
        """Ends of the steps of each window [s]."""
        return np.linspace(0.0, self.length, max(1, round(self.length / STEP)) + 1)

    def some(self, most: int) -> Problem:
        """Return the problem with at most so many of its windows, spread evenly."""
        keep = np.linspace(0, len(self.windows) - 1, min(len(self.windows), most))
        at = keep.round().astype(int).tolist()
        windows = tuple(self.windows[k] for k in at)
        return replace(self, windows=windows, measured=tuple(self.measured[k] for k in at))

    def errors(self, choices: Sequence[Servos]) -> list[Array]:
        """Return per choice the position errors (M, n) of all windows [rad]; pi, if it diverges."""
        played = played_servos(self.robot, self.actuators, choices, self.windows, self.edges)
        pairs = (zip(each, self.measured) for each in played)
        return [np.concatenate([self._error(*pair) for pair in each]) for each in pairs]

    def _error(self, q: Array, measured: tuple[Array, Array]) -> Array:
        time, positions = measured
        found = np.stack([np.interp(time, self.edges, column) for column in q.T], axis=1)
        return np.nan_to_num(found - positions, nan=np.pi)

    def residuals(self, servos: Servos) -> Array:
        """Return the errors of one choice, in units of sigma, as one vector."""
        return np.asarray((self.errors([servos])[0] / self.sigma).ravel())


def problem_of(
    robot: RobotModel,
    actuators: Actuators,
    pieces: Sequence[Piece],
    most: int,
    length: float = LENGTH,
    settled: float = SETTLED,
) -> Problem:
    """Return the windows of some pieces, one after the other; at most so many, spread evenly.

    Raises:
        InputError: no piece is long enough.
    """
    windows, measured = [], []
    for piece in pieces:
        lead = MOST_PERIODS * piece.period
        starts = np.arange(piece.time[0] + lead, piece.time[-1] - length, length)
        for sample in np.searchsorted(piece.time, starts).tolist():
            start = piece.time[sample]
            inside = (piece.time > start + settled) & (piece.time <= start + length)
            windows.append(piece.window(sample))
            measured.append((piece.time[inside] - start, piece.q[inside]))
    if not windows:
        raise InputError(f"no piece of the log is as long as {length:g} s; record longer")
    sigma = np.ones(robot.n_joints)
    return Problem(robot, actuators, tuple(windows), tuple(measured), sigma, length).some(most)

"""The self-test: the last link and its joint's friction from a simulation, in constant memory.

It is a question to the rows and sums that logs are fitted with. The samples of a simulation are
exact, so that no row is low-passed and none is left out; and the sums keep triangles (Bierman,
"Factorization Methods for Discrete Sequential Estimation", 1977, ch. IV), which lose no digit: a
self-test returns the model's parameters to 1e-8.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import BeyondRigidBodies
from robot_sysid.estimate.equations.bodies import consistent_least_squares
from robot_sysid.estimate.identifiability import fit_quality, visible_space
from robot_sysid.estimate.rows import Rows, Sums
from robot_sysid.estimate.terms import LAST_LINK, ArmTerms
from robot_sysid.records import Array, FitQuality, Recording, RobotModel
from robot_sysid.signals.filters import LowPass
from robot_sysid.signals.process import FilteredRecording

TERMINAL_FRICTION = ("coulomb", "viscous")
"""Friction terms of the terminal joint that are estimated from a simulation."""


class LastLinkTerms(ArmTerms):
    """Terms of the last link and of its joint's friction; all other torque is taken as known.

    The torque of the other links is computed by Newton and Euler's recursion, without the
    regressor: a wrong regressor then shows as a wrong result, also on the model's own simulation,
    whose torques are MuJoCo's.

    Args:
        robot: the arm with its model.
        torques: "chain" for the equations of all joints, "terminal" for the last one's only.
        friction: terms of the last joint that are estimated; all else of the model's friction is
            taken as known.

    Attributes:
        prior: (p,) the model's values of the parameters.
    """

    def __init__(
        self,
        robot: RobotModel,
        torques: str = "chain",
        friction: Sequence[str] = TERMINAL_FRICTION,
    ) -> None:
        super().__init__(robot, torques)
        terms = {LAST_LINK: self.terms[LAST_LINK]}
        known = {}
        for name in friction:
            terms[name] = self.terms[name].only([-1])
            known[name] = np.append(vars(robot.friction)[name][:-1], 0.0)
        self.terms = terms
        self.prior = np.array([self.model[name] for name in self.names])
        # Nonlinear damping is known, too.
        self._beyond = BeyondRigidBodies(robot)
        self._known_friction = replace(robot.friction, **known)
        self._point = self.start()

    def known(self, rows: Rows) -> Array:
        """Return the torque (m, J) of all that is not estimated [N m]."""
        motion = rows.motion
        thetas = self.robot.thetas
        thetas[-1] = 0.0
        torque = rows.moves(self.robot, self._point.gravity).torque(thetas)
        torque += self._beyond.torque(motion.q, motion.qd, motion.qdd)
        torque += self._known_friction.torque(motion.qd)
        return torque[:, self.indices]

    def exact_sums(self, recordings: Iterable[Recording]) -> Sums:
        """Return the sums of exact samples, all in one block, with triangles.

        The recordings, chunks with velocities and accelerations, are read one at a time, so that
        the memory does not grow with their number.
        """
        pairs = (
            (exact_recording(recording), np.zeros(len(recording), dtype=np.int64))
            for recording in recordings
        )
        return self.add_up(pairs, [""], self._point, with_triangles=True)


def exact_recording(recording: Recording) -> FilteredRecording:
    """Return samples without noise, of which all rows are used and none is low-passed."""
    unfiltered = LowPass(np.inf, np.inf, np.ones(1), 1)
    exact = FilteredRecording.exact(recording, recording.tau, unfiltered)
    # A torque of zero is one, not a missing sensor.
    return exact.using(np.ones(recording.q.shape, dtype=bool))


class Solution(NamedTuple):
    """Parameters (p,) of one solver run, their standard errors (p,), and what they rest on.

    An error is infinite where only the model's value is known.
    """

    values: Array
    standard_errors: Array
    quality: FitQuality


def identify_parameters(sums: Sums, prior: Array, possible: bool = False) -> Solution:
    """Return the estimate of all p parameters by ordinary least squares.

    Parameters that the data does not identify keep the prior's value. The first ten are those of
    the terminal link, the body that ``possible`` constrains.

    Args:
        sums: of all rows, with triangles.
        prior: (p,) the model's own values, in the order of ``sums.names``.
        possible: whether a terminal link that is no possible rigid body is estimated again, with
            the constraint to be one.
    """
    assert sums.triangles is not None
    rows = np.concatenate(sums.triangles)
    matrix = rows[:, :-1]
    space = visible_space(matrix)
    values = prior + space.solve(rows @ np.append(-prior, 1.0))
    counts = np.sum(sums.counts, axis=0)
    count = np.sum(counts)
    misfit = np.linalg.norm(rows @ np.append(-values, 1.0))
    noise = misfit / np.sqrt(max(count - space.rank, 1.0))
    rounding = 1e-9 * np.linalg.norm(rows[:, -1]) / np.sqrt(count)
    noise = float(max(noise, rounding)) or 1.0
    link = np.arange(spatial.N_INERTIAL)
    if possible and not spatial.is_consistent(values[link]):
        # Near the prior's body the solver looks for possible ones.
        right_side = rows[:, -1] / noise
        values = consistent_least_squares(
            matrix / noise, right_side, link[None], prior
        ).values
    residuals = sums.triangles @ np.append(-values, 1.0)
    squares = np.sum(residuals**2, axis=1)
    noises = dict.fromkeys(sums.joints, noise)
    errors = noise * np.sqrt(np.diag(space.inverse()))
    return Solution(
        values,
        np.where(space.is_identified, errors, np.inf),
        fit_quality(matrix, sums.names, sums.joints, squares, counts, noises),
    )

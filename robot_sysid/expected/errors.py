"""The torque error to expect of a model on motions, from what is known of the arm.

With x the values that are known, C the covariance of their errors, f what the model holds and G the
sums of the motions, the squares of the model's torque error there are expected to be

    (x - f)' G (x - f) + tr(C G):

what the model leaves out of what is known, and what is not known.

Shapes: p parameters of the motions, J joints with equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.estimate.rows import Sums
from robot_sysid.expected.knowledge import Knowledge
from robot_sysid.expected.motions import grams, without_constant
from robot_sysid.records import Array

NO_TORQUE = 1e-300
"""Least squares of a torque, over which errors are stated [N^2 m^2]."""


@dataclass(frozen=True)
class ExpectedSquares:
    """Squares of a torque error to expect on motions.

    Attributes:
        joints: names of the J joints.
        of_parameters: (J, p) those that each parameter makes; of what two make together, each has a
            half, so that some are negative.
        torque: (J,) squares of the whole torque.
    """

    joints: tuple[str, ...]
    of_parameters: Array
    torque: Array

    @property
    def of_joints(self) -> Array:
        """Squares of each joint's error (J,) [N^2 m^2]."""
        return np.maximum(np.sum(self.of_parameters, axis=1), 0.0)

    @property
    def relative_error(self) -> float:
        """The error over the torque, of all joints together."""
        return float(np.sqrt(np.sum(self.of_joints) / self.whole_torque))

    @property
    def relative_error_per_joint(self) -> dict[str, float]:
        """Name of each joint to its error, over its own torque."""
        errors = np.sqrt(self.of_joints / np.maximum(self.torque, NO_TORQUE))
        return dict(zip(self.joints, errors.tolist()))

    @property
    def whole_torque(self) -> float:
        """Squares of the torque of all joints [N^2 m^2]."""
        return max(float(np.sum(self.torque)), NO_TORQUE)

    @property
    def worst_joint(self) -> str:
        """Name of the joint that makes most of the error."""
        return self.joints[int(np.argmax(np.sum(self.of_parameters, axis=1)))]

    def parts(self, names: Sequence[str]) -> dict[str, float]:
        """Return the error that each part makes over the torque of all joints, largest first.

        ``names`` (p,) are of the part that each parameter belongs to.
        """
        squares: dict[str, float] = {}
        for name, square in zip(names, np.sum(self.of_parameters, axis=0).tolist()):
            squares[name] = squares.get(name, 0.0) + square
        ordered = sorted(squares.items(), key=lambda entry: -entry[1])
        return {
            name: float(np.sqrt(square / self.whole_torque))
            for name, square in ordered
            if square > 0.0
        }


def expected(
    held: Mapping[str, float],
    known: Knowledge,
    sums: Sums,
    counts_offsets: bool = False,
) -> ExpectedSquares:
    """Return the squares of a model's torque error to expect in motions.

    Args:
        held: name of each parameter that the model holds to its value.
        known: of the arm.
        sums: of the motions.
        counts_offsets: whether offsets of torque sensors, which no model holds, are errors; if not,
            no joint's mean error is one.
    """
    offsets = [OFFSET.key_of(joint) for joint in sums.joints]
    is_offset = np.isin(sums.names, offsets)
    in_model = np.array([held.get(name, 0.0) for name in sums.names])
    torque = np.append(np.where(is_offset, 0.0, known.values), -1.0)
    apart = known.values - np.where(is_offset, 0.0, in_model)
    of_parameters = []
    torques = []
    for offset, gram in zip(offsets, grams(sums)):
        torques.append(torque @ gram @ torque)
        gram = gram[:-1, :-1]
        if not counts_offsets:
            gram = without_constant(gram, sums.names.index(offset))
        own = np.sum(known.covariance * gram, axis=1)
        of_parameters.append(apart * (gram @ apart) + own)
    return ExpectedSquares(sums.joints, np.array(of_parameters), np.array(torques))


def largest_expected(
    held: Mapping[str, float], known: Knowledge, sums: Sums
) -> ExpectedSquares:
    """Return the squares of a model's torque error, offsets counted where that makes them larger.

    The arguments are those of ``expected``.
    """
    both = (
        expected(held, known, sums, counts_offsets) for counts_offsets in (False, True)
    )
    return max(both, key=lambda squares: squares.relative_error)

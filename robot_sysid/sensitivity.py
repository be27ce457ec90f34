"""How errors that no data can reveal would move an estimate: other links' parameters, torque scale.

A weighted least-squares estimate x = C Y^T W tau moves by C Y^T W d when the torques are wrong by
d. Two kinds of d matter on real arms and hide from the residuals, because a slightly different
terminal link explains them nearly as well: the torque of the other links, which the model predicts
with the errors of its own numbers, and the scale of each joint's torque.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.identifiability import visible_space
from robot_sysid.records import Array, SquareRootInformation

OTHER_LINKS = "other_links_1_percent"
TORQUE_SCALE = "torque_scale_1_percent"
_SHARE = 0.01


def sensitivity(
    information: SquareRootInformation,
    weights: Array,
    rows: Sequence[Array],
    rest: Sequence[Array],
    measured: Sequence[Array],
) -> Mapping[str, Mapping[str, float]]:
    """Return cause to parameter to change: of a plain weighted estimate, by 1 % of each cause.

    ``OTHER_LINKS``: the torque of the rest of the arm is 1 % larger than its model says, in all
    joints. ``TORQUE_SCALE``: each joint's torque is 1 % too large, independently of the others;
    root of the summed squares.

    Args:
        information: the equations that were fitted.
        weights: (joints,) 1 / noise of each joint [1/(N m)].
        rows: per joint, its equations' rows (N_j, k).
        rest: per joint (N_j,) the torque that the model says the rest of the arm takes [N m].
        measured: per joint (N_j,) the whole measured torque [N m].
    """
    root = visible_space(information.stacked(weights)[0]).inverse_root()
    columns = [joint.columns for joint in information.joints]
    links = np.sum(_moves(root, columns, weights, rows, rest), axis=0)
    scales = np.linalg.norm(_moves(root, columns, weights, rows, measured), axis=0)
    return {
        OTHER_LINKS: dict(zip(information.names, map(float, links))),
        TORQUE_SCALE: dict(zip(information.names, map(float, scales))),
    }


def _moves(
    root: Array,
    columns: Sequence[NDArray[np.int64]],
    weights: Array,
    rows: Sequence[Array],
    torque: Sequence[Array],
) -> Array:
    """Return (joints, p) how the estimate moves by 1 % of each joint's torque."""
    moves = [
        root @ (root[own].T @ (weight**2 * _SHARE * (block.T @ tau)))
        for own, weight, block, tau in zip(columns, weights, rows, torque)
    ]
    return np.array(moves)

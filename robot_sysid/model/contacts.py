"""Which bodies of an arm touch, at rest and along a trajectory, as MuJoCo computes it.

Links next to each other often overlap in a model: one carries the other, and it does not matter
that a model leaves out their joint's housing. Any other two bodies that touch are a collision.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import product
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.errors import InputError, ModelError
from robot_sysid.model.chain import body_label
from robot_sysid.records import Array, Motion, RobotModel

CHECK_RATE_HZ = 40.0
"""How often a trajectory is checked; at 2 rad/s and 0.5 m that is every 25 mm."""
_POSITIONS = 7
"""Positions of each joint at which two bodies are tried for whether they can part."""
_MAX_JOINTS_BETWEEN = 3
"""Joints between two bodies beyond which they are taken to part."""


def joint_ranges(robot: RobotModel) -> tuple[Array, Array]:
    """Return the positions (n,), (n,) between which each joint can be; a turn where unlimited."""
    lower = robot.limits.lower
    upper = robot.limits.upper
    return (
        np.where(np.isfinite(lower), lower, robot.reference - np.pi),
        np.where(np.isfinite(upper), upper, robot.reference + np.pi),
    )


def count_moving_joints(robot: RobotModel) -> NDArray[np.int64]:
    """Return how many chain joints move each body (nbody,): the first so many of the chain.

    Bodies with equal counts keep their distances. InputError for joints of two arms, which do not
    move the bodies one after the other.
    """
    model = robot.mj_model
    counts = np.zeros(model.nbody, dtype=np.int64)
    for index, joint in enumerate(model.dof_jntid[robot.dof_index]):
        moved = subtree(model, int(model.jnt_bodyid[joint]))
        if np.any(counts[moved] != index):
            names = ", ".join(robot.joint_names)
            raise InputError(f"{names} are no serial chain: take one arm")
        counts[moved] += 1
    return counts


def adjacent_bodies(mj_model: Any) -> NDArray[np.bool_]:
    """Return whether two bodies are next to each other in the tree, (nbody, nbody).

    Bodies welded together count as one. A body that stands still is next to a link only if it
    carries it or is fixed to the body that does: the arm's base and its housing are, a table in the
    same world is not.
    """
    weld = mj_model.body_weldid
    bodies = np.arange(mj_model.nbody)
    parent = mj_model.body_parentid[weld]
    carries = (weld[:, None] == weld[parent]) & (weld[:, None] != weld)
    below = np.array([np.isin(bodies, subtree(mj_model, int(body))) for body in bodies])
    stands_still = (weld == 0)[:, None]
    is_fixed = below | below[parent].T & (parent != 0)
    carries &= ~stands_still | (is_fixed & (bodies != 0)[:, None])
    return np.asarray(carries | carries.T)


class ContactFinder:
    """Finds which bodies touch in a configuration.

    Attributes:
        resting_pairs: pairs of body ids that touch in the robot's reference configuration.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._model: Any = robot.mj_model
        self._data = data_at_pose(self._model, robot.reference_qpos)
        self._joint_counts = count_moving_joints(robot)
        self.resting_pairs = self._touching()

    def by_design(self, pairs: Collection[tuple[int, int]]) -> set[tuple[int, int]]:
        """Return those of some touching pairs of body ids that touch by the model's design.

        One carries the other, or they touch whatever the joints between them do (MuJoCo takes the
        convex hull of a mesh): no position would be free of it. A pair of the arm and something
        beside it is not by design.
        """
        is_adjacent = adjacent_bodies(self._model)
        return {pair for pair in pairs if is_adjacent[pair] or self._never_part(pair)}

    def _never_part(self, pair: tuple[int, int]) -> bool:
        """Return whether two bodies touch at all tried positions of the joints between them."""
        first, last = sorted(self._joint_counts[list(pair)].tolist())
        first_root, second_root = self._model.body_rootid[list(pair)]
        if last - first > _MAX_JOINTS_BETWEEN or first_root != second_root:
            return False
        low, high = (ends[first:last] for ends in joint_ranges(self._robot))
        q = self._robot.reference.copy()
        for positions in product(*np.linspace(low, high, _POSITIONS).T):
            q[first:last] = positions
            self._data.qpos[self._robot.qpos_index] = q
            if pair not in self._touching():
                return False
        return True

    def new_pairs(self, q: Array) -> set[tuple[int, int]]:
        """Return pairs of body ids that touch at chain positions q (n,) but not at rest."""
        self._data.qpos[self._robot.qpos_index] = q
        return self._touching() - self.resting_pairs

    def _touching(self) -> set[tuple[int, int]]:
        """Return pairs of body ids, the lower first, that touch in the current configuration."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        try:
            mujoco.mj_collision(self._model, self._data)
        except mujoco.FatalError:
            raise ModelError(
                "so many parts of the model touch each other that MuJoCo's memory does not hold "
                'their contacts; give it more with <size memory="1G"/>, or let fewer parts collide'
            ) from None
        if not self._data.ncon:
            return set()
        geoms = self._data.contact.geom[self._data.contact.dist <= 0.0]
        geoms = geoms[np.all(geoms >= 0, axis=1)]
        bodies = np.sort(self._model.geom_bodyid[geoms], axis=1)
        pairs = {(int(a), int(b)) for a, b in bodies}
        counts = self._joint_counts
        return {(a, b) for a, b in pairs if counts[a] != counts[b]}


def find_new_contacts(robot: RobotModel, motions: Iterable[Motion]) -> tuple[str, ...]:
    """Return in words which bodies collide at rest, and when others first do along a motion.

    ``motions`` are the pieces of that motion in the order of time.
    """
    finder = ContactFinder(robot)
    first_time: dict[tuple[int, int], float] = {}
    for motion in motions:
        for time, q in zip(motion.time, motion.q):
            for pair in finder.new_pairs(q):
                first_time.setdefault(pair, float(time))

    def contact(pair: tuple[int, int]) -> str:
        """Return a sentence on two bodies (ids), without the time."""
        first, second = (body_label(robot.mj_model, body) for body in pair)
        return f"{first} and {second} touch"

    resting = finder.resting_pairs - finder.by_design(finder.resting_pairs)
    at_rest = sorted(f"{contact(pair)} at rest" for pair in resting)
    later = [f"{contact(pair)} at {t:.2f} s" for pair, t in first_time.items()]
    return (*at_rest, *later)

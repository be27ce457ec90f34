"""Which bodies of an arm touch, at rest and along a trajectory, found by MuJoCo.

Links next to each other often overlap in a model: one carries the other, and what a model leaves
out of their joint's housing does not matter. Any other two bodies that touch are a collision.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from functools import partial
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
_JOINTS_BETWEEN = 3
"""Positions of each joint that tell whether two bodies can part; at most so many joints apart."""


def joint_ranges(robot: RobotModel) -> tuple[Array, Array]:
    """Return the positions (n,), (n,) between which each joint can be; a turn where unlimited."""
    lower = robot.limits.lower
    upper = robot.limits.upper
    return (
        np.where(np.isfinite(lower), lower, robot.reference - np.pi),
        np.where(np.isfinite(upper), upper, robot.reference + np.pi),
    )


def parts_of(robot: RobotModel) -> NDArray[np.int64]:
    """Return the part (nbody,) each body belongs to; bodies of one part keep their distances.

    Part 0 is what no chain joint moves, part l what is moved by the first l of them. InputError for
    joints of two arms, whose parts cannot be numbered like that.
    """
    model = robot.mj_model
    part = np.zeros(model.nbody, dtype=np.int64)
    for number, joint in enumerate(model.dof_jntid[robot.dof_index]):
        moved = subtree(model, int(model.jnt_bodyid[joint]))
        if np.any(part[moved] != number):
            raise InputError(
                f"{', '.join(robot.joint_names)} are no serial chain: take one arm"
            )
        part[moved] += 1
    return part


def neighbours(mj_model: Any) -> NDArray[np.bool_]:
    """Return (nbody, nbody) booleans: which bodies are next to each other in the tree.

    Bodies welded together count as one. What stands still is next to a link only if it carries it
    or is fixed to the body that does: the arm's base and its housing are, a table in the same world
    is not.
    """
    weld = mj_model.body_weldid
    bodies = np.arange(mj_model.nbody)
    parent = mj_model.body_parentid[weld]
    carries = (weld[:, None] == weld[parent]) & (weld[:, None] != weld)
    below = np.array([np.isin(bodies, subtree(mj_model, int(body))) for body in bodies])
    still = (weld == 0)[:, None]
    carries &= ~still | (
        (below | below[parent].T & (parent != 0)) & (bodies != 0)[:, None]
    )
    return np.asarray(carries | carries.T)


class ContactFinder:
    """Tells which bodies touch in a configuration; those in the reference one, pairs of body ids
    ``at_rest``, are taken for granted.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._model: Any = robot.mj_model
        self._data = data_at_pose(self._model, robot.reference_qpos)
        self._part = parts_of(robot)
        self.at_rest = self._touching()

    def by_design(self, pairs: Collection[tuple[int, int]]) -> set[tuple[int, int]]:
        """Return those of some touching pairs of body ids that a model is drawn with.

        One carries the other, or they touch whatever the joints between them do (MuJoCo takes the
        convex hull of a mesh): no position would be free of it. What stands beside the arm is no
        part of that drawing.
        """
        next_to = neighbours(self._model)
        return {pair for pair in pairs if next_to[pair] or self._never_part(pair)}

    def _never_part(self, pair: tuple[int, int]) -> bool:
        first, last = sorted(int(self._part[body]) for body in pair)
        first_root, second_root = self._model.body_rootid[list(pair)]
        if last - first > _JOINTS_BETWEEN or first_root != second_root:
            return False
        low, high = (ends[first:last] for ends in joint_ranges(self._robot))
        q = self._robot.reference.copy()
        for q[first:last] in product(*np.linspace(low, high, _POSITIONS).T):
            self._data.qpos[self._robot.qpos_index] = q
            if pair not in self._touching():
                return False
        return True

    def new_pairs(self, q: Array) -> set[tuple[int, int]]:
        """Return pairs of body ids that touch at chain positions q (n,) but not at rest."""
        self._data.qpos[self._robot.qpos_index] = q
        return self._touching() - self.at_rest

    def _touching(self) -> set[tuple[int, int]]:
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
        bodies = np.sort(
            self._model.geom_bodyid[geoms[np.all(geoms >= 0, axis=1)]], axis=1
        )
        pairs = {(int(a), int(b)) for a, b in bodies}
        return {(a, b) for a, b in pairs if self._part[a] != self._part[b]}


def find_new_contacts(robot: RobotModel, motions: Iterable[Motion]) -> tuple[str, ...]:
    """Return in words which bodies collide at rest, and when others first do along a motion."""
    finder = ContactFinder(robot)
    resting = finder.at_rest - finder.by_design(finder.at_rest)
    first_time: dict[tuple[int, int], float] = {}
    for motion in motions:
        for time, q in zip(motion.time, motion.q):
            for pair in finder.new_pairs(q):
                first_time.setdefault(pair, float(time))
    words = [(pair, "at rest") for pair in resting]
    words += [(pair, f"at {time:.2f} s") for pair, time in first_time.items()]
    name = partial(body_label, robot.mj_model)
    said = [f"{name(a)} and {name(b)} touch {when}" for (a, b), when in words]
    return (*sorted(said[: len(resting)]), *said[len(resting) :])

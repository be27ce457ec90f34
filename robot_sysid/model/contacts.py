"""Contacts that a trajectory makes and that are not there at rest, found by MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.kinematics import subtree
from robot_sysid.model.chain import body_label
from robot_sysid.records import Array, Motion, RobotModel

CHECK_RATE_HZ = 40.0
"""How often a trajectory is checked; at 2 rad/s and 0.5 m that is every 25 mm."""


class ContactFinder:
    """Tells which bodies touch in a configuration of the arm.

    Args:
        robot: the arm; contacts of its reference configuration are taken for granted.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._model: Any = robot.mj_model
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = robot.reference_qpos
        first_joint = self._model.dof_jntid[robot.dof_index[0]]
        self._moving = set(subtree(self._model, int(self._model.jnt_bodyid[first_joint])))
        self._at_rest = self._touching()

    def new_pairs(self, q: Array) -> set[tuple[int, int]]:
        """Return pairs of body ids that touch at chain positions q (n,) but not at rest."""
        self._data.qpos[self._robot.qpos_index] = q
        return self._touching() - self._at_rest

    def _touching(self) -> set[tuple[int, int]]:
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        geoms = self._data.contact.geom[self._data.contact.dist <= 0.0]
        bodies = np.sort(self._model.geom_bodyid[geoms[np.all(geoms >= 0, axis=1)]], axis=1)
        pairs = {(int(a), int(b)) for a, b in bodies}
        return {pair for pair in pairs if not self._moving.isdisjoint(pair)}


def find_new_contacts(robot: RobotModel, motions: Iterable[Motion]) -> tuple[str, ...]:
    """Return in words when each new pair of bodies touches for the first time along a motion."""
    finder = ContactFinder(robot)
    first_time: dict[tuple[int, int], float] = {}
    for motion in motions:
        for time, q in zip(motion.time, motion.q):
            for pair in finder.new_pairs(q):
                first_time.setdefault(pair, float(time))
    name = partial(body_label, robot.mj_model)
    return tuple(
        f"{name(first)} and {name(second)} touch at {time:.2f} s"
        for (first, second), time in first_time.items()
    )

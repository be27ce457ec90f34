"""Two arms of one model that move at the same time: as one arm, and how near they come.

The search and its checks know one serial chain (``clearance``); between two of them there is a test
of its own. Two points approach each other no faster than each arm's fastest part moves, so a
distance d shows that nothing touches until both have moved so far (conservative advancement, see
``limit_check``).
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.kinematics import subtree
from robot_sysid.model.contacts import parts_of
from robot_sysid.motion.clearance import approach_rates
from robot_sysid.motion.limit_check import LEAST_RATE_HZ
from robot_sysid.records import Array, JointFriction, JointLimits, MotionPlan, RobotModel
from robot_sysid.trajectory import sample_times

# Farther than this is as good as any distance, and nearer than that counts as a touch [m].
_FAR, _TOUCH = 0.2, 2e-3


def as_one(first: RobotModel, second: RobotModel) -> RobotModel:
    """Return two arms of one model as one, the joints of the first in front.

    For what goes joint by joint: inverse dynamics, limits, stepping. Its terminal link is that of
    the first, and it is no serial chain.
    """

    def both(*path: str) -> Any:
        found: Any = [first, second]
        for name in path:
            found = [getattr(each, name) for each in found]
        return np.concatenate(found)

    limits = ("lower", "upper", "velocity", "torque")
    return replace(
        first,
        joint_names=first.joint_names + second.joint_names,
        qpos_index=both("qpos_index"),
        dof_index=both("dof_index"),
        is_slide=both("is_slide"),
        limits=JointLimits(*(both("limits", name) for name in limits)),
        friction=JointFriction(both("friction", "coulomb"), both("friction", "viscous")),
        links=first.links + second.links,
    )


class BetweenArms:
    """Distances between two arms of one model."""

    def __init__(self, first: RobotModel, second: RobotModel) -> None:
        self._model = model = copy.copy(first.mj_model)
        model.geom_margin[:] = model.body_margin[:] = _FAR
        model.geom_gap[:] = 0.0
        self._data = mujoco.MjData(model)
        self._data.qpos[:] = first.reference_qpos
        mujoco.mj_kinematics(model, self._data)
        both, arms = as_one(first, second), (first, second)
        self._at_q = both.qpos_index
        self._arm = np.zeros(model.nbody, int)
        for number, arm in enumerate(arms, start=1):
            base = model.jnt_bodyid[model.dof_jntid[arm.dof_index[0]]]
            self._arm[subtree(model, int(base))] = number
        # The last row bounds the speed of every part.
        rates = (approach_rates(arm, self._data, parts_of(arm))[-1] for arm in arms)
        self._rates = np.concatenate([*rates])
        # Arms that rest close to each other keep half of that.
        self._least = min(_TOUCH, 0.5 * self.distance(both.reference))

    def distance(self, q: Array) -> float:
        """Return how far the arms are apart at positions q (n,) of both [m], 0.2 at most."""
        self._data.qpos[self._at_q] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        contact = self._data.contact
        arms = self._arm[self._model.geom_bodyid[contact.geom.reshape(-1, 2)]]
        between = np.prod(arms, axis=1) == 2
        return float(np.min(contact.dist[between], initial=_FAR))

    def touch_at(self, motion: MotionPlan) -> float | None:
        """Return when the arms first touch along a motion of both [s], or None.

        Arms that touch at rest are not told apart.
        """
        room = 0.0
        for time in sample_times(motion.duration, LEAST_RATE_HZ) if self._least > 0.0 else ():
            chunk = motion.evaluate(time)
            for k, way in enumerate(np.abs(chunk.qd) @ self._rates / LEAST_RATE_HZ):
                room -= way
                if room > 0.0:
                    continue
                room = self.distance(chunk.q[k])
                if room < self._least:
                    return float(time[k])
        return None

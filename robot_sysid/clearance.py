"""How far the arm is from itself, from the scene and from forbidden half-spaces, by MuJoCo.

MuJoCo finds every pair of geoms nearer than a margin, with distance, point and normal; half-spaces
are tested against the extreme point of each geom. The gradient of a distance is the relative
velocity of the two nearest points along the normal, per unit joint rate.

Pairs of bodies that touch at rest stay in touch by design of the model (neighbouring links) and are
ignored. A pair that is apart at rest but nearer than the clearance must keep half that distance.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from robot_sysid.design_problem import Closest
from robot_sysid.halfspaces import GeomShape, HalfSpace, geom_shapes
from robot_sysid.kinematics import subtree
from robot_sysid.records import Array, RobotModel
from robot_sysid.terminal import body_label

HORIZON = 0.1
"""How much farther than the clearance a pair is still seen [m]."""
KEPT_SHARE = 0.5
"""Share of its distance at rest that a pair nearer than the clearance must keep."""
_NOWHERE = np.zeros(3), np.zeros(3)


class Clearance:
    """Distances of one arm; fulfils ``design_problem.Obstacles``.

    Args:
        robot: the arm.
        rest: (n,) configuration in which the motion starts.
        clearance: distance to keep between bodies that are apart at rest [m].
        half_spaces: further space that is forbidden.
    """

    horizon = HORIZON

    def __init__(
        self, robot: RobotModel, rest: Array, clearance: float, half_spaces: Sequence[HalfSpace]
    ) -> None:
        self._arguments = (robot, rest, clearance, tuple(half_spaces))
        self._robot = robot
        self._model = _with_margin(robot.mj_model, clearance + HORIZON)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = robot.reference_qpos
        self._joints = self._model.dof_jntid[robot.dof_index]
        self._moves = _moved_bodies(robot, self._joints)
        self._moving = np.any(self._moves, axis=1)
        self._half_spaces = tuple(half_spaces)
        self._required = np.full((self._model.nbody, self._model.nbody), clearance)
        self._learn_pairs(robot.reference, rest)
        self._place(rest)
        self.reach = self._reach()
        self._planes = [
            (space, shape, _required_at(self._height(space, shape), space.clearance))
            for space in self._half_spaces
            for shape in geom_shapes(self._model, space.bodies)
        ]

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process as what it was made from: MuJoCo data is made anew there."""
        return type(self), self._arguments

    def slack(self, q: Array) -> tuple[Array, Array]:
        """Return the smallest slack (N,) [m] at q (N, n), and its gradient (N, n)."""
        value = np.empty(len(q))
        axes, anchors = np.empty((2, len(q), len(self._joints), 3))
        normals, points = np.zeros((2, len(q), 3))
        bodies = np.zeros((len(q), 2), dtype=np.int64)
        for k, position in enumerate(q):
            self._place(position)
            value[k], normals[k], points[k], bodies[k] = self._tightest()
            axes[k], anchors[k] = self._data.xaxis[self._joints], self._data.xanchor[self._joints]
        lever = np.cross(points[:, None, :] - anchors, normals[:, None, :])
        arm = np.where(self._robot.is_slide[:, None], normals[:, None, :], lever)
        # Joints that move both bodies do not change their distance.
        side = self._moves[bodies[:, 1]].astype(float) - self._moves[bodies[:, 0]]
        return value, side * np.einsum("knd,knd->kn", axes, arm)

    def closest(self, q: Array) -> Closest:
        """Return the tightest distance at one configuration q (n,)."""
        self._place(q)
        slack, _, bodies, distance = self._nearest_contact()
        label = " and ".join(self._label(b) for b in bodies) if np.isfinite(distance) else ""
        best = Closest(slack, distance, label)
        for space, shape, required in self._planes:
            height = self._height(space, shape)
            if height - required < best.slack:
                label = f"{self._label(shape.body)} and {space.label}"
                best = Closest(height - required, height, label)
        return best

    def half_spaces_left_at_rest(self) -> list[tuple[HalfSpace, str, float]]:
        """Return (half-space, body, how far outside [m]) of what is outside already at rest."""
        self._place(self._arguments[1])
        found = []
        for space, shape, _ in self._planes:
            height = self._height(space, shape)
            if height <= 0.0:
                found.append((space, self._label(shape.body), -height))
        return found

    def close_at_rest(self) -> list[str]:
        """Return names of body pairs that are apart at rest but nearer than the clearance."""
        clearance = self._arguments[2]
        near = np.argwhere(np.triu((self._required < clearance) & np.isfinite(self._required)))
        return [f"{self._label(a)} and {self._label(b)}" for a, b in near]

    def _place(self, q: Array) -> None:
        self._data.qpos[self._robot.qpos_index] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)

    def _contact_bodies(self) -> tuple[Array, Any]:
        """Return distances (C,) and bodies (C, 2) of the contacts MuJoCo sees."""
        contact = self._data.contact
        geoms = np.stack((contact.geom1, contact.geom2), axis=1).reshape(-1, 2)
        return np.asarray(contact.dist), self._model.geom_bodyid[geoms]

    def _learn_pairs(self, *rests: Array) -> None:
        """Settle the distance each pair has to keep, from what it has at rest."""
        self._required[~(self._moving[:, None] | self._moving)] = -np.inf
        for rest in rests:
            self._place(rest)
            for distance, (a, b) in zip(*self._contact_bodies()):
                kept = min(self._required[a, b], _required_at(distance, np.inf))
                self._required[a, b] = self._required[b, a] = kept

    def _nearest_contact(self) -> tuple[float, int, tuple[int, int], float]:
        """Return (slack, contact index, its bodies, its distance); index -1 where none is near."""
        if self._data.ncon == 0:
            return self.horizon, -1, (0, 0), np.inf
        distance, bodies = self._contact_bodies()
        slack = distance - self._required[bodies[:, 0], bodies[:, 1]]
        index = int(np.argmin(slack))
        if slack[index] >= self.horizon:
            return self.horizon, -1, (0, 0), np.inf
        pair = (int(bodies[index, 0]), int(bodies[index, 1]))
        return float(slack[index]), index, pair, float(distance[index])

    def _tightest(self) -> tuple[float, Array, Array, tuple[int, int]]:
        """Return the smallest slack, with normal, point, and the bodies it leads from and to."""
        slack, index, bodies, _ = self._nearest_contact()
        normal, point = _NOWHERE
        if index >= 0:
            contact = self._data.contact[index]
            normal, point = contact.frame[:3], contact.pos
        for space, shape, required in self._planes:
            height = self._height(space, shape) - required
            if height < slack:
                slack, bodies = height, (0, shape.body)
                normal, point = space.normal, self._lowest(space, shape)
        return slack, normal, point, bodies

    def _height(self, space: HalfSpace, shape: GeomShape) -> float:
        """Return how far the lowest point of a geom is above a half-space's boundary [m]."""
        return float(space.normal @ self._lowest(space, shape)) - space.offset

    def _lowest(self, space: HalfSpace, shape: GeomShape) -> Array:
        """Return the point (3,) of a geom that is farthest against a half-space's normal."""
        if shape.geom < 0:
            return self._data.xpos[shape.body].copy()
        rotation = self._data.geom_xmat[shape.geom].reshape(3, 3)
        local = shape.extreme_point(-rotation.T @ space.normal)
        return self._data.geom_xpos[shape.geom] + rotation @ local

    def _reach(self) -> Array:
        """Bound how far any point can get from each joint's axis, going from the tip inwards."""
        anchors, farther = self._data.xanchor[self._joints], 0.0
        reach = np.ones(len(self._joints))
        for j in reversed(range(len(self._joints))):
            last = j + 1 == len(self._joints)
            own = self._moves[:, j] & (True if last else ~self._moves[:, j + 1])
            link = 0.0 if last else float(np.linalg.norm(anchors[j + 1] - anchors[j]))
            farther = max(self._extent(own, anchors[j]), link + farther)
            if self._robot.is_slide[j]:
                limits = self._robot.limits
                farther += min(1.0, float(limits.upper[j] - limits.lower[j]))
            else:
                reach[j] = farther
        return reach

    def _extent(self, bodies: Array, anchor: Array) -> float:
        """Return how far from a point the geoms of some bodies reach [m]."""
        geoms = np.flatnonzero(bodies[self._model.geom_bodyid])
        centers = np.linalg.norm(self._data.geom_xpos[geoms] - anchor, axis=1)
        return float(np.max(centers + self._model.geom_rbound[geoms], initial=0.0))

    def _label(self, body: int) -> str:
        return body_label(self._model, int(body))


def _with_margin(mj_model: Any, margin: float) -> Any:
    """Return a copy in which pairs of geoms are reported up to a distance [m]."""
    model = copy.copy(mj_model)
    model.geom_margin[:] = margin
    model.geom_gap[:] = 0.0
    if model.npair:
        model.pair_margin[:] = margin
        model.pair_gap[:] = 0.0
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _moved_bodies(robot: RobotModel, joints: Array) -> Array:
    """Return (nbody, n) booleans: which chain joint moves which body."""
    model = robot.mj_model
    moves = np.zeros((model.nbody, len(joints)), dtype=bool)
    for j, joint in enumerate(joints):
        moves[subtree(model, int(model.jnt_bodyid[joint])), j] = True
    return moves


def _required_at(distance: float, clearance: float) -> float:
    """Return the distance to keep for a pair with this distance at rest [m]."""
    return -np.inf if distance <= 0.0 else min(clearance, KEPT_SHARE * distance)

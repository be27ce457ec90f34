"""Which pairs of geoms need no distance test: those that cannot matter, and those still far apart.

MuJoCo tests two geoms if a bit of one's ``contype`` is set in the other's ``conaffinity``. Geoms
that behave alike form a group with a bit of its own; the affinities then say for every two groups
whether they are tested. Bodies of one part of the arm, or of the scene, keep their distances; a
model with a second arm or a full scene has many of those.

How fast two bodies can approach each other is bounded in every posture: only joints between them
change their distance, and joint j changes it by at most |qd_j| times the largest distance any point
of the outer body can have from its axis. For a serial chain that distance is at most the sum of the
link lengths in between plus the outer body's own extent.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_sysid.model.contacts import parts_of
from robot_sysid.records import Array, RobotModel

MOST_GROUPS = 31
"""Bits there are for groups."""


def drop_pairs(mj_model: Any, part: Any, ignored: Any) -> None:
    """Change a model's collision filter so that only pairs that matter are tested.

    Explicit contact pairs of the model are tested as before. A model with too many groups is left
    as it is.

    Args:
        mj_model: compiled model, changed in place.
        part: (nbody,) bodies with equal numbers do not move against each other.
        ignored: (nbody, nbody) body pairs whose distance does not matter.
    """
    body = mj_model.geom_bodyid
    keys = np.stack((part[body], mj_model.geom_contype, mj_model.geom_conaffinity), axis=1)
    groups, member = np.unique(keys, axis=0, return_inverse=True)
    member = np.ravel(member)
    if len(groups) > MOST_GROUPS:
        return
    tested = _compatible(groups) & (groups[:, :1] != groups[:, 0])
    tested &= _any_pair_matters(len(groups), member, ~ignored[np.ix_(body, body)])
    bit = 1 << np.arange(len(groups))
    _write(mj_model, "contype", bit[member])
    _write(mj_model, "conaffinity", (tested @ bit)[member])


def _write(mj_model: Any, name: str, value: Any) -> None:
    """Give geoms new filter bits, and bodies all bits of their geoms: they are tested first."""
    getattr(mj_model, f"geom_{name}")[:] = value
    of_bodies = getattr(mj_model, f"body_{name}", None)
    if of_bodies is not None:
        of_bodies[:] = 0
        np.bitwise_or.at(of_bodies, mj_model.geom_bodyid, value.astype(of_bodies.dtype))


def _compatible(groups: Any) -> Any:
    """Return (G, G) booleans: which groups the model itself tests against each other."""
    contype, conaffinity = groups[:, 1], groups[:, 2]
    one_way = (contype[:, None] & conaffinity) != 0
    return one_way | one_way.T


def _any_pair_matters(count: int, member: Any, matters: Any) -> Any:
    """Return (G, G) booleans: whether any two geoms of two groups matter."""
    belongs = (np.arange(count)[:, None] == member).astype(float)
    return belongs @ matters.astype(float) @ belongs.T > 0.0


_UNLIMITED_TRAVEL = 1.0
"""Travel assumed for a slide joint without limits [m]."""


class ApproachBounds:
    """Approach bounds between the parts of one arm.

    Args:
        robot: the arm.
        data: MuJoCo data of it, positions computed.

    Attributes:
        part: (nbody,) part of each body, see ``model.contacts.parts_of``.
        rates: (P, n) row ``row(a, b)`` bounds the approach of parts a and b [m/s] as rates @ |qd|;
            the last row holds for all pairs.
    """

    def __init__(self, robot: RobotModel, data: Any) -> None:
        self._n = robot.n_joints
        joints = robot.mj_model.dof_jntid[robot.dof_index]
        self.part = parts_of(robot)
        self._reach = _reach(robot, data, joints, self.part)
        pairs = [self._rate(a, b) for a in range(self._n + 1) for b in range(self._n + 1)]
        self.rates = np.vstack((pairs, np.max(pairs, axis=0)))

    def row(self, a: Any, b: Any) -> Any:
        """Return the row of ``rates`` for parts a and b (numbers or arrays)."""
        return a * (self._n + 1) + b

    def _rate(self, a: int, b: int) -> Array:
        low, high = min(a, b), max(a, b)
        rate = np.zeros(self._n)
        rate[low:high] = self._reach[low:high, high]
        return rate


def _reach(robot: RobotModel, data: Any, joints: Array, part: Any) -> Array:
    """Return (n, n + 1): how far part l can get from the axis of joint j; 1 for a slide's rate."""
    n = robot.n_joints
    anchors = data.xanchor[joints]
    limits = robot.limits
    travel = np.where(robot.is_slide, limits.upper - limits.lower, 0.0)
    travel[~np.isfinite(travel)] = _UNLIMITED_TRAVEL
    links = np.linalg.norm(np.diff(anchors, axis=0), axis=1) + travel[1:]
    reach = np.zeros((n, n + 1))
    for outer in range(1, n + 1):
        extent = _extent(robot.mj_model, data, part == outer, anchors[outer - 1])
        for j in range(outer):
            reach[j, outer] = extent + np.sum(links[j : outer - 1])
    reach[robot.is_slide] = 1.0
    return reach


def _extent(mj_model: Any, data: Any, bodies: Any, anchor: Array) -> float:
    """Return how far from a point the geoms and origins of some bodies reach [m]."""
    geoms = np.flatnonzero(bodies[mj_model.geom_bodyid])
    centers = np.linalg.norm(data.geom_xpos[geoms] - anchor, axis=1)
    origins = np.linalg.norm(data.xpos[bodies] - anchor, axis=1)
    solid = np.max(centers + mj_model.geom_rbound[geoms], initial=0.0)
    return float(max(solid, np.max(origins, initial=0.0)))

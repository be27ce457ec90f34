"""How far the arm is from itself, from the scene and from forbidden half-spaces, by MuJoCo.

MuJoCo finds every pair of geoms nearer than a margin, with distance, point and normal; half-spaces
are tested against the extreme point of each geom. The gradient of a distance is the relative
velocity of the two nearest points along the normal, per unit joint rate.

Links next to each other that overlap at rest, and links that overlap whatever the joints between
them do, do so by design of the model and are ignored. Any other pair that touches at rest may never
get deeper, and one that is deep inside each other there is a collision. A pair that is apart at
rest but nearer than the clearance must keep half that distance.

How fast two bodies can approach each other is bounded in every posture: only joints between them
change their distance, and joint j changes it by at most |qd_j| times the largest distance any point
of the outer body can have from its axis. For a serial chain that distance is at most the sum of the
link lengths in between plus the outer body's own extent.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.dynamics.spatial import cross
from robot_sysid.model.chain import body_label
from robot_sysid.model.contacts import ContactFinder, count_moving_joints, joint_ranges
from robot_sysid.motion.plan_options import HalfSpace
from robot_sysid.motion.solids import HalfSpaces
from robot_sysid.records import Array, RobotModel

HORIZON = 0.05
"""How much farther than the clearance a pair is still seen [m]."""
KEPT_SHARE = 0.5
"""Share of its distance at rest that a pair nearer than the clearance must keep."""
DEEPEST_TOUCH = 1e-3
"""How deep two bodies may be inside each other at rest to count as touching, as parked arms do [m];
deeper they collide, and no motion may start there."""
_TOUCH_ROOM = 1e-4
"""How much deeper than at rest a touching pair may get: how well depths are known [m]."""
_NEIGHBOUR_POSTURES = 181
_FINER = 41
"""How many positions of a joint tell whether its neighbours are harmless; more where nearest."""
MOST_GROUPS = 31
"""Bits there are for groups of geoms."""
_UNLIMITED_TRAVEL = 1.0
"""Travel assumed for a slide joint without limits [m]."""


@dataclass
class Closest:
    """The tightest pair of one configuration: between what, and when along a motion [s].

    The slack is the distance minus the one that must be kept [m], negative where it is not kept;
    the distance [m] is infinite where nothing is near.
    """

    slack: float
    distance: float = np.inf
    label: str = ""
    time: float = 0.0


class _Nearest:
    """The tightest pair of each of N configurations, at most the horizon away: in which direction
    and where (N, 3), bodies (N, 2), the world and one where a half-space is near, which (N,) or -1.
    """

    def __init__(self, count: int) -> None:
        self.slack = np.full(count, HORIZON)
        self.distance = np.full(count, np.inf)
        self.normal, self.point = np.zeros((2, count, 3))
        self.bodies = np.zeros((count, 2), dtype=int)
        self.space = np.full(count, -1)


class Slack(NamedTuple):
    """Smallest slack (N,) of N configurations, at most the horizon [m], and its gradient (N, n)."""

    value: Array
    gradient: Array


class Clearance:
    """Distances of one arm: what it must not touch, itself included.

    Args:
        rest: (n,) configuration in which the motion starts.
        clearance: distance to keep between bodies that are apart at rest [m].

    Attributes:
        is_solid: whether the model has collision geometry.
        rates: approach bounds (P, n): pairs of row p approach at rates[p] @ abs(qd) [m/s] at most.
        at_rest: pairs of bodies that need words, each with its distance in the starting
            configuration: "ignored" are neighbours inside each other, which are not looked at;
            "deep" others inside each other, collisions; "touching" others that touch and never get
            deeper; "near" those so near that they keep half that distance, not the clearance.
        neighbours: the least distance of links next to each other that keep theirs whatever the
            arm does, and so are not looked at any more.
        left_at_rest: (half-space, body, how far outside [m]) of what is outside already at rest.
    """

    def __init__(
        self,
        robot: RobotModel,
        rest: Array,
        clearance: float,
        half_spaces: Sequence[HalfSpace],
    ) -> None:
        self._arguments = (robot, rest, clearance, tuple(half_spaces))
        self._robot = robot
        self._model = model = _with_margin(robot.mj_model, clearance + HORIZON)
        self._data = data_at_pose(model, robot.reference_qpos)
        self._joints = model.dof_jntid[robot.dof_index]
        self._body_of_geom = np.array(model.geom_bodyid)
        self._required = np.full((model.nbody, model.nbody), clearance)
        self._place(rest)
        self._part = part = count_moving_joints(robot)
        self.is_solid = bool(
            np.any(model.geom_contype | model.geom_conaffinity) or model.npair
        )
        # Where nothing is in the way, no motion uses up any of its room.
        self.rates = approach_rates(robot, self._data, part) * (
            self.is_solid or bool(half_spaces)
        )
        self._rows = part[:, None] * (robot.n_joints + 1) + part
        self._free = np.append(np.full(len(self.rates) - 1, np.inf), HORIZON)
        self.at_rest = self._learn_pairs(clearance)
        self.neighbours = self._settle_neighbours(rest)
        drop_pairs(model, part, np.isneginf(self._required))
        self._place(rest)
        self._spaces = HalfSpaces(model, half_spaces) if half_spaces else None
        self.left_at_rest = (
            [] if self._spaces is None else self._settle_spaces(self._spaces)
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process as what it was made from: MuJoCo data is made anew there."""
        return type(self), self._arguments

    def slack(self, q: Array) -> Slack:
        """Return the slack at positions q (N, n)."""
        frames = np.empty((2, len(q), self._model.njnt, 3))
        near = self._nearest(q, frames=frames)
        # Component first, (3, N, n): a cross product by hand costs a tenth of numpy's.
        axes, anchors = (each[:, self._joints].transpose(2, 0, 1) for each in frames)
        normal = near.normal.T[:, :, None]
        point = near.point.T[:, :, None]
        lever = np.where(self._robot.is_slide, normal, cross(point - anchors, normal))
        rates = np.sum(axes * lever, axis=0)
        # A joint changes the distance only if it moves one body and not the other.
        part = self._part[near.bodies]
        joint = np.arange(q.shape[1])
        side = (joint < part[:, 1:]).astype(float) - (joint < part[:, :1])
        return Slack(near.slack, side * rates)

    def slack_at(self, q: Array) -> tuple[float, Array]:
        """Return the slack at one configuration q (n,) [m], and what each pair of parts has.

        The second is (P,), the smallest slack among the pairs of each row of ``rates``, infinite
        where a row has no pair within the horizon.
        """
        budget = self._free.copy()
        return float(self._nearest(q[None], budget).slack[0]), budget

    def closest(self, q: Array) -> Closest:
        """Return the tightest distance at one configuration q (n,)."""
        near = self._nearest(q[None])
        label = ""
        first, second = near.bodies[0].tolist()
        if near.space[0] >= 0 and self._spaces is not None:
            space = self._spaces.spaces[near.space[0]]
            label = f"{body_label(self._model, second)} and {space.label}"
        elif np.isfinite(near.distance[0]):
            label = self._label(first, second)
        return Closest(float(near.slack[0]), float(near.distance[0]), label)

    @property
    def distances(self) -> Clearance:
        """The same arm, with each slack the whole distance of a pair, and without half-spaces."""
        other = copy.copy(self)
        other._required = np.where(np.isneginf(self._required), -np.inf, 0.0)
        other._spaces = None
        other.rates = self.rates * self.is_solid
        return other

    def _label(self, first: int, second: int) -> str:
        return f"{body_label(self._model, first)} and {body_label(self._model, second)}"

    def _place(self, q: Array) -> None:
        self._data.qpos[self._robot.qpos_index] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)

    def _contact_bodies(self) -> tuple[Array, Any]:
        """Return distances (C,) and bodies (C, 2) of the contacts."""
        contact = self._data.contact
        bodies = self._body_of_geom[contact.geom.reshape(-1, 2)]
        if not self._model.nflex:
            return contact.dist, bodies
        # Deformable bodies have no geoms; they are infinitely far away.
        return np.where(np.all(contact.geom >= 0, axis=1), contact.dist, np.inf), bodies

    def _learn_pairs(self, clearance: float) -> Mapping[str, Sequence[str]]:
        """Settle the distance each pair has to keep, from what it has at rest, where the arm is."""
        distances = dict[tuple[int, int], float]()
        part = self._part
        for distance, (a, b) in zip(*self._contact_bodies()):
            if part[a] != part[b]:  # else they do not move against each other
                pair = (min(int(a), int(b)), max(int(a), int(b)))
                distances[pair] = min(distances.get(pair, np.inf), float(distance))
        touching = [pair for pair, distance in distances.items() if distance <= 0.0]
        by_design = (
            ContactFinder(self._robot).by_design(touching) if touching else set()
        )
        self._required[part[:, None] == part] = -np.inf
        found: dict[str, list[str]] = {
            kind: [] for kind in ("ignored", "deep", "touching", "near")
        }
        for (a, b), distance in distances.items():
            kind, required = _settled(distance, clearance, (a, b) in by_design)
            self._required[a, b] = self._required[b, a] = required
            if kind:
                apart = "apart" if distance > 0.0 else "deep"
                found[kind].append(
                    f"{self._label(a, b)} ({1e3 * abs(distance):.2g} mm {apart})"
                )
        return found

    def _settle_spaces(self, spaces: HalfSpaces) -> list[tuple[HalfSpace, str, float]]:
        """Let what is near a boundary at rest keep half that distance; return what is beyond."""
        left = []
        for each, _, (height,), _ in spaces.heights(
            self._data.xpos[None], self._data.xmat[None]
        ):
            required = spaces.required[each]
            body = spaces.solids[each].body
            for k in np.flatnonzero((height <= 0.0) & np.isfinite(required)).tolist():
                left.append(
                    (spaces.spaces[k], body_label(self._model, body), -float(height[k]))
                )
            required[:] = np.minimum(required, np.maximum(0.0, KEPT_SHARE * height))
        return left

    def _settle_neighbours(self, rest: Array) -> Closest:
        """Drop pairs that keep their distance over all of the joint between; return the least."""
        # Links next to each other are always near; to know that this is harmless saves most tests.
        least = np.full_like(self._required, np.inf)
        for joint, (low, high) in enumerate(zip(*joint_ranges(self._robot))):
            nearest = self._sweep(
                rest, joint, np.linspace(low, high, _NEIGHBOUR_POSTURES), least
            )
            about = (high - low) / _NEIGHBOUR_POSTURES * np.linspace(-1.0, 1.0, _FINER)
            self._sweep(rest, joint, np.clip(nearest + about, low, high), least)
        harmless = (
            np.isfinite(least) & (least >= self._required) & np.isfinite(self._required)
        )
        pair = divmod(int(np.argmin(np.where(harmless, least, np.inf))), len(least))
        apart = float(np.min(least[harmless], initial=np.inf))
        self._required[harmless | harmless.T] = -np.inf
        label = self._label(*pair) if np.any(harmless) else ""
        return Closest(min(apart, HORIZON), apart, label)

    def _sweep(self, rest: Array, joint: int, positions: Array, least: Array) -> float:
        """Note the least distances (nbody, nbody) of pairs with just this joint between them, and
        return the position in which one of them is nearest.
        """
        q = rest.copy()
        nearest = np.inf
        at = float(rest[joint])
        for q[joint] in positions:
            self._place(q)
            distance, bodies = self._contact_bodies()
            part = np.sort(self._part[bodies], axis=1)
            ours = (part[:, 0] == joint) & (part[:, 1] == joint + 1)
            first, second = np.sort(bodies[ours], axis=1).T
            np.minimum.at(least, (first, second), distance[ours])
            here = float(np.min(distance[ours], initial=np.inf))
            nearest, at = (here, float(q[joint])) if here < nearest else (nearest, at)
        return at

    def _nearest(
        self, q: Array, budget: Array | None = None, frames: Array | None = None
    ) -> _Nearest:
        """Return what is nearest, among contacts and half-spaces, at configurations q (N, n).

        Lowers the budget (P,) of each row of ``rates`` to the least slack of its pairs, and tells
        the joints' frames, axes and anchors (2, N, joints of the model, 3), where there is room.
        """
        near = _Nearest(len(q))
        spaces = self._spaces
        data = self._data
        places, turns = (
            np.empty((len(q), self._model.nbody, width)) for width in (3, 9)
        )
        for k, position in enumerate(q):
            self._place(position)
            if data.ncon:
                self._note_contact(near, k, budget)
            # Whole arrays: choosing from each posture's takes ten times as long.
            if spaces is not None:
                places[k] = data.xpos
                turns[k] = data.xmat
            if frames is not None:
                frames[:, k] = data.xaxis, data.xanchor
        if spaces is not None:
            self._note_spaces(spaces, places, turns, near, budget)
        return near

    def _note_contact(self, near: _Nearest, at: int, budget: Array | None) -> None:
        """Note the tightest contact of MuJoCo's present configuration, which is number ``at``."""
        distance, bodies = self._contact_bodies()
        first, second = bodies.T
        slack = distance - self._required[first, second]
        if budget is not None:
            np.minimum.at(budget, self._rows[first, second], slack)
        k = int(slack.argmin())
        if slack[k] < near.slack[at]:
            contact = self._data.contact[k]
            near.slack[at] = slack[k]
            near.distance[at] = distance[k]
            near.bodies[at] = bodies[k]
            near.normal[at] = contact.frame[:3]
            near.point[at] = contact.pos

    def _note_spaces(
        self,
        spaces: HalfSpaces,
        places: Array,
        turns: Array,
        near: _Nearest,
        budget: Array | None,
    ) -> None:
        """Note the half-spaces that are nearest, where one is; frames of all bodies as MuJoCo's."""
        for each, at, height, lowest in spaces.heights(places, turns, HORIZON):
            body = spaces.solids[each].body
            slack = height - spaces.required[each]
            which = np.argmin(slack, axis=1)
            least = slack[np.arange(len(at)), which]
            if budget is not None:
                budget[self._rows[0, body]] = min(
                    budget[self._rows[0, body]], np.min(least)
                )
            own = np.flatnonzero(least < near.slack[at])
            to = at[own]
            by = which[own]
            near.slack[to] = least[own]
            near.distance[to] = height[own, by]
            near.space[to] = by
            near.normal[to] = spaces.normals[by]
            near.point[to] = lowest[own, by]
            near.bodies[to] = 0, body


def _with_margin(mj_model: Any, margin: float) -> Any:
    """Return a copy in which pairs of geoms are reported up to a distance [m]."""
    model = copy.copy(mj_model)
    model.geom_margin[:] = margin
    model.geom_gap[:] = 0.0
    # The largest margin among a body's geoms: without it the search for close bodies misses pairs.
    model.body_margin[:] = margin
    if model.npair:
        model.pair_margin[:] = margin
        model.pair_gap[:] = 0.0
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _settled(distance: float, clearance: float, by_design: bool) -> tuple[str, float]:
    """Return what a pair with this distance at rest is called, and the distance it has to keep."""
    if distance > 0.0:
        kept = KEPT_SHARE * distance
        return ("near" if kept < clearance else ""), min(clearance, kept)
    if by_design:
        return "ignored", -np.inf
    if distance < -DEEPEST_TOUCH:
        return "deep", clearance
    return "touching", distance - _TOUCH_ROOM


def drop_pairs(mj_model: Any, part: Any, ignored: Any) -> None:
    """Change a model's collision filter, in place, so that only pairs that matter are tested.

    MuJoCo tests two geoms if a bit of one's ``contype`` is set in the other's ``conaffinity``.
    Geoms that behave alike form a group with a bit of its own; the affinities then say for every
    two groups whether they are tested. Explicit contact pairs of the model are tested as before.
    A model with too many groups is left as it is. Bodies with equal numbers in ``part`` (nbody,)
    do not move against each other; distances of ``ignored`` pairs (nbody, nbody) do not matter.
    """
    body = mj_model.geom_bodyid
    keys = np.stack(
        (part[body], mj_model.geom_contype, mj_model.geom_conaffinity), axis=1
    )
    groups, member = np.unique(keys, axis=0, return_inverse=True)
    if len(groups) > MOST_GROUPS:
        return
    one_way = (groups[:, 1:2] & groups[:, 2]) != 0
    belongs = (np.arange(len(groups))[:, None] == np.ravel(member)).astype(float)
    matters = belongs @ (~ignored[np.ix_(body, body)]).astype(float) @ belongs.T > 0.0
    tested = (one_way | one_way.T) & (groups[:, :1] != groups[:, 0]) & matters
    bit = 1 << np.arange(len(groups))
    for name, value in (("contype", bit), ("conaffinity", tested @ bit)):
        value = value[np.ravel(member)]
        getattr(mj_model, f"geom_{name}")[:] = value
        # Bodies have all bits of their geoms, in releases that test them first.
        of_bodies = getattr(mj_model, f"body_{name}", None)
        if of_bodies is not None:
            of_bodies[:] = 0
            np.bitwise_or.at(of_bodies, body, value.astype(of_bodies.dtype))


def approach_rates(robot: RobotModel, data: Any, part: Any) -> Array:
    """Return how fast the parts (nbody,) of one arm can approach each other, (P, n).

    Row a (n + 1) + b bounds the approach of parts a and b [m/s] as rates @ abs(qd); the last row
    holds for all pairs.
    """
    n = robot.n_joints
    reach = _reach(robot, data, part)
    joint = np.arange(n)
    pairs = []
    for low, high in map(sorted, np.ndindex(n + 1, n + 1)):
        pairs.append(np.where((low <= joint) & (joint < high), reach[:, high], 0.0))
    return np.vstack((pairs, np.max(pairs, axis=0)))


def _reach(robot: RobotModel, data: Any, part: Any) -> Array:
    """Return (n, n + 1): how far part l can get from the axis of joint j; 1 for a slide's rate."""
    n = robot.n_joints
    mj_model = robot.mj_model
    anchors = data.xanchor[mj_model.dof_jntid[robot.dof_index]]
    travel = np.where(robot.is_slide, robot.limits.upper - robot.limits.lower, 0.0)
    travel[~np.isfinite(travel)] = _UNLIMITED_TRAVEL
    links = np.linalg.norm(np.diff(anchors, axis=0), axis=1) + travel[1:]
    reach = np.zeros((n, n + 1))
    for outer in range(1, n + 1):
        # How far from its joint the geoms and origins of this part reach.
        bodies = part == outer
        anchor = anchors[outer - 1]
        geoms = np.flatnonzero(bodies[mj_model.geom_bodyid])
        centers = np.linalg.norm(data.geom_xpos[geoms] - anchor, axis=1)
        origins = np.linalg.norm(data.xpos[bodies] - anchor, axis=1)
        solid = np.max(centers + mj_model.geom_rbound[geoms], initial=0.0)
        extent = max(solid, np.max(origins, initial=0.0))
        for j in range(outer):
            reach[j, outer] = extent + np.sum(links[j : outer - 1])
    reach[robot.is_slide] = 1.0
    return reach

"""How far the arm is from itself, from the scene and from forbidden half-spaces, by MuJoCo.

MuJoCo finds every pair of geoms nearer than a margin, with distance, point and normal; half-spaces
are tested against the extreme point of each geom. The gradient of a distance is the relative
velocity of the two nearest points along the normal, per unit joint rate.

Links next to each other that overlap at rest, and links that overlap whatever the joints between
them do, do so by design of the model and are ignored. Any other pair that touches at rest may never
get deeper; two bodies that are more than ``DEEPEST_TOUCH`` inside each other at rest collide. A
pair that is apart at rest must keep half of its distance there, at most the clearance.

How fast two bodies can approach each other is bounded in every posture: only joints between them
change their distance, and joint j changes it by at most |qd_j| times the largest distance any point
of the outer body can have from its axis. For a serial chain that distance is at most the sum of the
link lengths in between plus the outer body's own extent.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.dynamics.spatial import cross
from robot_sysid.model.bodies import (
    count_moving_joints,
    joint_ranges,
    touching_by_design,
    update_contacts,
)
from robot_sysid.model.chain import body_label
from robot_sysid.motion import HalfSpace
from robot_sysid.motion.solids import HalfSpaces, pass_filters
from robot_sysid.records import Array, RobotModel

HORIZON = 0.05
"""How much farther than the clearance a pair is still reported [m]."""
KEPT_SHARE = 0.5
"""Share of its distance at rest that a pair must keep, where this is less than the clearance."""
DEEPEST_TOUCH = 1e-3
"""How deep two bodies may be inside each other at rest to count as touching, as parked arms do [m];
deeper they collide, and no motion may start there."""
_TOUCH_ROOM = 1e-4
"""How much deeper than at rest a touching pair may get [m]: the error of MuJoCo's depths."""
_NEIGHBOUR_POSTURES = 181
"""Number of positions, evenly spread over a joint's range, at which the distance of the bodies on
its two sides is computed."""
_FINE_POSTURES = 41
"""Number of further positions around the one at which these bodies came nearest."""
MOST_GROUPS = 31
"""Largest number of groups of geoms in ``drop_pairs``: MuJoCo has 31 bits for them."""
_UNLIMITED_TRAVEL = 1.0
"""Travel assumed for a slide joint without limits [m]."""


@dataclass
class Closest:
    """The tightest pair of bodies in one configuration.

    Attributes:
        slack: distance minus the distance that must be kept [m]; negative where it is not kept.
        distance: of the pair [m]; infinite where nothing is near.
        label: names of the two bodies, or of a body and a half-space; "" where nothing is near.
        time: of the configuration along a motion [s].
    """

    slack: float
    distance: float = np.inf
    label: str = ""
    time: float = 0.0


class _Nearest:
    """The tightest pair of each of N configurations: the pair with the least slack.

    A new instance holds no pair; ``Clearance`` writes each pair that it finds into the arrays.

    Attributes:
        slack: (N,) distance minus required distance of the pair; ``HORIZON`` without a pair [m].
        distance: (N,) of the pair; infinite without a pair [m].
        normal: (N, 3) unit vector from the first body to the second, in the world.
        point: (N, 3) where the two bodies are nearest, in the world [m].
        bodies: (N, 2) MuJoCo ids; 0 (the world) and a body where the pair is a body and the
            boundary of a half-space.
        space: (N,) index of that half-space, -1 for a pair of two bodies.
    """

    def __init__(self, count: int) -> None:
        self.slack = np.full(count, HORIZON)
        self.distance = np.full(count, np.inf)
        self.normal, self.point = np.zeros((2, count, 3))
        self.bodies = np.zeros((count, 2), dtype=int)
        self.space = np.full(count, -1)


class Slack(NamedTuple):
    """Slack of N configurations: distance minus required distance of the tightest pair.

    Attributes:
        value: (N,) slack, at most ``HORIZON`` [m]; negative where a distance is not kept.
        gradient: (N, n) derivative of the slack by the joint positions [m/rad, or 1 for slides].
    """

    value: Array
    gradient: Array


class Clearance:
    """Distances of one arm: what it must not touch, itself included.

    Args:
        robot: the arm.
        start: (n,) configuration at rest, in which the motion starts [rad or m].
        clearance: distance to keep between bodies that are apart at rest [m].
        half_spaces: half-spaces that their ``bodies`` have to stay in.

    Attributes:
        is_solid: whether the model has collision geometry.
        rates: approach bounds (P, n): pairs of row p approach at rates[p] @ abs(qd) [m/s] at most;
            one row per pair of links, and a last row for every pair (``approach_rates``).
        collisions: descriptions of the pairs of bodies that are inside each other at rest, but not
            by design and deeper than ``DEEPEST_TOUCH``.
        outside_at_rest: (half-space, name of the body, distance outside [m]) of each body that is
            outside a half-space at rest.
    """

    def __init__(
        self,
        robot: RobotModel,
        start: Array,
        clearance: float,
        half_spaces: Sequence[HalfSpace],
    ) -> None:
        self._arguments = (robot, start, clearance, half_spaces)
        self._robot = robot
        self._model = model = _with_margin(robot.mj_model, clearance + HORIZON)
        self._data = data_at_pose(model, robot.reference_qpos)
        self._joints = model.dof_jntid[robot.dof_index]
        self._body_of_geom = np.array(model.geom_bodyid)
        self._required = np.full((model.nbody, model.nbody), clearance)
        self._set_configuration(start)
        self._link_of_body = link_of_body = count_moving_joints(robot)
        self.is_solid = bool(
            np.any(model.geom_contype | model.geom_conaffinity) or model.npair
        )
        # With nothing to touch, bodies need not be treated as approaching at all.
        has_obstacles = self.is_solid or bool(half_spaces)
        self.rates = approach_rates(robot, self._data, link_of_body) * has_obstacles
        # (nbody, nbody) the row of ``rates`` of each pair of bodies.
        self._rows = link_of_body[:, None] * (robot.n_joints + 1) + link_of_body
        # (P,) slack of each row of ``rates`` where no pair is within the horizon; the last row,
        # which stands for every pair, has no more slack than the horizon then.
        self._free = np.append(np.full(len(self.rates) - 1, np.inf), HORIZON)
        self.collisions = self._set_required_distances(clearance)
        self._ignore_harmless_neighbours(start)
        drop_pairs(model, link_of_body, np.isneginf(self._required))
        self._set_configuration(start)
        self._spaces = HalfSpaces(model, half_spaces) if half_spaces else None
        self.outside_at_rest = []
        if self._spaces is not None:
            self.outside_at_rest = self._set_required_heights(self._spaces)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments of the constructor: another process makes its own MuJoCo data."""
        return type(self), self._arguments

    def slack(self, q: Array) -> Slack:
        """Return the slack, with its gradient, at joint positions q (N, n) [rad or m]."""
        frames = np.empty((2, len(q), self._model.njnt, 3))
        nearest = self._nearest(q, frames=frames)
        # Component first, (3, N, n): a cross product by hand costs a tenth of numpy's.
        axes, anchors = frames[:, :, self._joints].transpose(0, 3, 1, 2)
        normal = nearest.normal.T[:, :, None]
        point = nearest.point.T[:, :, None]
        lever = np.where(self._robot.is_slide, normal, cross(point - anchors, normal))
        rates = np.sum(axes * lever, axis=0)
        # A joint changes the distance only if it moves one body and not the other.
        links = self._link_of_body[nearest.bodies]
        joint = np.arange(q.shape[1])
        moves_first = joint < links[:, :1]
        moves_second = joint < links[:, 1:]
        side = moves_second.astype(float) - moves_first
        return Slack(nearest.slack, side * rates)

    def slack_at(self, q: Array) -> tuple[float, Array]:
        """Return the slack at one configuration q (n,) [m], and the slack (P,) of each row of
        ``rates``: the smallest among its pairs, infinite where none is within the horizon;
        ``HORIZON`` in the last row, which bounds all other pairs.
        """
        budget = self._free.copy()
        nearest = self._nearest(q[None], budget)
        return float(nearest.slack[0]), budget

    def closest(self, q: Array) -> Closest:
        """Return the pair of bodies, or body and half-space, with the least slack at one
        configuration q (n,) [rad or m].
        """
        nearest = self._nearest(q[None])
        label = ""
        first, second = nearest.bodies[0].tolist()
        if nearest.space[0] >= 0 and self._spaces is not None:
            space = self._spaces.spaces[nearest.space[0]]
            label = f"{body_label(self._model, second)} and {space.label}"
        elif np.isfinite(nearest.distance[0]):
            label = self._label(first, second)
        return Closest(float(nearest.slack[0]), float(nearest.distance[0]), label)

    def _label(self, first: int, second: int) -> str:
        """Return the names of two bodies, given by MuJoCo ids, joined by "and"."""
        return f"{body_label(self._model, first)} and {body_label(self._model, second)}"

    def _set_configuration(self, q: Array) -> None:
        """Set joint positions q (n,) in ``self._data`` and compute frames and contacts there."""
        self._data.qpos[self._robot.qpos_index] = q
        update_contacts(self._model, self._data)

    def _contact_bodies(self) -> tuple[Array, Any]:
        """Return distances (C,) [m] and body ids (C, 2) of the contacts that MuJoCo has found."""
        contact = self._data.contact
        bodies = self._body_of_geom[contact.geom.reshape(-1, 2)]
        if not self._model.nflex:
            return contact.dist, bodies
        # A contact of a deformable body has no geom, so no body here: its distance is infinite.
        return np.where(np.all(contact.geom >= 0, axis=1), contact.dist, np.inf), bodies

    def _set_required_distances(self, clearance: float) -> Sequence[str]:
        """Set ``self._required``, in place, to the distance that each pair has to keep, from its
        distance in the configuration that ``self._data`` has; return ``collisions``.

        ``clearance`` is the distance of pairs that are farther apart there [m].
        """
        distances = dict[tuple[int, int], float]()
        link = self._link_of_body
        for distance, (a, b) in zip(*self._contact_bodies()):
            if link[a] != link[b]:  # else they do not move against each other
                pair = (min(int(a), int(b)), max(int(a), int(b)))
                distances[pair] = min(distances.get(pair, np.inf), float(distance))
        touching = [pair for pair, distance in distances.items() if distance <= 0.0]
        by_design = touching_by_design(self._robot, touching)
        self._required[link[:, None] == link] = -np.inf
        collisions = []
        for (a, b), distance in distances.items():
            required = min(clearance, KEPT_SHARE * distance)
            if (a, b) in by_design:
                required = -np.inf
            elif distance < -DEEPEST_TOUCH:
                required = clearance
                collisions.append(
                    f"{self._label(a, b)} ({-1e3 * distance:.2g} mm deep)"
                )
            elif distance <= 0.0:
                required = distance - _TOUCH_ROOM
            self._required[a, b] = self._required[b, a] = required
        return collisions

    def _set_required_heights(
        self, spaces: HalfSpaces
    ) -> list[tuple[HalfSpace, str, float]]:
        """Let bodies near a boundary in the configuration that ``self._data`` has keep half of
        their height above it, in place in ``spaces.required``; return ``outside_at_rest``.
        """
        outside = []
        # One posture: (1, nbody, 3) and (1, nbody, 9).
        frames = self._data.xpos[None], self._data.xmat[None]
        for number, _, (height,), _ in spaces.heights(*frames):
            # (K,) heights above all half-spaces, and the heights that this body has to keep.
            required = spaces.required[number]
            name = body_label(self._model, spaces.solids[number].body)
            is_outside = (height <= 0.0) & np.isfinite(required)
            for k in np.flatnonzero(is_outside).tolist():
                outside.append((spaces.spaces[k], name, -float(height[k])))
            required[:] = np.minimum(required, np.maximum(0.0, KEPT_SHARE * height))
        return outside

    def _ignore_harmless_neighbours(self, start: Array) -> None:
        """Ignore pairs of neighbours that keep their distance over the entire range of the joint
        between them, the other joints at ``start`` (n,).

        To ignore a pair, its entry in ``self._required`` is set to minus infinity.
        """
        # Links next to each other are always near; to know that this is harmless saves most tests.
        # Least distance of two bodies, the one with the smaller id in the row.
        least = np.full_like(self._required, np.inf)
        for joint, (low, high) in enumerate(zip(*joint_ranges(self._robot))):
            positions = np.linspace(low, high, _NEIGHBOUR_POSTURES)
            nearest = self._sweep(start, joint, positions, least)
            step = (high - low) / _NEIGHBOUR_POSTURES
            around = nearest + step * np.linspace(-1.0, 1.0, _FINE_POSTURES)
            self._sweep(start, joint, np.clip(around, low, high), least)
        is_harmless = np.isfinite(least) & np.isfinite(self._required)
        is_harmless &= least >= self._required
        self._required[is_harmless | is_harmless.T] = -np.inf

    def _sweep(self, start: Array, joint: int, positions: Array, least: Array) -> float:
        """Return the position of a joint, of ``positions`` (K,), at which the bodies on its two
        sides are nearest, or ``start[joint]`` where they are near at none; the other joints stay at
        ``start`` (n,).

        Lowers ``least`` (nbody, nbody), in place, to the distances of these bodies.
        """
        q = start.copy()
        smallest = np.inf
        nearest = float(start[joint])
        for position in positions:
            q[joint] = position
            self._set_configuration(q)
            distance, bodies = self._contact_bodies()
            links = np.sort(self._link_of_body[bodies], axis=1)
            is_neighbour = (links[:, 0] == joint) & (links[:, 1] == joint + 1)
            first, second = np.sort(bodies[is_neighbour], axis=1).T
            np.minimum.at(least, (first, second), distance[is_neighbour])
            least_distance = float(np.min(distance[is_neighbour], initial=np.inf))
            if least_distance < smallest:
                smallest = least_distance
                nearest = float(q[joint])
        return nearest

    def _nearest(
        self, q: Array, budget: Array | None = None, frames: Array | None = None
    ) -> _Nearest:
        """Return the tightest pair, among contacts and half-spaces, at configurations q (N, n).

        Args:
            q: the configurations.
            budget: (P,) is lowered, in place, to the least slack of the pairs of each row of
                ``rates``.
            frames: (2, N, joints of the model, 3) is filled with the joints' axes and anchors.
        """
        nearest = _Nearest(len(q))
        spaces = self._spaces
        data = self._data
        positions = np.empty((len(q), self._model.nbody, 3))
        rotations = np.empty((len(q), self._model.nbody, 9))
        for k, configuration in enumerate(q):
            self._set_configuration(configuration)
            if data.ncon:
                self._note_contact(nearest, k, budget)
            # Entire arrays: choosing bodies in each posture takes ten times as long.
            if spaces is not None:
                positions[k] = data.xpos
                rotations[k] = data.xmat
            if frames is not None:
                frames[:, k] = data.xaxis, data.xanchor
        if spaces is not None:
            self._note_spaces(spaces, positions, rotations, nearest, budget)
        return nearest

    def _note_contact(
        self, nearest: _Nearest, index: int, budget: Array | None
    ) -> None:
        """Write the tightest contact of ``self._data`` into row ``index`` of ``nearest``, if it is
        tighter than the pair there; lower ``budget`` (P,), in place, to the slacks of all contacts.
        """
        distance, bodies = self._contact_bodies()
        first, second = bodies.T
        slack = distance - self._required[first, second]
        if budget is not None:
            np.minimum.at(budget, self._rows[first, second], slack)
        k = int(slack.argmin())
        if slack[k] < nearest.slack[index]:
            contact = self._data.contact[k]
            nearest.slack[index] = slack[k]
            nearest.distance[index] = distance[k]
            nearest.bodies[index] = bodies[k]
            nearest.normal[index] = contact.frame[:3]
            nearest.point[index] = contact.pos

    def _note_spaces(
        self,
        spaces: HalfSpaces,
        positions: Array,
        rotations: Array,
        nearest: _Nearest,
        budget: Array | None,
    ) -> None:
        """Write into ``nearest`` the half-spaces that are tighter than the pairs there.

        Args:
            spaces: the half-spaces.
            positions: (N, nbody, 3) MuJoCo's xpos of all bodies in N configurations [m].
            rotations: (N, nbody, 9) MuJoCo's xmat of all bodies.
            nearest: pairs of these N configurations; changed in place.
            budget: (P,) least slack per row of ``rates`` [m]; lowered in place.
        """
        heights = spaces.heights(positions, rotations, HORIZON)
        for number, postures, height, lowest in heights:
            body = spaces.solids[number].body
            slack = height - spaces.required[number]
            tightest = np.argmin(slack, axis=1)
            least = slack[np.arange(len(postures)), tightest]
            if budget is not None:
                # Half-spaces rest, as the world does, which is body 0.
                row = self._rows[0, body]
                budget[row] = min(budget[row], np.min(least))
            nearer = np.flatnonzero(least < nearest.slack[postures])
            index = postures[nearer]
            space = tightest[nearer]
            nearest.slack[index] = least[nearer]
            nearest.distance[index] = height[nearer, space]
            nearest.space[index] = space
            nearest.normal[index] = spaces.normals[space]
            nearest.point[index] = lowest[nearer, space]
            nearest.bodies[index] = 0, body


def _with_margin(mj_model: Any, margin: float) -> Any:
    """Return a copy of a compiled model in which contacts are reported up to a distance ``margin``
    [m], also where the model switches contacts off.
    """
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


def drop_pairs(mj_model: Any, link_of_body: Any, ignored: Any) -> None:
    """Change a model's collision filter, in place, so that MuJoCo tests no pair that is ignored or
    that cannot move against each other.

    Geoms with equal filters on one link form a group with a bit of its own; the affinities then
    define for every two groups whether they are tested. Explicit contact pairs of the model are
    tested as before. A model with more than ``MOST_GROUPS`` groups is left as it is.

    Args:
        mj_model: compiled model; changed.
        link_of_body: (nbody,) number of the link each body belongs to; bodies with equal numbers do
            not move against each other.
        ignored: (nbody, nbody) whether the distance of two bodies need not be tested.
    """
    body = mj_model.geom_bodyid
    keys = np.stack(
        (link_of_body[body], mj_model.geom_contype, mj_model.geom_conaffinity), axis=1
    )
    groups, member = np.unique(keys, axis=0, return_inverse=True)
    member = np.ravel(member)
    if len(groups) > MOST_GROUPS:
        return
    link, contype, conaffinity = groups.T
    # (groups, geoms) membership, and (geoms, geoms) pairs whose distance matters: two groups are
    # relevant where the number of such pairs between their members is not zero.
    is_member = (np.arange(len(groups))[:, None] == member).astype(float)
    matters = ~ignored[np.ix_(body, body)]
    is_relevant = is_member @ matters.astype(float) @ is_member.T > 0.0
    is_tested = pass_filters(link, contype, conaffinity) & is_relevant
    bit = 1 << np.arange(len(groups))
    # A group's affinity is the sum of the bits of all groups that it is tested against.
    for name, value in (("contype", bit), ("conaffinity", is_tested @ bit)):
        bits = value[member]
        getattr(mj_model, f"geom_{name}")[:] = bits
        # Bodies have all bits of their geoms, in releases that test them first.
        of_bodies = getattr(mj_model, f"body_{name}", None)
        if of_bodies is not None:
            of_bodies[:] = 0
            np.bitwise_or.at(of_bodies, body, bits.astype(of_bodies.dtype))


def approach_rates(robot: RobotModel, data: Any, link_of_body: Any) -> Array:
    """Return bounds (P, n) on how fast the links of one arm can approach each other, per unit joint
    speed [m/rad, or 1 for slides]; P = (n + 1)^2 + 1.

    Row a (n + 1) + b bounds the approach of links a and b [m/s] as rates @ abs(qd); the last row
    bounds that of every pair.

    Args:
        robot: the arm.
        data: MuJoCo data of its model with all frames computed, in any configuration.
        link_of_body: (nbody,) number of the link that each body belongs to, 1 to n; 0 for bodies
            that no joint of the arm moves.
    """
    n = robot.n_joints
    reach = _reach(robot, data, link_of_body)
    joint = np.arange(n)
    pairs = []
    for low, high in map(sorted, np.ndindex(n + 1, n + 1)):
        # The joints between two links move the outer one, of the higher number, about their axes.
        is_between = (low <= joint) & (joint < high)
        pairs.append(np.where(is_between, reach[:, high], 0.0))
    return np.vstack((pairs, np.max(pairs, axis=0)))


def _reach(robot: RobotModel, data: Any, link_of_body: Any) -> Array:
    """Return the largest distance (n, n + 1) that a point of link l (column) can have from the axis
    of joint j (row) [m]; rows of slides are 1, as a slide moves all points alike.

    The arguments are those of ``approach_rates``.
    """
    n = robot.n_joints
    mj_model = robot.mj_model
    anchors = data.xanchor[mj_model.dof_jntid[robot.dof_index]]
    travel = np.where(robot.is_slide, robot.limits.upper - robot.limits.lower, 0.0)
    travel[~np.isfinite(travel)] = _UNLIMITED_TRAVEL
    # From each joint's anchor to the next one, which a slide there moves away by its travel.
    lengths = np.linalg.norm(np.diff(anchors, axis=0), axis=1) + travel[1:]
    reach = np.zeros((n, n + 1))
    for outer in range(1, n + 1):
        # How far from its joint the geoms and origins of this link reach.
        bodies = link_of_body == outer
        anchor = anchors[outer - 1]
        geoms = np.flatnonzero(bodies[mj_model.geom_bodyid])
        centers = np.linalg.norm(data.geom_xpos[geoms] - anchor, axis=1)
        origins = np.linalg.norm(data.xpos[bodies] - anchor, axis=1)
        solid = np.max(centers + mj_model.geom_rbound[geoms], initial=0.0)
        extent = max(solid, np.max(origins, initial=0.0))
        for j in range(outer):
            reach[j, outer] = extent + np.sum(lengths[j : outer - 1])
    reach[robot.is_slide] = 1.0
    return reach

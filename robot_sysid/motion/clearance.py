"""How far the arm is from itself, from the scene and from forbidden half-spaces, by MuJoCo.

MuJoCo finds every pair of geoms nearer than a margin, with distance, point and normal; the
boundaries of half-spaces are planes beside the model (``planes``). The gradient of a distance is
the relative velocity of the two nearest points along the normal, per unit joint rate.

Links next to each other that overlap at rest, and links that overlap whatever the joints between
them do, do so by design of the model and are ignored. Any other pair that touches at rest may never
get deeper; two bodies that are more than 1 mm inside each other at rest collide. A
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
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import InputError
from robot_sysid.model.bodies import (
    count_moving_joints,
    touching_by_design,
    update_contacts,
)
from robot_sysid.model.chain import body_label
from robot_sysid.motion.planes import Planes
from robot_sysid.records import Array, HalfSpace, Limits, RobotModel
from robot_sysid.spatial import cross

HORIZON = 0.05
"""How much farther than the clearance a pair is still reported [m]."""
SEARCH_HORIZON = 0.015
"""The same where a search asks, which needs a slope near the clearance alone [m]: the time that
distances take grows with the number of pairs, three to ten times between both."""
KEPT_SHARE = 0.5
"""Share of its distance at rest that a pair must keep, where this is less than the clearance."""

DEPTH_ERROR = 1e-4
"""Error of MuJoCo's depths of bodies inside each other [m], by which a pair that touches at rest
may get deeper."""
LARGEST_OVERLAP = 1e-3
"""Depth up to which bodies that are inside each other at rest touch, as parked arms do [m]; deeper
ones collide."""

BITS = 31
"""Bits of MuJoCo's contype and conaffinity, the sign's left out."""


@dataclass(frozen=True)
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


class TightPairs(NamedTuple):
    """C pairs of links, or of a half-space and a link, with little slack in N postures.

    Attributes:
        posture: (C,) index of the posture.
        number: (C,) of the pair, below ``Clearance.n_pairs``.
        slack: (C,) distance minus required distance [m]; negative where it is not kept.
        slope: (C, n) its derivative by the joint positions [m/rad, or 1 for slides].
    """

    posture: Any
    number: Any
    slack: Array
    slope: Array


class _Near(NamedTuple):
    """C pairs of bodies, or of a half-space and a body, that are near each other.

    Attributes:
        posture: (C,) index of the configuration.
        bodies: (C, 2) MuJoCo ids; 0 (the world) and a body for a half-space.
        distance: (C,) [m].
        slack: (C,) distance minus required distance [m].
        normal: (C, 3) unit vector from the first body to the second, in the world.
        point: (C, 3) where the two are nearest, in the world [m].
        wall: (C,) index of the half-space, -1 for a pair of two bodies.
    """

    posture: Any
    bodies: Any
    distance: Array
    slack: Array
    normal: Array
    point: Array
    wall: Any

    def tightest(self, group: Any, horizon: float = HORIZON) -> _Near:
        """Return the pair with the least slack of each group (C,), if below a horizon [m]."""
        order = np.lexsort((self.slack, group))
        _, first = np.unique(group[order], return_index=True)
        tightest = order[first]
        tightest = tightest[self.slack[tightest] < horizon]
        return _Near(*(values[tightest] for values in self))


_NOTHING_NEAR = _Near(
    posture=np.zeros(0, dtype=int),
    bodies=np.zeros((0, 2), dtype=int),
    distance=np.zeros(0),
    slack=np.zeros(0),
    normal=np.zeros((0, 3)),
    point=np.zeros((0, 3)),
    wall=np.zeros(0, dtype=int),
)


class _Walls:
    """Boundaries of half-spaces, and the height above them that bodies have to keep.

    A body near a boundary at rest keeps half of its height there.

    Args:
        mj_model: the arm's model.
        data: MuJoCo's data of it at rest.
        spaces: the half-spaces.

    Attributes:
        spaces: as above.
        planes: their boundaries.

    Raises:
        InputError: a body is outside a half-space at rest.
    """

    def __init__(self, mj_model: Any, data: Any, spaces: Sequence[HalfSpace]) -> None:
        self.spaces = spaces
        self._normals = np.array([space.normal for space in spaces])
        bodies = np.concatenate([space.bodies for space in spaces])
        boundaries = [(space.normal, space.offset) for space in spaces]
        margin = HORIZON + max(space.clearance for space in spaces)
        self.planes = Planes(mj_model, bodies, boundaries, margin)
        near = self.planes.near(data)
        heights = np.full((len(spaces), mj_model.nbody), np.inf)
        np.minimum.at(heights, (near.plane, near.body), near.distance)
        # (spaces, nbody) [m]; bodies that a half-space does not hold for may be anywhere.
        self._required = np.full_like(heights, -np.inf)
        for number, space in enumerate(spaces):
            held = np.intersect1d(space.bodies, self.planes.bodies)
            height = heights[number, held]
            if np.any(height <= 0.0):
                first = np.argmax(height <= 0.0)
                body = body_label(mj_model, held[first].item())
                depth = round(-1e3 * height[first])
                place = f"is {depth} mm beyond" if depth else "touches"
                raise InputError(
                    f"no trajectory is feasible: at rest, body {body} {place} {space.label}; "
                    "move that limit, or change the model's reference configuration"
                )
            kept = np.minimum(space.clearance, KEPT_SHARE * height)
            self._required[number, held] = kept

    def pairs(self, positions: Array, matrices: Array) -> _Near:
        """Return the pairs of boundaries and bodies that are near each other in postures.

        Args:
            positions: (N, nbody, 3) of the bodies' origins in the world [m].
            matrices: (N, nbody, 9) their rotation matrices.
        """
        near = self.planes.near_in_postures(positions, matrices)
        return _Near(
            posture=near.posture,
            # A boundary is part of the world, body 0.
            bodies=np.stack((np.zeros_like(near.body), near.body), axis=1),
            distance=near.distance,
            slack=near.distance - self._required[near.plane, near.body],
            normal=self._normals[near.plane],
            point=near.point,
            wall=near.plane,
        )


class Clearance:
    """Distances of one arm: what it must not touch, itself included.

    Args:
        robot: the arm.
        start: (n,) configuration at rest, in which the motion starts [rad or m].
        limits: their clearance between bodies that are apart at rest, and their half-spaces, are
            kept.

    Attributes:
        rates: approach bounds (P, n): pairs of row p approach at rates[p] @ abs(qd) [m/s] at most;
            one row per pair of links (``approach_rates``).
        collisions: descriptions of the pairs of bodies that are inside each other at rest, but not
            by design and deeper than 1 mm.

    Raises:
        InputError: a body is outside a half-space at rest.
    """

    def __init__(self, robot: RobotModel, start: Array, limits: Limits) -> None:
        self._arguments = robot, start, limits
        clearance = limits.clearance
        self._robot = robot
        self._clearance = clearance
        self._model = model = _with_contacts(robot.mj_model)
        self._data = data_at_pose(model, robot.reference_qpos)
        self._joints = model.dof_jntid[robot.dof_index]
        self._walls: _Walls | None = None
        self._link_of_body = link_of_body = count_moving_joints(robot)
        self.rates, rows = approach_rates(robot, self._data, link_of_body)
        # (nbody, nbody) the row of ``rates`` of each pair of bodies.
        self._rows = rows[link_of_body[:, None], link_of_body]
        self._required = np.full((model.nbody, model.nbody), clearance)
        self.collisions = self._set_required_distances(start, clearance)
        links = np.abs(link_of_body[:, None] - link_of_body)
        masks = model.geom_contype.copy(), model.geom_conaffinity.copy()
        let_pairs_meet(model, masks, np.isfinite(self._required) & (links == 1))
        self._ignore_harmless_neighbours(start)
        let_pairs_meet(model, masks, np.isfinite(self._required))
        if limits.spaces:
            self._data.qpos[robot.qpos_index] = start
            mujoco.mj_kinematics(model, self._data)
            self._walls = _Walls(model, self._data, limits.spaces)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the constructor's arguments: a pickle of MuJoCo's data ends the process in 3.0."""
        return type(self), self._arguments

    def slack(self, q: Array) -> Array:
        """Return the slack (N,) of the tightest pair at joint positions q (N, n), at most
        ``SEARCH_HORIZON`` [m]; it is distance minus required distance.
        """
        near = self._near(q, SEARCH_HORIZON)
        slack = np.full(len(q), SEARCH_HORIZON)
        np.minimum.at(slack, near.posture, near.slack)
        return slack

    def tight_pairs(self, q: Array) -> TightPairs:
        """Return the pairs with a slack below ``SEARCH_HORIZON`` at joint positions q (N, n)."""
        frames = np.empty((2, len(q), self._model.njnt, 3))
        near = self._near(q, SEARCH_HORIZON, frames)
        group = near.posture * self.n_pairs + self._number(near)
        near = near.tightest(group, SEARCH_HORIZON)
        # Component first, (3, C, n): a cross product by hand costs a tenth of numpy's.
        axes, anchors = frames[:, near.posture][:, :, self._joints].transpose(
            0, 3, 1, 2
        )
        normal = near.normal.T[:, :, None]
        point = near.point.T[:, :, None]
        lever = np.where(self._robot.is_slide, normal, cross(point - anchors, normal))
        rates = np.sum(axes * lever, axis=0)
        # A joint changes the distance only if it moves one body and not the other.
        links = self._link_of_body[near.bodies]
        joint = np.arange(q.shape[1])
        side = (joint < links[:, 1:]).astype(float) - (joint < links[:, :1])
        return TightPairs(near.posture, self._number(near), near.slack, side * rates)

    @property
    def n_pairs(self) -> int:
        """How many pairs of links, and of half-spaces and links, there are."""
        n_walls = 0 if self._walls is None else len(self._walls.spaces)
        return len(self.rates) + n_walls * self._n_links

    @property
    def _n_links(self) -> int:
        """Number of links, what does not move included."""
        return self.rates.shape[1] + 1

    def _number(self, near: _Near) -> Any:
        """Return the number (C,) of each pair of links, or of a half-space and a link."""
        of_links = self._rows[near.bodies[:, 0], near.bodies[:, 1]]
        outer = self._link_of_body[near.bodies[:, 1]]
        of_walls = len(self.rates) + near.wall * self._n_links + outer
        return np.where(near.wall < 0, of_links, of_walls)

    def slacks(self, q: Array) -> Array:
        """Return the slack (N, P) of each row of ``rates``, at most ``HORIZON``, at joint positions
        q (N, n) [m]: the smallest among its pairs.
        """
        near = self._near(q)
        slacks = np.full((len(q), len(self.rates)), HORIZON)
        rows = self._rows[near.bodies[:, 0], near.bodies[:, 1]]
        np.minimum.at(slacks, (near.posture, rows), near.slack)
        return slacks

    def closest_pair(self, q: Array) -> Closest:
        """Return the pair of bodies, or body and half-space, with the least slack at one
        configuration q (n,) [rad or m].
        """
        near = self._near(q[None])
        near = near.tightest(near.posture)
        if not len(near.slack):
            return Closest(HORIZON)
        first, second = near.bodies[0].tolist()
        label = self._label(first, second)
        if self._walls is not None and near.wall[0] >= 0:
            space = self._walls.spaces[near.wall[0]]
            label = f"{body_label(self._model, second)} and {space.label}"
        return Closest(near.slack[0], near.distance[0], label)

    def _label(self, first: int, second: int) -> str:
        """Return the names of two bodies, given by MuJoCo ids, joined by "and"."""
        return f"{body_label(self._model, first)} and {body_label(self._model, second)}"

    def _near(
        self, q: Array, horizon: float = HORIZON, frames: Array | None = None
    ) -> _Near:
        """Return all pairs that are near each other at configurations q (N, n).

        Args:
            q: (N, n) configurations.
            horizon: how much farther than the clearance pairs are looked for [m].
            frames: (2, N, joints of the model, 3), filled with the joints' axes and anchors.
        """
        data = self._data
        model = self._model
        _set_margin(model, self._clearance + horizon)
        qpos_index = self._robot.qpos_index
        positions = np.empty((len(q), model.nbody, 3))
        matrices = np.empty((len(q), model.nbody, 9))
        found = []
        for k, configuration in enumerate(q):
            data.qpos[qpos_index] = configuration
            update_contacts(model, data)
            # Mostly nothing is near: to ask MuJoCo for its arrays takes as long as to find that.
            if data.ncon:
                contact = data.contact
                fields = (contact.geom, contact.dist, contact.frame, contact.pos)
                found.append((np.full(data.ncon, k), *map(np.array, fields)))
            positions[k] = data.xpos
            matrices[k] = data.xmat
            if frames is not None:
                frames[:, k] = data.xaxis, data.xanchor
        pairs = self._pairs_of_bodies(found)
        if self._walls is None:
            return pairs
        of_walls = self._walls.pairs(positions, matrices)
        return _Near(*map(np.concatenate, zip(pairs, of_walls)))

    def _pairs_of_bodies(self, contacts: Sequence[tuple[Any, ...]]) -> _Near:
        """Return the pairs of bodies of MuJoCo's contacts in postures with any.

        Each entry is of one posture: its index (c,), then geoms (c, 2), distances (c,), frames (c,
        9) and points (c, 3) of its contacts.
        """
        if not contacts:
            return _NOTHING_NEAR
        posture, geoms, distance, frame, point = map(np.concatenate, zip(*contacts))
        bodies = self._model.geom_bodyid[geoms]
        # A contact of a deformable body has no geom, so no body here.
        distance = np.where(np.all(geoms >= 0, axis=1), distance, np.inf)
        slack = distance - self._required[bodies[:, 0], bodies[:, 1]]
        wall = np.full(len(posture), -1)
        return _Near(posture, bodies, distance, slack, frame[:, :3], point, wall)

    def _set_required_distances(self, start: Array, clearance: float) -> list[str]:
        """Set ``self._required``, in place, to the distance that each pair has to keep, from its
        distance at joint positions ``start`` (n,); return ``collisions``.

        ``clearance`` is the distance of pairs that are farther apart there [m].
        """
        near = self._near(start[None])
        distances = np.full_like(self._required, np.inf)
        np.minimum.at(distances, tuple(near.bodies.T), near.distance)
        distances = np.minimum(distances, distances.T)
        self._required = np.minimum(clearance, KEPT_SHARE * distances)
        # Bodies of one link do not move against each other.
        is_rigid = self._link_of_body[:, None] == self._link_of_body
        self._required[is_rigid] = -np.inf
        is_touching = np.triu(~is_rigid & (distances <= 0.0))
        touching = [(a, b) for a, b in np.argwhere(is_touching).tolist()]
        by_design = touching_by_design(self._robot, touching)
        collisions = []
        for a, b in touching:
            required = distances[a, b] - DEPTH_ERROR
            if (a, b) in by_design:
                required = -np.inf
            # No motion may start where bodies collide.
            elif distances[a, b] < -LARGEST_OVERLAP:
                required = clearance
                depth = -1e3 * distances[a, b]
                collisions.append(f"{self._label(a, b)} ({round(depth)} mm deep)")
            self._required[a, b] = self._required[b, a] = required
        return collisions

    def _ignore_harmless_neighbours(self, start: Array) -> None:
        """Ignore pairs of neighbours that keep their distance over the entire range of the joint
        between them, the other joints at ``start`` (n,).

        To ignore a pair, its entry in ``self._required`` is set to minus infinity.
        """
        # Links next to each other are always near; to know that this is harmless saves most tests.
        slacks = np.full_like(self._required, np.inf)
        robot = self._robot
        # Half a turn to both sides where a joint has no limit.
        limits = robot.limits.around(robot.reference, np.pi)
        for joint, ends in enumerate(zip(limits.lower, limits.upper)):
            q = np.tile(start, (361, 1))
            q[:, joint] = np.linspace(*ends, len(q))
            near = self._near(q)
            links = np.sort(self._link_of_body[near.bodies], axis=1)
            is_neighbour = np.all(links == (joint, joint + 1), axis=1)
            pairs = tuple(near.bodies[is_neighbour].T)
            np.minimum.at(slacks, pairs, near.slack[is_neighbour])
        slacks = np.minimum(slacks, slacks.T)
        self._required[(slacks >= 0.0) & np.isfinite(slacks)] = -np.inf


def unguarded_links(robot: RobotModel) -> tuple[str, ...]:
    """Return the names of the moving links with mass, but without geometry that can meet any that
    moves against it, from the base on.
    """
    model = robot.mj_model
    # (ngeom,) number of the link that each geom is part of, from 1; 0 for what does not move.
    link_of_geom = count_moving_joints(robot)[model.geom_bodyid]
    # Geoms meet if a bit of one's contype is set in the other's conaffinity, or as a pair.
    meets = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    meets[model.pair_geom1, model.pair_geom2] = True
    moves = link_of_geom[:, None] != link_of_geom
    can_meet = np.any((meets | meets.T) & moves, axis=1)
    guarded = set(link_of_geom[can_meet].tolist())
    return tuple(
        link.body_name
        for number, link in enumerate(robot.links, start=1)
        if link.has_mass and number not in guarded
    )


def _with_contacts(mj_model: Any) -> Any:
    """Return a copy of a compiled model in which contacts are looked for, also where the model
    switches them off.
    """
    model = copy.copy(mj_model)
    model.geom_gap[:] = 0.0
    model.pair_gap[:] = 0.0
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _set_margin(model: Any, margin: float) -> None:
    """Let contacts of a compiled model be reported up to a distance [m], in place."""
    model.geom_margin[:] = margin
    # The largest margin among a body's geoms: without it the search for close bodies misses pairs.
    model.body_margin[:] = margin
    model.pair_margin[:] = margin


def let_pairs_meet(
    model: Any, masks: tuple[Any, Any], counts: NDArray[np.bool_]
) -> None:
    """Let geoms of a compiled model meet, in place, only where the distance of their bodies counts.

    Most of the time that distances take is that of pairs whose distance is ignored, such as those
    within another arm. Each set of geoms that meet the same others gets a bit of its own as
    contype, and the bits of these others as conaffinity. With more sets than there are bits, the
    model has the masks that are given.

    Args:
        model: the compiled model.
        masks: (ngeom,) contype and conaffinity of its geoms in the model file.
        counts: (nbody, nbody) of which pairs of bodies the distance counts.
    """
    kinds, kind_of_geom = np.unique(
        np.stack((model.geom_bodyid, *masks)), axis=1, return_inverse=True
    )
    bodies, contypes, conaffinities = kinds
    meets = (contypes[:, None] & conaffinities) != 0
    meets = (meets | meets.T) & counts[bodies[:, None], bodies]
    # Kinds with equal rows meet the same others, by symmetry in both directions.
    rows, row_of_kind = np.unique(meets, axis=0, return_inverse=True)
    if len(rows) <= BITS:
        bits = 1 << np.arange(len(rows))
        bit_of_kind = bits[np.ravel(row_of_kind)] * np.any(meets, axis=1)
        met_by_kind = np.bitwise_or.reduce(np.where(meets, bit_of_kind, 0), axis=1)
        kind_of_geom = np.ravel(kind_of_geom)
        masks = bit_of_kind[kind_of_geom], met_by_kind[kind_of_geom]
    model.geom_contype[:], model.geom_conaffinity[:] = masks
    # What the search for close bodies looks at: the bits of all geoms of a body.
    model.body_contype[:] = 0
    model.body_conaffinity[:] = 0
    np.bitwise_or.at(model.body_contype, model.geom_bodyid, model.geom_contype)
    np.bitwise_or.at(model.body_conaffinity, model.geom_bodyid, model.geom_conaffinity)


def approach_rates(
    robot: RobotModel, data: Any, link_of_body: Any
) -> tuple[Array, Any]:
    """Return bounds (P, n) on how fast the links of one arm can approach each other, per unit joint
    speed [m/rad, or 1 for slides], and the row (n + 1, n + 1) of each pair of links.

    Args:
        robot: the arm.
        data: MuJoCo data of its model with all frames computed, in any configuration.
        link_of_body: (nbody,) number of the link that each body belongs to, 1 to n; 0 for bodies
            that no joint of the arm moves.
    """
    n = robot.n_joints
    mj_model = robot.mj_model
    anchors = data.xanchor[mj_model.dof_jntid[robot.dof_index]]
    # A metre is assumed for a slide without limits.
    travel = 2.0 * robot.is_slide * robot.limits.around(robot.reference, 0.5).span
    # From each joint's anchor to the next one, which a slide there moves away by its travel.
    lengths = np.linalg.norm(np.diff(anchors, axis=0), axis=1) + travel[1:]
    # The ball about each body's origin that holds all its geoms.
    radius = np.zeros(mj_model.nbody)
    far = np.linalg.norm(mj_model.geom_pos, axis=1) + mj_model.geom_rbound
    np.maximum.at(radius, mj_model.geom_bodyid, far)
    # The largest distance (n, n + 1) of a point of link l (column) from the axis of joint j (row).
    reach = np.zeros((n, n + 1))
    for outer in range(1, n + 1):
        # How far from its joint the geoms and origins of this link reach.
        bodies = link_of_body == outer
        origins = np.linalg.norm(data.xpos[bodies] - anchors[outer - 1], axis=1)
        extent = np.max(origins + radius[bodies], initial=0.0)
        for j in range(outer):
            reach[j, outer] = extent + np.sum(lengths[j : outer - 1])
    # A slide moves all points alike.
    reach[robot.is_slide] = 1.0
    rows = np.zeros((n + 1, n + 1), dtype=int)
    low, high = np.triu_indices(n + 1, 1)
    rows[low, high] = rows[high, low] = np.arange(len(low))
    # The joints between two links move the outer one, of the higher number, about their axes.
    joint = np.arange(n)
    is_between = (low[:, None] <= joint) & (joint < high[:, None])
    return np.where(is_between, reach[:, high].T, 0.0), rows

"""How far the convex shapes of bodies reach, in any direction or beyond forbidden planes.

A body is a set of points, the corners of its geoms, and what is round about each of them: the balls
at both ends of a capsule, the rims of a cylinder, an ellipsoid about its middle. The farthest point
along a direction is then the farthest corner plus the farthest point of its round part. MuJoCo
tells distances between geoms, but not from planes that are no part of a model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.model.bodies import count_moving_joints
from robot_sysid.model.chain import body_label
from robot_sysid.motion import HalfSpace
from robot_sysid.records import Array, RobotModel

_TYPES = mujoco.mjtGeom
"""MuJoCo's types of geoms."""
_CORNERS = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
"""Corners (8, 3) of a cube with half sides of one."""
_ENDS = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
"""Ends (2, 3) of a capsule's or cylinder's axis with a half length of one."""
_HULL_POINTS = 60
"""Corners beyond which a convex hull takes less time than it saves."""
MARKER_MASS = 5e-3
"""Mass up to which a small part of an arm is no body but marks a frame, such as a tool's [kg]."""
MARKER_SIZE = 0.02
"""Radius up to which a light part is small [m]: larger ones are the shell of a link."""


class Solid:
    """The shape of one body: its geoms that collide; without any, its visible geoms; without any
    geom, its origin.

    Attributes:
        points: (P, 3) corners in the body's frame [m]; none of a body that is a plane.
        spread: (P, 3, 3) matrix that maps the unit ball to the ellipsoid about each corner [m].
        radius: (P,) largest half axis of this ellipsoid [m].
        center: (3,) centre of a ball that contains the body, in the body's frame [m].
        bound: radius of that ball [m].
        body: MuJoCo id of the body.

    Args:
        mj_model: compiled MuJoCo model.
        body: MuJoCo id of the body.
    """

    def __init__(self, mj_model: Any, body: int) -> None:
        self.body = body
        geoms = np.flatnonzero(mj_model.geom_bodyid == body)
        solid = mj_model.geom_contype[geoms] | mj_model.geom_conaffinity[geoms]
        shape_geoms = geoms[solid != 0] if np.any(solid) else geoms
        # The origin stands for a body without geoms.
        n_origins = int(len(shape_geoms) == 0)
        points = [np.zeros((n_origins, 3))]
        spreads = [np.zeros((n_origins, 3, 3))]
        for geom in shape_geoms.tolist():
            corners, axes = _shape(mj_model, geom)
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, mj_model.geom_quat[geom])
            turn = matrix.reshape(3, 3)
            points.append(mj_model.geom_pos[geom] + corners @ turn.T)
            spreads.append(np.tile(turn * axes, (len(corners), 1, 1)))
        corners = np.concatenate(points)
        spread = np.concatenate(spreads)
        radius = np.max(np.linalg.norm(spread, axis=1), axis=1)
        on_hull = _on_the_hull(corners, radius)
        self.points = corners[on_hull]
        self.spread = spread[on_hull]
        self.radius = radius[on_hull]
        self._spreads = self.spread.transpose(1, 0, 2).reshape(3, -1)
        extent = self.points if len(self.points) else np.zeros((1, 3))
        self.center = 0.5 * (np.min(extent, axis=0) + np.max(extent, axis=0))
        reach = np.linalg.norm(self.points - self.center, axis=1) + self.radius
        self.bound = float(np.max(reach, initial=0.0))

    def farthest(self, directions: Array) -> Array:
        """Return the points (K, 3) [m] farthest along unit directions (K, 3), both in the body's
        frame.
        """
        # (K, P) heights of corners along the directions, plus those of the ellipsoids about them:
        # an ellipsoid that is the image A b of the unit ball reaches |A^T d| along d, at
        # b = A^T d / |A^T d|.
        heights = directions @ self.points.T
        if np.any(self.radius):
            turned = (directions @ self._spreads).reshape(len(directions), -1, 3)
            heights += np.sqrt(np.einsum("kpb,kpb->kp", turned, turned))
        best = np.argmax(heights, axis=1)
        spread = self.spread[best]
        around = np.einsum("ka,kab->kb", directions, spread)
        length = np.sqrt(np.einsum("kb,kb->k", around, around))[:, None]
        around /= np.where(length > 0.0, length, 1.0)
        return np.asarray(self.points[best] + np.einsum("kab,kb->ka", spread, around))


def solids_of(mj_model: Any, bodies: Sequence[int]) -> list[Solid]:
    """Return the shapes of bodies, given by MuJoCo ids, without those that are planes alone."""
    solids = [Solid(mj_model, int(body)) for body in bodies]
    return [solid for solid in solids if len(solid.points)]


def _shape(mj_model: Any, geom: int) -> tuple[Array, Array]:
    """Return corners (P, 3) of a geom in its own frame, and the half axes (3,) of the ellipsoid
    about each corner [m]: zero for a box or a mesh. P is 0 for a plane.
    """
    geom_type = int(mj_model.geom_type[geom])
    size = mj_model.geom_size[geom]
    axes = np.zeros(3)
    if geom_type == _TYPES.mjGEOM_PLANE:
        return np.zeros((0, 3)), axes
    if geom_type in (_TYPES.mjGEOM_MESH, _TYPES.mjGEOM_SDF):
        return _hull_vertices(mj_model, int(mj_model.geom_dataid[geom])), axes
    if geom_type == _TYPES.mjGEOM_BOX:
        return size * _CORNERS, axes
    # MuJoCo's size is the half axes of an ellipsoid, else a radius and a half length.
    axes[:] = size if geom_type == _TYPES.mjGEOM_ELLIPSOID else size[0]
    if geom_type == _TYPES.mjGEOM_CYLINDER:
        axes[2] = 0.0
    is_long = geom_type in (_TYPES.mjGEOM_CAPSULE, _TYPES.mjGEOM_CYLINDER)
    return size[1] * _ENDS if is_long else np.zeros((1, 3)), axes


def _hull_vertices(mj_model: Any, mesh: int) -> Array:
    """Return the vertices (P, 3) of a mesh; of its convex hull where MuJoCo has computed one."""
    first = int(mj_model.mesh_vertadr[mesh])
    count = int(mj_model.mesh_vertnum[mesh])
    vertices = np.array(mj_model.mesh_vert[first : first + count], dtype=float)
    graph = int(mj_model.mesh_graphadr[mesh])
    if graph < 0:
        return vertices
    # For each mesh: P, F, P addresses, P vertex numbers, ...
    hull = int(mj_model.mesh_graph[graph])
    return vertices[mj_model.mesh_graph[graph + 2 + hull : graph + 2 + 2 * hull]]


class HalfSpaces:
    """Heights of the lowest points of bodies above the boundaries of half-spaces.

    Args:
        mj_model: compiled MuJoCo model.
        spaces: the K half-spaces, with the bodies that have to stay in each.

    Attributes:
        spaces: the half-spaces.
        solids: shapes of the B bodies that some half-space binds.
        normals: (K, 3) unit vectors in the world that point into the half-spaces.
        required: (B, K) height that each body has to keep [m]; minus infinity where a half-space
            does not bind the body. ``Clearance`` lowers it for bodies that are nearer in the start
            pose.
    """

    def __init__(self, mj_model: Any, spaces: Sequence[HalfSpace]) -> None:
        self.spaces = tuple(spaces)
        bodies = set[int]().union(*(space.bodies for space in spaces))
        self.solids = solids_of(mj_model, sorted(bodies))
        frames = [(solid.body, *solid.center, solid.bound) for solid in self.solids]
        table = np.array(frames).reshape(-1, 5)
        self._bodies = table[:, 0].astype(int)
        self._centers = table[:, 1:4]
        self._bounds = table[:, 4:]
        boundaries = np.array([(*space.normal, space.offset) for space in spaces])
        self.normals, offsets = np.split(boundaries.reshape(-1, 4), [3], axis=1)
        self._offsets = offsets[:, 0]
        self.required = np.full((len(self.solids), len(spaces)), -np.inf)
        for k, space in enumerate(spaces):
            self.required[np.isin(self._bodies, space.bodies), k] = space.clearance

    def heights(
        self, positions: Array, rotations: Array, margin: float = np.inf
    ) -> Iterator[tuple[int, NDArray[np.intp], Array, Array]]:
        """Yield per body its index in ``solids``, the indices (M,) of the postures in which it is
        near a boundary, its heights (M, K) [m] above all K boundaries in these postures, and
        its points (M, K, 3) in the world [m] that are nearest to the boundaries.

        A body that is near no boundary in any posture is left out.

        Args:
            positions: (N, nbody, 3) of the bodies in N postures, MuJoCo's xpos [m].
            rotations: (N, nbody, 9) of the bodies, MuJoCo's xmat.
            margin: a posture is left out where the ball around the body is higher than required
                above every boundary by more than this [m].
        """
        positions = positions[:, self._bodies]
        rotations = rotations[:, self._bodies].reshape(*positions.shape, 3)
        middle = positions + (rotations @ self._centers[:, :, None])[..., 0]
        least_height = middle @ self.normals.T - self._offsets - self._bounds
        is_near = np.any(least_height - self.required < margin, axis=2)
        for body in np.flatnonzero(np.any(is_near, axis=0)).tolist():
            postures = np.flatnonzero(is_near[:, body])
            turn = rotations[postures, body]
            directions = (-self.normals @ turn).reshape(-1, 3)
            corner = (
                self.solids[body].farthest(directions).reshape(len(postures), -1, 3)
            )
            lowest = positions[postures, body, None] + corner @ turn.transpose(0, 2, 1)
            heights = np.sum(lowest * self.normals, axis=2) - self._offsets
            yield body, postures, heights, lowest


def mounting_height(
    robot: RobotModel, start_pose: Array
) -> tuple[Array, float, list[int]] | None:
    """Return (up (3,), height of the ground along it [m], ids of the moving bodies above it).

    The height is the lowest of the origin of the body that carries the arm and of everything that
    is fixed to that body (its meshes where it has any, as collision geometry may be rough): the
    foot of a pedestal is on the ground. None without gravity, or where more of the arm than its
    first link is below that height: such an arm hangs, or stands at an edge.

    Args:
        robot: the arm.
        start_pose: (n,) joint positions in which the arm is looked at [rad or m].
    """
    model = robot.mj_model
    link_of_body = count_moving_joints(robot)
    down = np.array(model.opt.gravity, dtype=float)
    if not np.any(down):
        return None
    up = -down / np.linalg.norm(down)
    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = start_pose
    data = data_at_pose(model, qpos)
    # The parent of the first body that the arm moves.
    moving = np.flatnonzero(link_of_body)
    carrier = int(model.body_parentid[moving[0]])
    fixed = np.flatnonzero(model.body_weldid == model.body_weldid[carrier])
    is_mesh = model.geom_type == _TYPES.mjGEOM_MESH

    def lowest_points(bodies: Any) -> dict[int, float]:
        """Return a dict from each body that is no plane to the height of its lowest point [m]."""
        heights = {}
        for solid in solids_of(model, bodies.tolist()):
            turn = data.xmat[solid.body].reshape(3, 3)
            lowest = turn @ solid.farthest(-up[None] @ turn)[0]
            heights[solid.body] = float(up @ (data.xpos[solid.body] + lowest))
        return heights

    corners = []
    for geom in np.flatnonzero(np.isin(model.geom_bodyid, fixed) & is_mesh).tolist():
        vertices, _ = _shape(model, geom)
        turned = vertices @ data.geom_xmat[geom].reshape(3, 3).T
        corners.append(data.geom_xpos[geom] + turned)
    if corners:
        feet = [float(np.min(np.concatenate(corners) @ up))]
    else:
        feet = list(lowest_points(fixed).values())
    height = min(float(up @ data.xpos[carrier]), *feet, np.inf)
    above = []
    for body, body_height in lowest_points(moving).items():
        if body_height > height:
            above.append(body)
        elif link_of_body[body] > 1:
            return None
    return up, height, above


def unguarded_links(robot: RobotModel) -> tuple[str, ...]:
    """Return the names of the moving links without collision geometry, base to terminal.

    Geometry that the model's filters keep from meeting anything that moves against it is none.
    Parts of at most ``MARKER_MASS`` that are fixed to a link do not count, with or without geometry
    up to ``MARKER_SIZE``: they mark frames.
    """
    model = robot.mj_model
    # (nbody,) number of the link that a body is part of, from 1; 0 for what does not move.
    link_of_body = count_moving_joints(robot)
    # (n,) the body of each link that its joint moves; other parts are fixed to it.
    link_bodies = model.dof_bodyid[robot.dof_index]
    is_link_body = np.isin(range(model.nbody), link_bodies)
    is_part = model.body_mass > MARKER_MASS
    is_large = model.geom_rbound > MARKER_SIZE
    bodies = model.geom_bodyid
    is_shell = is_large | is_part[bodies] | is_link_body[bodies]
    link_of_geom = link_of_body[bodies]
    is_solid = is_shell & _can_meet(model, link_of_geom)
    moving_links = set(link_of_body[is_part].tolist()) - {0}
    unguarded = moving_links - set(link_of_geom[is_solid].tolist())
    return tuple(body_label(model, link_bodies[k - 1]) for k in sorted(unguarded))


def pass_filters(
    links: NDArray[np.int64], contype: NDArray[np.int64], conaffinity: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return whether two geoms (m, m) move against each other and pass MuJoCo's collision filter.

    They pass if a bit of one's ``contype`` is set in the other's ``conaffinity``.

    Args:
        links: (m,) number of the link of each geom; geoms with equal numbers do not move against
            each other.
        contype, conaffinity: (m,) bits of each geom.
    """
    passes = (contype[:, None] & conaffinity) != 0
    return (passes | passes.T) & (links[:, None] != links)


def _can_meet(mj_model: Any, links: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each geom (ngeom,) can meet a geom that moves against it.

    MuJoCo tests geoms that pass its filter and whose bodies are not excluded, and all explicit
    pairs. That it leaves out neighbours in the tree does not count here.

    Args:
        mj_model: compiled model.
        links: (ngeom,) number of each geom's link.
    """
    is_tested = pass_filters(links, mj_model.geom_contype, mj_model.geom_conaffinity)
    # The upper half of a signature is the first body's id.
    first_body = mj_model.exclude_signature >> 16
    second_body = mj_model.exclude_signature & 0xFFFF
    is_excluded = np.zeros((mj_model.nbody, mj_model.nbody), dtype=bool)
    is_excluded[first_body, second_body] = True
    bodies = mj_model.geom_bodyid
    is_tested &= ~(is_excluded | is_excluded.T)[np.ix_(bodies, bodies)]
    first = mj_model.pair_geom1
    second = mj_model.pair_geom2
    is_tested[first, second] = links[first] != links[second]
    return np.any(is_tested | is_tested.T, axis=1)


def unguarded_text(links: Sequence[str]) -> str:
    """Return in words that nothing keeps these links from touching anything; "" for none."""
    if not links:
        return ""
    return (
        f"nothing keeps {', '.join(links)} from touching anything: the model has no collision "
        "geometry of them that can meet any other"
    )


def has_floor(robot: RobotModel) -> bool:
    """Return whether the model has a level plane, or ground of any form, that the arm can touch."""
    model = robot.mj_model
    fixed = model.body_weldid[model.geom_bodyid] == 0
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    ground_types = (int(_TYPES.mjGEOM_PLANE), int(_TYPES.mjGEOM_HFIELD))
    is_ground = np.isin(model.geom_type, ground_types)
    return bool(np.any(fixed & solid & is_ground))


def outermost_points(robot: RobotModel) -> tuple[Array, Array]:
    """Return corners (P, 3) of the terminal link and all it carries, in the terminal body's frame
    [m], and the radius (P,) of a ball about each [m].

    All of the link is within the convex hull of these balls.
    """
    data = data_at_pose(robot.mj_model, robot.reference_qpos)
    turns = data.xmat.reshape(-1, 3, 3)
    body = robot.body_id
    points = [np.zeros((0, 3))]
    radius = [np.zeros(0)]
    for solid in solids_of(robot.mj_model, subtree(robot.mj_model, body)):
        corners = data.xpos[solid.body] + solid.points @ turns[solid.body].T
        points.append((corners - data.xpos[body]) @ turns[body])
        radius.append(solid.radius)
    all_points = np.vstack(points)
    all_radius = np.concatenate(radius)
    on_hull = _on_the_hull(all_points, all_radius)
    return all_points[on_hull], all_radius[on_hull]


def _on_the_hull(points: Array, radius: Array) -> Any:
    """Return the indices, ascending, of points (P, 3) that have a radius (P,) above zero or are
    corners of the convex hull of those without one; all indices where at most ``_HULL_POINTS`` are
    without one, or all of these lie in a plane.
    """
    sharp = np.flatnonzero(radius == 0.0)
    if len(sharp) <= _HULL_POINTS:
        return np.arange(len(points))
    from scipy.spatial import ConvexHull, QhullError

    try:
        outer = sharp[ConvexHull(points[sharp]).vertices]
    except QhullError:  # All in one plane.
        return np.arange(len(points))
    return np.sort(np.concatenate((outer, np.flatnonzero(radius > 0.0))))

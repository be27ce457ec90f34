"""How far the convex shapes of bodies reach, in any direction or beyond forbidden planes.

A body is a set of balls: the corners of its boxes and meshes with radius zero, both ends of its
capsules, spheres. Cylinders and ellipsoids are polyhedra about them, at most 2 % larger. The
farthest point along a direction is then that of the farthest ball. MuJoCo tells distances between
geoms, but not from planes that are no part of a model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.model.bodies import count_moving_joints
from robot_sysid.model.stated import GROUND_TYPES
from robot_sysid.records import Array, HalfSpace, RobotModel
from robot_sysid.wording import option_name

# MuJoCo's types of geoms.
_TYPES = mujoco.mjtGeom
# Corners (8, 3) of a cube with half sides of one.
_CORNERS = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
# Ends (2, 3) of a capsule's or cylinder's axis with a half length of one.
_ENDS = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
# Number of sides of the polygon about a circle.
_SIDES = 24
_ANGLES = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
# Corners (P, 2) of the regular polygon about the unit circle that stands for it.
_RING = np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES))) / np.cos(np.pi / _SIDES)
# Corners (P, 3) of the polyhedron that stands for a ball: turned polygons.
_GLOBE = np.vstack(
    [np.column_stack((across * _RING, np.full(_SIDES, up))) for up, across in _RING]
)


@dataclass(frozen=True)
class Solid:
    """The shape of one body: all that is drawn of it or collides; without any geom, its origin.

    Attributes:
        body: MuJoCo id of the body.
        points: (P, 3) middles of balls, in the body's frame [m].
        radius: (P,) of these balls [m].
    """

    body: int
    points: Array
    radius: Array

    def farthest(self, directions: Array) -> Array:
        """Return the points (K, 3) [m] farthest along unit directions (K, 3), both in the body's
        frame.
        """
        best = np.argmax(directions @ self.points.T + self.radius, axis=1)
        return self.points[best] + self.radius[best, None] * directions

    def lowest(self, positions: Array, rotations: Array, up: Array) -> Array:
        """Return the lowest points (N, 3) of the body in N postures, in the world [m].

        Args:
            positions: (N, nbody, 3) of all bodies, MuJoCo's xpos [m].
            rotations: (N, nbody, 9) of all bodies, MuJoCo's xmat.
            up: (3,) unit vector in the world.
        """
        turns = rotations[:, self.body].reshape(-1, 3, 3)
        corner = self.farthest(-up @ turns)
        return positions[:, self.body] + np.einsum("nab,nb->na", turns, corner)

    def height(self, data: Any, up: Array) -> float:
        """Return the height of the body's lowest point along a unit vector (3,) [m], in
        MuJoCo's ``data``.
        """
        return self.lowest(data.xpos[None], data.xmat[None], up)[0] @ up


def solids_of(
    mj_model: Any, bodies: Iterable[int], geoms: NDArray[np.bool_] | bool = True
) -> list[Solid]:
    """Return the shapes of bodies, given by MuJoCo ids, without those that are planes alone.

    ``geoms`` (ngeom,) says which geoms count.
    """
    solids = [_solid(mj_model, body, geoms) for body in bodies]
    return [solid for solid in solids if len(solid.points)]


def _solid(mj_model: Any, body: int, counts: NDArray[np.bool_] | bool) -> Solid:
    """Return the shape of a body by the geoms that count; it has no points where it is a plane."""
    geoms = np.flatnonzero((mj_model.geom_bodyid == body) & counts)
    if not len(geoms):
        return Solid(body, np.zeros((1, 3)), np.zeros(1))
    points = []
    radius = []
    for geom in geoms.tolist():
        corners, size = _shape(mj_model, geom)
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, mj_model.geom_quat[geom])
        points.append(mj_model.geom_pos[geom] + corners @ matrix.reshape(3, 3).T)
        radius.append(np.full(len(corners), size))
    return Solid(body, np.concatenate(points), np.concatenate(radius))


def _shape(mj_model: Any, geom: int) -> tuple[Array, float]:
    """Return points (P, 3) of a geom in its own frame, and the radius of the ball about each [m].

    P is 0 for a plane.
    """
    geom_type = int(mj_model.geom_type[geom])
    size = mj_model.geom_size[geom]
    if geom_type == _TYPES.mjGEOM_PLANE:
        return np.zeros((0, 3)), 0.0
    if geom_type in (_TYPES.mjGEOM_MESH, _TYPES.mjGEOM_SDF):
        mesh = mj_model.geom_dataid[geom]
        first = mj_model.mesh_vertadr[mesh]
        count = mj_model.mesh_vertnum[mesh]
        return _hull(mj_model.mesh_vert[first : first + count].astype(float)), 0.0
    if geom_type == _TYPES.mjGEOM_BOX:
        return size * _CORNERS, 0.0
    if geom_type == _TYPES.mjGEOM_ELLIPSOID:
        return size * _GLOBE, 0.0
    # MuJoCo's size is a radius and a half length.
    if geom_type == _TYPES.mjGEOM_CYLINDER:
        rims = [
            np.column_stack((size[0] * _RING, [z] * _SIDES))
            for z in (-size[1], size[1])
        ]
        return np.vstack(rims), 0.0
    is_long = geom_type == _TYPES.mjGEOM_CAPSULE
    return size[1] * _ENDS if is_long else np.zeros((1, 3)), float(size[0])


def mounting_plane(robot: RobotModel, start_pose: Array) -> HalfSpace | None:
    """Return the space above the ground that the arm is mounted on, for the moving bodies above it.

    The ground's height is the lowest of the origin of the body that carries the arm and of
    everything that is fixed to that body (its meshes where it has any, as collision geometry may be
    rough): the foot of a pedestal is on the ground. None without gravity, where the model has a
    level plane, or ground of any form, that the arm can touch, or where more of the arm than its
    first link is below that height: such an arm hangs, or stands at an edge.

    Args:
        robot: the arm.
        start_pose: (n,) joint positions in which the arm is looked at [rad or m].
    """
    model = robot.mj_model
    link_of_body = count_moving_joints(robot)
    down = np.array(model.opt.gravity, dtype=float)
    is_static = model.body_weldid[model.geom_bodyid] == 0
    is_solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    is_ground = np.isin(model.geom_type, GROUND_TYPES)
    if np.any(is_static & is_solid & is_ground) or not np.any(down):
        return None
    up = -down / np.linalg.norm(down)
    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = start_pose
    data = data_at_pose(model, qpos)
    # The parent of the first body that the arm moves.
    moving = np.flatnonzero(link_of_body)
    carrier = model.body_parentid[moving[0]]
    is_fixed = model.body_weldid[model.geom_bodyid] == model.body_weldid[carrier]
    is_mesh = is_fixed & (model.geom_type == _TYPES.mjGEOM_MESH)
    counts = is_mesh if np.any(is_mesh) else is_fixed
    grounded = solids_of(model, np.unique(model.geom_bodyid[counts]), counts)
    heights = [solid.height(data, up) for solid in grounded]
    height = min([up @ data.xpos[carrier], *heights])
    above = []
    for solid in solids_of(model, moving):
        if solid.height(data, up) > height:
            above.append(solid.body)
        elif link_of_body[solid.body] > 1:
            return None
    # Adding zero turns -0.0 into 0.0.
    lifts = option_name("below_base")
    label = f"the plane that the arm is mounted on, at {height + 0.0:.3g} m ({lifts} lifts it)"
    return HalfSpace(up, height, clearance=0.0, bodies=tuple(above), label=label)


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


def tool_corners(robot: RobotModel) -> Array:
    """Return the corners (8, 3) of a box about the terminal link and all it carries, along the axes
    of the terminal body's frame, in that frame [m]; the frame's origin is in the box.
    """
    model = robot.mj_model
    data = data_at_pose(model, robot.reference_qpos)
    body = robot.body_id
    axes = data.xmat[body].reshape(3, 3).T
    solids = solids_of(model, subtree(model, body))
    extents = []
    for direction in (*axes, *-axes):
        origin = data.xpos[body] @ direction
        # How far below the frame's origin the shapes reach.
        depths = [origin - solid.height(data, direction) for solid in solids]
        extents.append(max([0.0, *depths]))
    lower, upper = np.array(extents).reshape(2, 3) * [[-1.0], [1.0]]
    return 0.5 * (lower + upper + (upper - lower) * _CORNERS)


def _hull(points: Array) -> Array:
    """Return those of points (P, 3) that are corners of their convex hull; all in one plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[np.sort(ConvexHull(points).vertices)]
    except QhullError:
        return points

"""Distances of bodies from planes that are no part of a model, by MuJoCo: walls, ground, boxes.

They are planes of a compiled copy, in which each body floats by itself, with all that is drawn of
it or collides. A plane meets boxes and meshes where it meets their convex hull, so that these are
one mesh per body. MuJoCo's distances of all shapes from planes are exact, negative ones too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.mjcf.inertial import format_numbers
from robot_sysid.model.bodies import update_contacts
from robot_sysid.model.stated import GROUND_TYPES
from robot_sysid.records import Array, RobotModel

# MuJoCo's types of geoms.
_TYPES = mujoco.mjtGeom
# Names of round shapes in MJCF, and how many numbers of a geom's size belong to them.
_ROUND = {
    int(_TYPES.mjGEOM_SPHERE): ("sphere", 1),
    int(_TYPES.mjGEOM_CAPSULE): ("capsule", 2),
    int(_TYPES.mjGEOM_ELLIPSOID): ("ellipsoid", 3),
    int(_TYPES.mjGEOM_CYLINDER): ("cylinder", 2),
}
# Corners (8, 3) of a cube with half sides of one.
_CUBE = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
CORE_SIZE = 1e-5
"""How far a body's mesh reaches at least to all sides of its middle [m], as MuJoCo compiles no mesh
without a volume, such as a flat drawing; a hundredth of what is ever said of a distance."""
_CORE = CORE_SIZE * np.vstack((np.eye(3), -np.eye(3)))
# Memory that MuJoCo works with besides contacts; of a plane and a geom these are four at most, each
# of 600 bytes or less. It would leave out those that it has no memory for.
_LEAST_BYTES = 2**24
_PAIR_BYTES = 4 * 600


class NearPlanes(NamedTuple):
    """C points where bodies are near planes.

    Attributes:
        plane: (C,) index of the plane.
        body: (C,) MuJoCo id of the body.
        distance: (C,) of the point of the body from the plane [m]; negative beyond it.
        point: (C, 3) in the world, half way to the plane [m].
    """

    plane: NDArray[np.int64]
    body: NDArray[np.int64]
    distance: Array
    point: Array


_NOWHERE = NearPlanes(
    np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, 3))
)


class Planes:
    """Planes, and bodies whose distances from them are asked.

    Args:
        mj_model: the model.
        bodies: MuJoCo ids of these bodies; those that are planes alone are left out. A body without
            any geom is its origin.
        planes: of each its normal (3,), a unit vector in the world, and its offset from the world's
            origin along it [m]. Distances are positive on the normal's side.
        margin: distance up to which a body is near a plane [m].
        is_part: (ngeom,) which geoms count.

    Attributes:
        bodies: (B,) MuJoCo ids of the bodies with a shape.
        count: number of planes.
    """

    def __init__(
        self,
        mj_model: Any,
        bodies: Sequence[int] | NDArray[np.int64],
        planes: Sequence[tuple[Array, float]],
        margin: float = 0.0,
        is_part: NDArray[np.bool_] | bool = True,
    ) -> None:
        shapes = {}
        for body in np.unique(bodies).tolist():
            geoms = np.flatnonzero((mj_model.geom_bodyid == body) & is_part)
            is_solid = ~np.isin(mj_model.geom_type[geoms], GROUND_TYPES)
            if np.any(is_solid) or not len(geoms):
                shapes[body] = _shape(mj_model, body, geoms[is_solid].tolist())
        self.bodies = np.array(list(shapes), dtype=np.int64)
        self.count = len(planes)
        # Body k + 1 of the copy is body k of the model; those that are not asked for have no shape.
        in_order = [shapes.get(body, _NOTHING) for body in range(mj_model.nbody)]
        self._model = mujoco.MjModel.from_xml_string(_scene(in_order, planes, margin))
        self._data = mujoco.MjData(self._model)
        self._owners = self._model.geom_bodyid - 1
        # Position and quaternion of each floating body.
        self._poses = self._data.qpos.reshape(-1, 7)

    def near(self, data: Any) -> NearPlanes:
        """Return where bodies are near planes, in the posture that the model's ``data`` has.

        A body and a plane may be near each other at several points.
        """
        self._poses[:, :3] = data.xpos
        self._poses[:, 3:] = data.xquat
        update_contacts(self._model, self._data)
        # Mostly there is nothing: to ask MuJoCo for its arrays takes as long as to find that.
        if not self._data.ncon:
            return _NOWHERE
        contact = self._data.contact
        geoms = np.array(contact.geom)
        bodies = self._owners[geoms[:, 1]]
        distance = np.array(contact.dist)
        return NearPlanes(geoms[:, 0], bodies, distance, np.array(contact.pos))

    def depths(self, data: Any) -> Array:
        """Return how far each body reaches beyond each plane (planes, B) [m], at least 0."""
        near = self.near(data)
        depths = np.zeros((self.count, len(self.bodies)))
        at = near.plane, np.searchsorted(self.bodies, near.body)
        np.maximum.at(depths, at, -near.distance)
        return depths


def tool_corners(robot: RobotModel) -> Array:
    """Return the corners (8, 3) of a box about the terminal link and all it carries, along the axes
    of the terminal body's frame, in that frame [m]; the frame's origin is in the box.
    """
    model = robot.mj_model
    data = data_at_pose(model, robot.reference_qpos)
    body = robot.body_id
    origin = data.xpos[body]
    axes = data.xmat[body].reshape(3, 3).T
    # Planes through the origin: how far the tool reaches beyond them is where the box ends.
    planes = [(normal, normal @ origin) for normal in (*axes, *-axes)]
    depths = Planes(model, subtree(model, body), planes).depths(data)
    extents = np.max(depths, axis=1, initial=0.0).reshape(2, 3)
    lower, upper = extents * [[-1.0], [1.0]]
    return 0.5 * (lower + upper + (upper - lower) * _CUBE)


class _Shape(NamedTuple):
    """Shape of a body in its own frame, as elements of MJCF: its geoms, and the mesh of one."""

    geoms: list[str]
    mesh: str = ""


_NOTHING = _Shape([])


def _shape(mj_model: Any, body: int, geoms: Sequence[int]) -> _Shape:
    """Return the shape of a body by geoms, given by their ids; its origin where there are none.

    All corners of boxes and meshes are one mesh, called by the id of the body.
    """
    parts = [] if geoms else [np.zeros((1, 3))]
    texts = []
    for geom in geoms:
        position = mj_model.geom_pos[geom]
        quaternion = mj_model.geom_quat[geom]
        size = mj_model.geom_size[geom]
        geom_type = int(mj_model.geom_type[geom])
        if geom_type in _ROUND:
            name, count = _ROUND[geom_type]
            texts.append(
                f'<geom type="{name}" size="{format_numbers(size[:count])}" '
                f'pos="{format_numbers(position)}" quat="{format_numbers(quaternion)}"/>'
            )
            continue
        corners = size * _CUBE
        if geom_type != _TYPES.mjGEOM_BOX:
            mesh = mj_model.geom_dataid[geom]
            first = mj_model.mesh_vertadr[mesh]
            count = mj_model.mesh_vertnum[mesh]
            corners = mj_model.mesh_vert[first : first + count].astype(float)
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, quaternion)
        parts.append(position + corners @ axes.reshape(3, 3).T)
    if not parts:
        return _Shape(texts)
    vertices = format_numbers(_hull(np.concatenate(parts)).ravel())
    texts.append(f'<geom type="mesh" mesh="{body}"/>')
    return _Shape(texts, f'<mesh name="{body}" vertex="{vertices}"/>')


def _hull(points: Array) -> Array:
    """Return the corners of the convex hull of points (P, 3), and of a small core about their mean
    that gives it a volume.
    """
    from scipy.spatial import ConvexHull

    points = np.vstack((points, np.mean(points, axis=0) + _CORE))
    return points[np.sort(ConvexHull(points).vertices)]


def _scene(
    shapes: Sequence[_Shape], planes: Sequence[tuple[Array, float]], margin: float
) -> str:
    """Return the MJCF of planes, the first geoms, and of shapes, each a floating body."""
    walls = [
        f'<geom type="plane" size="1 1 1" pos="{format_numbers(offset * normal)}" '
        f'zaxis="{format_numbers(normal)}" margin="{margin}" contype="2" conaffinity="1"/>'
        for normal, offset in planes
    ]
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    bodies = [
        f"<body><freejoint/>{inertial}{''.join(shape.geoms)}</body>" for shape in shapes
    ]
    meshes = [shape.mesh for shape in shapes]
    pairs = len(planes) * sum(len(shape.geoms) for shape in shapes)
    # Shapes meet planes, and no other shape.
    return (
        f'<mujoco><size memory="{_LEAST_BYTES + _PAIR_BYTES * pairs}"/>'
        '<default><geom contype="1" conaffinity="2"/></default>'
        f"<asset>{''.join(meshes)}</asset>"
        f"<worldbody>{''.join(walls + bodies)}</worldbody></mujoco>"
    )

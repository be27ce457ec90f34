"""Distances of bodies from planes, against the support functions of their shapes."""

import mujoco
import numpy as np
from hypothesis import given
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms.excitation_arms import robot
from rigs.arms.small_arms import SEEDS, X, Z, compile_xml, hinge, link, world
from robot_sysid.motion.planes import Planes, tool_corners

POINTS = default_rng(3).normal(size=(30, 3)) * [0.05, 0.2, 0.3]
CUBE = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
# How far a shape of three sizes reaches from its middle along a unit vector in its own axes.
REACH = {
    "sphere": lambda size, u: size[0],
    "capsule": lambda size, u: size[0] + size[1] * abs(u[2]),
    "ellipsoid": lambda size, u: np.linalg.norm(size * u),
    "cylinder": lambda size, u: size[0] * np.hypot(u[0], u[1]) + size[1] * abs(u[2]),
    "box": lambda size, u: np.max(size * CUBE @ u),
}
FAR = 10.0


def text(numbers):
    return " ".join(map(repr, np.ravel(numbers).tolist()))


def geom(shape, size, pose, attributes=""):
    """Return a geom of MJCF; ``pose`` (7,) is its position and quaternion."""
    size = f'size="{text(size)}"'
    kind = 'mesh="m"' if shape == "mesh" else size
    place = f'pos="{text(pose[:3])}" quat="{text(pose[3:])}"'
    return f'<geom type="{shape}" {kind} {place} {attributes}/>'


def random_pose(rng):
    quaternion = rng.normal(size=4)
    return np.append(rng.uniform(-1.0, 1.0, 3), quaternion / np.linalg.norm(quaternion))


def mesh(points):
    return f'<asset><mesh name="m" vertex="{text(points)}"/></asset>'


def model_of(content, asset=""):
    """Return the compiled model of a world's content, and its data with all frames."""
    model = compile_xml(f"<mujoco>{asset}<worldbody>{content}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def least(planes, data):
    """Return the distance (planes, B) of each body from each plane."""
    near = planes.near(data)
    distances = np.full((planes.count, len(planes.bodies)), FAR)
    at = near.plane, np.searchsorted(planes.bodies, near.body)
    np.minimum.at(distances, at, near.distance)
    return distances


@given(SEEDS)
def test_the_distance_from_a_plane_is_that_of_the_extreme_point_of_the_body(seed):
    """Of any shape in any pose, and beyond the plane too, where the distance is negative."""
    rng = default_rng(seed)
    size = rng.uniform(0.01, 0.5, 3)
    shapes = [*REACH, "mesh"]
    geoms = [geom(shape, size, random_pose(rng)) for shape in shapes]
    bodies = "".join(f"<body>{shape}</body>" for shape in geoms)
    # One body has all shapes.
    bodies += f"<body>{''.join(geoms)}</body>"
    model, data = model_of(bodies, mesh(POINTS))
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    offset = rng.uniform(-2.0, 2.0)
    reaches = [
        reach(size, data.geom_xmat[k].reshape(3, 3).T @ normal)
        for k, reach in enumerate(REACH.values())
    ]
    exact = data.geom_xpos[: len(REACH)] @ normal - reaches
    number = len(REACH)
    count = model.mesh_vertnum[0]
    vertices = model.mesh_vert[:count] @ data.geom_xmat[number].reshape(3, 3).T
    exact = np.append(exact, np.min((vertices + data.geom_xpos[number]) @ normal))
    exact = np.append(exact, np.min(exact)) - offset
    planes = Planes(model, range(1, model.nbody), [(normal, offset)], margin=FAR)
    assert_allclose(least(planes, data)[0], exact, rtol=0.0, atol=2e-5)
    assert_allclose(
        planes.depths(data)[0], np.maximum(0.0, -exact), rtol=0.0, atol=2e-5
    )


def test_the_deepest_corner_of_a_box_is_found_where_others_are_level():
    """Of boxes on an edge or a corner MuJoCo takes four corners, which need not be the lowest."""
    sizes = ("1 1 1", "1 1 2", "2 1 1")
    bodies = [f'<body><geom type="box" size="{size}"/></body>' for size in sizes]
    model, data = model_of("".join(bodies))
    directions = np.indices((5, 5, 5)).reshape(3, -1).T - 2.0
    normals = directions[np.any(directions != 0.0, axis=1)]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    planes = Planes(model, (1, 2, 3), [(normal, 0.0) for normal in normals], FAR)
    exact = -np.abs(normals) @ model.geom_size.T
    assert_allclose(least(planes, data), exact, rtol=0.0, atol=1e-6)


def test_a_body_is_all_its_geoms_or_its_origin():
    """Geoms that are only drawn count; a flat mesh has a shape, a plane has none."""
    flat = '<geom type="box" size=".2 .3 1e-9"/>'
    model, data = model_of(
        '<body><geom size=".1"/><geom size=".2" contype="0" conaffinity="0"/></body>'
        '<body><geom size=".3" contype="0" conaffinity="0"/></body>'
        '<body pos="0 0 7"/><body><geom type="plane" size="1 1 1"/></body>'
        f"<body>{flat}</body>"
    )
    planes = Planes(model, range(1, 6), [(-normal, 0.0) for normal in np.eye(3)])
    assert planes.bodies.tolist() == [1, 2, 3, 5]
    exact = [(0.2, 0.3, 0.0, 0.2), (0.2, 0.3, 0.0, 0.3), (0.2, 0.3, 7.0, 0.0)]
    assert_allclose(planes.depths(data), exact, atol=2e-5)


def test_as_many_planes_as_are_asked_for_are_all_met():
    """MuJoCo leaves out contacts that it has no memory for."""
    balls = "".join(f'<body pos="{k} 0 0"><geom size=".1"/></body>' for k in range(40))
    model, data = model_of(balls)
    offsets = np.linspace(-1.0, 1.0, 200)
    planes = Planes(model, range(1, 41), [(np.eye(3)[2], at) for at in offsets], FAR)
    exact = np.tile(-0.1 - offsets[:, None], 40)
    assert_allclose(least(planes, data), exact, atol=1e-9)


def test_the_box_of_the_tool_includes_bodies_fixed_to_the_last_one():
    """The corners are in the last body's frame."""
    tool = '<body name="tool" pos="0 0 .1" quat="1 0 1 0"><geom type="box" size=".1 .2 .3"/></body>'
    tip = link(
        hinge("roll", X),
        '<geom size=".05" pos="0 0 -.1"/>' + tool,
        "tip",
        quat="0 1 1 0",
    )
    corners = tool_corners(robot(world(link(hinge("yaw", Z), tip, "base"))))
    # A quarter turn about y: the tool's z is the tip's x.
    assert_allclose(np.max(corners, axis=0), [0.3, 0.2, 0.2], atol=1e-12)
    assert_allclose(np.min(corners, axis=0), [-0.3, -0.2, -0.15], atol=1e-12)
    assert len({tuple(corner) for corner in corners.tolist()}) == 8

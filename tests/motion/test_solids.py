"""Shapes of bodies, half-spaces and swept boxes, against points of their surfaces."""

from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms import SEEDS, X, Z, compile_xml, hinge, link, world
from rigs.excitation_arms import robot
from robot_sysid.motion.solids import solids_of, tool_corners, unguarded_links

SIZE = np.array([0.3, 0.2, 0.5])
SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
MESH = '<asset><mesh name="m" vertex="0 0 0 .2 0 0 0 .3 0 0 0 .4 .01 .01 .01"/></asset>'


def inside(shape, p):
    """Return points of a geom of size SIZE, made from points p (N, 3) of a cube."""
    ball = p / np.maximum(1.0, np.linalg.norm(p, axis=1))[:, None]
    disc = p[:, :2] / np.maximum(1.0, np.linalg.norm(p[:, :2], axis=1))[:, None]
    return {
        "sphere": SIZE[0] * ball,
        "ellipsoid": SIZE * ball,
        "capsule": SIZE[0] * ball + np.outer(np.sign(p[:, 0]), [0.0, 0.0, SIZE[1]]),
        "cylinder": np.column_stack((SIZE[0] * disc, SIZE[1] * p[:, 2])),
        "box": SIZE * p,
    }[shape]


@cache
def all_shapes():
    """Return MuJoCo data and the Solids of one body per shape, each turned and shifted."""
    geom = '<body><geom type="{}" size=".3 .2 .5" pos=".1 .2 {}" quat="1 .5 {} .2"/></body>'
    content = "".join(map(geom.format, SHAPES, range(5), range(5)))
    model = compile_xml(f"<mujoco><worldbody>{content}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data, solids_of(model, range(1, model.nbody))


@given(SEEDS)
def test_a_solid_contains_its_shape_and_hardly_more(seed):
    """No point of the shape is farther along a direction, and none is 2 % nearer."""
    data, solids = all_shapes()
    rng = default_rng(seed)
    direction = rng.normal(size=(1, 3))
    direction /= np.linalg.norm(direction)
    for geom, (shape, solid) in enumerate(zip(SHAPES, solids)):
        position = data.geom_xpos[geom]
        rotation = data.geom_xmat[geom].reshape(3, 3)
        local = inside(shape, rng.uniform(-1.0, 1.0, size=(400, 3)))
        along = (position + local @ rotation.T) @ direction[0]
        (farthest,) = solid.farthest(direction)
        assert np.max(along) <= direction[0] @ farthest + 1e-12
        x, y, z = (farthest - position) @ rotation
        distances = {
            "sphere": np.linalg.norm((x, y, z)) - 0.3,
            "capsule": np.linalg.norm((x, y, z - np.clip(z, -0.2, 0.2))) - 0.3,
            "ellipsoid": (np.linalg.norm((x, y, z) / SIZE) - 1.0) / 2.0,
            "cylinder": max(np.hypot(x, y) - 0.3, abs(abs(z) - 0.2)),
            "box": np.max(np.abs(np.abs((x, y, z)) - SIZE)),
        }
        larger = 0.0087 if shape in ("ellipsoid", "cylinder") else 0.0
        assert 0.0 <= distances[shape] + 1e-12 <= larger + 2e-12


def test_a_solid_is_all_geoms_or_the_origin():
    model = compile_xml(
        f'<mujoco>{MESH}<worldbody><body><geom size=".1"/><geom size=".2" contype="0" '
        'conaffinity="0"/></body><body><geom size=".3" contype="0" conaffinity="0"/></body>'
        '<body pos="0 0 7"/><body><geom type="plane" size="1 1 1"/></body>'
        '<body><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    solids = solids_of(model, range(1, 6))
    assert [solid.body for solid in solids] == [1, 2, 3, 5]
    reach = [np.diag(solid.farthest(np.eye(3))) for solid in solids]
    assert_allclose(reach[:3], np.outer([0.2, 0.3, 0.0], np.ones(3)), atol=1e-12)
    assert_allclose(reach[3], (0.2, 0.3, 0.4), atol=1e-7)


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


SHELL = '<geom size=".03" pos="0 0 .1"/>'
PART = '<body><geom size=".03" mass=".1"/></body>'
ONE_SIDED = '<geom size=".03" pos="0 0 .1" contype="1" conaffinity="0"/>'
DRAWN = '<geom size=".03" contype="0" conaffinity="0"/>'


@pytest.mark.parametrize(
    ("shells", "names"),
    [
        ((SHELL, "", SHELL), ("link1",)),
        ((DRAWN, PART, SHELL), ("link0",)),
        ((SHELL, "", ""), ("link0", "link1", "link2")),
        ((ONE_SIDED, ONE_SIDED, ""), ("link0", "link1", "link2")),
    ],
)
def test_links_that_nothing_keeps_from_a_contact_are_named(shells, names):
    """Geometry that is only drawn, or can meet nothing, is none."""
    content = ""
    for index, shell in reversed(list(enumerate(shells))):
        joint = hinge(f"joint{index}", (Z, X, Z)[index])
        content = link(joint, shell + content, f"link{index}")
    assert unguarded_links(robot(world(content))) == names

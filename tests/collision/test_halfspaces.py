"""Extreme points of geoms, and the half-spaces they are tested against."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.collision.halfspaces import (
    GeomShape,
    box_half_spaces,
    geom_shapes,
    plane_half_space,
)
from robot_sysid.collision.obstacles import Box, Plane
from tests.support.arms import SEEDS, compile_xml

KINDS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}
SIZE = np.array([0.3, 0.2, 0.5])


def points_inside(kind, rng, count=400):
    """Random points of a geom, its boundary included."""
    p = rng.uniform(-1.0, 1.0, size=(count, 3))
    ball = p / np.maximum(1.0, np.linalg.norm(p, axis=1))[:, None]
    round_xy = p[:, :2] / np.maximum(1.0, np.linalg.norm(p[:, :2], axis=1))[:, None]
    if kind == "sphere":
        return SIZE[0] * ball
    if kind == "ellipsoid":
        return SIZE * ball
    if kind == "capsule":
        return SIZE[0] * ball + np.outer(rng.uniform(-1, 1, count), [0.0, 0.0, SIZE[1]])
    if kind == "cylinder":
        return np.column_stack((SIZE[0] * round_xy, SIZE[1] * p[:, 2]))
    return SIZE * p


@given(st.sampled_from(sorted(KINDS)), SEEDS)
def test_no_point_of_a_shape_is_farther_than_its_extreme_point(kind, seed):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    shape = GeomShape(0, 1, int(KINDS[kind]), SIZE, np.zeros((0, 3)))
    farthest = shape.extreme_point(direction)
    assert np.max(points_inside(kind, rng) @ direction) <= farthest @ direction + 1e-12


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("sphere", 0.3), ("capsule", 0.5), ("ellipsoid", 0.5), ("cylinder", 0.2), ("box", 0.5)],
)
def test_extent_along_the_axis_is_exact(kind, expected):
    shape = GeomShape(0, 1, int(KINDS[kind]), SIZE, np.zeros((0, 3)))
    assert shape.extreme_point(np.array([0.0, 0.0, 1.0]))[2] == pytest.approx(expected, abs=1e-15)


def test_a_mesh_is_as_wide_as_its_vertices():
    model = compile_xml(
        '<mujoco><asset><mesh name="m" vertex="0 0 0 .2 0 0 0 .3 0 0 0 .4 .01 .01 .01"/></asset>'
        '<worldbody><body><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    (shape,) = geom_shapes(model, [1])
    rotation = data.geom_xmat[0].reshape(3, 3)
    for axis, width in enumerate((0.2, 0.3, 0.4)):
        direction = np.eye(3)[axis]
        point = data.geom_xpos[0] + rotation @ shape.extreme_point(rotation.T @ direction)
        assert point[axis] == pytest.approx(width, abs=1e-7)


def test_a_body_is_its_collision_geoms_else_its_visuals_else_its_origin():
    model = compile_xml(
        '<mujoco><worldbody><body><geom size=".1"/><geom size=".2" contype="0" conaffinity="0"/>'
        '</body><body><geom size=".3" contype="0" conaffinity="0"/></body><body/></worldbody>'
        "</mujoco>"
    )
    shapes = geom_shapes(model, [1, 2, 3])
    assert [float(shape.size[0]) for shape in shapes] == [0.1, 0.3, 0.0]
    assert [shape.geom for shape in shapes] == [0, 2, -1]


def test_a_box_has_one_half_space_per_finite_side():
    box = Box((-1.0, -np.inf, 0.1), (np.inf, 2.0, 3.0))
    spaces = box_half_spaces(box, [4])
    inside, outside = np.array([0.0, 0.0, 1.0]), np.array([-2.0, 3.0, 0.0])
    assert len(spaces) == 4
    assert all(space.normal @ inside > space.offset for space in spaces)
    assert sum(space.normal @ outside < space.offset for space in spaces) == 3


def test_a_plane_keeps_its_distance_whatever_the_length_of_its_normal():
    space = plane_half_space(Plane((0.0, 0.0, 2.0), 0.5), 0.01, [1])
    assert np.array_equal(space.normal, [0.0, 0.0, 1.0])
    assert space.offset == 0.25
    assert "0.25 m" in space.label

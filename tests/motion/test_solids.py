"""Shapes of bodies, half-spaces and swept boxes, against their points."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given

from robot_sysid.motion.options import LimitOptions
from robot_sysid.motion.solids import HalfSpaces, Solids, outermost_points, swept_space
from tests.support.arms import SEEDS, X, Y, Z, compile_xml, hinge, link, world
from tests.support.excitation_arms import FLOOR, robot, tube_arm

SIZE = np.array([0.3, 0.2, 0.5])
KINDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
MESH = '<asset><mesh name="m" vertex="0 0 0 .2 0 0 0 .3 0 0 0 .4 .01 .01 .01"/></asset>'


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


@cache
def all_kinds():
    """Model and data of one body per kind, each turned and moved its own way."""
    content = "".join(
        f'<body pos="0 {k} .2" quat="1 {0.3 * k} .2 -.4"><geom type="{kind}" size=".3 .2 .5" '
        'pos=".1 .2 .3" quat="1 .5 0 .2"/></body>'
        for k, kind in enumerate(KINDS)
    )
    model = compile_xml(f"<mujoco><worldbody>{content}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data, Solids(model, range(1, model.nbody))


@given(SEEDS)
def test_no_point_of_a_shape_is_farther_than_its_extreme_point(seed):
    _, data, solids = all_kinds()
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(4, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for geom, kind in enumerate(KINDS):
        inside = points_inside(kind, rng) @ data.geom_xmat[geom].reshape(3, 3).T
        inside += data.geom_xpos[geom]
        reach = np.sum(solids.extremes(data, geom, directions) * directions, axis=1)
        assert np.all(np.max(inside @ directions.T, axis=0) <= reach + 1e-12)


@given(SEEDS)
def test_an_extreme_point_belongs_to_its_shape(seed):
    _, _, solids = all_kinds()
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    local = [shape.extremes(direction[None])[0] for shape in solids.shapes]
    sphere, capsule, ellipsoid, cylinder, box = local
    assert np.linalg.norm(sphere) == pytest.approx(0.3, abs=1e-12)
    from_axis = capsule - np.clip(capsule[2], -0.2, 0.2) * np.eye(3)[2]
    assert np.linalg.norm(from_axis) == pytest.approx(0.3, abs=1e-12)
    assert np.linalg.norm(ellipsoid / SIZE) == pytest.approx(1.0, abs=1e-12)
    assert np.hypot(*cylinder[:2]) == pytest.approx(0.3, abs=1e-12)
    assert abs(cylinder[2]) == pytest.approx(0.2, abs=1e-12)
    assert np.allclose(np.abs(box), SIZE, atol=1e-12)


@given(SEEDS)
def test_balls_about_the_corners_and_one_about_all_hold_the_whole_shape(seed):
    _, _, solids = all_kinds()
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    for shape, bound, kind in zip(solids.shapes, solids.bound, KINDS):
        inside = points_inside(kind, rng)
        reach = np.max(shape.corners @ direction) + shape.radius
        assert np.max(inside @ direction) <= reach + 1e-12
        assert np.max(np.linalg.norm(inside, axis=1)) <= bound + 1e-12


def test_a_mesh_is_as_wide_as_its_vertices():
    model = compile_xml(
        f'<mujoco>{MESH}<worldbody><body><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = Solids(model, [1]).extremes(data, 0, np.eye(3))
    assert np.allclose(np.diag(found), (0.2, 0.3, 0.4), atol=1e-7)


def test_a_body_is_its_collision_geoms_else_its_visuals_else_its_origin():
    model = compile_xml(
        '<mujoco><worldbody><body><geom size=".1"/><geom size=".2" contype="0" conaffinity="0"/>'
        '</body><body><geom size=".3" contype="0" conaffinity="0"/></body><body pos="0 0 7"/>'
        '<body><geom type="plane" size="1 1 1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solids = Solids(model, [1, 2, 3, 4])
    assert [shape.geom for shape in solids.shapes] == [0, 2, -1]
    assert solids.body.tolist() == [1, 2, 3]
    assert np.allclose(solids.centers(data)[:, 2], [0.0, 0.0, 7.0])
    heights = [solids.extremes(data, shape, np.eye(3))[2, 2] for shape in range(3)]
    assert np.allclose(heights, [0.1, 0.3, 7.0], atol=1e-12)


def test_each_half_space_binds_its_own_bodies():
    model = compile_xml(
        '<mujoco><worldbody><body pos="0 0 1"><geom size=".1"/></body>'
        '<body pos="0 0 2"><geom type="box" size=".1 .1 .3"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    sides = (-np.inf, np.inf, -np.inf, np.inf, -np.inf, 4.0)
    limits = LimitOptions(keep_out=((0.0, 0.0, 1.0, 0.5),), workspace=sides)
    spaces = HalfSpaces(model, limits.half_spaces([1, 2], [2]))
    (ball, block) = spaces.heights(data)
    assert np.allclose(ball[1], [0.4, 2.9]) and np.allclose(block[1], [1.2, 1.7])
    assert np.array_equal(spaces.required, [[0.01, -np.inf], [0.01, 0.0]])
    assert np.allclose(ball[2][:, 2], [0.9, 1.1]) and np.allclose(block[2][:, 2], [1.7, 2.3])
    assert [shape for shape, _, _ in spaces.heights(data, near=0.5)] == [0]


TUBES = tube_arm((Z, Y, X, Y), FLOOR)


@given(SEEDS)
def test_the_box_is_that_of_all_capsules_in_all_postures(seed):
    arm = robot(TUBES)
    model, data = arm.mj_model, mujoco.MjData(arm.mj_model)
    positions = np.random.default_rng(seed).uniform(-2.0, 2.0, size=(5, 4))
    found = swept_space(arm, [positions[:2], positions[2:]])
    ends, names = [], []
    for q in positions:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE):
            axis = model.geom_size[geom, 1] * data.geom_xmat[geom].reshape(3, 3)[:, 2]
            ends += [data.geom_xpos[geom] + axis, data.geom_xpos[geom] - axis]
            names += 2 * [model.body(model.geom_bodyid[geom]).name]
    np.testing.assert_allclose(found.lower, np.min(ends, axis=0) - 0.03, atol=1e-12)
    np.testing.assert_allclose(found.upper, np.max(ends, axis=0) + 0.03, atol=1e-12)
    assert found.lowest == names[int(np.argmin(np.array(ends)[:, 2]))]


def test_the_outermost_points_are_in_the_last_bodys_frame_with_all_it_carries():
    tool = '<body name="tool" pos="0 0 .1" quat="1 0 1 0"><geom type="box" size=".1 .2 .3"/></body>'
    tip = link(hinge("roll", X), '<geom size=".05" pos="0 0 -.1"/>' + tool, "tip", quat="0 1 1 0")
    points, radius = outermost_points(robot(world(link(hinge("yaw", Z), tip, "base"))))
    assert sorted(radius) == [0.0] * 8 + [0.05]
    np.testing.assert_allclose(points[radius > 0.0], [[0.0, 0.0, -0.1]], atol=1e-12)
    # A quarter turn about y: the tool's z is the tip's x.
    corners = points[radius == 0.0] - [0.0, 0.0, 0.1]
    np.testing.assert_allclose(np.max(corners, axis=0), [0.3, 0.2, 0.1], atol=1e-12)


def test_what_is_inside_a_tools_hull_is_left_out():
    rng = np.random.default_rng(0)
    inner = "".join("{:.3f} {:.3f} {:.3f} ".format(*v) for v in rng.uniform(-0.1, 0.1, (200, 3)))
    mesh = f'<asset><mesh name="m" vertex="{inner}"/></asset>'
    boxes = "".join(f'<geom type="box" size=".{k} .3 .3"/>' for k in range(1, 10))
    arm = world(link(hinge("yaw", Z), boxes, "tip"), extra=mesh)
    points, _ = outermost_points(robot(arm))
    assert len(points) == 8
    assert np.max(points[:, 0]) == pytest.approx(0.9)

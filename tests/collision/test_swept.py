"""Where an arm gets to, held against every corner of it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given

from robot_sysid.collision.swept import outermost_points, swept_space
from tests.support.arms import SEEDS, X, Y, Z, hinge, link, world
from tests.support.excitation_arms import FLOOR, robot, tube_arm

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

"""The half-spaces that an arm stays in, and how far it is from their boundaries."""

from __future__ import annotations

import mujoco
import numpy as np

from robot_sysid.collision.halfspaces import HalfSpaces, box_half_spaces, plane_half_space
from robot_sysid.collision.obstacles import Box, Plane
from tests.support.arms import compile_xml


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


def test_each_half_space_binds_its_own_bodies():
    model = compile_xml(
        '<mujoco><worldbody><body pos="0 0 1"><geom size=".1"/></body>'
        '<body pos="0 0 2"><geom type="box" size=".1 .1 .3"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    floor = plane_half_space(Plane((0.0, 0.0, 1.0), 0.5), 0.01, [1, 2])
    box = box_half_spaces(Box((-np.inf,) * 3, (np.inf, np.inf, 4.0)), [2])
    spaces = HalfSpaces(model, (floor, *box))
    (ball, block) = spaces.heights(data)
    assert np.allclose(ball[1], [0.4, 2.9]) and np.allclose(block[1], [1.2, 1.7])
    assert np.array_equal(spaces.required, [[0.01, -np.inf], [0.01, 0.0]])
    assert np.allclose(ball[2][:, 2], [0.9, 1.1]) and np.allclose(block[2][:, 2], [1.7, 2.3])
    assert [shape for shape, _, _ in spaces.heights(data, near=0.5)] == [0]

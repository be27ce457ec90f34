"""A base on wheels stands still; every other joint at the root is part of the arm."""

from __future__ import annotations

import numpy as np
import pytest

from tests.arms import X, Y, Z, robot_of, serial_bodies, world

PLANE = (("slide", X), ("slide", Y), ("hinge", Z))


def on_base(kinds_and_axes, attributes="", axes=(Z, Y, X, Y)):
    joints = "".join(
        f'<joint name="base{i}" type="{kind}" axis="{axis}" {attributes}/>'
        for i, (kind, axis) in enumerate(kinds_and_axes)
    )
    inertial = '<inertial pos="0 0 .1" mass="20" diaginertia="1 1 1"/>'
    return world(f'<body name="base">{inertial}{joints}{serial_bodies(axes)}</body>')


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 0, 1)])
def test_a_mobile_base_is_held_and_named(order):
    robot = robot_of(on_base([PLANE[i] for i in order]))
    assert robot.joint_names == ("joint0", "joint1", "joint2", "joint3")
    assert any("base0, base1, base2 drive a mobile base" in note for note in robot.notes)


@pytest.mark.parametrize(
    ("joints", "attributes", "axes"),
    [
        (PLANE, 'range="-1 1"', (Z, Y, X, Y)),  # a gantry: its travel ends somewhere
        (PLANE, "", (Z, Y)),  # too little of an arm remains
        ((("slide", X), ("slide", Y), ("hinge", X)), "", (Z, Y, X, Y)),  # the turn is not planar
        ((("slide", X), ("slide", Y), ("slide", Z)), "", (Z, Y, X, Y)),
        (PLANE[:2], "", (Z, Y, X, Y)),
    ],
)
def test_other_joints_at_the_root_belong_to_the_arm(joints, attributes, axes):
    robot = robot_of(on_base(joints, attributes, axes))
    assert robot.n_joints == len(joints) + len(axes)
    assert not any("mobile base" in note for note in robot.notes)


def test_the_arm_is_the_same_with_and_without_its_base():
    fixed, mobile = robot_of(world(serial_bodies((Z, Y, X, Y)))), robot_of(on_base(PLANE))
    np.testing.assert_allclose(mobile.prior.theta, fixed.prior.theta, rtol=1e-12, atol=0.0)

"""Rotations: each way of writing one means the same as MuJoCo's and URDF's."""

from __future__ import annotations

import mujoco
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid import spatial

angles = st.floats(-np.pi, np.pi, allow_subnormal=False)


@given(seed=st.integers(0, 2**32 - 1), k=st.integers(0, 3), size=st.floats(0.0, 1.0))
def test_a_quaternion_survives_the_way_through_its_matrix(seed, k, size):
    # Small ``size`` gives nearly a half turn about one axis, where signs are fragile.
    quaternion = size * np.random.default_rng(seed).normal(size=4) + 2.0 * np.eye(4)[k]
    quaternion /= np.linalg.norm(quaternion)
    back = spatial.quaternion_from_rotation(spatial.rotation_from_quaternion(quaternion))
    np.testing.assert_allclose(np.abs(back @ quaternion), 1.0, rtol=0, atol=1e-15 * 4)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, back)
    expected = spatial.rotation_from_quaternion(quaternion)
    np.testing.assert_allclose(matrix.reshape(3, 3), expected, rtol=0, atol=1e-14)


@given(roll=angles, pitch=angles, yaw=angles)
def test_rpy_turns_as_a_urdf_joint_does(roll, pitch, yaw):
    text = (
        '<robot name="r"><mujoco><compiler fusestatic="false"/></mujoco><link name="a"/>'
        '<link name="b"/><joint name="j" type="fixed"><parent link="a"/><child link="b"/>'
        f'<origin rpy="{roll!r} {pitch!r} {yaw!r}"/></joint></robot>'
    )
    quaternion = mujoco.MjModel.from_xml_string(text).body_quat[-1]
    expected = spatial.rotation_from_quaternion(quaternion)
    actual = spatial.rotation_from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-13)

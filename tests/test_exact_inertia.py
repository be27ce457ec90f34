"""Inaccurate axes of a compiled body are put right; what was changed on purpose is left."""

from __future__ import annotations

import mujoco
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid import spatial
from robot_sysid.compiled.composite import body_theta
from robot_sysid.compiled.exact_inertia import restore_exact_inertias
from robot_sysid.modelfile.inertial_text import mjcf_inertial
from tests.model_files import random_theta


def compiled(theta):
    inertial = mjcf_inertial(theta, principal=True)
    body = f"<body name='b'><joint/>{inertial}</body>"
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


@given(seed=st.integers(0, 2**32 - 1))
def test_a_turned_inertia_is_restored_with_all_that_follows(seed):
    rng = np.random.default_rng(seed)
    theta = random_theta(rng)
    good, bad = compiled(theta), compiled(theta)
    turn = spatial.rotation_from_quaternion(np.append(1.0, 1e-4 * rng.normal(size=3)))
    axes = turn @ spatial.rotation_from_quaternion(bad.body_iquat[1])
    bad.body_iquat[1] = spatial.quaternion_from_rotation(axes)
    restore_exact_inertias(bad, {"b": spatial.com_from_theta(theta)})
    np.testing.assert_allclose(body_theta(bad, 1), theta, rtol=0, atol=1e-15)
    np.testing.assert_allclose(bad.dof_M0, good.dof_M0, rtol=1e-11)


def test_a_bounded_inertia_and_an_unknown_link_are_left_alone():
    theta = random_theta(np.random.default_rng(0))
    model = compiled(theta)
    model.body_inertia[1] *= 2.0
    before = body_theta(model, 1)
    restore_exact_inertias(model, {"b": spatial.com_from_theta(theta), "gone": (1, 0, np.eye(3))})
    np.testing.assert_array_equal(body_theta(model, 1), before)

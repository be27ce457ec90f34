"""Inertia of bodies and of what hangs on them, against MuJoCo's own dynamics."""

from __future__ import annotations

import mujoco
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.model.inertia import body_theta, composite_theta, inertia_about_com, subtree_bodies
from tests.support.arms import SEEDS
from tests.support.model_files import ARM

MODEL = mujoco.MjModel.from_xml_string(ARM)
LINK2 = MODEL.body("link2").id


@given(SEEDS)
def test_a_compiled_body_has_the_inertia_of_its_principal_axes(seed):
    rng = np.random.default_rng(seed)
    quaternion, com = rng.normal(size=4), rng.normal(size=3)
    moments = np.array([0.3, 0.4, 0.5]) * rng.uniform(0.9, 1.1, 3)
    model = mujoco.MjModel.from_xml_string(ARM)
    model.body_mass[LINK2], model.body_ipos[LINK2] = 1.5, com
    model.body_inertia[LINK2] = moments
    model.body_iquat[LINK2] = quaternion / np.linalg.norm(quaternion)
    axes = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    expected = axes @ np.diag(moments) @ axes.T
    found = inertia_about_com(model, LINK2)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-15)
    mass, back, inertia = spatial.com_from_theta(body_theta(model, LINK2))
    assert mass == 1.5
    np.testing.assert_allclose(back, com, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(inertia, expected, rtol=0.0, atol=1e-13)


@given(q=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_the_composite_is_mujocos_subtree(q):
    data = mujoco.MjData(MODEL)
    data.qpos[:] = q
    mujoco.mj_kinematics(MODEL, data)
    mujoco.mj_comPos(MODEL, data)
    mass, com, _ = spatial.com_from_theta(composite_theta(MODEL, data.qpos, LINK2))
    assert abs(mass - MODEL.body_subtreemass[LINK2]) < 1e-14
    world = data.xpos[LINK2] + data.xmat[LINK2].reshape(3, 3) @ com
    np.testing.assert_allclose(world, data.subtree_com[LINK2], rtol=0, atol=1e-14)


@given(q=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_a_hinge_feels_the_composite_inertia(q):
    data = mujoco.MjData(MODEL)
    data.qpos[:] = q
    mujoco.mj_forward(MODEL, data)
    dof = MODEL.joint("j2").dofadr[0]
    unit, column = np.eye(MODEL.nv)[dof], np.zeros(MODEL.nv)
    mujoco.mj_mulM(MODEL, data, column, unit)
    # The hinge turns about the body's x axis through its origin.
    inertia = spatial.symmetric_from_six(composite_theta(MODEL, data.qpos, LINK2)[4:])
    assert abs(column[dof] - inertia[0, 0]) < 1e-14


def test_what_is_fixed_to_a_finger_is_not_welded_to_the_link():
    """Whatever lies behind a joint moves against the link, however it is fastened there."""
    inertial = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>'
    pad = f'<body name="pad">{inertial}<body name="screw">{inertial}</body></body>'
    finger = '<body name="finger" pos="0 0.05 0.1">'
    model = mujoco.MjModel.from_xml_string(ARM.replace(finger, finger + pad))
    bodies = subtree_bodies(model, model.qpos0, model.body("link2").id)
    welded = {b.name: b.welded for b in bodies}
    assert welded == {"link2": True, "tool": True, "finger": False, "pad": False, "screw": False}

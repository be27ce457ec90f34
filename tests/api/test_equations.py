"""The regressor that programs get, and models that they hold in memory."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.files.places import EXAMPLE, MODELS
from rigs.files.refusals import refused
from robot_sysid.dynamics.inverse_dynamics import analysis_copy

JOINT = 'range="-2 2" frictionloss=".3" damping=".2" armature=".05"'
TEXT = small_arms.serial_arm(joint=JOINT)


def motion(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 20, n))
    return q, qd, qdd


def by_mujoco(model, q, qd, qdd):
    """Inverse dynamics without MuJoCo's own friction, and friction as Coulomb's law has it."""
    bare = analysis_copy(model)
    data = mujoco.MjData(bare)
    tau = []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, qd, qdd):
        mujoco.mj_inverse(bare, data)
        tau.append(data.qfrc_inverse.copy())
    return np.array(tau) + model.dof_frictionloss * np.sign(qd) + model.dof_damping * qd


def check_law(regressor, tau):
    assert regressor.Y.shape == (*tau.shape, len(regressor.names)) and len(
        regressor.theta
    ) == len(regressor.names)
    scale = np.max(np.abs(tau))
    assert_allclose(regressor.Y @ regressor.theta, tau, rtol=0, atol=1e-9 * scale)
    assert_allclose(regressor.tau, tau, rtol=0, atol=1e-9 * scale)


@pytest.mark.parametrize("form", ["file", "MjModel", "MjSpec"])
def test_columns_times_parameters_are_the_inverse_dynamics_of_mujoco(tmp_path, form):
    model = mujoco.MjModel.from_xml_string(TEXT)
    source = model
    if form == "file":
        source = tmp_path / "arm.xml"
        source.write_text(TEXT)
    elif form == "MjSpec":
        pytest.importorskip("mujoco", minversion="3.2.5")
        source = mujoco.MjSpec.from_string(TEXT)
    regressor = rs.joint_torque_regressor(source, *motion(3))
    check_law(regressor, by_mujoco(model, *motion(3)))
    matrix, tau = rs.joint_torque_regressor(
        source, *(signal[4] for signal in motion(3))
    )
    # One sample and many take other sums of the same terms, all of them smaller than 10.
    assert_allclose(matrix, regressor.Y[4], rtol=0.0, atol=1e-14)
    assert_allclose(tau, regressor.tau[4], rtol=0.0, atol=1e-13)
    assert (
        regressor.names[:2] == ("m(link0)", "hx(link0)")
        and regressor.names[-1] == "coulomb[joint2]"
    )


def test_it_is_so_of_a_public_arm():
    path = MODELS / "kuka_iiwa_14" / "iiwa14.xml"
    if not path.exists():
        pytest.skip("the public models are not here")
    model = mujoco.MjModel.from_xml_path(str(path))
    check_law(rs.joint_torque_regressor(path, *motion(7)), by_mujoco(model, *motion(7)))


def test_arrays_that_do_not_fit_are_refused():
    model = mujoco.MjModel.from_xml_string(TEXT)
    q, qd, qdd = motion(3)
    with refused(r"qd has shape \(20, 2\), expected \(20, 3\)"):
        rs.joint_torque_regressor(model, q, qd[:, :2], qdd)
    with refused(r"qdd has shape \(5, 3\), expected \(20, 3\)"):
        rs.joint_torque_regressor(model, q, qd, qdd[:5])


def test_a_spec_is_identified_like_its_file(tmp_path):
    """Also where its meshes are beside a file, and where they are in memory."""
    pytest.importorskip("mujoco", minversion="3.2.5")
    path = EXAMPLE / "model" / "kinova_fullinertia_guess.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    mesh_dir = spec.meshdir
    quick = {"seed": 1, "duration": 1.0}
    from_file = rs.self_test(path, **quick)
    from_spec = rs.self_test(spec, **quick)
    assert_allclose(from_spec.theta, from_file.theta, rtol=1e-4, atol=1e-6)
    assert spec.meshdir == mesh_dir
    assert from_spec.spec().compile().ngeom == spec.compile().ngeom
    assert (tmp_path / "updated_model.xml") in from_spec.save(tmp_path)
    assets = {
        mesh.name: mesh.read_bytes() for mesh in (EXAMPLE / "model/meshes").iterdir()
    }
    held = mujoco.MjSpec.from_string(path.read_text(encoding="utf-8"), assets=assets)
    assert_allclose(rs.self_test(held, **quick).theta, from_spec.theta, rtol=1e-6)
    assert repr(from_spec).startswith(
        "<Result link6 of kinova_fullinertia_guess.xml: 0.78"
    )


def test_a_compiled_model_cannot_be_written_to_a_file():
    model = mujoco.MjModel.from_xml_string(TEXT)
    with refused("give its file, or the MjSpec", rs.ModelError):
        rs.self_test(model, seed=1, duration=1.0)

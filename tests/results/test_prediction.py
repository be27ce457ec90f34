"""A file is judged by its torques."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pytest import approx

from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import load_robot_model
from robot_sysid.results.prediction import torque_error
from robot_sysid.simulator import ArmTorque
from tests.support import arms
from tests.support.model_files import write_files
from tests.support.releases import since

OFFSETS = np.array([3.0, -2.0, 0.5])


def error_on(model, robot, motion, tau, usable=None):
    """The torque error of a model on samples as they are: nothing is filtered or decimated."""
    if usable is None:
        usable = np.ones(tau.shape, bool)
    signals = SimpleNamespace(
        tau=tau,
        low_pass=SimpleNamespace(decimate=np.asarray),
        filter_columns=lambda make: make(motion),
        usable=lambda: usable,
    )
    model = compile_model(model).mj_model if isinstance(model, Path) else model
    return torque_error(model, robot, signals, "a log")


def by_inverse_dynamics(xml, motion):
    """Torque of smooth damping and links by MuJoCo itself, and Coulomb's friction."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    tau = np.empty_like(motion.q)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    for k in range(len(tau)):
        data.qpos[:] = motion.q[k]
        data.qvel[:] = motion.qd[k]
        data.qacc[:] = motion.qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    tau += model.dof_frictionloss * np.sign(motion.qd)
    for tendon, friction in enumerate(model.tendon_frictionloss):
        ratios = np.zeros(model.nv)
        first = model.tendon_adr[tendon]
        count = model.tendon_num[tendon]
        for wrap in range(first, first + count):
            ratios[model.jnt_dofadr[model.wrap_objid[wrap]]] = model.wrap_prm[wrap]
        tau += friction * np.sign(motion.qd @ ratios)[:, None] * ratios
    return tau


@pytest.mark.parametrize(
    "xml",
    [
        arms.ARMATURE,
        arms.TENDON_SPRING,
        pytest.param(arms.SHARED_MOTOR, marks=since(3, 3)),
        pytest.param(arms.NONLINEAR_DAMPING, marks=since(3, 7)),
    ],
)
def test_a_perfect_file_is_off_by_its_sensors_offsets_alone(tmp_path, xml):
    path = write_files(tmp_path, {"arm.xml": xml})
    motion = arms.seeded_motion(0, 3, 40)
    robot = load_robot_model(path)
    tau = by_inverse_dynamics(xml, motion) + OFFSETS
    error = error_on(path, robot, motion, tau)
    assert error.relative_error < 1e-12 and error.rmse < 1e-11 and error.n_samples == 40
    assert max(error.relative_error_per_joint.values()) < 1e-10


@pytest.mark.parametrize(
    ("original_text", "replacement", "torque_change"),
    [
        ('damping="2"', 'damping="2.1"', lambda motion: 0.1 * motion.qd),
        (
            'frictionloss="1.5"',
            'frictionloss="1.6"',
            lambda motion: 0.1 * np.sign(motion.qd),
        ),
        ("<joint ", '<joint armature=".01" ', lambda motion: 0.01 * motion.qdd),
        ("<joint ", '<joint stiffness="1" ', lambda motion: motion.q),
    ],
)
def test_each_joint_attribute_counts_in_the_torque_error(
    original_text, replacement, torque_change
):
    motion = arms.seeded_motion(0, 3, 40)
    robot = arms.robot_of(arms.DRY_FRICTION)
    tau = ArmTorque(robot)(motion)
    model = arms.compile_xml(arms.DRY_FRICTION.replace(original_text, replacement))
    report = error_on(model, robot, motion, tau)
    residuals = torque_change(motion)
    residuals = residuals - residuals.mean(axis=0)
    assert_allclose(report.rmse, np.sqrt(np.mean(residuals**2)), rtol=1e-9)
    relative_error = np.linalg.norm(residuals) / np.linalg.norm(tau)
    assert_allclose(report.relative_error, relative_error)
    joint_errors = np.linalg.norm(residuals, axis=0)
    relative_errors = joint_errors / np.linalg.norm(tau, axis=0)
    rmse = joint_errors / np.sqrt(len(tau))
    for k, joint in enumerate(robot.joint_names):
        assert report.relative_error_per_joint[joint] == approx(relative_errors[k])
        assert report.rmse_per_joint[joint] == approx(rmse[k])


def test_samples_that_are_not_usable_do_not_count():
    motion = arms.seeded_motion(0, 3, 40)
    robot = arms.robot_of(arms.THREE)
    usable = np.random.default_rng(1).uniform(size=motion.q.shape) < 0.7
    usable[:, 0] = False
    tau = np.where(usable, ArmTorque(robot)(motion) + OFFSETS, np.nan)
    error = error_on(robot.mj_model, robot, motion, tau, usable)
    assert error.source == "a log" and error.relative_error < 1e-12
    assert error.relative_error_per_joint["joint0"] is None
    assert error.n_samples == np.max(np.count_nonzero(usable, axis=0))
    empty_error = error_on(robot.mj_model, robot, motion, tau, np.zeros_like(usable))
    assert (empty_error.relative_error, empty_error.rmse, empty_error.n_samples) == (
        None,
        0.0,
        0,
    )

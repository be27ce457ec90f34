"""A model file predicts as well as is stated, and leaves out what it cannot hold."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    gravity_vector,
    with_gravity,
)
from robot_sysid.estimation.choices import coupling
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.question import FILE_FRICTION as FRICTION
from robot_sysid.estimation.question import FILE_GRAVITY as GRAVITY
from robot_sysid.estimation.question import FILE_LINKS as LINKS
from robot_sysid.estimation.question import FILE_ROTORS as ROTORS
from robot_sysid.results.prediction import torque_error
from tests.support import arms
from tests.support.core_fits import BASIC, filter_logs, fit_recordings, fitter_of
from tests.support.measured_logs import log_of, plan_of
from tests.support.releases import since

MIDDLE = np.array([0.0, 1.0, 0.0])
WRIST = np.array([0.0, 1.0, 1.0])


def record(plant, model, seed=1, extra_torque=None):
    """Return (low-passed datasets of a log of an arm, options).

    ``extra_torque`` is a function of the exact motion that is added to the plant's torque.
    """
    plan = plan_of(plant, seed, 20.0)
    log = log_of(plant, plan, seed, noise_torque=0.02, encoder_resolution=1e-5)
    if extra_torque is not None:
        log = replace(log, tau=log.tau + extra_torque(plan.evaluate(log.time)))
    return filter_logs(model, log)


def fit_file_of(model, datasets, options, kept=(), couplings=(), friction=BASIC):
    """Return the fit of a model file; ``kept`` are the parts that stay as they are."""
    fit = fit_recordings(model, datasets, options, friction, couplings)
    fitter = fitter_of(model, datasets, couplings=couplings)
    return fit_file(fitter, options, kept, fit)


@pytest.fixture(scope="module")
def recording(plant, robot):
    return record(plant, robot)


def compile_fit(robot, fit):
    """Return the MuJoCo model as it would be written."""
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, fit.columns.thetas(fit.values)):
        arms.write_body(model, link.body_id, theta)
    for term, field in (
        ("coulomb", model.dof_frictionloss),
        ("viscous", model.dof_damping),
        ("armature", model.dof_armature),
    ):
        field[robot.dof_index] = joint_values(fit, term)
    model.opt.gravity[:] = fit.point.gravity
    return model


def joint_values(fit, term):
    """Return the value of a friction term in each joint."""
    return [fit.value(f"{term}[{joint}]") for joint in fit.columns.robot.joint_names]


def angle_between(vector, other):
    """Return the angle [deg]."""
    cosine = vector @ other / np.linalg.norm(vector) / np.linalg.norm(other)
    return np.degrees(np.arccos(min(cosine, 1.0)))


def test_the_file_predicts_with_the_stated_error(plant, robot, recording):
    file = fit_file_of(robot, *recording)
    fit = file.fit
    other_recording = record(plant, robot, 11)
    signals, other_signals = (
        datasets[0].signals for datasets, _ in (recording, other_recording)
    )
    assert all(spatial.is_consistent(theta) for theta in fit.columns.thetas(fit.values))
    prior_error = torque_error(robot.mj_model, robot, signals, "log").relative_error
    assert file.model_validation.relative_error == pytest.approx(prior_error, rel=0.05)
    assert file.validation.relative_error < 0.02 * file.model_validation.relative_error
    model = compile_fit(robot, fit)
    for log in (signals, other_signals):
        error = torque_error(model, robot, log, "file").relative_error
        assert error == pytest.approx(file.validation.relative_error, rel=0.25)
    # It has only the terms that a file holds, and each joint's sensor offset.
    terms = {
        name.partition("[")[0] for name in fit.unknowns.estimated_names if "[" in name
    }
    assert terms == {"coulomb", "viscous", "offset"}
    assert np.array_equal(fit.point.gravity, gravity_vector(robot))


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_links_and_sensor_offsets_are_not_confounded(plant, offset):
    """Both look alike where joints turn little; the file has to be right without the sensors."""
    true_offset = offset * MIDDLE
    log = log_of(plant, plan_of(plant, 2, 5.0), 2, noise_torque=0.02)
    recording = filter_logs(plant, replace(log, tau=log.tau + true_offset))
    fit = fit_file_of(plant, *recording).fit
    tolerance = 0.02 if offset else 1e-6
    assert joint_values(fit, "offset") == pytest.approx(true_offset, abs=tolerance)
    # Beside a sensor that clearly has an offset, the others may have a small one.
    assert fit.choice.offsets
    assert all((size > 0.0) == (offset > 0.0) for size in fit.choice.offsets.values())
    q = log.q[::50]
    dynamics = LinkDynamics(plant).motion(q, 0.0 * q, 0.0 * q)
    weight = dynamics.torque(plant.thetas)
    error = dynamics.torque(fit.columns.thetas(fit.values)) - weight
    assert np.linalg.norm(error) < 0.02 * np.linalg.norm(weight)


def test_a_tilted_gravity_is_estimated_unless_it_is_kept(plant, robot):
    axis = np.array([0.5, 0.8, 0.0])
    turn = Rotation.from_rotvec(np.radians(2.0) * axis / np.linalg.norm(axis))
    tilted = with_gravity(plant, turn.apply(gravity_vector(plant)))
    recording = record(tilted, robot)
    file = fit_file_of(robot, *recording)
    assert angle_between(file.fit.point.gravity, gravity_vector(tilted)) < 0.3
    kept = fit_file_of(robot, *recording, (GRAVITY,))
    assert np.array_equal(kept.fit.point.gravity, gravity_vector(robot))
    assert kept.validation.relative_error > file.validation.relative_error


def without_rotors(robot):
    """Return the arm with a model that has no rotor inertia."""
    model = copy.copy(robot.mj_model)
    model.dof_armature[:] = 0.0
    return replace(robot, mj_model=model)


@pytest.mark.parametrize(("has_rotors", "tolerance"), [(True, 0.0), (False, 0.01)])
def test_a_rotor_is_that_of_the_estimate_where_it_is_clear_else_the_models(
    plant, robot, has_rotors, tolerance
):
    """Friction that a file cannot hold would look like a rotor."""

    def stribeck(motion):
        """Return friction (K, 3) of the middle joint that fades with speed [N m]."""
        return 1.5 * np.sign(motion.qd) * np.exp(-((motion.qd / 0.3) ** 2)) * MIDDLE

    model = robot if has_rotors else without_rotors(robot)
    recording = record(plant, model, extra_torque=stribeck)
    fit = fit_file_of(model, *recording, friction=f"{BASIC}-stribeck").fit
    assert joint_values(fit, "armature") == pytest.approx([0.05] * 3, abs=tolerance)


@pytest.mark.parametrize("kept", [(FRICTION,), (ROTORS, LINKS)])
def test_a_kept_part_stays(robot, recording, kept):
    fit = fit_file_of(without_rotors(robot), *recording, (*kept, GRAVITY)).fit
    for name, part in {
        "coulomb[joint1]": FRICTION,
        "viscous[joint2]": FRICTION,
        "armature[joint0]": ROTORS,
        "armature[joint2]": ROTORS,
        "m(link0)": LINKS,
        "Izz(link1)": LINKS,
    }.items():
        prior = fit.columns.model_values[fit.columns.index[name]]
        assert (fit.value(name) == prior) == (part in kept), name
    assert "offset[joint1]" in fit.unknowns.estimated_names


def test_rotors_of_a_urdfs_arm_are_in_the_mjcf_beside_it(robot, recording):
    """A URDF cannot hold them: beside links it has friction only, and rotors count as links."""
    model = replace(without_rotors(robot), kind="urdf")
    file = fit_file_of(model, *recording)
    assert file.fit.question.file_kind == "mjcf"
    assert joint_values(file.fit, "armature") == pytest.approx([0.05] * 3, abs=0.01)
    fit = file.file.fit
    assert not any("armature[" in name for name in fit.unknowns.estimated_names)
    assert joint_values(fit, "armature") == [0.0] * 3
    error = file.validation.relative_error
    assert file.file.validation.relative_error > 1.5 * error

    # The URDF alone where rotors are to stay as they are, or none is seen.
    for kept, friction in (((ROTORS,), BASIC), ((), "coulomb-viscous-offset")):
        alone = fit_file_of(model, *recording, kept, friction=friction)
        assert alone.file is None and alone.fit.question.file_kind == "urdf"


@since(3, 7)
def test_nonlinear_damping_of_the_model_is_known(plant, robot, recording):
    def braking(motion):
        """Return the torque (K, 3) of damping that the arm and the changed model have [N m]."""
        return 0.3 * motion.qd * np.abs(motion.qd)

    model = copy.copy(robot.mj_model)
    model.dof_dampingpoly[robot.dof_index] = [0.3, 0.0]
    changed = replace(robot, mj_model=model)
    file = fit_file_of(changed, *record(plant, changed, extra_torque=braking))
    expected = fit_file_of(robot, *recording)
    viscous = joint_values(expected.fit, "viscous")
    assert joint_values(file.fit, "viscous") == pytest.approx(viscous, abs=0.01)
    assert file.validation.rmse == pytest.approx(expected.validation.rmse, rel=0.1)


def shared_motor(motion):
    """Return the torque (K, 3) of a motor with friction that turns with both wrist joints [N m]."""
    speed = motion.qd @ WRIST
    acceleration = motion.qdd @ WRIST
    return np.outer(1.5 * np.sign(speed) + 0.4 * speed + 0.02 * acceleration, WRIST)


@pytest.fixture(scope="module")
def recording_of_motor(plant, robot):
    return record(plant, robot, extra_torque=shared_motor)


def test_a_motor_that_turns_two_joints_is_in_the_file(robot, recording_of_motor):
    """Its rotor is in the joints, because tendons of older releases have none."""
    motors = (coupling(robot, WRIST),)
    file = fit_file_of(robot, *recording_of_motor, (GRAVITY,), motors)
    without = fit_file_of(robot, *recording_of_motor, (GRAVITY,))
    for term, value in {"coulomb": 1.5, "viscous": 0.4, "armature": 0.0}.items():
        estimate = file.fit.value(f"{term}[joint1+joint2]")
        assert estimate == pytest.approx(value, rel=0.1)
    rotors = np.subtract(joint_values(file.fit, "armature"), robot.armature)
    assert rotors == pytest.approx([0.0, 0.02, 0.02], abs=0.01)
    assert file.validation.relative_error < 0.2 * without.validation.relative_error
    assert file.file is None

    kept = (GRAVITY, FRICTION)
    fit = fit_file_of(robot, *recording_of_motor, kept, motors).fit
    assert not fit.choice.couplings


def test_a_urdf_beside_the_mjcf_that_holds_a_shared_motor_is_fitted_as_a_urdf(
    robot, recording_of_motor
):
    model = replace(robot, kind="urdf")
    motors = (coupling(robot, WRIST),)
    file = fit_file_of(model, *recording_of_motor, (GRAVITY,), motors)
    assert file.fit.question.file_kind == "mjcf"
    assert file.file.fit.question.file_kind == "urdf"
    alone = fit_file_of(model, *recording_of_motor, (GRAVITY,))
    error = alone.validation.relative_error
    assert file.file.validation.relative_error == pytest.approx(error, rel=0.05)
    assert file.validation.relative_error < 0.2 * error

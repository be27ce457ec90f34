"""A model file predicts as well as is stated, and leaves out what it cannot hold."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rigs.arms import small_arms
from rigs.arms.core_fits import filter_logs, fit_recordings
from rigs.files.file_judge import torque_error
from rigs.logs.measured_logs import log_of, plan_of
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    gravity_vector,
    with_gravity,
)
from robot_sysid.estimate.fit import settled_values
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.links import last_link_scale
from robot_sysid.estimate.options import FILE_FRICTION as FRICTION
from robot_sysid.estimate.options import FILE_GRAVITY as GRAVITY
from robot_sysid.estimate.options import FILE_LINKS as LINKS
from robot_sysid.estimate.options import FILE_ROTORS as ROTORS
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.restricted_fit import (
    error_without_rotors,
    errors_of,
    errors_on,
    fit_file,
    gravity_in,
)
from robot_sysid.records import InertialParameters, SubtreeBody

MIDDLE = np.array([0.0, 1.0, 0.0])
WRIST = np.array([0.0, 1.0, 1.0])


def record(plant, model, seed=1, extra_torque=None, duration=20.0):
    """Return low-passed recordings of a log of an arm.

    ``extra_torque`` is a function of the exact motion that is added to the plant's torque.
    """
    plan = plan_of(plant, seed, duration)
    log = log_of(plant, plan, seed, noise_torque=0.02, encoder_resolution=1e-5)
    if extra_torque is not None:
        log = replace(log, tau=log.tau + extra_torque(plan.evaluate(log.time)))
    return filter_logs(model, log)


def file_of(model, recordings, kept=()):
    """Return the fit of a model file; ``kept`` are the parts that stay as they are."""
    return fit_file(fit_recordings(model, recordings, EstimationOptions(keep=kept)))


@pytest.fixture(scope="module")
def recording(plant, robot):
    return record(plant, robot)


def joint_values(file, term):
    """Return the value of a term in each joint of a file."""
    names = file.arm.robot.joint_names
    return np.array([file.by_name[f"{term}[{joint}]"] for joint in names])


def compiled(robot, file):
    """Return the MuJoCo model as it would be written."""
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, file.thetas):
        small_arms.write_body(model, link.body_id, theta)
    for term, field in (
        ("coulomb", model.dof_frictionloss),
        ("viscous", model.dof_damping),
        ("armature", model.dof_armature),
    ):
        field[robot.dof_index] = joint_values(file, term)
    gravity = gravity_in(file)
    if gravity is not None:
        model.opt.gravity[:] = gravity
    return model


def angle_between(vector, other):
    """Return the angle [deg]."""
    cosine = vector @ other / np.linalg.norm(vector) / np.linalg.norm(other)
    return np.degrees(np.arccos(min(cosine, 1.0)))


def test_the_file_predicts_with_the_stated_error(plant, robot, recording):
    file = file_of(robot, recording)
    other = record(plant, robot, 11)
    before = errors_of(file).before.relative_error
    after = validation(file).relative_error
    assert all(map(spatial.is_consistent, file.thetas))
    signals = recording[0]
    error = torque_error(robot.mj_model, robot, signals)
    assert before == pytest.approx(error, rel=0.05)
    assert after < 0.02 * before
    model = compiled(robot, file)
    for log in (recording[0], other[0]):
        error = torque_error(model, robot, log)
        assert error == pytest.approx(after, rel=0.25)
    stated = errors_on(file, other, "other")
    for each, mj_model in zip(vars(stated).values(), (robot.mj_model, model)):
        error = torque_error(mj_model, robot, other[0])
        assert each.relative_error == pytest.approx(error, rel=0.02)
    # It has only the terms that a file holds, and each joint's sensor offset.
    terms = {name.partition("[")[0] for name in file.names if "[" in name}
    assert terms == {"coulomb", "viscous", "offset"} and gravity_in(file) is None


# A hundredth of the strongest joint's torque, as offsets usually are [N m].
@pytest.mark.parametrize("offset", [0.0, 0.009])
def test_links_and_sensor_offsets_are_not_confounded(plant, offset):
    """Both look alike where joints turn little; the file has to be right without the sensors."""
    log = log_of(plant, plan_of(plant, 2, 5.0), 2, noise_torque=0.002)
    recordings = filter_logs(plant, replace(log, tau=log.tau + offset * MIDDLE))
    file = file_of(plant, recordings)
    tolerance = 0.01 if offset else 1e-6
    assert joint_values(file, "offset") == pytest.approx(offset * MIDDLE, abs=tolerance)
    q = log.q[::50]
    moves = LinkDynamics(plant).motion(q, 0.0 * q, 0.0 * q)
    weight = moves.torque(plant.thetas)
    error = moves.torque(file.thetas) - weight
    # 2.8 % without the rows at turns, a fifth of the middle joint's in so short a log.
    assert np.linalg.norm(error) < 0.035 * np.linalg.norm(weight)


def test_a_tilted_gravity_is_estimated_unless_it_is_kept(plant, robot):
    axis = np.array([0.5, 0.8, 0.0])
    turn = Rotation.from_rotvec(np.radians(2.0) * axis / np.linalg.norm(axis))
    tilted = with_gravity(plant, turn.apply(gravity_vector(plant)))
    recordings = record(tilted, robot)
    file = file_of(robot, recordings)
    assert angle_between(gravity_in(file), gravity_vector(tilted)) < 0.3
    other = record(tilted, robot, 2)
    model = compiled(robot, file)
    error = torque_error(model, robot, other[0])
    stated = errors_on(file, other, "other").after
    assert stated.relative_error == pytest.approx(error, rel=0.05)
    kept = file_of(robot, recordings, (GRAVITY,))
    assert gravity_in(kept) is None and not {"tilt_1", "tilt_2"} & set(kept.names)
    assert validation(kept).relative_error > validation(file).relative_error


def without_rotors(robot, kind="mjcf"):
    """Return the arm with a model of a kind that has no rotor inertia."""
    model = copy.copy(robot.mj_model)
    model.dof_armature[:] = 0.0
    return replace(robot, mj_model=model, kind=kind)


@pytest.mark.parametrize(("has_rotors", "tolerance"), [(True, 0.0), (False, 0.01)])
def test_a_rotor_is_that_of_the_estimate_where_it_is_clear_else_the_models(
    plant, robot, has_rotors, tolerance
):
    """Friction that a file cannot hold would look like a rotor."""

    def stribeck(motion):
        """Return friction (K, 3) of the middle joint that fades with speed [N m]."""
        return 0.6 * np.sign(motion.qd) * np.exp(-((motion.qd / 0.3) ** 2)) * MIDDLE

    model = robot if has_rotors else without_rotors(robot)
    file = file_of(model, record(plant, model, extra_torque=stribeck))
    assert joint_values(file, "armature") == pytest.approx([0.05] * 3, abs=tolerance)


@pytest.mark.parametrize("kept", [(FRICTION,), (ROTORS, LINKS)])
def test_a_kept_part_stays(robot, recording, kept):
    file = file_of(without_rotors(robot), recording, (*kept, GRAVITY))
    for name, part in {
        "coulomb[joint1]": FRICTION,
        "viscous[joint2]": FRICTION,
        "armature[joint0]": ROTORS,
        "armature[joint2]": ROTORS,
        "m(link0)": LINKS,
        "Izz(link1)": LINKS,
    }.items():
        is_models = file.by_name[name] == file.arm.model[name]
        assert is_models == (part in kept), name


def test_rotors_of_a_urdfs_arm_are_in_the_mjcf_beside_it(robot, recording):
    """MuJoCo does not read them in a URDF, whose error is that without them."""
    model = without_rotors(robot, "urdf")
    file = file_of(model, recording)
    assert joint_values(file, "armature") == pytest.approx([0.05] * 3, abs=0.01)
    bare = compiled(robot, file)
    bare.dof_armature[:] = 0.0
    error = torque_error(bare, robot, recording[0])
    assert error_without_rotors(file).relative_error == pytest.approx(error, rel=0.05)
    assert error > 1.5 * validation(file).relative_error
    # Nothing is left out where rotors are to stay as they are.
    alone = file_of(model, recording, (ROTORS,))
    error = validation(alone).relative_error
    assert error_without_rotors(alone).relative_error == pytest.approx(error, rel=0.1)


def shared_motor(motion):
    """Return the torque (K, 3) of a motor with friction that turns with both wrist joints [N m]."""
    speed = motion.qd @ WRIST
    acceleration = motion.qdd @ WRIST
    return np.outer(1.5 * np.sign(speed) + 0.4 * speed + 0.02 * acceleration, WRIST)


def test_a_motor_that_turns_two_joints_is_in_the_mjcf_alone(plant, robot):
    """Its rotor is in the joints, because tendons of older releases have none."""
    recordings = record(plant, robot, extra_torque=shared_motor)
    file = file_of(replace(robot, kind="urdf"), recordings, (GRAVITY,))
    for term, value in {"coulomb": 1.5, "viscous": 0.4, "armature": 0.0}.items():
        estimate = file.by_name[f"{term}[joint1+joint2]"]
        assert estimate == pytest.approx(value, rel=0.1)
    rotors = joint_values(file, "armature") - robot.armature
    assert rotors == pytest.approx([0.0, 0.02, 0.02], abs=0.01)
    assert (
        validation(file).relative_error
        < 0.2 * error_without_rotors(file).relative_error
    )
    kept = file_of(robot, recordings, (GRAVITY, FRICTION))
    assert not any("+" in name for name in kept.names)


def test_a_last_link_leaves_a_possible_body_beside_its_fingers(robot, recording):
    """Fingers on joints of their own keep their inertia in a written model."""
    without = file_of(robot, recording)
    free = InertialParameters(without.thetas[-1])
    inertia = np.diag([1.02, 0.5, 0.5]) * free.inertia_com
    theta = spatial.theta_from_com(0.3 * free.mass, free.com, inertia)
    finger = SubtreeBody(99, "finger", theta, welded=False)
    assert not spatial.is_consistent(free.theta - theta)
    last = replace(robot.links[-1], bodies=(*robot.bodies, finger))
    gripper = replace(robot, links=(*robot.links[:-1], last))
    file = file_of(gripper, recording)
    # Six digits of where it sits, as an MJCF of a URDF has them, leave room for it, too.
    for shift in 1e-6 * np.eye(3):
        moved = spatial.transform_theta(theta, np.eye(3), shift)
        assert spatial.is_consistent(file.thetas[-1] - moved)
    assert validation(file).relative_error < 1.2 * validation(without).relative_error
    # So do the bodies that predict each block from the others: their error is that of such files.
    last = file.at(spatial.PARAMETER_NAMES)
    assert all(spatial.is_consistent(values[last] - theta) for values in file.alone)


def test_a_last_link_that_nothing_shows_settles_at_the_models(robot, recording):
    """The log decides where it tells, the model where it does not, whatever noise has made."""
    fitted = fit_recordings(robot, recording)
    names = fitted.arm.terms["last link"].names
    at = fitted.at(names)
    told = settled_values(fitted)
    moved = np.array([told[name] for name in names]) - fitted.values[at]
    assert np.all(np.abs(moved) < 0.2 * fitted.errors[at])
    # As a link of which noise has made something else, in a log that tells nothing of it.
    lost = fitted.values.copy()
    lost[at] += 100.0 * last_link_scale(robot)
    silent = replace(fitted, values=lost, noise=1e6 * fitted.noise)
    untold = settled_values(silent)
    settled = np.array([untold[name] for name in names])
    off = np.abs(settled - robot.prior.theta) / last_link_scale(robot)
    assert np.max(off) < 0.01
    # A flange may carry what a usual link weighs.
    assert last_link_scale(robot)[0] >= np.mean(robot.thetas[:, 0]) - 1e-9

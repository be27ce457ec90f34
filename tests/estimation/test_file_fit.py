"""What a file is given predicts, as a file, as well as is said; what it cannot hold is left out."""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.newton_euler import LinkDynamics, gravity_vector, with_gravity
from robot_sysid.estimation.choices import coupling
from robot_sysid.estimation.file_fit import fit_file, holds_polynomial
from robot_sysid.estimation.question import FILE_FRICTION as FRICTION
from robot_sysid.estimation.question import FILE_GRAVITY as GRAVITY
from robot_sysid.estimation.question import FILE_LINKS as LINKS
from robot_sysid.estimation.question import FILE_ROTORS as ROTORS
from robot_sysid.model.chain import CAN_HOLD_ROTORS
from robot_sysid.results.rollout import torque_error
from tests.support import arms
from tests.support.core_fits import BASIC, filter_logs, fit_recordings, fitter_of
from tests.support.measured_logs import log_of, plan_of


def recorded(plant, model, seed=1, more=None):
    """(the filtered log of an arm, the options)."""
    plan = plan_of(plant, seed, 20.0)
    log = log_of(plant, plan, seed, noise_torque=0.02, encoder_resolution=1e-5)
    moved = 0.0 if more is None else more(plan.evaluate(log.time))
    return filter_logs(model, replace(log, tau=log.tau + moved))


def file_of(plant, model, kept=(), more=None, couplings=()):
    """The file's fit."""
    datasets, options = recorded(plant, model, more=more)
    made = fit_recordings(model, datasets, options, couplings=couplings)
    return fit_file(
        fitter_of(model, datasets, couplings=couplings), options, kept, made
    )


def compiled(robot, fit):
    """The model as it would be written."""
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, fit.columns.thetas(fit.values)):
        arms.write_body(model, link.body_id, theta)
    fields = (("coulomb", model.dof_frictionloss), ("viscous", model.dof_damping))
    for term, field in (*fields, ("armature", model.dof_armature)):
        for dof, joint in zip(robot.dof_index, robot.joint_names):
            field[dof] = fit.value(f"{term}[{joint}]")
    model.opt.gravity[:] = fit.point.gravity
    return model


def turned(plant, degrees):
    turn = Rotation.from_rotvec(
        np.radians(degrees) * np.array([0.5, 0.8, 0.0]) / np.hypot(0.5, 0.8)
    )
    return with_gravity(plant, turn.apply(gravity_vector(plant)))


def angle(found, truth):
    cosine = found @ truth / np.linalg.norm(found) / np.linalg.norm(truth)
    return np.degrees(np.arccos(min(cosine, 1.0)))


def test_the_file_predicts_as_it_is_said_to(plant, robot):
    found = file_of(plant, robot)
    fit = found.fit
    own, other = (recorded(plant, robot, seed)[0][0] for seed in (1, 11))
    assert all(spatial.is_consistent(theta) for theta in fit.columns.thetas(fit.values))
    before = torque_error(robot.mj_model, robot, own.signals, "own").relative_error
    assert found.before.relative_error == pytest.approx(before, rel=0.05)
    assert found.after.relative_error < 0.02 * found.before.relative_error
    model = compiled(robot, fit)
    for recording in (own, other):
        error = torque_error(model, robot, recording.signals, "file").relative_error
        assert error == pytest.approx(found.after.relative_error, rel=0.25)
    # Nothing but what a file holds, and each joint's sensor offset.
    terms = {
        name.partition("[")[0] for name in fit.unknowns.estimated_names if "[" in name
    }
    assert terms == {"coulomb", "viscous", "offset"}
    assert np.array_equal(fit.point.gravity, gravity_vector(robot))


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_links_and_sensor_offsets_do_not_take_each_other_s_part(plant, offset):
    """They read alike where joints turn little: the file has to be right without the sensors."""
    read = np.array([0.0, offset, 0.0])
    log = log_of(plant, plan_of(plant, 2, 5.0), 2, noise_torque=0.02)
    datasets, options = filter_logs(plant, replace(log, tau=log.tau + read))
    made = fit_recordings(plant, datasets, options)
    fit = fit_file(fitter_of(plant, datasets), options, (), made).fit
    found = np.array([fit.value(f"offset[{joint}]") for joint in plant.joint_names])
    assert found == pytest.approx(read, abs=0.02 if offset else 1e-6)
    # Beside a sensor that is clearly off, the others may be a little.
    assert fit.choice.offsets
    assert all((size > 0.0) == (offset > 0.0) for size in fit.choice.offsets.values())
    still = log.q[::50]
    moves = LinkDynamics(plant).motion(still, 0.0 * still, 0.0 * still)
    weight = moves.torque(plant.thetas)
    off = moves.torque(fit.columns.thetas(fit.values)) - weight
    assert np.linalg.norm(off) < 0.02 * np.linalg.norm(weight)


def test_a_turned_gravity_is_found_and_kept_out_where_it_is_to_stay(plant, robot):
    askew = turned(plant, 2.0)
    found = file_of(askew, robot)
    assert angle(found.fit.point.gravity, gravity_vector(askew)) < 0.3
    kept = file_of(askew, robot, (GRAVITY,))
    assert np.array_equal(kept.fit.point.gravity, gravity_vector(robot))
    assert kept.after.relative_error > found.after.relative_error


def without_rotors(robot):
    model = copy.copy(robot.mj_model)
    model.dof_armature[:] = 0.0
    return replace(robot, mj_model=model)


def test_a_rotor_is_that_of_the_estimate_where_it_is_clear_else_the_model_s(
    plant, robot
):
    """What a file lacks of friction would look like one."""

    def more(motion):
        return (
            1.5
            * np.sign(motion.qd)
            * np.exp(-((motion.qd / 0.3) ** 2))
            * [0.0, 1.0, 0.0]
        )

    for model, error in ((robot, 0.0), (without_rotors(robot), 0.01)):
        datasets, options = recorded(plant, model, more=more)
        made = fit_recordings(model, datasets, options, f"{BASIC}-stribeck")
        fit = fit_file(fitter_of(model, datasets), options, (), made).fit
        found = [fit.value(f"armature[{joint}]") for joint in model.joint_names]
        assert found == pytest.approx([0.05] * 3, abs=error)


@pytest.mark.parametrize("parts", [(FRICTION,), (ROTORS, LINKS)])
def test_a_part_that_is_to_stay_stays(plant, robot, parts):
    fit = file_of(plant, without_rotors(robot), (*parts, GRAVITY)).fit
    stays = {
        FRICTION: ["coulomb[joint1]", "viscous[joint2]"],
        ROTORS: ["armature[joint0]", "armature[joint2]"],
        LINKS: ["m(link0)", "Izz(link1)"],
    }
    for name, held in (
        (name, kind in parts) for kind, names in stays.items() for name in names
    ):
        place = fit.columns.index[name]
        assert (fit.values[place] == fit.columns.prior[place]) == held, name
    assert "offset[joint1]" in fit.unknowns.estimated_names


def test_a_urdf_gets_no_rotors(plant, robot):
    """It cannot hold them: what it has beside links is friction, and rotors count as links."""
    model = replace(robot, kind="urdf")
    fit = file_of(plant, model).fit
    assert not [
        name for name in fit.unknowns.estimated_names if name.startswith("armature[")
    ]
    assert all(fit.value(f"armature[{joint}]") == 0.0 for joint in model.joint_names)


@pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "dof_dampingpoly"), reason="MuJoCo before 3.7"
)
def test_nonlinear_damping_is_given_to_the_joint_that_has_it(plant, robot):
    def more(motion):
        return 0.3 * motion.qd * np.abs(motion.qd) * [0.0, 1.0, 0.0]

    fit = file_of(plant, robot, (GRAVITY,), more).fit
    bent = ["quadratic" in model.terms for model in fit.choice.friction]
    assert bent == [False, True, False]
    joint = robot.joint_names[1]
    curve = fit.value(f"quadratic[{joint}]") + fit.value(f"cubic[{joint}]")
    assert curve == pytest.approx(0.3, abs=0.15)
    assert holds_polynomial(robot, 1, "mjcf") and not holds_polynomial(robot, 1, "urdf")
    other = file_of(plant, robot, (FRICTION, GRAVITY), more).fit
    assert not any("quadratic" in model.terms for model in other.choice.friction)


WRIST = np.array([0.0, 1.0, 1.0])
holds_motors = pytest.mark.skipif(not CAN_HOLD_ROTORS, reason="MuJoCo before 3.2.7")


def shared_motor(motion):
    speed = motion.qd @ WRIST
    acceleration = motion.qdd @ WRIST
    return np.outer(1.5 * np.sign(speed) + 0.4 * speed + 0.02 * acceleration, WRIST)


@holds_motors
def test_a_motor_that_turns_two_joints_is_in_the_file(plant, robot):
    motors = (coupling(robot, WRIST),)
    with_it = file_of(plant, robot, (GRAVITY,), shared_motor, motors)
    without = file_of(plant, robot, (GRAVITY,), shared_motor)
    for term, value in {"coulomb": 1.5, "viscous": 0.4, "armature": 0.02}.items():
        assert with_it.fit.value(f"{term}[joint1+joint2]") == pytest.approx(
            value, rel=0.1
        )
    assert with_it.after.relative_error < 0.2 * without.after.relative_error
    assert with_it.beside is None

    kept = file_of(plant, robot, (GRAVITY, FRICTION), shared_motor, motors).fit
    assert (
        kept.value("coulomb[joint1+joint2]")
        == 0.0
        != kept.value("armature[joint1+joint2]")
    )
    kept = file_of(plant, robot, (GRAVITY, FRICTION, ROTORS), shared_motor, motors).fit
    assert not kept.choice.couplings


@holds_motors
def test_beside_the_mjcf_that_holds_such_a_motor_a_urdf_is_fitted_as_one(plant, robot):
    model = replace(robot, kind="urdf")
    found = file_of(plant, model, (GRAVITY,), shared_motor, (coupling(robot, WRIST),))
    assert (
        found.fit.question.file_kind == "mjcf"
        and found.beside.fit.question.file_kind == "urdf"
    )
    alone = file_of(plant, model, (GRAVITY,), shared_motor)
    assert found.beside.after.relative_error == pytest.approx(
        alone.after.relative_error, rel=0.05
    )
    assert found.after.relative_error < 0.2 * alone.after.relative_error

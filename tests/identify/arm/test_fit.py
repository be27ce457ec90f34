"""Every link from logs of a small arm whose truth is known."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import BENT
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.arm.base_parameters import base_combinations
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.identify.arm import fit as module
from robot_sysid.identify.arm.columns import ArmColumns
from robot_sysid.identify.arm.couplings import coupling
from robot_sysid.identify.arm.fit import fit_arm
from robot_sysid.identify.arm.model_friction import model_friction
from robot_sysid.identify.arm.result import (
    estimate_of,
    judge,
    model_error,
    parameter_scale,
    structural_base,
)
from robot_sysid.records import Validation
from robot_sysid.records.progress import Progress
from robot_sysid.records.whole_arm import ArmStatus
from robot_sysid.signals.process import process
from tests.support import arms
from tests.support.measured_logs import JOINT, log_of, plan_of, true_arm

CUTOFF = 8.0
WRIST = np.array([0.0, 1.0, 1.0])


def off_by(robot, share, seed=0):
    """The same arm as a model whose links' masses and inertias are off by about this share."""
    rng = np.random.default_rng(seed)
    links = [replace(each, theta=each.theta * np.exp(share * rng.normal())) for each in robot.links]
    model = arms.compile_xml(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT))
    for each in links:
        arms.write_body(model, each.body_id, each.theta)
    model.dof_frictionloss[:] = model.dof_damping[:] = model.dof_armature[:] = 0.0
    return arms.robot_of(model)


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def robot(plant):
    return off_by(plant, 0.2)


@pytest.fixture(scope="module")
def signals(plant, robot):
    return [
        process(log_of(plant, plan_of(plant, seed)), robot.joint_names, CUTOFF) for seed in (1, 2)
    ]


def fit_of(robot, signals, **options):
    chosen = ArmOptions(**{"cutoff": CUTOFF, **options})
    return fit_arm(robot, signals, chosen, Progress())


@pytest.fixture(scope="module")
def fit(robot, signals):
    return fit_of(robot, signals[:1], model_weight=1e-3, friction=module.BASIC)


def test_noise_free_torques_give_the_true_base_parameters(fit, plant, robot):
    estimate = estimate_of(robot, fit)
    assert estimate.base.rank == estimate.base.structural_rank
    # Rotor inertia of the first joints and some of their links' inertia turn alike.
    found = with_rotors(robot)
    rotors = [estimate.value(f"armature[{joint}]") for joint in robot.joint_names]
    truth = np.concatenate([*(link.theta for link in plant.links), [0.05] * 3])
    value = np.concatenate((*estimate.thetas, rotors))
    assert found.matrix @ value == pytest.approx(found.matrix @ truth, abs=2e-4)


def with_rotors(robot):
    """Combinations of the links' parameters and all joints' rotor inertia that torques can show."""
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 40, 3))
    links = LinkDynamics(robot).motion(q, qd, qdd).columns(range(3))
    both = np.concatenate((links, qdd[:, :, None] * np.eye(3)), axis=-1)
    scale = np.append(parameter_scale(3), np.ones(3))
    return base_combinations(both.reshape(-1, 33), scale)


def test_friction_and_rotor_inertia_come_with_them(fit, robot):
    held = model_friction(robot, fit, estimate_of(robot, fit))
    for joint in held.values():
        assert joint.values["coulomb"] == pytest.approx(0.3, abs=0.01)
        assert joint.values["viscous"] == pytest.approx(0.2, abs=0.01)
        assert set(joint.kept) <= {"armature"} and "cubic" not in joint.values
        curve = joint.curve
        expected = 0.3 * np.sign(curve.measured_speed) + 0.2 * curve.measured_speed
        assert curve.measured_torque == pytest.approx(expected, abs=0.05)
    assert held["joint2"].values["armature"] == pytest.approx(0.05, abs=1e-3)


def test_every_link_is_a_possible_body(fit):
    assert all(spatial.is_consistent(theta) for theta in fit.thetas)


def test_another_log_is_predicted(fit, robot, signals):
    assert fit.validate_on(robot, signals[1:], "other").relative_error < 2e-3
    assert fit.validation("own").relative_error < 2e-3


def test_no_motor_is_shared_where_none_is(fit):
    assert fit.couplings == ()


def test_a_heavy_model_stays(robot, signals):
    fit = fit_of(robot, signals[:1], model_weight=1e9, friction="coulomb-viscous-offset")
    model = np.array([link.theta for link in robot.links])
    assert fit.thetas == pytest.approx(model, rel=1e-3, abs=1e-6)


@pytest.mark.slow
def test_the_weight_of_a_right_model_is_larger_than_that_of_a_wrong_one(plant):
    noisy = [process(log_of(plant, noise_torque=0.3), plant.joint_names, CUTOFF)]
    assert fit_of(off_by(plant, 1.0), noisy).gamma < fit_of(plant, noisy).gamma == 1000.0


def test_rotor_inertia_that_does_not_show_stays_at_the_models(plant, signals):
    fit = fit_of(plant, signals[:1], model_weight=1.0, friction=module.BASIC)
    values = dict(zip(fit.columns.names, fit.values))
    for joint in plant.joint_names:
        # With nothing to hold it, that of the first joints would go to zero.
        assert values[f"armature[{joint}]"] == pytest.approx(0.05, abs=5e-3)


def shared_wrist(plant, friction=1.5, seed=1):
    """A log of an arm whose last motor turns with both last joints."""
    log = log_of(plant, plan_of(plant, seed))
    speed = np.gradient(log.q, log.time, axis=0) @ WRIST
    tau = log.tau + (friction * np.sign(speed) + 0.4 * speed)[:, None] * WRIST
    return replace(log, tau=tau)


def test_a_shared_motor_is_found(plant, robot):
    signals = [process(shared_wrist(plant), robot.joint_names, CUTOFF)]
    fit = fit_of(robot, signals, friction=module.BASIC)
    assert [each.name for each in fit.couplings] == ["joint1+joint2"]
    values = dict(zip(fit.columns.names, fit.values))
    assert values["coulomb[joint1+joint2]"] == pytest.approx(1.5, abs=0.1)
    assert values["viscous[joint1+joint2]"] == pytest.approx(0.4, abs=0.05)


@pytest.mark.slow
def test_a_given_coupling_is_taken_whatever_the_log_says(robot, signals, tmp_path):
    path = tmp_path / "coupling.json"
    path.write_text(json.dumps({"motor_3": {"joint1": 1.0, "joint2": 1.0}}))
    fit = fit_of(robot, signals[:1], coupling=path, friction=module.BASIC)
    assert [each.name for each in fit.couplings] == ["joint1+joint2"]
    assert fit.validation("own").relative_error < 5e-3


def test_columns_of_a_choice_are_those_made_for_it_alone(robot, signals):
    both = [coupling(robot, WRIST), coupling(robot, np.array([1.0, 1.0, 0.0]))]
    thetas = np.array([link.theta for link in robot.links])
    (fewer,) = ArmColumns(robot, signals[:1], both).with_couplings(both[:1]).samples(thetas)
    (alone,) = ArmColumns(robot, signals[:1], both[:1]).samples(thetas)
    assert fewer.names == alone.names
    for mine, theirs in zip(fewer.rows, alone.rows):
        assert np.array_equal(mine, theirs)
    for mine, theirs in zip(fewer.columns, alone.columns):
        assert np.array_equal(mine, theirs)


@pytest.mark.slow
def test_a_crooked_base_and_a_wrong_zero_are_found(plant, robot):
    log = log_of(plant, plan_of(plant))
    shifted = replace(log, q=log.q + np.array([0.0, 0.01, 0.0]))
    signals = [process(shifted, robot.joint_names, CUTOFF)]
    fit = fit_of(robot, signals, friction=module.BASIC, zero_uncertainty=10.0)
    values = dict(zip(fit.columns.names, fit.values))
    assert values["zero[joint1]"] == pytest.approx(0.01, abs=2e-3)
    assert abs(values["zero[joint2]"]) < 2e-3
    exact = fit_of(robot, signals, friction=module.BASIC, zero_uncertainty=0.0)
    assert not any(name.startswith("zero") for name in np.array(exact.columns.names)[exact.kept])


def test_structural_rank_is_that_of_textbooks():
    """A vertical first axis shows one parameter, a planar two-link arm under gravity seven."""
    upright = arms.robot_of(arms.serial_arm((arms.Z,)))
    assert structural_base(upright).rank == 1
    assert structural_base(arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X)))).rank == 15


def validation(error):
    return Validation("x", 1, 0.0, error, {}, {})


def test_what_cannot_be_is_not_trusted(fit, robot):
    estimate = estimate_of(robot, fit)
    assert judge(robot, estimate, validation(0.05), 0.2) == (ArmStatus.OK, ())
    assert judge(robot, estimate, validation(0.3), 0.2)[0] is ArmStatus.UNPREDICTED
    assert judge(robot, estimate, validation(0.6), 0.9)[0] is ArmStatus.UNPREDICTED
    assert judge(robot, estimate, validation(None), 0.9)[0] is ArmStatus.UNPREDICTED
    heavy, far = copy.copy(estimate.thetas), copy.copy(estimate.thetas)
    heavy[1] *= 100.0
    mass, com, inertia = spatial.com_from_theta(far[2])
    far[2] = spatial.theta_from_com(mass, com + 2.0, inertia)
    for thetas, said in ((heavy, "would weigh"), (far, "centre of mass of link2")):
        status, reasons = judge(robot, replace(estimate, thetas=thetas), validation(0.05), 0.2)
        assert status is ArmStatus.IMPLAUSIBLE and said in reasons[0]


def test_the_models_own_links_predict_worse(fit):
    assert model_error(fit) > 10.0 * fit.validation("own").relative_error


@pytest.mark.slow
def test_simplest_friction_wins_where_more_does_not_help(robot, signals):
    assert set(fit_of(robot, signals).friction.values()) == {module.BASIC}


def test_nothing_is_said_of_a_joint_that_does_not_move(plant, robot):
    """The search begins with a guess; it must not come out as a result."""
    plan = plan_of(plant).scaled(np.array([1.0, 1.0, 0.0]))
    signals = [process(log_of(plant, plan, noise_torque=0.05), robot.joint_names, CUTOFF)]
    fit = fit_of(robot, signals, friction=module.BASIC, model_weight=1.0)
    estimate = estimate_of(robot, fit)
    assert fit.friction["joint2"] == "none" and fit.friction["joint1"] == module.BASIC
    own = [name for name in estimate.names if name.endswith("[joint2]")]
    assert own == ["zero[joint2]"]
    held = model_friction(robot, fit, estimate)["joint2"]
    terms = ("coulomb", "viscous", "armature")
    assert [held.written(term) for term in terms] == [None] * 3
    assert "does not move fast enough" in held.notes[0]


def with_stribeck(plant, drop=0.4, speed=0.05, more_forward=0.06):
    """A log of an arm whose joints hold on to where they are, and rub more one way."""
    log = log_of(plant, plan_of(plant), noise_torque=0.02)
    qd = np.gradient(log.q, log.time, axis=0)
    extra = drop * np.sign(qd) * np.exp(-((qd / speed) ** 2)) + more_forward
    return replace(log, tau=log.tau + extra)


@pytest.mark.slow
def test_the_speed_of_a_stribeck_term_is_found_with_it(plant, robot):
    signals = [process(with_stribeck(plant), robot.joint_names, CUTOFF)]
    model = f"{module.BASIC}-stribeck"
    estimate = estimate_of(robot, fit_of(robot, signals, friction=model, model_weight=1.0))
    for joint in robot.joint_names:
        for name, true in (("stribeck_speed", 0.05), ("stribeck", 0.4), ("coulomb", 0.3)):
            found, error = (f(f"{name}[{joint}]") for f in (estimate.value, estimate.error))
            assert found == pytest.approx(true, abs=max(4.0 * error, 0.05 * true))
            assert 0.0 < error < 0.2 * true
        (forward, _), (backward, error) = estimate.two_way[joint]
        assert (forward, backward) == pytest.approx((0.36, 0.24), abs=max(4.0 * error, 0.02))


def test_a_stribeck_term_that_is_not_there_stays_within_its_bounds(plant, robot, signals):
    model = f"{module.BASIC}-stribeck"
    fit = fit_of(robot, signals[:1], friction=model, model_weight=1.0)
    low, high = BENT["stribeck"].bounds
    assert np.all((fit.bends.speed["stribeck"] >= low) & (fit.bends.speed["stribeck"] <= high))
    values = dict(zip(fit.columns.names, fit.values))
    for joint in robot.joint_names:
        assert values[f"stribeck[{joint}]"] == pytest.approx(0.0, abs=0.02)
        assert values[f"coulomb[{joint}]"] == pytest.approx(0.3, abs=0.02)

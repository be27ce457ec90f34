"""Recordings choose the friction terms and scales that they clearly show, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.equations import NO_FRICTION, Equations
from robot_sysid.dynamics.friction import DEFAULT_MEASURED, friction_model
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics
from robot_sysid.estimation.choices import (
    CANDIDATES,
    choose,
    clearly_best,
    coupling,
    couplings_of,
    couplings_of_model,
    neighbours,
    select_couplings,
)
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.held_out import CLEAR_SHARE
from robot_sysid.estimation.question import EstimationOptions, Priors, Question
from robot_sysid.estimation.unknowns import SCALES
from robot_sysid.records import Measurement, Motion
from robot_sysid.simulator import simulate_inverse
from tests.support import arms
from tests.support.core_fits import BASIC, filter_logs, fitter_of
from tests.support.measured_logs import JOINT, RATE, XML, log_of, plan_of
from tests.support.payload_logs import perturb_body
from tests.support.releases import since
from tests.support.synthetic_data import autocorrelated

STRIBECK = f"{BASIC}-stribeck"
RICHEST = CANDIDATES[-1]
MIDDLE = np.array([0.0, 1.0, 0.0])
WRIST = np.array([0.0, 1.0, 1.0])
BLOCKS = np.array([1.0, 2.0, 0.5, 1.0, 1.5])


def block_errors(factors):
    """Return each candidate's squared error of each block, from factors by candidate."""
    return {name: BLOCKS * factors.get(name, 1.0) for name in CANDIDATES}


@pytest.mark.parametrize(
    ("factors", "best"),
    [
        ({}, BASIC),
        ({STRIBECK: 0.5}, STRIBECK),
        ({STRIBECK: 0.5, RICHEST: 0.2}, RICHEST),
        # As good, but with more terms, or a little better only.
        ({STRIBECK: 0.5, RICHEST: 0.5}, STRIBECK),
        ({STRIBECK: 1.0 - 0.8 * CLEAR_SHARE}, BASIC),
        # Clearly lower on average, but by 0.5 or 1.5 standard errors of that only; and by more.
        ({RICHEST: np.exp([-0.9, -0.5, 0.6, 0.2, -0.1])}, BASIC),
        ({RICHEST: np.exp([-0.9, -0.4, 0.3, -0.1, -0.4])}, BASIC),
        ({RICHEST: np.exp([-0.4, -0.1, -0.3, -0.1, -0.2])}, RICHEST),
        # Much better in one block, worse in another.
        ({RICHEST: np.array([0.2, 1.6, 1.0, 0.9, 1.3])}, BASIC),
    ],
)
def test_the_simplest_candidate_wins_that_no_other_clearly_beats(factors, best):
    assert clearly_best(block_errors(factors)) == best


def no_torque(motion):
    return 0.0 * motion.q


def choose_and_fit(
    plant,
    robot,
    extra_torque=no_torque,
    offers_couplings=False,
    friction=None,
    seed=1,
    duration=10.0,
    **uncertainties,
):
    """Return (fit of a simulated log, held-out errors by joint and friction model).

    ``extra_torque`` is a function of the exact motion that is added to the plant's torque.
    """
    plan = plan_of(plant, seed, duration)
    log = log_of(plant, plan, seed, noise_torque=0.02, encoder_resolution=1e-5)
    log = replace(log, tau=log.tau + extra_torque(plan.evaluate(log.time)))
    datasets, options = filter_logs(robot, log, **uncertainties)
    motors = tuple(neighbours(robot)) if offers_couplings else ()
    fitter = fitter_of(robot, datasets, couplings=motors)
    model = friction and friction_model(friction)
    question = Question(options)
    couplings = ()
    if offers_couplings:
        couplings = select_couplings(fitter, question, model, motors)
    choice, errors, start = choose(fitter, question, model, couplings)
    return fitter.fit(question, choice, start, rounds=1), errors


def friction_names(fit):
    return [model.name for model in fit.choice.friction]


def test_nothing_is_added_where_nothing_is_missing(plant, robot):
    fit, errors_of_joints = choose_and_fit(plant, robot, offers_couplings=True)
    assert friction_names(fit) == [BASIC] * 3
    assert fit.choice.couplings == ()
    assert set(errors_of_joints) == set(robot.joint_names)
    for errors in errors_of_joints.values():
        assert set(errors) == set(CANDIDATES)
        assert errors[BASIC] == pytest.approx(min(errors.values()), rel=0.1)


def test_rows_at_reversals_are_left_out_of_a_joint_that_sticks_there(robot, noisy):
    """The second joint's friction reverses as late as that of a joint that stood for 80 ms."""
    (plain,), _ = filter_logs(robot, noisy)
    assert plain.signals.standing == ()
    speed = np.gradient(noisy.q[:, 1], noisy.time)
    direction = np.sign(np.convolve(speed, np.ones(9) / 9.0, "same"))
    tau = noisy.tau.copy()
    tau[:, 1] += 1.5 * (np.roll(direction, 8) - direction)
    (recording,), _ = filter_logs(robot, replace(noisy, tau=tau))
    assert recording.signals.standing == (1,)
    usable = recording.signals.usable()
    plain_usable = plain.signals.usable()
    assert_array_equal(usable[:, [0, 2]], plain_usable[:, [0, 2]])
    assert np.mean(usable[:, 1]) < np.mean(plain_usable[:, 1])


def stribeck(motion):
    return 0.4 * np.sign(motion.qd) * np.exp(-((motion.qd / 0.05) ** 2))


def square_root(motion):
    return 0.8 * np.sign(motion.qd) * np.sqrt(np.abs(motion.qd))


def load_loss(motion):
    robot = arms.robot_of(XML)
    dynamics = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    return 0.2 * np.sign(motion.qd) * np.abs(dynamics.torque(robot.thetas))


@pytest.mark.parametrize(
    ("term", "friction"),
    [("stribeck", stribeck), ("sqrt", square_root), ("load", load_loss)],
)
def test_a_friction_term_goes_to_the_joint_that_has_it(plant, robot, term, friction):
    fit, errors = choose_and_fit(
        plant, robot, lambda motion: friction(motion) * MIDDLE, seed=2
    )
    name = f"{BASIC}-{term}"
    assert friction_names(fit) == [BASIC, name, BASIC]
    assert errors["joint1"][name] < 0.9 * errors["joint1"][BASIC]
    if term == "stribeck":
        assert fit.point.speed["stribeck"][1] == pytest.approx(0.05, rel=0.2)


def test_a_speed_of_friction_settles_before_further_friction_is_allowed_for(
    plant, robot
):
    """What a wrong speed misses would go to priors on other shapes, which leave no slope to it."""
    plan = plan_of(plant, 2, 10.0)
    log = log_of(plant, plan, 2, noise_torque=0.02, encoder_resolution=1e-5)
    motion = plan.evaluate(log.time)
    middle = np.sign(motion.qd) * np.exp(-((motion.qd / 0.032) ** 2)) * MIDDLE
    datasets, options = filter_logs(robot, replace(log, tau=log.tau + 0.4 * middle))
    choice, _, point = choose(fitter_of(robot, datasets), Question(options), None, ())
    assert "stribeck" in choice.friction[1].terms
    assert point.speed["stribeck"][1] == pytest.approx(0.032, rel=0.1)


def shared_motor(motion):
    speed = motion.qd @ WRIST
    return (1.5 * np.sign(speed) + 0.4 * speed)[:, None] * WRIST


def test_a_shared_motor_is_found(plant, robot):
    fit, _ = choose_and_fit(plant, robot, shared_motor, offers_couplings=True)
    assert [coupling.name for coupling in fit.choice.couplings] == ["joint1+joint2"]
    assert friction_names(fit) == [BASIC] * 3
    assert fit.value("coulomb[joint1+joint2]") == pytest.approx(1.5, abs=0.1)
    assert fit.value("viscous[joint1+joint2]") == pytest.approx(0.4, abs=0.05)


def perturb_links(robot, share, seed):
    """Return the arm's model with links that differ by a share."""
    rng = np.random.default_rng(seed)
    model = arms.compile_xml(XML)
    for link in robot.links:
        arms.write_body(model, link.body_id, perturb_body(link.theta, share, rng))
    return arms.robot_of(model)


def test_the_prior_of_links_widens_where_all_links_are_wrong(plant):
    """That the links are wrong, and not the torques, follows from the given torque scales."""
    choices = []
    for model in (perturb_links(plant, 0.5, 7), plant):
        known_scales = {"duration": 30.0, "priors": Priors(scale=2.0)}
        fit, _ = choose_and_fit(plant, model, friction=BASIC, **known_scales)
        choices.append(fit.choice)
    wide, narrow = (choice.link_scales for choice in choices)
    assert wide.mass > narrow.mass
    assert wide.centre_of_mass > narrow.centre_of_mass
    assert not choices[0].common_scale


def test_a_body_that_two_joints_move_is_one_link_of_the_prior():
    """The first of its joints has a link without mass, which the model cannot state wrong."""
    turn = f'<joint name="turn" {JOINT} axis="{arms.Z}"/>'
    xml = arms.serial_arm((arms.Y, arms.X), joint=JOINT)
    xml = xml.replace('<joint name="joint0"', f'{turn}<joint name="joint0"', 1)
    plant = arms.robot_of(xml)
    assert [link.has_mass for link in plant.links] == [False, True, True]
    fit, _ = choose_and_fit(plant, plant, friction=BASIC)
    stated = fit_errors(fit).total.standard_errors[0]
    assert abs(fit.values[0] - plant.prior.mass) < 2.0 * stated


LONG = {"friction": BASIC, "seed": 3, "duration": 30.0}
LEVEL = Priors(zero=0.5, gravity=0.02, delay=0.0)


def scale_torque(plant, factor):
    """Return what a common torque scale adds to the torque, as a function of the motion."""
    dynamics = ArmDynamics(plant)
    return lambda motion: (
        (factor - 1.0) * dynamics.torque(motion.q, motion.qd, motion.qdd)
    )


@pytest.mark.parametrize(
    ("factor", "is_scaled"), [(1.0, False), (1.25, True), (0.8, True)]
)
def test_a_common_torque_scale_is_distinguished_from_wrong_links(
    plant, factor, is_scaled
):
    """The model is the plant; a common scale looks like links that are all wrong alike."""
    torque = scale_torque(plant, factor)
    priors = replace(LEVEL, link=0.2)
    fit, _ = choose_and_fit(plant, plant, torque, **LONG, priors=priors)
    mass = plant.prior.mass
    assert bool(fit.choice.common_scale) == is_scaled
    error = abs(fit.values[0] - mass)
    stated = fit_errors(fit).total.standard_errors[0]
    assert error < 0.1 * mass and error < 2.0 * stated < 0.2 * mass


@pytest.mark.parametrize(("link", "grows"), [(1.0, True), (0.05, False)])
def test_errors_grow_where_a_common_torque_scale_is_doubtful(plant, link, grows):
    """Torques contradict by 25 % links that are known to 1 %, or to 0.05 %: then they are wrong."""
    torque = scale_torque(plant, 1.25)
    priors = replace(LEVEL, link=link)
    fit, _ = choose_and_fit(plant, plant, torque, **LONG, priors=priors)
    errors = fit_errors(fit)
    (scales,) = (group for group in fit.unknowns.groups if group.cause == SCALES)
    prior_rows = scales.covariance_rows(fit.information.names, errors.total.inverse)
    growth = np.sum(errors.causes[SCALES][:, 0] ** 2) / np.sum(prior_rows[:, 0] ** 2)
    assert growth > 1.5 if grows else growth == pytest.approx(1.0, abs=0.01)


def test_autocorrelated_noise_does_not_widen_the_prior_of_links(plant, robot):
    def noise(motion):
        white = np.random.default_rng(3).standard_normal(motion.q.shape)
        return 0.1 * autocorrelated(white, 0.3 * RATE)

    slow, fast = (
        choose_and_fit(plant, robot, torque, **{**LONG, "seed": 1})[
            0
        ].choice.link_scales
        for torque in (noise, no_torque)
    )
    assert slow.mass < 1.2 * fast.mass
    assert slow.centre_of_mass < 2.0 * fast.centre_of_mass


# ---- motors that turn several joints


@pytest.fixture(scope="module")
def wrist():
    """Return an arm whose model has a motor that turns two joints."""
    return arms.robot_of(arms.SHARED_MOTOR)


@since(3, 3)
@pytest.mark.parametrize("friction", [NO_FRICTION, friction_model(DEFAULT_MEASURED)])
def test_a_motor_of_the_model_is_in_the_torque_whether_estimated_or_not(
    wrist, friction
):
    (motor,) = couplings_of_model(wrist)
    assert motor.name == "joint1-2*joint2" and motor.tendon == 0
    assert_array_equal(motor.model[:3], [1.5, 0.4, 0.03])
    motion = Motion(
        np.arange(20.0), *arms.random_motion(np.random.default_rng(0), 3, 20)
    )
    (measured,) = simulate_inverse(wrist, [motion])
    for motors in ((), (motor,)):
        equations = Equations(wrist, "chain", (friction,) * 3, motors)
        for (rows, tau), columns in zip(equations.rows(measured), equations.columns):
            assert_allclose(rows @ equations.prior[columns], tau, atol=1e-10)


@since(3, 3)
def test_motors_of_the_model_are_no_candidates(wrist):
    motors, candidates = couplings_of(wrist, EstimationOptions())
    assert [motor.tendon for motor in motors] == [0, None, None, None, None]
    assert motors[1:] == candidates


def test_a_spring_or_a_tendon_to_a_held_joint_is_no_motor():
    spring = arms.TENDON_SPRING.replace('damping="3"', "")
    assert couplings_of_model(arms.robot_of(spring)) == ()
    (damper,) = couplings_of_model(arms.robot_of(arms.TENDON_SPRING))
    assert damper.model[1] == 3.0 and not np.any(damper.model[[0, 2]])
    shorter_arm = arms.robot_of(arms.TENDON_SPRING, joint="joint1")
    assert couplings_of_model(shorter_arm) == ()


def test_joints_and_motor_have_the_same_power(three_joint_arm):
    """tau^T qd = tau_motor s, whatever the ratios."""
    qd, qdd, q, tau = np.random.default_rng(0).normal(size=(4, 5, 3))
    motor = coupling(three_joint_arm, np.array([0.5, 0.0, -2.0]))
    equations = Equations(three_joint_arm, "chain", (NO_FRICTION,) * 3, (motor,))
    rows_of_joints = equations.rows(Measurement(np.arange(5.0), q, qd, tau, qdd))
    power = np.zeros((len(equations.names), 5))
    for joint, (rows, _) in enumerate(rows_of_joints):
        power[equations.columns[joint]] += rows.T * qd[:, joint]
    speed = qd @ motor.ratios
    for term, expected in (("viscous", speed**2), ("coulomb", np.abs(speed))):
        index = equations.names.index(f"{term}[{motor.name}]")
        assert power[index] == pytest.approx(expected)

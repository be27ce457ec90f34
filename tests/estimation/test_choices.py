"""Recordings choose the friction terms and scales that they clearly show, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.choices import (
    CANDIDATES,
    choose,
    clearly_best,
    neighbours,
    select_couplings,
)
from robot_sysid.estimation.dataset import block_masks
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.held_out import CLEAR_SHARE, held_out, is_clearly_lower
from robot_sysid.estimation.question import Question
from robot_sysid.estimation.unknowns import SCALES
from tests.support import arms
from tests.support.core_fits import BASIC, NOISE_ONLY, filter_logs, fit_logs, fitter_of
from tests.support.measured_logs import RATE, XML, log_of, plan_of
from tests.support.payload_logs import autocorrelated, perturb_body

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
        # Clearly lower on average, but not by two standard errors of that; and by more.
        ({RICHEST: np.exp([-0.9, -0.5, 0.6, 0.2, -0.1])}, BASIC),
        ({RICHEST: np.exp([-0.4, -0.1, -0.3, -0.1, -0.2])}, RICHEST),
        # Much better in one block, worse in another.
        ({RICHEST: np.array([0.2, 1.6, 1.0, 0.9, 1.3])}, BASIC),
    ],
)
def test_the_simplest_candidate_wins_that_no_other_clearly_beats(factors, best):
    assert clearly_best(block_errors(factors)) == best


def test_a_block_with_far_larger_errors_does_not_hide_an_improvement():
    """Every block improves fivefold; their errors differ by a factor of a hundred."""
    errors = np.array([4.2, 3.9, 2.8, 3.9, 400.0])
    assert is_clearly_lower(errors / 5.0, errors)


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
        known_scales = {"duration": 30.0, "scale_uncertainty": 2.0}
        fit, _ = choose_and_fit(plant, model, friction=BASIC, **known_scales)
        choices.append(fit.choice)
    wide, narrow = (choice.link_scales for choice in choices)
    assert wide.mass > narrow.mass
    assert wide.centre_of_mass > narrow.centre_of_mass
    assert not choices[0].common_scale


LONG = {"friction": BASIC, "seed": 3, "duration": 30.0}
LEVEL = {"zero_uncertainty": 0.5, "gravity_uncertainty": 0.02, "delay_uncertainty": 0.0}


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
    fit, _ = choose_and_fit(plant, plant, torque, **LONG, **LEVEL, link_uncertainty=0.2)
    mass = plant.prior.mass
    assert bool(fit.choice.common_scale) == is_scaled
    error = abs(fit.values[0] - mass)
    stated = fit_errors(fit).total.standard_errors[0]
    assert error < 0.1 * mass and error < 2.0 * stated < 0.2 * mass


@pytest.mark.parametrize(("link_uncertainty", "grows"), [(1.0, True), (0.05, False)])
def test_errors_grow_where_a_common_torque_scale_is_doubtful(
    plant, link_uncertainty, grows
):
    """Torques contradict by 25 % links that are known to 1 %, or to 0.05 %: then they are wrong."""
    torque = scale_torque(plant, 1.25)
    uncertainties = {**LEVEL, "link_uncertainty": link_uncertainty}
    fit, _ = choose_and_fit(plant, plant, torque, **LONG, **uncertainties)
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


# ---- cross-validation


def free_equations(samples, unknowns, weights):
    """Yield each joint's (rows (M, k), right-hand sides (M,)) in the free parameters."""
    for weight, rows, tau, columns in zip(
        weights, samples.rows, samples.tau, samples.columns
    ):
        full = np.zeros((len(rows), len(unknowns.names)))
        full[:, columns] = rows
        finite = np.isfinite(tau)
        fixed = np.delete(unknowns.held, unknowns.estimated)
        right = tau - np.delete(full, unknowns.estimated, 1) @ fixed
        yield weight * full[finite][:, unknowns.estimated], weight * right[finite]


def test_each_block_is_predicted_from_the_others(noisy_fit):
    """Against least squares of the rows themselves."""
    cross_validation = held_out(noisy_fit)
    (samples,) = noisy_fit.samples
    unknowns = noisy_fit.unknowns
    prior = np.vstack(
        [group.rows(unknowns.estimated_names) for group in unknowns.groups]
    )
    squared_errors = cross_validation.squared_errors(unknowns)
    for mask, squared in zip(block_masks(samples), squared_errors):
        weights = 1.0 / cross_validation.noise
        rows, right = zip(*free_equations(samples.where(~mask), unknowns, weights))
        matrix = np.vstack([*rows, prior[:, :-1]])
        values = np.linalg.lstsq(
            matrix, np.concatenate([*right, prior[:, -1]]), rcond=None
        )[0]
        block = free_equations(samples.where(mask), unknowns, np.ones(3))
        expected = [np.sum((rows @ values - tau) ** 2) for rows, tau in block]
        assert_allclose(squared, expected, rtol=1e-4)


def test_the_held_out_error_is_that_of_the_noise(payload_fit):
    cross_validation = held_out(payload_fit)
    squared_errors = cross_validation.consistent_squared_errors(payload_fit.unknowns)
    validation = cross_validation.validation(squared_errors, "parts")
    noise = np.sqrt(np.mean(payload_fit.weights**-2.0))
    assert validation.rmse == pytest.approx(noise, rel=0.15)
    assert 0.0 < validation.relative_error < 0.05
    assert tuple(validation.rmse_per_joint) == payload_fit.columns.joints
    assert cross_validation.score(squared_errors) == pytest.approx(1.0, abs=0.3)


def test_blocks_are_predicted_with_possible_bodies(robot, noisy):
    """With noise ten times as large, the plain estimate of a block is impossible."""
    noise = 3.0 * np.random.default_rng(1).normal(size=noisy.tau.shape)
    fit = fit_logs(robot, replace(noisy, tau=noisy.tau + noise), **NOISE_ONLY)
    assert spatial.is_consistent(fit.values[:10]) and fit.is_constrained
    cross_validation = held_out(fit)
    plain_errors = cross_validation.squared_errors(fit.unknowns)
    assert np.sum(cross_validation.consistent_squared_errors(fit.unknowns)) < np.sum(
        plain_errors
    )

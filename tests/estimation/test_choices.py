"""Recordings decide for what they clearly ask for, and for nothing else."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.choices import (
    CANDIDATES,
    CLEAR_SHARE,
    choose,
    clearly_best,
    held_out,
    is_clearly_lower,
)
from robot_sysid.estimation.couplings import neighbours, select_couplings
from robot_sysid.estimation.dataset import block_masks
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.unknowns import SCALES, Question
from tests.support import arms
from tests.support.core_fits import (
    BASIC,
    NOISE_ONLY,
    filter_logs,
    fit_recordings,
    fitter_of,
)
from tests.support.measured_logs import RATE, XML, log_of, plan_of
from tests.support.payload_logs import perturb_body

STRIBECK = f"{BASIC}-stribeck"
RICHEST = CANDIDATES[-1]
MIDDLE = np.array([0.0, 1.0, 0.0])
WRIST = np.array([0.0, 1.0, 1.0])
BLOCKS = np.array([1.0, 2.0, 0.5, 1.0, 1.5])


def scores(**factors):
    return {name: BLOCKS * factors.get(name, 1.0) for name in CANDIDATES}


@pytest.mark.parametrize(
    ("found", "taken"),
    [
        (scores(), CANDIDATES[0]),
        (scores(**{STRIBECK: 0.5}), STRIBECK),
        (scores(**{STRIBECK: 0.5, RICHEST: 0.2}), RICHEST),
        # As good, but with more terms, or a little better only.
        (scores(**{STRIBECK: 0.5, RICHEST: 0.5}), STRIBECK),
        (scores(**{STRIBECK: 1.0 - 0.8 * CLEAR_SHARE}), CANDIDATES[0]),
        # Clearly lower on average, but not by two standard errors of that; and by more.
        (
            {**scores(), RICHEST: BLOCKS * np.exp([-0.9, -0.5, 0.6, 0.2, -0.1])},
            CANDIDATES[0],
        ),
        (
            {**scores(), RICHEST: BLOCKS * np.exp([-0.4, -0.1, -0.3, -0.1, -0.2])},
            RICHEST,
        ),
        # Much better here, worse there.
        ({**scores(), RICHEST: BLOCKS * [0.2, 1.6, 1.0, 0.9, 1.3]}, CANDIDATES[0]),
    ],
)
def test_the_simplest_is_taken_that_is_not_clearly_beaten(found, taken):
    assert clearly_best(found) == taken


def test_a_stretch_that_shows_friction_far_more_than_others_does_not_hide_it():
    """Every stretch is far better; their gains differ by a factor of a hundred."""
    before = np.array([4.2, 3.9, 2.8, 3.9, 400.0])
    assert is_clearly_lower(before / 5.0, before)


def chosen(
    plant, robot, more, offered=False, given=None, seed=1, duration=10.0, **uncertain
):
    """(choice, its fit) of a log with more torque, of the exact motion, than the plant has."""
    plan = plan_of(plant, seed, duration)
    log = log_of(plant, plan, seed, noise_torque=0.02, encoder_resolution=1e-5)
    log = replace(log, tau=log.tau + more(plan.evaluate(log.time)))
    datasets, options = filter_logs(robot, log, **uncertain)
    motors = tuple(neighbours(robot)) if offered else ()
    fitter = fitter_of(robot, datasets, couplings=motors)
    model = given and friction_model(given)
    question = Question(options)
    shared = select_couplings(fitter, question, model, motors) if offered else ()
    choice, errors, start = choose(fitter, question, model, shared)
    fit = fitter.fit(question, choice, start, rounds=1)
    return SimpleNamespace(choice=choice, errors=errors), fit


def names(found):
    return [model.name for model in found.choice.friction]


def test_nothing_is_added_where_nothing_is_missing(plant, robot):
    found, _ = chosen(plant, robot, lambda motion: 0.0 * motion.q, offered=True)
    assert names(found) == [BASIC] * 3
    assert found.choice.couplings == ()
    assert set(found.errors) == set(robot.joint_names)
    for errors in found.errors.values():
        assert set(errors) == set(CANDIDATES)
        assert errors[BASIC] == pytest.approx(min(errors.values()), rel=0.1)


def test_rows_over_turns_are_left_out_of_the_joint_that_stands_there(robot, noisy):
    """The second joint's friction turns round as late as that of a joint that stood for 80 ms."""
    (plain,), options = filter_logs(robot, noisy)
    assert plain.signals.standing == ()
    speed = np.gradient(noisy.q[:, 1], noisy.time)
    direction = np.sign(np.convolve(speed, np.ones(9) / 9.0, "same"))
    late = np.roll(direction, 8) - direction
    tau = noisy.tau.copy()
    tau[:, 1] += 1.5 * late
    (recording,), _ = filter_logs(robot, replace(noisy, tau=tau))
    assert recording.signals.standing == (1,)
    used = recording.signals.usable()
    assert_array_equal(used[:, [0, 2]], plain.signals.usable()[:, [0, 2]])
    assert np.mean(used[:, 1]) < np.mean(plain.signals.usable()[:, 1])


def stribeck(motion):
    return 0.4 * np.sign(motion.qd) * np.exp(-((motion.qd / 0.05) ** 2))


def root(motion):
    return 0.8 * np.sign(motion.qd) * np.sqrt(np.abs(motion.qd))


def loss(motion):
    robot = arms.robot_of(XML)
    thetas = robot.thetas
    carried = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd).torque(thetas)
    return 0.2 * np.sign(motion.qd) * np.abs(carried)


@pytest.mark.parametrize(
    ("term", "more"), [("stribeck", stribeck), ("sqrt", root), ("load", loss)]
)
def test_the_joint_that_has_a_term_takes_it(plant, robot, term, more):
    found, fit = chosen(plant, robot, lambda motion: more(motion) * MIDDLE, seed=2)
    assert names(found) == [BASIC, f"{BASIC}-{term}", BASIC]
    assert (
        found.errors["joint1"][f"{BASIC}-{term}"] < 0.9 * found.errors["joint1"][BASIC]
    )
    if term == "stribeck":
        assert fit.point.speed["stribeck"][1] == pytest.approx(0.05, rel=0.2)


def shared_motor(motion):
    speed = motion.qd @ WRIST
    return (1.5 * np.sign(speed) + 0.4 * speed)[:, None] * WRIST


def test_a_shared_motor_is_found(plant, robot):
    found, fit = chosen(plant, robot, shared_motor, offered=True)
    assert [each.name for each in found.choice.couplings] == ["joint1+joint2"]
    assert names(found) == [BASIC] * 3
    assert fit.value("coulomb[joint1+joint2]") == pytest.approx(1.5, abs=0.1)
    assert fit.value("viscous[joint1+joint2]") == pytest.approx(0.4, abs=0.05)


def with_links(robot, share, seed):
    """The arm's model with links that are off."""
    rng = np.random.default_rng(seed)
    model = arms.compile_xml(XML)
    for link in robot.links:
        arms.write_body(model, link.body_id, perturb_body(link.theta, share, rng))
    return arms.robot_of(model)


def test_links_that_are_further_off_are_given_more_room(plant):
    """That all are, and not the torques, is known where scales are said."""
    model = with_links(plant, 0.5, 7)
    told = {"given": BASIC, "duration": 30.0}
    found, _ = chosen(
        plant, model, lambda motion: 0.0 * motion.q, scale_uncertainty=2.0, **told
    )
    usual, _ = chosen(
        plant, plant, lambda motion: 0.0 * motion.q, scale_uncertainty=2.0, **told
    )
    assert found.choice.link_scales.mass > usual.choice.link_scales.mass
    assert (
        found.choice.link_scales.centre_of_mass
        > usual.choice.link_scales.centre_of_mass
    )
    assert not found.choice.common_scale


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1.25, True), (0.8, True)])
def test_a_scale_of_all_torques_is_told_from_none(plant, factor, told):
    """The model is the plant, and what all torques read too much looks like links off alike."""

    def more(motion):
        return (factor - 1.0) * ArmDynamics(plant).torque(
            motion.q, motion.qd, motion.qdd
        )

    known = {
        "link_uncertainty": 0.2,
        "zero_uncertainty": 0.5,
        "gravity_uncertainty": 0.02,
    }
    known["delay_uncertainty"] = 0.0
    found, fit = chosen(plant, plant, more, given=BASIC, seed=3, duration=30.0, **known)
    assert bool(found.choice.common_scale) == told
    off = abs(fit.values[0] - plant.prior.mass)
    stated = fit_errors(fit).whole.standard_errors[0]
    assert off < 0.1 * plant.prior.mass and off < 2.0 * stated < 0.2 * plant.prior.mass


def test_errors_grow_where_there_may_be_no_scale_of_all_torques(plant):
    """Torques contradict by 25 % links that are known to 1 %, or to 0.05 %: then they are wrong."""

    def more(motion):
        return 0.25 * ArmDynamics(plant).torque(motion.q, motion.qd, motion.qdd)

    known = {
        "zero_uncertainty": 0.5,
        "gravity_uncertainty": 0.02,
        "delay_uncertainty": 0.0,
    }
    for share, either in ((1.0, True), (0.05, False)):
        told = {
            "given": BASIC,
            "seed": 3,
            "duration": 30.0,
            "link_uncertainty": share,
            **known,
        }
        _, fit = chosen(plant, plant, more, **told)
        errors = fit_errors(fit)
        names = fit.information.names
        (scales,) = (group for group in fit.unknowns.groups if group.cause == SCALES)
        parts = (
            scales.covariance_rows(names, errors.whole.inverse),
            errors.causes[SCALES],
        )
        prior, whole = (np.sum(rows[:, 0] ** 2) for rows in parts)
        grown = whole / prior
        assert grown > 1.5 if either else grown == pytest.approx(1.0, abs=0.01)


def test_noise_with_a_memory_alone_gives_them_none(plant, robot):
    def noise(motion):
        keep = np.exp(-1.0 / (0.3 * RATE))
        drive = np.sqrt(1.0 - keep**2) * np.random.default_rng(3).standard_normal(
            motion.q.shape
        )
        return 0.1 * lfilter([1.0], [1.0, -keep], drive, axis=0)

    found, _ = chosen(plant, robot, noise, given=BASIC, duration=30.0)
    white, _ = chosen(
        plant, robot, lambda motion: 0.0 * motion.q, given=BASIC, duration=30.0
    )
    slow = found.choice.link_scales
    fast = white.choice.link_scales
    assert slow.mass < 1.2 * fast.mass
    assert slow.centre_of_mass < 2.0 * fast.centre_of_mass


# ---- the judge


def equations(part, sought, weights):
    """Yield each joint's (rows (M, k), right-hand sides (M,)) in what is sought."""
    for weight, rows, tau, places in zip(weights, part.rows, part.tau, part.columns):
        full = np.zeros((len(rows), len(sought.names)))
        used = np.isfinite(tau)
        full[:, places] = rows
        known = np.delete(full, sought.kept, 1) @ np.delete(sought.held, sought.kept)
        yield weight * full[used][:, sought.kept], weight * (tau - known)[used]


def test_each_block_is_predicted_from_the_others(robot, noisy):
    """Done again by hand, with the rows themselves."""
    (log,), options = filter_logs(robot, noisy)
    fit = fit_recordings(robot, [log], options)
    judge = held_out(fit)
    (samples,) = fit.samples
    sought = fit.unknowns
    prior = np.vstack([group.rows(sought.kept_names) for group in sought.groups])
    for mask, squared in zip(block_masks(samples), judge.squared_errors(sought)):
        rest = list(equations(samples.where(~mask), sought, 1.0 / judge.noise))
        matrix = np.vstack([*(rows for rows, _ in rest), prior[:, :-1]])
        right = np.concatenate([*(tau for _, tau in rest), prior[:, -1]])
        values = np.linalg.lstsq(matrix, right, rcond=None)[0]
        parts = equations(samples.where(mask), sought, np.ones(3))
        left = [np.sum((rows @ values - tau) ** 2) for rows, tau in parts]
        assert_allclose(squared, left, rtol=1e-4)


def test_the_error_is_that_of_the_noise(payload_fit):
    judge = held_out(payload_fit)
    found = judge.validation(judge.of(payload_fit), "parts")
    noise = np.sqrt(np.mean(payload_fit.weights**-2.0))
    assert found.rmse == pytest.approx(noise, rel=0.15)
    assert 0.0 < found.relative_error < 0.05
    assert tuple(found.rmse_per_joint) == payload_fit.columns.joints
    assert judge.score(judge.of(payload_fit)) == pytest.approx(1.0, abs=0.3)


def test_a_fit_is_judged_with_bodies_that_are_possible(robot, noisy):
    """Noise ten times as large: what a block alone would give is impossible."""
    loud = replace(
        noisy,
        tau=noisy.tau + 3.0 * np.random.default_rng(1).normal(size=noisy.tau.shape),
    )
    (log,), options = filter_logs(robot, loud, **NOISE_ONLY)
    fit = fit_recordings(robot, [log], options)
    assert spatial.is_consistent(fit.values[:10]) and fit.is_constrained
    judge = held_out(fit)
    assert np.sum(judge.of(fit)) < np.sum(judge.squared_errors(fit.unknowns))

"""Recordings decide for what they clearly ask for, and for nothing else."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.choices import CANDIDATES, choose, clearly_best, coupled
from robot_sysid.estimation.couplings import neighbours
from robot_sysid.estimation.held_out import CLEAR_SHARE
from robot_sysid.estimation.unknowns import Question
from tests.support import arms
from tests.support.core_fits import BASIC, datasets_of, fitter_of
from tests.support.measured_logs import JOINT, RATE, log_of, plan_of
from tests.support.payload_logs import changed

STRIBECK, RICHEST = f"{BASIC}-stribeck", CANDIDATES[-1]
MIDDLE, WRIST = np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 1.0])
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
        # Much better here, worse there.
        ({**scores(), RICHEST: BLOCKS * [0.2, 1.6, 1.0, 0.9, 1.3]}, CANDIDATES[0]),
    ],
)
def test_the_simplest_is_taken_that_is_not_clearly_beaten(found, taken):
    assert clearly_best(found) == taken


def chosen(plant, robot, more, offered=False, given=None, seed=1, duration=10.0):
    """(choice, its fit) of a log with more torque, of the exact motion, than the plant has."""
    plan = plan_of(plant, seed, duration)
    log = log_of(plant, plan, seed, noise_torque=0.02, encoder_resolution=1e-5)
    log = replace(log, tau=log.tau + more(plan.evaluate(log.time)))
    datasets, options = datasets_of(robot, log)
    motors = tuple(neighbours(robot)) if offered else ()
    fitter = fitter_of(robot, datasets, couplings=motors)
    model = given and friction_model(given)
    question = Question(options)
    shared = coupled(fitter, question, model, motors) if offered else ()
    choice, errors, start = choose(fitter, question, model, shared)
    fit = fitter.fit(question, choice, start, rounds=1)
    return SimpleNamespace(choice=choice, errors=errors), fit


def names(found):
    return [model.name for model in found.choice.friction]


def test_nothing_is_added_where_nothing_is_missing(plant, robot):
    found, _ = chosen(plant, robot, lambda motion: 0.0 * motion.q, offered=True)
    assert names(found) == [BASIC] * 3
    assert found.choice.couplings == () and found.choice.prior_scale == 1.0
    assert set(found.errors) == set(robot.joint_names)
    for errors in found.errors.values():
        assert set(errors) == set(CANDIDATES)
        assert errors[BASIC] == pytest.approx(min(errors.values()), rel=0.1)


def stribeck(motion):
    return 0.4 * np.sign(motion.qd) * np.exp(-((motion.qd / 0.05) ** 2))


def root(motion):
    return 0.8 * np.sign(motion.qd) * np.sqrt(np.abs(motion.qd))


def loss(motion):
    robot = arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT))
    thetas = np.array([link.theta for link in robot.links])
    carried = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd).torque(thetas)
    return 0.2 * np.sign(motion.qd) * np.abs(carried)


@pytest.mark.parametrize(("term", "more"), [("stribeck", stribeck), ("sqrt", root), ("load", loss)])
def test_the_joint_that_has_a_term_takes_it(plant, robot, term, more):
    found, fit = chosen(plant, robot, lambda motion: more(motion) * MIDDLE, seed=2)
    assert names(found) == [BASIC, f"{BASIC}-{term}", BASIC]
    assert found.errors["joint1"][f"{BASIC}-{term}"] < 0.9 * found.errors["joint1"][BASIC]
    if term == "stribeck":
        assert fit.point.speed["stribeck"][1] == pytest.approx(0.05, rel=0.2)


def test_friction_that_is_given_is_taken(plant, robot):
    found, fit = chosen(plant, robot, lambda motion: root(motion), given="coulomb-viscous")
    assert names(found) == ["coulomb-viscous"] * 3 and found.errors == {}
    assert fit.choice.friction == found.choice.friction


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
    model = arms.compile_xml(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT))
    for link in robot.links:
        arms.write_body(model, link.body_id, changed(link.theta, share, rng))
    return arms.robot_of(model)


def test_links_that_are_further_off_are_given_more_room(plant):
    model = with_links(plant, 0.5, 7)
    found, _ = chosen(plant, model, lambda motion: 0.0 * motion.q, given=BASIC, duration=30.0)
    assert found.choice.prior_scale > 1.0


@pytest.mark.parametrize("memory", [0.03, 0.3])
def test_noise_with_a_memory_alone_gives_them_none(plant, robot, memory):
    def noise(motion):
        keep = np.exp(-1.0 / (memory * RATE))
        drive = np.sqrt(1.0 - keep**2) * np.random.default_rng(3).standard_normal(motion.q.shape)
        return 0.1 * lfilter([1.0], [1.0, -keep], drive, axis=0)

    found, _ = chosen(plant, robot, noise, given=BASIC, duration=30.0)
    assert found.choice.prior_scale == 1.0

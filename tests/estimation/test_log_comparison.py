"""Logs of the arm alone compared: whether they agree, and how much their friction varies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.log_comparison import compare_logs, compare_recordings
from tests.support import arms
from tests.support.core_fits import filter_logs, fit_recordings
from tests.support.measured_logs import XML, log_of, plan_of

# ---- the variation of parameters from log to log

COMMON = 5
"""Number of parameters that all logs share."""
VARYING = 12
"""Number of parameters that may differ between logs: six of each of two terms."""
TERMS = np.repeat((0, 1), VARYING // 2)
SIZES = np.repeat((1.0, 3.0), VARYING // 2)


def compare_random_logs(shares, n_logs, seed, hidden_in_first=()):
    """Return (comparison, truth (logs, 12)) of logs that differ by shares (2,) of SIZES."""
    rng = np.random.default_rng(seed)
    common = rng.standard_normal(COMMON)
    mean = SIZES * (1.0 + rng.uniform(size=VARYING))
    spread = np.array(shares)[TERMS] * SIZES
    truth = mean + spread * rng.standard_normal((n_logs, VARYING))
    normals = []
    for log in range(n_logs):
        rows = rng.standard_normal((400, COMMON + VARYING))
        if log == 0:
            rows[:, COMMON + np.array(hidden_in_first, dtype=int)] = 0.0
        right = rows @ np.append(common, truth[log]) + 0.2 * rng.standard_normal(400)
        equations = np.column_stack((rows, right)) / 0.2
        normals.append(equations.T @ equations)
    prior = np.zeros_like(normals[0])
    indices = COMMON + np.arange(VARYING)
    return compare_logs(normals, prior, indices, mean, SIZES, TERMS), truth


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.3, 0.0), (0.1, 0.4)])
@pytest.mark.parametrize("n_logs", [2, 5])
def test_spread_and_values_are_those_of_the_logs(shares, n_logs):
    spreads = []
    ratios = []
    for seed in range(10):
        between, truth = compare_random_logs(shares, n_logs, seed)
        spreads.append(between.spread / SIZES)
        ratios.append((between.values - truth) / between.errors)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.12)
    for term, share in enumerate(shares):
        spread = np.sqrt(np.mean(np.square(spreads)[:, term == TERMS]))
        assert spread == pytest.approx(share, rel=0.35, abs=0.012)


def test_the_error_in_another_log_adds_the_spread_and_the_error_of_the_mean():
    between, _ = compare_random_logs((0.3, 0.3), 2, 0)
    expected = np.sqrt(0.1**2 + 1.5 * between.spread**2)
    assert_allclose(between.next_log(np.full(VARYING, 0.1)), expected)


def test_logs_differ_where_they_were_made_to_and_nowhere_else():
    for seed in range(20):
        between, _ = compare_random_logs((0.3, 0.0), 2, seed)
        assert between.differ(np.flatnonzero(TERMS == 0), 2)
        assert not between.differ(np.flatnonzero(TERMS == 1), 2)


def test_a_parameter_hidden_in_one_log_is_uncertain_in_it_alone():
    between, _ = compare_random_logs((0.0, 0.0), 2, 0, hidden_in_first=(3,))
    assert between.errors[0, 3] > 10.0 > 0.1 > between.errors[1, 3]
    assert not between.differ(np.array([3]), 1)
    assert np.max(np.delete(between.errors, 3, axis=1)) < 0.1


# ---- logs of arms

WITHIN = 3.5
"""Standard errors by which the worst of some numbers may differ from the truth."""


def filter_logs_of_days(robot, plants, seed=0, **options):
    """Return (low-passed logs of each arm, options); the motions differ."""
    logs = []
    for day, plant in enumerate(plants, seed):
        plan = plan_of(plants[0], 1 + day)
        logs.append(log_of(plant, plan, day, noise_torque=0.1, encoder_resolution=1e-4))
    return filter_logs(robot, *logs, **options)


def compare(robot, datasets, options):
    """Return (fit, notes, tests, friction by log) of low-passed logs."""
    fit = fit_recordings(robot, datasets, options)
    return fit, *compare_recordings(fit)


def compare_plants(robot, *plants):
    """Return (fit, notes, tests, friction of logs) of one log from each plant."""
    return compare(robot, *filter_logs_of_days(robot, plants, link_uncertainty=2.0))


def test_logs_that_agree_are_reported_so(plant, robot):
    _, notes, tests, friction = compare_plants(robot, plant, plant)
    masses, agreement = notes
    assert friction.differences == {}
    assert masses.startswith("mass of each log alone: log0 ") and "; log1 0." in masses
    assert agreement.startswith("the logs agree")
    for number, test in enumerate(tests):
        assert test.source == f"log{number}, predicted from the other logs"
        assert test.relative_error < 0.1
    assert len(tests) == 2


@pytest.mark.parametrize("resting", [(), (2,), (0, 2)])
def test_a_log_of_joints_that_move_in_it_alone_is_no_test_of_the_others(
    plant, robot, resting
):
    logs = [
        log_of(plant, plan_of(plant, 1 + k), k, noise_torque=0.05) for k in range(2)
    ]
    (first, second), options = filter_logs(robot, *logs)
    used = np.ones(first.motion.q.shape, dtype=bool)
    used[:, list(resting)] = False
    _, _, tests, _ = compare(robot, [replace(first, used=used), second], options)
    sources = [test.source.partition(",")[0] for test in tests]
    assert sources == (["log0"] if resting else ["log0", "log1"])


def test_logs_of_different_bodies_are_reported_not_to_agree(plant, robot):
    lighter = arms.robot_of(XML.replace('mass=".8"', 'mass=".5"'))
    _, notes, tests, _ = compare_plants(robot, plant, lighter)
    assert notes[1].startswith("the logs do not agree")
    assert max(test.relative_error for test in tests) > 0.1


def with_friction(plant, coulomb_factor, viscous_factor=1.0):
    """Return an arm whose friction is multiplied by factors, one number or one per joint."""
    friction = plant.friction
    coulomb = coulomb_factor * friction.coulomb
    viscous = viscous_factor * friction.viscous
    return replace(plant, friction=replace(friction, coulomb=coulomb, viscous=viscous))


def true_friction(plant, names):
    """Return Coulomb and viscous friction by name, such as "coulomb[joint1]"."""
    values = []
    for name in names:
        term, joint = name[:-1].split("[")
        values.append(getattr(plant.friction, term)[plant.joint_names.index(joint)])
    return np.array(values)


def test_friction_that_differs_between_logs_is_named_and_their_masses_agree(
    plant, robot
):
    other = with_friction(plant, np.array([1.0, 1.3, 1.0]))
    _, notes, _, friction = compare_plants(robot, plant, other)
    assert friction.differences == {"joint1": pytest.approx(0.2, abs=0.05)}
    _, agreement, difference = notes[:3]
    assert agreement.startswith("the logs agree on the mass, not on friction")
    message = "friction differs between the logs by more than its errors: joint1 by"
    assert message in difference
    by_log = friction.by_log("joint1")
    for log, arm in (("log0", plant), ("log1", other)):
        coulomb = by_log[log]["coulomb"]
        (truth,) = true_friction(arm, ["coulomb[joint1]"])
        assert abs(coulomb.value - truth) < WITHIN * coulomb.error


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_the_error_on_another_day_covers_the_friction_of_a_third_log(
    plant, robot, share
):
    """Friction of all logs is drawn from one distribution; two of them are identified."""
    ratios = []
    growths = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        factors = 1.0 + share * rng.standard_normal((3, 2, plant.n_joints))
        *plants, third = (with_friction(plant, *pair) for pair in factors)
        logs, options = filter_logs_of_days(robot, plants, 10 * seed)
        fit, *_, friction = compare(robot, logs, options)
        names = [name for name in friction.names if not name.startswith("offset")]
        indices = [fit.unknowns.estimated_names.index(name) for name in names]
        columns = [friction.names.index(name) for name in names]
        errors = np.zeros(len(friction.names))
        errors[columns] = fit_errors(fit).total.standard_errors[indices]
        another_day = friction.between.next_log(errors)[columns]
        values = fit.values[fit.unknowns.estimated[indices]]
        ratios.append((values - true_friction(third, names)) / another_day)
        growths.append(another_day / errors[columns])
        assert bool(friction.differences) == (share > 0.0)
    coverage = np.mean(np.abs(ratios) < 1.96)
    assert coverage >= 0.93
    if share:
        assert coverage < 1.0
        assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.15
    else:
        assert np.median(growths) < 1.6

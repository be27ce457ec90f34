"""Cross-validation: each block is predicted from the others, and other logs from the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.dataset import block_masks
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.held_out import (
    held_out,
    held_out_logs,
    is_clearly_lower,
    validate_datasets,
)
from tests.support import arms
from tests.support.core_fits import NOISE_ONLY, filter_logs, fit_logs, fit_recordings
from tests.support.measured_logs import XML, log_of, plan_of


def test_a_block_with_far_larger_errors_does_not_hide_an_improvement():
    """Every block improves fivefold; their errors differ by a factor of a hundred."""
    errors = np.array([4.2, 3.9, 2.8, 3.9, 400.0])
    assert is_clearly_lower(errors / 5.0, errors)


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
        [group.prior_rows(unknowns.estimated_names) for group in unknowns.groups]
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
    assert cross_validation.score(payload_fit.unknowns) == pytest.approx(1.0, abs=0.3)


def test_blocks_are_predicted_with_possible_bodies(robot, noisy):
    """With noise ten times as large, the plain estimate of a block is impossible."""
    noise = 3.0 * np.random.default_rng(1).normal(size=noisy.tau.shape)
    fit = fit_logs(robot, replace(noisy, tau=noisy.tau + noise), **NOISE_ONLY)
    assert spatial.is_consistent(fit.values[:10]) and fit.is_constrained
    cross_validation = held_out(fit)
    plain_errors = cross_validation.squared_errors(fit.unknowns)
    errors = cross_validation.consistent_squared_errors(fit.unknowns)
    assert np.sum(errors) < np.sum(plain_errors)


def validate(fit, *logs):
    """Return the validation of a fit on other measurements."""
    datasets, _ = filter_logs(fit.columns.robot, *logs)
    return validate_datasets(fit, fit_errors(fit), datasets, "other.csv")


@pytest.fixture(scope="module")
def other_logs(plant):
    """Return logs of the plant, and of an arm with twice its last link's mass."""
    heavy = arms.robot_of(XML.replace('mass=".8"', 'mass="1.6"'))
    sensors = {"noise_torque": 0.1, "encoder_resolution": 1e-4}
    plan = plan_of(plant, 7)
    return [log_of(arm, plan, 7, **sensors) for arm in (plant, heavy)]


def test_another_log_is_predicted_down_to_its_noise(noisy_fit, other_logs):
    log, _ = other_logs
    validation = validate(noisy_fit, log)
    assert validation.source == "other.csv"
    assert validation.rmse < 1.3 * np.sqrt(np.mean(noisy_fit.weights**-2.0))
    scaled = validate(noisy_fit, replace(log, tau=1.2 * log.tau))
    assert scaled.relative_error > 3.0 * validation.relative_error


@pytest.mark.parametrize("is_moving", [True, False])
def test_only_another_body_is_informative_where_a_joints_friction_is_unknown(
    robot, noisy_fit, other_logs, is_moving
):
    """A link of another mass shows even if one joint stood still in the fitted log."""
    (recording,) = noisy_fit.columns.datasets
    used = np.ones(recording.motion.q.shape, dtype=bool)
    used[:, 1] = is_moving
    options = noisy_fit.question.options
    fit = fit_recordings(robot, [replace(recording, used=used)], options)
    is_informative = [validate(fit, log).is_informative for log in other_logs]
    assert is_informative == [is_moving, True]


def errors_by_log(robot, arms_of_logs, resting=()):
    """Return the log's name to its error predicted from the others, of one log per arm.

    Joints that rest have no rows in the first log.
    """
    logs = [
        log_of(arm, plan_of(arms_of_logs[0], 1 + k), k, noise_torque=0.05)
        for k, arm in enumerate(arms_of_logs)
    ]
    (first, *others), options = filter_logs(robot, *logs)
    used = np.ones(first.motion.q.shape, dtype=bool)
    used[:, list(resting)] = False
    fit = fit_recordings(robot, [replace(first, used=used), *others], options)
    tests = held_out_logs(fit)
    return {test.source.partition(",")[0]: test.relative_error for test in tests}


@pytest.mark.parametrize("resting", [(), (2,), (0, 2)])
def test_a_log_of_joints_that_move_in_it_alone_is_no_test_of_the_others(
    plant, robot, resting
):
    errors = errors_by_log(robot, [plant, plant], resting)
    assert list(errors) == (["log0"] if resting else ["log0", "log1"])
    assert max(errors.values()) < 0.1


def test_a_log_of_another_body_is_not_predicted(plant, robot):
    lighter = arms.robot_of(XML.replace('mass=".8"', 'mass=".5"'))
    assert max(errors_by_log(robot, [plant, lighter]).values()) > 0.1
    assert errors_by_log(robot, [plant]) == {}

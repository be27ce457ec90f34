"""Errors on rows that were not fitted: what they are, and whether they say something of the fit."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.core_fits import filter_logs, fit_recordings
from rigs.logs.measured_logs import XML, log_of, plan_of
from robot_sysid.estimate.held_out import (
    held_out_logs,
    is_clearly_lower,
    prediction_error,
    validation,
)
from robot_sysid.estimate.trust import misfit_ratio, odd_joints
from robot_sysid.records.levels import SURE

BLOCKS = np.array([1.0, 2.0, 0.5, 1.0, 1.5])


@pytest.mark.parametrize(
    ("factors", "is_lower"),
    [
        (1.0, False),
        (0.5, True),
        (0.92, False),
        # Lower on average, but by 0.5 or 1.5 standard errors of that only; and by more.
        (np.exp([-0.9, -0.5, 0.6, 0.2, -0.1]), False),
        (np.exp([-0.9, -0.4, 0.3, -0.1, -0.4]), False),
        (np.exp([-0.4, -0.1, -0.3, -0.1, -0.2]), True),
        # Much better in one block, worse in another.
        (np.array([0.2, 1.6, 1.0, 0.9, 1.3]), False),
    ],
)
def test_only_what_is_lower_in_most_blocks_is_clearly_lower(factors, is_lower):
    assert is_clearly_lower(BLOCKS * factors, BLOCKS) == is_lower


def test_each_block_is_predicted_from_the_others(noisy_fit):
    """Against least squares without it, written down in full."""
    equations = noisy_fit.equations
    for block in noisy_fit.sums.blocks:
        others = [k for k in noisy_fit.sums.blocks if k != block]
        normal = equations.data(noisy_fit.weights, others) + equations.prior
        size = np.sqrt(np.diag(normal)[:-1])
        matrix = normal[:-1, :-1] / np.outer(size, size)
        values = np.linalg.solve(matrix, normal[:-1, -1] / size) / size
        expected = equations.squared_residuals(values, [block])
        assert_allclose(noisy_fit.held_out[block], expected, rtol=1e-4)
    noise = noisy_fit.noise
    test = validation(noisy_fit)
    assert test.rmse == pytest.approx(np.sqrt(np.mean(noise**2)), rel=0.3)
    squares = np.sum(noisy_fit.held_out) / np.sum(noisy_fit.sums.squared_torque)
    assert test.relative_error == pytest.approx(np.sqrt(squares))
    assert test.is_informative


@pytest.fixture(scope="module")
def other_logs(plant):
    """Return logs of the plant, and of an arm with twice its last link's mass."""
    heavy = small_arms.robot_of(XML.replace('mass=".8"', 'mass="1.6"'))
    sensors = {"noise_torque": 0.1, "encoder_resolution": 1e-4}
    plan = plan_of(plant, 7)
    return [log_of(arm, plan, 7, **sensors) for arm in (plant, heavy)]


def test_another_log_is_predicted_down_to_its_noise(robot, noisy_fit, other_logs):
    log, _ = other_logs
    test = prediction_error(noisy_fit, filter_logs(robot, log), "other.csv")
    assert test.source == "other.csv"
    assert test.rmse < 1.3 * np.sqrt(np.mean(noisy_fit.noise**2))
    scaled = filter_logs(robot, replace(log, tau=1.2 * log.tau))
    worse = prediction_error(noisy_fit, scaled, "scaled.csv")
    assert worse.relative_error > 3.0 * test.relative_error


@pytest.mark.parametrize("is_moving", [True, False])
def test_only_another_body_is_informative_where_a_joints_friction_is_unknown(
    robot, noisy_fit, other_logs, is_moving
):
    """A link of another mass shows even if one joint stood still in the fitted log."""
    (recording,) = noisy_fit.recordings
    kept = np.full(recording.is_used.shape, is_moving) | [True, False, True]
    fitted = fit_recordings(robot, [recording.only(kept)])
    is_informative = []
    for log in other_logs:
        test = prediction_error(fitted, filter_logs(robot, log), "other.csv")
        is_informative.append(test.is_informative)
    assert is_informative == [is_moving, True]


def errors_by_log(robot, arms_of_logs, resting=()):
    """Return the log's name to its error predicted from the others, of one log per arm.

    Joints that rest have no rows in the first log.
    """
    logs = [
        log_of(arm, plan_of(arms_of_logs[0], 1 + k), k, noise_torque=0.05)
        for k, arm in enumerate(arms_of_logs)
    ]
    first, *others = filter_logs(robot, *logs)
    kept = np.ones_like(first.is_used)
    kept[:, list(resting)] = False
    fitted = fit_recordings(robot, [first.only(kept), *others])
    tests = held_out_logs(fitted)
    return {test.source.partition(",")[0]: test.relative_error for test in tests}


@pytest.mark.parametrize("resting", [(), (0, 2)])
def test_a_log_of_joints_that_move_in_it_alone_is_no_test_of_the_others(
    plant, robot, resting
):
    errors = errors_by_log(robot, [plant, plant], resting)
    assert list(errors) == (["log0"] if resting else ["log0", "log1"])
    assert max(errors.values()) < 0.1


def test_a_log_of_another_body_is_not_predicted(plant, robot):
    lighter = small_arms.robot_of(XML.replace('mass=".8"', 'mass=".5"'))
    assert max(errors_by_log(robot, [plant, lighter]).values()) > 0.1
    assert errors_by_log(robot, [plant]) == {}


def test_a_log_in_which_a_joint_stood_still_does_not_speak_against_the_next(
    plant, robot
):
    """It identifies nothing of that joint, so that it predicts nothing of it: no misfit."""
    moving = log_of(plant, plan_of(plant, 1), 1, noise_torque=0.02)
    still_plan = plan_of(plant, 2).scale_amplitudes(np.array([1.0, 0.0, 1.0]))
    still = log_of(plant, still_plan, 2, noise_torque=0.02)
    fitted = fit_recordings(robot, filter_logs(robot, still, moving))
    sums = fitted.sums
    first, second = dict.fromkeys(sums.logs)
    assert not np.any(sums.counts[sums.is_of(first), 1])
    # What is left are the rows of the others: a difference would leave rounding of the second log
    # where the first one shows nothing, and numbers of 1e18 with it.
    of_second, of_first = (
        np.flatnonzero(sums.is_of(x)).tolist() for x in (second, first)
    )
    alone = fitted.equations.prior + fitted.equations.data(fitted.weights, of_first)
    np.testing.assert_array_equal(fitted.normal_without(of_second), alone)
    for test in held_out_logs(fitted):
        assert test.relative_error < 0.1
    for test in (validation(fitted), *held_out_logs(fitted)):
        assert misfit_ratio(fitted, test) <= SURE
    independent = dict(zip(fitted.arm.joints, 1.0 / fitted.correlation))
    assert not [*odd_joints(fitted.noise_per_joint, fitted.torque, independent)]

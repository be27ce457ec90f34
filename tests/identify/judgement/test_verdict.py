"""A result is trusted only if its whole error is small and the link is one that can hang there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.identify.judgement.verdict import judged, reaches
from robot_sysid.records import Status
from tests.support.arms import SEVEN, robot_of
from tests.support.results import NAMES, estimate, found, validation_of, with_value

TORQUE = {"j5": 5.0, "j6": 1.0}


@pytest.fixture(scope="module")
def robot():
    return robot_of(SEVEN)


def verdict(robot, result, torque=TORQUE, acceleration_error=0.0):
    return judged(result, robot, torque, acceleration_error)


def with_body(mass, com, inertia):
    """A result with this body."""
    values = np.array(estimate().values)
    values[:10] = spatial.theta_from_com(mass, np.array(com), np.diag(inertia))
    return estimate(values=values)


def test_a_good_result_stays_good(robot):
    before = found(validation=(validation_of(0.03),))
    after = verdict(robot, before)
    assert after.estimate.status is Status.OK and after.reasons == ()


@pytest.mark.parametrize(("error", "status"), [(0.19, Status.OK), (0.21, Status.UNCERTAIN)])
def test_a_tenth_of_the_mass_is_the_largest_whole_error(robot, error, status):
    result = verdict(robot, found(with_value("m", 2.0, error)))
    assert result.estimate.status is status
    assert bool(result.reasons) == (status is Status.UNCERTAIN)


def test_the_causes_of_a_large_error_are_named(robot):
    uncertain = with_value("m", 2.0, 0.5)
    budget = {"links": np.full(len(NAMES), 0.49), "gravity": np.full(len(NAMES), 0.01)}
    (reason,) = verdict(robot, found(replace(uncertain, error_budget=budget))).reasons
    assert "2 ± 0.5 kg" in reason and "links 0.49" in reason


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ((0.3, (0.0, 0.0, 1.8), (0.01, 0.01, 0.01)), "centre of mass is 1.8 m away"),
        ((0.3, (0.0, 0.0, 0.05), (0.1, 0.1, 0.1)), "radius of gyration is 0.58 m"),
    ],
)
def test_a_link_that_cannot_hang_there_is_refused(robot, body, words):
    result = verdict(robot, found(with_body(*body)))
    assert result.estimate.status is Status.IMPLAUSIBLE
    assert words in result.reasons[0]


def test_a_tool_that_the_model_does_not_have_is_plausible(robot):
    """A gripper and what it holds, a fifth of the arm's reach beyond the flange."""
    own, arm = reaches(robot)
    result = verdict(robot, found(with_body(2.0, (0.0, 0.0, own + 0.2 * arm), (0.01,) * 3)))
    assert result.estimate.status is Status.OK


def test_a_mass_that_only_consistency_moved_is_refused(robot):
    hidden = with_body(10.4, (0.0, 0.0, 0.05), (0.1, 0.1, 0.1))
    errors = np.array(hidden.standard_errors)
    errors[0] = np.inf
    result = verdict(robot, found(replace(hidden, standard_errors=errors)))
    assert result.estimate.status is Status.IMPLAUSIBLE
    assert "do not show the mass" in result.reasons[0]


@pytest.mark.parametrize(("rmse", "fine"), [(0.08, True), (0.12, False)])
def test_held_out_torque_may_be_three_times_the_noise(robot, rmse, fine):
    test = replace(validation_of(rmse), rmse_per_joint={"j5": rmse, "j6": rmse}, relative_error=0.1)
    result = verdict(robot, found(validation=(test,)))
    assert (result.estimate.status is Status.OK) == fine
    harmless = replace(test, relative_error=0.01)
    assert verdict(robot, found(validation=(harmless,))).estimate.status is Status.OK


def test_a_joint_whose_torque_follows_from_nothing_is_named(robot):
    result = verdict(robot, found(estimate(noise_per_joint={"j5": 0.03, "j6": 0.9})))
    assert result.estimate.status is Status.UNEXPLAINED
    assert "90 % of the torque of j6" in result.reasons[0]


def test_positions_too_coarse_for_accelerations_are_refused(robot):
    result = verdict(robot, found(), acceleration_error=0.49)
    assert result.estimate.status is Status.UNEXPLAINED and "49 %" in result.reasons[0]


def test_what_was_refused_before_keeps_its_reason(robot):
    weak = estimate(status=Status.TOO_WEAK)
    assert verdict(robot, found(weak), acceleration_error=0.9).estimate.status is Status.TOO_WEAK

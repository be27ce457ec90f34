"""Changes that are suggested lower the errors that a plan states, by the same rule."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.motion.expected_errors import RecordingPlan, predict, predict_posterior
from robot_sysid.motion.improvements import (
    KNOWN_MASS,
    LONGER,
    expected_improvements,
    identifiability_note,
)
from tests.motion.test_expected_errors import ARM, PLAN, PROBLEM, RATE, SIGMA, USUAL
from tests.support import arms
from tests.support.excitation_arms import make_problem, robot


def improvements_of(target, options=USUAL):
    """Return the errors predicted for PLAN on ARM, and the changes that lower them."""
    recording = RecordingPlan(RATE, options, target)
    prediction = predict(PROBLEM, PLAN, recording)
    return prediction, expected_improvements(PROBLEM, PLAN, recording, prediction)


@pytest.mark.parametrize("target", ["link", "payload"])
def test_every_change_lowers_the_error_and_the_largest_gain_is_first(target):
    prediction, improvements = improvements_of(target)
    before = prediction.combined_error(*prediction.errors_of(prediction.covariance))
    after = [
        prediction.combined_error(c.mass_error, c.centre_error) for c in improvements
    ]
    assert improvements and after == sorted(after) and after[-1] < before


def test_a_longer_motion_never_states_larger_errors():
    """Its errors are those of the same motion recorded so many times."""
    for target in ("link", "payload"):
        recording = RecordingPlan(RATE, USUAL, target)
        once = predict(PROBLEM, PLAN, recording)
        often = predict(PROBLEM, PLAN, replace(recording, repetitions=LONGER))
        assert np.all(often.standard_errors <= once.standard_errors * (1.0 + 1e-9))


def test_a_known_weight_leaves_the_noise_of_its_recordings():
    options = EstimationOptions(scale_uncertainty=6.0)
    prediction, improvements = improvements_of("payload", options)
    (weight,) = (change for change in improvements if "weight of" in change.description)
    mass = prediction.theta[0]
    assert prediction.relative_mass_error > 0.03
    exact = replace(options, scale_uncertainty=0.0)
    without_scales = predict(PROBLEM, PLAN, RecordingPlan(RATE, exact, "payload"))
    noise = without_scales.standard_errors[0]
    known = noise * np.hypot(1.0, mass / KNOWN_MASS)
    assert weight.mass_error == pytest.approx(known, rel=0.1)


def test_a_link_weighed_by_difference_is_as_uncertain_as_the_torque_scale():
    _, improvements = improvements_of("link", EstimationOptions(scale_uncertainty=6.0))
    (payload,) = (x for x in improvements if "by difference" in x.description)
    relative_error = payload.mass_error / robot(ARM).prior.mass
    assert 0.06 / np.sqrt(robot(ARM).n_joints) < relative_error < 0.1


def test_a_mass_that_no_motion_determines_is_reported_in_advance():
    """The note states the smallest possible error and the measurement that helps."""
    tip = '<inertial pos=".02 .03 .06" mass=".08" diaginertia=".0005 .0006 .0003"/>'
    light = ARM.replace(arms.TIP, tip)
    problem = make_problem(light, noise_torque=SIGMA)
    recording = RecordingPlan(RATE, USUAL)
    note = identifiability_note(problem, PLAN, recording)
    floor = float(re.search(r"better than ± ([\d.]+) kg", note).group(1))
    assert floor > 0.2 * problem.robot.prior.mass and "weighed by difference" in note
    surer = RecordingPlan(RATE, EstimationOptions(link_uncertainty=0.5))
    assert identifiability_note(problem, PLAN, surer) == ""
    posterior = predict_posterior(problem, PLAN, recording)
    covariance, _ = posterior.errors_of(PARAMETER_NAMES)
    assert np.sqrt(covariance[0, 0]) > 0.99 * floor

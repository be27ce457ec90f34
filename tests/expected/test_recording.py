"""Predicted errors of a motion equal those of an identification from its recording."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.random import default_rng

from rigs.arms import small_arms
from rigs.arms.excitation_arms import link_covariance, make_problem, robot
from robot_sysid.errors import InputError
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.options import DEFAULT_FRICTION, EstimationOptions, Priors
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.terms import LINKS, SCALES
from robot_sysid.expected.criterion import Criterion
from robot_sysid.expected.recording import predict, prior_knowledge
from robot_sysid.records import join_recordings
from robot_sysid.signals.process import low_pass_recordings
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks
from tests.motion.test_plan_lines import best_plan

RATE = 250.0
SIGMA = 0.01
# With rotors: an estimate that stops at none spreads less than it could.
ARM = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X),
    joint='range="-2.5 2.5" frictionloss=".4" armature=".05" damping=".1"',
)
PLAN = best_plan(ARM, duration=10.0)
USUAL = EstimationOptions()
KNOWN_ARM = EstimationOptions(
    priors=Priors(link=0.0, scale=0.0, zero=0.0, gravity=0.0, friction=0.0)
)
PROBLEM = make_problem(ARM, noise_torque=SIGMA)


@cache
def predict_errors(options=USUAL, target="link"):
    """Return the errors predicted for PLAN on ARM."""
    return predict(PROBLEM, PLAN, RATE, options, target)


@cache
def identify_recording(options, seed):
    """Return the fit of one noisy recording of PLAN with measured friction."""
    exact = join_recordings(simulate_inverse(robot(ARM), motion_chunks(PLAN, RATE)))
    noise = SIGMA * default_rng([seed, 1]).normal(size=exact.tau.shape)
    recording = replace(exact, tau=exact.tau + noise, qd=None, qdd=None)
    measured_options = replace(options, friction_model=DEFAULT_FRICTION)
    recordings, _ = low_pass_recordings(robot(ARM), [replace(recording, name="log")])
    return solve_question(robot(ARM), recordings, Question(measured_options))


def test_predicted_errors_of_an_exact_arm_equal_reported_errors():
    # One short recording knows its own noise, and how white it is, to a tenth or so.
    fits = [identify_recording(KNOWN_ARM, seed) for seed in range(4)]
    stated = np.mean([np.sqrt(np.diag(fit.inverse))[:10] for fit in fits], axis=0)
    ratio = stated / predict_errors(KNOWN_ARM).errors
    assert abs(np.median(ratio) - 1.0) < 0.2 and np.all(np.abs(ratio - 1.0) < 0.3)


def test_predicted_errors_of_an_uncertain_arm_include_its_model_errors():
    expected = predict_errors()
    fitted = identify_recording(USUAL, 0)
    # This model is right, which a recording finds out and a plan cannot know.
    ratio = np.sqrt(np.diag(fitted.inverse))[:10] / expected.errors
    assert np.all((ratio > 0.25) & (ratio < 1.3))
    assert np.all(expected.errors > predict_errors(KNOWN_ARM).errors)
    stated = fitted.budget(np.eye(len(fitted.names))[:1])
    for cause in (LINKS, SCALES):
        assert 0.6 < expected.by_cause[cause][0] / stated[cause][0] < 3.0


@pytest.mark.parametrize("target", ["link", "payload"])
def test_errors_by_cause_add_up_to_the_error(target):
    expected = predict_errors(target=target)
    masses = [mass for mass, _ in expected.by_cause.values()]
    assert np.linalg.norm(masses) == pytest.approx(expected.errors[0], rel=1e-6)


@pytest.mark.parametrize("options", [USUAL, KNOWN_ARM], ids=["usual", "known"])
def test_the_search_minimises_the_predicted_errors(options):
    """The search uses all samples, the prediction a recording of them without its ends."""
    prior = prior_knowledge(PROBLEM, options, "link")
    motion = PLAN.evaluate((np.arange(100) + 0.5) * PLAN.duration / 100)
    criterion = Criterion(PROBLEM, prior, RATE * PLAN.duration / 100, smoothing=1e-9)
    covariance = link_covariance(criterion, (motion.q, motion.qd, motion.qdd))
    ratio = predict_errors(options).errors / np.sqrt(np.diag(covariance))
    assert np.all((ratio > 0.99) & (ratio < 1.5)) and np.median(ratio) < 1.25


def test_payload_errors_come_from_the_difference_of_recordings():
    """Errors of the links cancel; noise and the error that all torque scales share count."""
    expected = predict_errors(target="payload")
    link_error = predict_errors().errors[0]
    assert 0.0 < expected.errors[0] < 0.3 * link_error
    scales, _ = expected.by_cause[SCALES]
    assert 0.01 * expected.size[0] < scales < expected.errors[0]


def test_a_recording_that_cannot_be_processed_has_no_predicted_errors():
    resting = replace(PLAN, amplitude=np.zeros_like(PLAN.amplitude))
    for plan, rate, message in (
        (PLAN, 4.0, "record longer"),
        (resting, RATE, "moves faster"),
    ):
        with pytest.raises(InputError, match=message):
            predict(PROBLEM, plan, rate, USUAL, "arm")

"""What is promised of a motion is what an identification of its recording then delivers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from robot_sysid.dynamics.friction import DEFAULT_MEASURED
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.answer import estimate_of
from robot_sysid.estimation.identify import Piece, answer_link, filtered, identify_itself
from robot_sysid.expected import expect
from robot_sysid.logs.reader import join_measurements
from robot_sysid.motion.prediction import predict
from robot_sysid.records.progress import Progress
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks
from tests.motion.test_prediction import a_plan
from tests.support import arms
from tests.support.excitation_arms import problem, robot

RATE, SIGMA = 250.0, 0.01
# With rotors: an estimate that stops at none spreads less than it could.
ARM = arms.serial_arm(
    (arms.Z, arms.Y, arms.Y, arms.X),
    joint='range="-2.5 2.5" frictionloss=".4" armature=".05" damping=".1"',
)
PLAN = a_plan(ARM, duration=10.0)
CAUSES = ("link", "scale", "zero", "gravity", "friction")
KNOWN_ARM = EstimationOptions(**{f"{cause}_uncertainty": 0.0 for cause in CAUSES})


def promised(options, **changes):
    return expect(problem(ARM, noise_torque=SIGMA, **changes), PLAN, RATE, options)


@cache
def delivered(options, seed):
    """Estimate from one noisy recording, with friction as the promise has it."""
    exact = join_measurements(simulate_inverse(robot(ARM), motion_chunks(PLAN, RATE)))
    noise = SIGMA * np.random.default_rng([seed, 1]).normal(size=exact.tau.shape)
    recording = replace(exact, tau=exact.tau + noise, qd=None, qdd=None)
    given = replace(options, friction_model=DEFAULT_MEASURED)
    datasets, _ = filtered(robot(ARM), [Piece("log", recording)], given)
    return estimate_of(answer_link(robot(ARM), datasets, given, Progress(), None))


def test_of_a_known_arm_the_promise_is_the_error_that_identifications_report():
    # One short recording knows its own noise, and how white it is, to a tenth or so.
    found = [delivered(KNOWN_ARM, seed).standard_errors[:10] for seed in range(4)]
    ratio = np.mean(found, axis=0) / promised(KNOWN_ARM).deviation
    assert abs(np.median(ratio) - 1.0) < 0.2 and np.all(np.abs(ratio - 1.0) < 0.3)


@pytest.mark.slow
def test_of_a_known_arm_the_promise_is_the_spread_of_identifications():
    """Sixty runs know a spread to 9 %; ten parameters stay within three times that."""
    found = np.array([delivered(KNOWN_ARM, seed).values[:10] for seed in range(60)])
    ratio = found.std(axis=0, ddof=1) / promised(KNOWN_ARM).deviation
    assert np.all(np.abs(ratio - 1.0) < 0.27)
    assert abs(np.median(ratio) - 1.0) < 0.1


def test_of_an_arm_that_is_not_known_the_whole_error_is_promised_too():
    options = EstimationOptions()
    expected = promised(options)
    ratio = delivered(options, 0).standard_errors[:10] / expected.stated
    assert np.all(np.abs(ratio - 1.0) < 0.3)
    assert np.all(expected.stated > 0.7 * expected.deviation)


def test_the_promise_is_never_better_than_all_samples_allow():
    bound = predict(problem(ARM, noise_torque=SIGMA), PLAN, RATE)
    prediction = promised(KNOWN_ARM)
    assert np.all(prediction.deviation > bound.deviation)
    assert prediction.com_deviation > bound.com_deviation


@pytest.mark.parametrize(
    ("rate", "words"), [(4.0, "too few to choose a cut-off"), (1e9, "only motions up to")]
)
def test_what_cannot_be_processed_gets_the_bound_and_the_reason(rate, words, monkeypatch):
    monkeypatch.setattr("robot_sysid.expected.MOST_SAMPLES", 1999)
    some = problem(ARM)
    expected, bound = expect(some, PLAN, rate, EstimationOptions()), predict(some, PLAN, rate)
    np.testing.assert_array_equal(expected.deviation, bound.deviation)
    assert expected.counted.startswith("if all samples could be used, but ")
    assert words in expected.counted
    assert len(expected.stated) == 0


def test_the_plans_condition_number_is_that_of_the_run():
    """Both look at the same equations; the run sees the motion at another rate."""
    found, _ = identify_itself(robot(ARM), PLAN, RATE, 0, EstimationOptions(), Progress())
    ran, shown = found.estimate.identifiability, promised(KNOWN_ARM).shown
    assert shown.condition_number == pytest.approx(ran.condition_number, rel=0.01)
    assert shown.scaled_condition_number == pytest.approx(ran.scaled_condition_number, rel=0.01)
    logged = delivered(EstimationOptions(), 0).identifiability
    # The ends of a log are cut off and its slow moments left out.
    assert logged.condition_number == pytest.approx(ran.condition_number, rel=0.2)

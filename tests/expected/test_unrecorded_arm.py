"""What a plan expects of the written file: no better without torques, right with exact ones."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.excitation_arms import make_problem, robot
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.estimate.terms import DELAY, LAST_LINK, LINKS, SCALES
from robot_sysid.expected.criterion import Criterion
from robot_sysid.expected.recording import expected_fit, predict, prior_knowledge
from robot_sysid.expected.unrecorded_arm import (
    UnrecordedArm,
    in_file,
    judging_speeds,
    model_values,
    units_of,
)
from robot_sysid.motion.trajectories import at_speed
from robot_sysid.records.usual_errors import (
    ERRORS_AS_THEY_ARE,
    PLANNED_FRICTION,
    PLANNED_LEAST,
)
from tests.motion.test_plan_lines import best_plan

RATE = 250.0
JOINT = 'range="-2.5 2.5" frictionloss=".4" armature=".05" damping=".1"'
ARM = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X), joint=JOINT
)
PLAN = best_plan(ARM, duration=10.0)
USUAL = EstimationOptions()
# Links and the friction that a file holds are not as the model says, and nothing else.
HELD_ONLY = EstimationOptions(
    priors=Priors(scale=0.0, zero=0.0, gravity=0.0, friction=0.0, delay=0.0)
)
FILE = "arm"


@cache
def file_after(noise, options=USUAL, target=FILE):
    """Return what is expected of the file after PLAN with some noise of the torques [N m]."""
    problem = make_problem(ARM, noise_torque=noise)
    return predict(problem, PLAN, RATE, options, target).file


@cache
def unrecorded():
    """Return ARM before any log."""
    problem = make_problem(ARM, noise_torque=0.01)
    return UnrecordedArm.of(problem, expected_fit(problem, PLAN, RATE, USUAL, FILE).arm)


def test_without_a_torque_that_can_be_read_the_file_is_the_model():
    file = file_after(1e6)
    assert file.after == pytest.approx(file.before, rel=1e-4)
    assert file.friction == pytest.approx(file_after(1e7).friction, rel=1e-4)


def test_less_noise_makes_a_better_file_where_it_holds_all_that_is_wrong():
    """Else noise may help: what a file does not hold is then taken up less."""
    files = [file_after(noise, HELD_ONLY) for noise in (10.0, 1.0, 0.1)]
    assert files[0].after > files[1].after > files[2].after
    assert files[0].friction > files[1].friction > files[2].friction
    assert files[0].before == files[1].before == files[2].before


def test_exact_torques_make_a_right_file_where_it_holds_all_that_is_wrong():
    assert file_after(1e-4, HELD_ONLY).after < 1e-3 * file_after(1e-4, HELD_ONLY).before
    # Torque scales and friction at standstill are left, which no file holds.
    assert file_after(1e-4).after > 0.02 * ERRORS_AS_THEY_ARE


@pytest.mark.parametrize("speed", [0.3, 0.1, 0.03])
def test_a_slow_motion_makes_a_worse_file_that_is_better_than_the_model(speed):
    """Friction that fades with speed is all that it shows of friction."""
    problem = make_problem(ARM, noise_torque=0.01)
    slow = predict(problem, at_speed(PLAN, speed), RATE, USUAL, FILE).file
    assert 1.5 * file_after(0.01).after < slow.after < 0.9 * slow.before


def test_another_tool_makes_the_model_worse_and_the_file_hardly():
    usual = file_after(0.01)
    replaced = file_after(0.01, target="link")
    assert replaced.before > 1.02 * usual.before
    assert replaced.after < 1.1 * usual.after


def test_a_payload_is_weighed_and_no_file_expected():
    assert file_after(0.01, target="payload") is None


def test_all_terms_are_known_as_well_as_they_usually_are():
    """Coulomb friction makes its share of a joint's torque, whatever its unit."""
    judge = unrecorded()
    terms = judge.terms(USUAL, is_replaced=False)
    causes = [term.cause for term in terms]
    assert DELAY not in causes
    assert {LAST_LINK, LINKS, SCALES} <= set(causes)
    deviations = np.sqrt(np.sum(units_of(terms) ** 2, axis=1))
    names = [name for term in terms for name in term.names]
    for term in ("coulomb", "viscous"):
        at = [names.index(f"{term}[{joint}]") for joint in judge.arm.joints]
        squares = np.sum(
            judge.sums.squares[:, judge.sums.at(judge.arm.terms[term].names)], axis=0
        )
        made = deviations[at] * np.sqrt(squares / judge.sums.row_counts)
        assert_allclose(made, PLANNED_FRICTION * judge.torque, rtol=1e-9)


def test_a_joint_that_carries_nothing_has_friction_all_the_same():
    problem = make_problem(small_arms.THREE)
    fitted = expected_fit(problem, best_plan(small_arms.THREE), RATE, USUAL, FILE)
    judge = UnrecordedArm.of(problem, fitted.arm)
    model = model_values(judge.arm, judge.sums.names)
    of_model = np.sqrt(judge.sums.squared_residuals(model) / judge.sums.row_counts)
    least = PLANNED_LEAST * np.max(of_model)
    assert_allclose(judge.torque, np.maximum(of_model, least))


def test_a_file_keeps_what_it_is_told_to():
    terms = unrecorded().terms(USUAL, is_replaced=False)
    names = np.array([name for term in terms for name in term.names])

    def held(*kept):
        """Return the first words of the names of what a file's fit has."""
        return {
            name.split("[")[0].split("(")[0] for name in names[in_file(terms, kept)]
        }

    assert {"coulomb", "viscous", "armature", "offset", "mass"} & held() >= {"coulomb"}
    assert not held() & {"scale", "zero", "tilt_1", "load", "bend", "fading"}
    assert "coulomb" not in held("friction") and "armature" in held("friction")
    assert "armature" not in held("rotors") and "coulomb" in held("rotors")
    n_links = 10 * len(unrecorded().arm.others)
    assert np.sum(in_file(terms, ())) - np.sum(in_file(terms, ["links"])) == n_links


def test_hinges_are_judged_at_usual_speeds_and_slides_at_their_own():
    problem = make_problem(small_arms.SLIDE_IN_CHAIN)
    fast = replace(problem, limits=replace(problem.limits, velocity=np.full(4, 5.0)))
    is_slide = robot(small_arms.SLIDE_IN_CHAIN).is_slide
    assert_allclose(judging_speeds(fast), np.where(is_slide, 5.0, 2.0))
    slow = replace(problem, limits=replace(problem.limits, velocity=np.full(4, 0.5)))
    assert_allclose(judging_speeds(slow), 0.5)


@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_the_search_minimises_what_is_promised(noise):
    """It knows neither encoder zeros nor tilt, and counts all samples, the ends too."""
    problem = make_problem(ARM, noise_torque=noise)
    knowledge = prior_knowledge(problem, USUAL, "arm")
    samples = RATE * PLAN.duration / 100
    criterion = Criterion(problem, knowledge, samples)
    motion = PLAN.evaluate((np.arange(100) + 0.5) * PLAN.duration / 100)
    value = criterion.evaluate(np.stack((motion.q, motion.qd, motion.qdd)))
    file = file_after(noise)
    assert np.exp(value) == pytest.approx(file.after / file.before, rel=0.25)

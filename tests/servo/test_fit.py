"""Servo numbers from the equations of the closed loop and, of fast servos, from rollouts."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.small_arms import robot_of
from rigs.logs.servo_logs import positions, sines_and_steps
from robot_sysid.records import Recording
from robot_sysid.servo.equations import LINK_ERROR
from robot_sysid.servo.fit import fit_servos
from robot_sysid.servo.loop import rms
from robot_sysid.servo.played_fit import refine_by_playing
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import (
    ServoParameters,
    ServoRollouts,
    servos_in_model,
)

ARM = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".1 0 .02" mass="{mass}" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".15 0 0"><joint name="roll" axis="1 0 0" range="-2 2" damping=".1"/>
<inertial pos=".05 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/></body></body></worldbody>
<actuator><position joint="lift" kp="{kp}"{limit}/><position joint="roll" kp="{kp}"/></actuator>
</mujoco>"""
"""A joint that carries a link, and one whose link weighs nothing."""
NO_PLAY = np.zeros(2)
TRUTH = ServoParameters(
    np.array([[14.0, 14.0], [0.6, 0.4], [0.06, 0.05], [0.028, 0.02]]), 0.04, NO_PLAY
)


def arm(mass=0.3, kp=17.8, limit=""):
    return robot_of(ARM.format(mass=mass, kp=kp, limit=limit))


def log(robot, scale=1.0, truth=TRUTH, steps=20, seconds=20.0):
    """A log of an arm behind servos with the true numbers, in some steps a sample."""
    time, command = sines_and_steps(seconds)
    command = scale * command
    q = positions(robot, time, command, truth, steps=steps)
    return Recording(time, q, None, command - q, command=command)


LOG = log(arm())


def fit_to(robot, piece=LOG):
    return fit_servos(robot, [piece])


@pytest.mark.parametrize("kp", [5.0, 998.0])
def test_numbers_come_from_the_log_and_not_from_the_models_servos(kp):
    """Those of a joint whose link weighs nothing come with the gain of the other one."""
    fit = fit_to(arm(kp=kp))
    assert fit.is_shown[0].tolist() == [True, False] and not fit.is_fast.any()
    errors = np.abs(fit.numbers / TRUTH.numbers - 1.0)
    assert np.all(errors[[0, 1, 3]] < [[0.05], [0.2], [0.2]])
    assert np.all(np.abs(fit.numbers - TRUTH.numbers) < 2.0 * fit.errors)
    assert fit.delay == pytest.approx(TRUTH.delay, abs=0.003)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01])
def test_the_delay_is_that_of_the_commands_alone(delay):
    """The servo's lag, the held commands and the low-pass are no part of it."""
    truth = replace(TRUTH, delay=delay)
    fit = fit_to(arm(), log(arm(), truth=truth, steps=40))
    assert abs(fit.delay - delay) < 2.0 * fit.delay_error
    assert fit.delay_error < 1e-3


@pytest.mark.slow
def test_a_model_without_servos_leads_to_the_same_numbers():
    xml = ARM.format(mass=0.3, kp=9.0, limit="")
    bare = fit_to(robot_of(xml[: xml.index("<actuator>")] + "</mujoco>"))
    assert bare.numbers == pytest.approx(fit_to(arm()).numbers, rel=0.05)


@pytest.mark.slow
def test_errors_of_links_cover_numbers_that_wrong_links_change():
    fit = fit_to(arm())
    errors = fit.errors[:, 0]
    numbers = fit.numbers[:, 0]
    # The mass is off by one standard deviation alone, which the common error adds to.
    wrong = fit_to(arm(mass=0.3 * (1.0 + LINK_ERROR))).numbers[:, 0]
    changes = np.abs(wrong - numbers)
    assert np.all(changes <= errors)
    assert changes[0] == pytest.approx(LINK_ERROR * numbers[0], rel=0.1)
    assert errors[0] < 3.5 * changes[0]


def test_samples_at_a_torque_limit_do_not_count():
    fit = fit_to(arm(), log(arm(limit=' forcerange="-2 2"'), scale=2.0))
    assert fit.numbers[0, 0] == pytest.approx(TRUTH.numbers[0, 0], rel=0.1)


@pytest.mark.parametrize("share", [0.0, 0.01])
def test_joints_that_hardly_move_are_not_known(share):
    """All that they show is how friction creeps."""
    fit = fit_to(arm(), log(arm(), np.array([1.0, share])))
    assert fit.is_known.tolist() == [True, False]
    if not share:
        in_model = servos_in_model(arm()).numbers
        np.testing.assert_array_equal(fit.numbers[:, 1], in_model[:, 1])
        assert not fit.errors[:, 1].any() and fit.errors[:, 0].all()


def test_a_joint_that_moves_a_little_has_the_numbers_of_larger_motions():
    """Friction that creeps in slow motion is not taken for damping."""
    fit = fit_to(arm(), log(arm(), np.array([1.0, 0.15])))
    assert fit.is_known.all()
    assert np.all(np.abs(fit.numbers - TRUTH.numbers) < 2.0 * fit.errors)
    ratios = fit.numbers[:, 1] / fit.numbers[0, 1]
    assert ratios == pytest.approx(TRUTH.numbers[:, 1] / TRUTH.numbers[0, 1], rel=0.15)


SMALL = """<mujoco><worldbody><body>
<joint name="pan" axis="0 0 1" range="-2 2" damping=".6" armature=".028" frictionloss=".05"/>
<inertial pos="0 0 .05" mass=".2" diaginertia="2e-4 2e-4 2e-4"/><body pos="0 0 .1">
<joint name="lift" axis="0 1 0" range="-2 2" damping=".6" armature=".028" frictionloss=".05"/>
<inertial pos=".12 0 .02" mass=".3" diaginertia="2e-4 5e-4 5e-4"/></body></body></worldbody>
<actuator><general joint="pan" biastype="affine" gainprm="998" biasprm="0 -998 -2.7"
  forcerange="-3.35 3.35"/>
<general joint="lift" biastype="affine" gainprm="998" biasprm="0 -998 -2.7"
  forcerange="-3.35 3.35"/></actuator></mujoco>"""
"""Two joints like those of a small hobby arm behind stiff servos."""


@pytest.mark.slow
def test_a_servo_that_is_too_fast_for_the_samples_is_found_by_rollouts():
    """Its rotor inertia and damping show; what it hides stays near the model's, with a wide ±."""
    robot = robot_of(SMALL)
    in_model = servos_in_model(robot)
    others = [[0.11, 0.1], [0.02, 0.018]]
    truth = ServoParameters(np.vstack((in_model.numbers[:2], others)), 0.02, NO_PLAY)
    # Small steps: at its limit, a step's error acts as rotor inertia.
    piece = log(robot, 0.8, truth, steps=200, seconds=4.0)
    fit = fit_to(robot, piece)
    assert fit.is_fast.all()
    problem = ServoProblem(ServoRollouts(robot), [piece])
    refined = refine_by_playing(problem, fit)
    assert refined.numbers[3] == pytest.approx(truth.numbers[3], rel=0.1)
    assert refined.numbers[1] == pytest.approx(truth.numbers[1], rel=0.2)
    assert np.all(np.abs(refined.numbers - truth.numbers) <= 3.0 * refined.errors)
    assert abs(refined.delay - truth.delay) < 2.0 * refined.delay_error < 2e-3
    before, after, _ = problem.test(replace(in_model, delay=fit.delay), refined)
    assert rms(after) < 0.5 * rms(before)

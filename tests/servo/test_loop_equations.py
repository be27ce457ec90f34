"""The equations of servos' closed loops: numbers without a start, links' errors, torque limits."""

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.records import Measurement
from robot_sysid.servo.loop_equations import (
    LINK_ERROR,
    link_errors,
    loop_equations,
    solve_loop_equations,
)
from robot_sysid.servo.windows import make_problem
from robot_sysid.simulation.playback import ServoParameters, ServoRollouts
from tests.support.arms import robot_of
from tests.support.servo_logs import commanded, positions

ARM = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".1 0 .02" mass="{mass}" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".15 0 0"><joint name="roll" axis="1 0 0" range="-2 2" damping=".1"/>
<inertial pos=".05 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/></body></body></worldbody>
<actuator><position joint="lift" kp="9"{limit}/><position joint="roll" kp="{kp}"/></actuator>
</mujoco>"""
"""A joint that carries a link, and one whose link weighs nothing."""
TRUTH = ServoParameters(
    np.array([18.0, 14.0]),
    np.array([0.6, 0.4]),
    np.array([0.06, 0.05]),
    np.array([0.028, 0.02]),
    0.04,
)
BOTH = np.array([True, True])


def arm(mass=0.3, kp=9.0, limit=""):
    return robot_of(ARM.format(mass=mass, kp=kp, limit=limit))


def log(robot, scale=1.0):
    """A log of an arm behind servos with the true numbers."""
    time, command = commanded(20.0)
    command = scale * command
    q = positions(robot, time, command, TRUTH, steps=20)
    return Measurement(time, q, None, command - q, command=command)


LOG = log(arm())


def solve(robot, pieces=(LOG,)):
    equations = loop_equations(robot, pieces)
    return solve_loop_equations(robot, equations, BOTH, np.full(2, 1.0))


def test_numbers_come_from_the_log_and_not_from_the_models_servos():
    fit = solve(arm(kp=14.0))
    assert (fit.scale_error < 1.0).tolist() == [True, False]
    for name, tolerance in (("stiffness", 0.05), ("damping", 0.2), ("armature", 0.2)):
        expected = pytest.approx(getattr(TRUTH, name), rel=tolerance)
        assert getattr(fit.servos, name) == expected, name
    assert fit.servos.delay == pytest.approx(TRUTH.delay, abs=0.01)


def test_a_joint_without_scale_has_the_right_ratios():
    (a, b) = (solve(arm(kp=kp)).servos for kp in (5.0, 10.0))
    for name in ("stiffness", "damping", "frictionloss", "armature"):
        assert getattr(b, name)[1] == pytest.approx(2.0 * getattr(a, name)[1], rel=0.01)


def test_a_joint_without_scale_and_servo_in_the_model_is_like_the_others():
    xml = ARM.format(mass=0.3, kp=9.0, limit="")
    bare = robot_of(xml[: xml.index("<actuator>")] + "</mujoco>")
    gain = solve(bare).servos.stiffness
    assert gain[1] == gain[0]


def test_errors_of_links_cover_numbers_that_wrong_links_change():
    fit = solve(arm())
    errors = link_errors(arm(), fit, fit.servos)[[0, 2, 4, 6]]
    numbers = fit.servos.vector()[[0, 2, 4, 6]]
    # The mass is off by one standard deviation alone, which the common error adds to.
    wrong = solve(arm(mass=0.3 * (1.0 + LINK_ERROR))).servos
    changes = np.abs(wrong.vector()[[0, 2, 4, 6]] - numbers)
    assert np.all(changes <= errors)
    assert changes[0] == pytest.approx(LINK_ERROR * numbers[0], rel=0.1)
    assert errors[0] < 3.5 * changes[0]


def test_a_servo_that_is_too_fast_for_the_samples_is_left_to_the_rollouts():
    fit = solve(arm())
    link_inertia = np.array([0.003, 1e-6])
    assert fit.is_resolved(link_inertia).all()
    stiff = replace(fit, servos=replace(TRUTH, stiffness=1000.0 * np.ones(2)))
    is_resolved = stiff.is_resolved(link_inertia)
    assert not is_resolved.any()
    assert not stiff.restrict(is_resolved).determines.any()
    assert np.isnan(stiff.restrict(is_resolved).limit).all()


def test_a_torque_limit_is_seen_and_its_samples_do_not_count():
    assert np.isnan(solve(arm()).limit).all()
    limited_log = log(arm(limit=' forcerange="-2.5 2.5"'), scale=2.0)
    fit = solve(arm(), [limited_log])
    assert fit.limit[0] == pytest.approx(2.5, rel=0.2) and np.isnan(fit.limit[1])
    assert 0.002 < np.mean(fit.is_limited[:, 0]) < 0.2
    assert fit.servos.stiffness[0] == pytest.approx(TRUTH.stiffness[0], rel=0.1)


def test_windows_with_limited_samples_are_left_out_unless_most_have_some():
    problem = make_problem(ServoRollouts(arm()), [LOG])
    window, _, _ = problem.windows[1]
    is_inside = np.abs(LOG.time - window.start - 1.0) < 0.1
    others = problem.without_samples([(LOG, is_inside)]).windows
    assert len(others) == len(problem.windows) - 1
    assert window not in [remaining for remaining, _, _ in others]
    everywhere = np.ones(len(LOG), dtype=bool)
    assert problem.without_samples([(LOG, everywhere)]) is problem


def test_goals_of_the_best_delay_are_the_positions_of_an_ideal_servo():
    command = LOG.command
    ideal = replace(LOG, q=np.vstack((command[:3], command[:-3])))
    problem = make_problem(ServoRollouts(arm()), [ideal])
    assert np.max(np.abs(problem.goal_errors(0.06))) < 1e-9

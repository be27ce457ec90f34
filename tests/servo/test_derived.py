"""What servos' numbers mean for their owner: formulas, and errors of the first order."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.servo_fits import off_with_links, servo_fit, with_links
from rigs.arms.small_arms import robot_of
from robot_sysid.servo.derived import absolute_numbers, derived_numbers, largest_weights
from robot_sysid.servo.unknowns import NAMES

ARM = """<mujoco><compiler angle="radian"/><worldbody><body>
<joint name="lift" axis="0 1 0" range="{range}"/>
<inertial pos=".1 0 0" mass="{mass}" diaginertia="2e-4 5e-4 5e-4"/></body></worldbody>
<actuator><position joint="lift" kp="20"/></actuator></mujoco>"""
FOUND = {
    "gain": 16.0,
    "torque_limit": 2.0,
    "damping": 0.5,
    "frictionloss": 0.08,
    "armature": 0.03,
    "stribeck": 0.04,
    "limited_damping": 0.2,
    "load_share": 0.15,
    "load_stribeck": 0.1,
    "dead_zone": 0.01,
    "loop_lag": 0.004,
}


SMALL = 1e-2
"""Size of changes, in deviations."""


def arm(mass=0.3, limits="-2 2"):
    return robot_of(ARM.format(mass=mass, range=limits))


def largest_of(robot):
    """The largest weight of the first joint."""
    return largest_weights(robot, robot.thetas)[0][0]


@pytest.mark.parametrize("mass", [0.3, 1.2])
def test_weights_are_the_largest_within_the_joints_range(mass):
    whole = mass * 9.81 * 0.1
    assert largest_of(arm(mass)) == pytest.approx(whole, rel=1e-3)
    # Hanging, and up to 0.3 rad from it.
    low = largest_of(arm(mass, f"{np.pi / 2 - 0.3} {np.pi / 2 + 0.3}"))
    assert low == pytest.approx(whole * np.sin(0.3), rel=0.01)


def test_formulas_of_what_needs_no_scale():
    robot = arm()
    weight = largest_weights(robot, robot.thetas)[0][0]
    found = derived_numbers(robot, servo_fit(robot, **FOUND))
    expected = {
        "dead_band": ("rad", (0.08 + 0.04) / 16.0 + 0.01),
        "sag": ("rad", weight / 16.0),
        "friction_over_gain": ("rad", 0.08 / 16.0),
        "damping_over_gain": ("s", 0.5 / 16.0),
        "even_speed": ("rad/s", 0.08 / 0.5),
        "torque_over_weight": ("", 2.0 / weight),
    }
    assert found.keys() == expected.keys()
    for name, (unit, value) in expected.items():
        assert found[name].unit == unit
        assert_allclose(found[name].values, value, rtol=1e-9)


def test_absolute_numbers_are_those_of_the_joint():
    robot = arm()
    found = absolute_numbers(servo_fit(robot, **FOUND))
    # Zeros of links are fitted beside the servos, and are no number of theirs.
    assert found.keys() == FOUND.keys() - {"zero"}
    for name, number in found.items():
        assert_allclose(number.values, FOUND[name], rtol=1e-9)


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_friction_and_limit_do_not_follow_a_gain_that_is_set(times):
    robot = arm()
    fit = servo_fit(robot, **FOUND)
    other = servo_fit(robot, **{**FOUND, "gain": 16.0 * times})
    expected = derived_numbers(robot, other)
    for name, found in derived_numbers(robot, fit, times).items():
        assert_allclose(found.values, expected[name].values, rtol=1e-9)


def moved(fit, step):
    """A fit with other unknowns and link errors."""
    u = len(NAMES)
    return replace(fit, x=fit.x + step[:u], link_errors=fit.link_errors + step[u:])


def correlated(robot, size):
    """A fit whose unknowns are off together."""
    fit = servo_fit(robot, **FOUND)
    root = np.random.default_rng(0).normal(size=(len(NAMES), len(NAMES)))
    covariance = size**2 * (root @ root.T)[None] / len(NAMES)
    return replace(fit, covariance=with_links(covariance))


@pytest.mark.parametrize("size", [1e-4, 1e-3])
@pytest.mark.parametrize(
    "numbers", [derived_numbers, lambda _, fit: absolute_numbers(fit)]
)
def test_errors_are_the_spread_of_changed_unknowns(numbers, size):
    """By small changes along the axes of their covariance."""
    robot = arm()
    fit = correlated(robot, size)
    variances, axes = np.linalg.eigh(fit.covariance[0])
    spread = dict.fromkeys(numbers(robot, fit), 0.0)
    for variance, axis in zip(variances, axes.T):
        step = SMALL * np.sqrt(max(variance, 0.0)) * axis
        sides = [numbers(robot, moved(fit, sign * step)) for sign in (1.0, -1.0)]
        for name in spread:
            more, less = (side[name].values[0] for side in sides)
            spread[name] += (0.5 * (more - less) / SMALL) ** 2
    for name, found in numbers(robot, fit).items():
        assert found.errors[0] == pytest.approx(np.sqrt(spread[name]), rel=5e-3)
        assert found.errors[0] > 0.0


def test_errors_of_drawn_unknowns_are_as_wide():
    robot = arm()
    fit = correlated(robot, 0.02)
    draws = np.random.default_rng(1).multivariate_normal(
        fit.x[0], fit.covariance[0][: len(NAMES), : len(NAMES)], 400
    )
    rows = [
        {
            name: one.values[0]
            for name, one in absolute_numbers(replace(fit, x=x[None])).items()
        }
        for x in draws
    ]
    for name, found in absolute_numbers(fit).items():
        # 400 draws have a spread that is known to 3.5 %.
        drawn = np.std([row[name] for row in rows])
        assert found.errors[0] == pytest.approx(drawn, rel=0.12)


def test_a_gain_that_is_off_as_the_links_are_leaves_the_sag():
    """Absolute numbers have the errors of the links in theirs, and ratios to their weight less."""
    robot = arm()
    fit = servo_fit(robot, **FOUND)
    together = off_with_links(robot, fit)
    alone = derived_numbers(robot, fit)
    for name, found in derived_numbers(robot, together).items():
        if name in ("sag", "torque_over_weight"):
            assert found.errors[0] < 0.9 * alone[name].errors[0]
        else:
            assert_allclose(found.errors, alone[name].errors)
    wide, narrow = (absolute_numbers(each)["gain"].errors for each in (together, fit))
    assert wide > 2.0 * narrow


def test_links_that_were_found_heavier_sag_more():
    robot = arm()
    fit = servo_fit(robot, **FOUND)
    heavier = replace(
        fit, link_errors=fit.link_errors + np.eye(fit.link_errors.shape[1])[0]
    )
    before, after = (derived_numbers(robot, each)["sag"] for each in (fit, heavier))
    weight, by_thetas = largest_weights(robot, robot.thetas)
    more = by_thetas[0] @ fit.links.directions[0, :, 0]
    assert more > 0.1 * weight[0]
    assert_allclose(after.values, before.values * (1.0 + more / weight), rtol=1e-9)


def test_heavier_links_with_stronger_servos_are_the_same_to_their_owner():
    """Dead band, sag and speeds; and the numbers of the servo are as many times as large."""
    light, heavy = arm(0.3), arm(0.6)
    torques = (
        "gain",
        "torque_limit",
        "damping",
        "frictionloss",
        "armature",
        "stribeck",
    )
    twice = {name: 2.0 * FOUND[name] for name in torques}
    fits = servo_fit(light, **FOUND), servo_fit(heavy, **{**FOUND, **twice})
    before, after = map(derived_numbers, (light, heavy), fits)
    for name in before:
        assert_allclose(after[name].values, before[name].values, rtol=1e-9)
        # The error of a mass is not quite in proportion to it.
        of_links = name in ("sag", "torque_over_weight")
        rtol = 0.05 if of_links else 1e-6
        assert_allclose(after[name].errors, before[name].errors, rtol=rtol)
    one, other = map(absolute_numbers, fits)
    for name in torques:
        assert_allclose(other[name].values, 2.0 * one[name].values, rtol=1e-9)
        assert_allclose(other[name].errors, 2.0 * one[name].errors, rtol=1e-6)

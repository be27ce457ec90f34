"""Constraint values, their gradient, and the memory that saves collision tests."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.excitation.design.constraints import MotionConstraints
from tests.support import arms
from tests.support.arms import SEEDS
from tests.support.excitation_arms import TUBES_AND_POST, problem, slope

STRONG_MOTORS = arms.DRY_FRICTION.replace(
    "</worldbody>",
    "</worldbody><actuator>"
    + "".join(
        f'<motor joint="joint{j}" ctrlrange="-{t} {t}" ctrllimited="true"/>'
        for j, t in enumerate((40, 90, 90))
    )
    + "</actuator>",
)


def columns(joints):
    """Names of the constraint families by column."""
    names = ("position", "velocity", "acceleration", "torque")
    return [name for name in names for _ in range(joints)] + ["tool speed", "clearance"]


LIMITED = ({}, {"max_tool_speed": 0.7}, {"payload_reserve": 2.0})


@given(st.sampled_from(LIMITED), SEEDS)
def test_gradient_equals_differences(limits, seed):
    constraints = MotionConstraints(problem(STRONG_MOTORS, **limits), 0.99, 0.0)
    rng = np.random.default_rng(seed)
    motion, direction = rng.normal(size=(2, 3, 3, 3))
    cache = constraints.evaluate(motion)
    weight = rng.uniform(size=cache.value.shape)
    gradient = constraints.vjp(cache, weight)
    exact = sum(np.sum(g * d) for g, d in zip(gradient, direction))
    size = sum(np.sum(np.abs(g * d)) for g, d in zip(gradient, direction))
    ahead, behind = (
        np.sum(weight * constraints.evaluate(motion + step * direction).value)
        for step in (1e-6, -1e-6)
    )
    here = np.sum(weight * cache.value)
    # A coordinate that passes zero within the step has a kink there: two slopes.
    slopes = np.array([ahead - here, here - behind]) / 1e-6
    assert min(abs(slopes - exact)) < 1e-4 * size


def test_values_are_shares_of_the_limits_minus_one():
    some = problem(arms.THREE, max_acceleration=5.0)
    limits = some.limits
    constraints = MotionConstraints(some, 1.0, 0.0)
    q = np.vstack((limits.upper, limits.lower, 0.5 * (limits.lower + limits.upper)))
    qd, qdd = np.tile(limits.velocity, (3, 1)), np.tile(-0.5 * limits.acceleration, (3, 1))
    value = constraints.evaluate((q, qd, qdd)).value
    names = np.array(columns(3))
    assert np.allclose(value[:, names == "position"], [[0.0] * 3, [0.0] * 3, [-1.0] * 3])
    assert np.allclose(value[:, names == "velocity"], 0.0)
    assert np.allclose(value[:, names == "acceleration"], -0.5)
    assert np.all(value[:, names == "torque"] == -1.0)
    assert np.all(value[:, names == "tool speed"] == -1.0)


def test_gradient_of_the_clearance_equals_differences():
    some = problem(TUBES_AND_POST)
    rng = np.random.default_rng(2)
    checked = 0
    while checked < 20:
        q, direction = rng.uniform(-1.5, 1.5, size=(2, 1, 4))
        still = np.zeros((1, 4))

        def value(at, still=still):
            return MotionConstraints(some, 1.0, 0.0).evaluate((at, still, still)).value[0, -1]

        constraints = MotionConstraints(some, 1.0, 0.0)
        cache = constraints.evaluate((q, still, still))
        if cache.value[0, -1] <= -0.9:
            continue
        weight = np.zeros_like(cache.value)
        weight[0, -1] = 1.0
        exact = np.sum(constraints.vjp(cache, weight)[0] * direction)
        if value(q + 1e-4 * direction) + value(q - 1e-4 * direction) - 2 * value(q) < 1e-6:
            checked += 1
            assert exact == pytest.approx(slope(value, q, direction), rel=1e-3, abs=1e-3)


@given(SEEDS)
def test_memory_never_hides_a_tight_sample(seed):
    some = problem(TUBES_AND_POST)
    remembering = MotionConstraints(some, 1.0, 0.003)
    rng = np.random.default_rng(seed)
    q, still = rng.uniform(-1.5, 1.5, size=(6, 4)), np.zeros((6, 4))
    for _ in range(4):
        fresh = MotionConstraints(some, 1.0, 0.003).evaluate((q, still, still)).value[:, -1]
        kept = remembering.evaluate((q, still, still)).value[:, -1]
        # Half the horizon is what the memory promises to tell exactly.
        tight = np.maximum(fresh, kept) > -0.4
        assert np.allclose(fresh[tight], kept[tight], atol=1e-12)
        q = q + 0.02 * rng.normal(size=q.shape)

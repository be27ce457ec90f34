"""The fit behind the checks: what it sees, and that a mistake undone is no mistake."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.diagnosis.model_fit import ModelFit
from robot_sysid.diagnosis.offsets import joint_delays, joint_zeros, time_base
from robot_sysid.diagnosis.torque import explanations, hypotheses, loaded, torque_scales
from tests.support import arms
from tests.support.wrong_logs import truth_of


def test_a_right_log_fits_tells_the_link_and_has_no_explanation(truth, right):
    base = right.fit()
    assert base.cost < 1.0 and right.plausible(base)
    assert base.thetas[-1, 0] == pytest.approx(truth.theta[0], rel=0.15)
    assert explanations(right) == []


def test_without_payload_and_friction_the_model_is_its_own_fit():
    """Its rotors are, too: they make most of this arm's torque."""
    joint = 'range="-2.5 2.5" armature="3"'
    truth = truth_of(arms.robot_of(arms.serial_arm(arms.SEVEN_AXES[:5], joint=joint)), seed=3)
    exact = ModelFit(truth.robot, [truth.log])
    sample = replace(exact.sample, tau=exact.model_torque + 3.0 * exact.sample.qdd)
    found = exact.fit(sample)
    assert found.cost < 1e-6
    np.testing.assert_allclose(found.thetas, exact.links, atol=1e-6)


def test_every_mistake_is_undone_by_making_it_again(truth, right):
    """Signs, exchanges and the reversed order are their own inverses."""
    cost = right.fit().cost
    for _, made, spoilt in list(hypotheses(right.sample, truth.robot))[2::7]:
        undone = {text: each for _, text, each in hypotheses(spoilt, truth.robot)}
        assert right.fit(undone[made]).cost == pytest.approx(cost, rel=1e-9)


def test_no_fit_costs_less_than_its_bound_which_is_no_empty_one(truth, right):
    tried = [undone for *_, undone in hypotheses(right.sample, truth.robot)][::3]
    share = right.least_costs(tried) / [right.fit(each).cost for each in tried]
    assert np.max(share) < 1.0 and np.median(share) > 0.05


def test_scaling_all_torques_scales_what_is_found(truth, right):
    scaled = copy.copy(right)
    scaled.sample = right.sample.with_torque(300.0)
    (one, _), (other, _) = torque_scales(right), torque_scales(scaled)
    np.testing.assert_allclose(other, 300.0 * one, rtol=1e-6)


@pytest.mark.parametrize(
    ("found_by", "spoilt", "true"),
    [
        (joint_zeros, lambda log: {"q": log.q + [0.0, 0.12, 0.0, 0.0, 0.0]}, {1: 0.12}),
        (
            joint_delays,
            lambda log: {"tau": np.roll(log.tau, 10, axis=0)},
            dict.fromkeys(range(5), 0.04),
        ),
        (
            time_base,
            lambda log: {"time": log.time * (1.0 + 0.06 * log.time / 12.0)},
            {0: 0.06, 1: 0.06},
        ),
    ],
)
def test_constants_are_found_within_their_errors(truth, found_by, spoilt, true):
    found = found_by(ModelFit(truth.robot, [replace(truth.log, **spoilt(truth.log))]))
    for place, value in enumerate(found.value):
        assert abs(value - true.get(place, 0.0)) < 3.0 * found.error[place], found
    assert found.after.cost < 1.0


def test_the_newtons_of_a_lift_say_nothing_of_the_arm_on_it():
    carriage = '<inertial pos="0 0 0" mass="1000" diaginertia="9 9 9"/>'
    lift = '<joint name="lift" type="slide" axis="0 0 1" range="0 .3"/>'
    bodies = arms.serial_bodies((arms.Z, arms.Y, arms.Y), joint='range="-2 2"')
    robot = arms.robot_of(arms.world(arms.link(lift, bodies, quat="1 0 0 0", inertial=carriage)))
    carries = loaded(ModelFit(robot, [truth_of(robot, 7).log]))
    assert carries[0] and carries[2]

"""Several recordings: those of a kind agree, and one that does not is named."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.recordings import (
    bodies_apart,
    contradiction,
    each_recording,
    logs_compared,
)
from robot_sysid.records import Flange
from tests.estimation.conftest import SIGMA
from tests.support import arms
from tests.support.core_fits import datasets_of, fitted
from tests.support.measured_logs import JOINT, log_of, plan_of
from tests.support.payload_logs import PAYLOAD, TrueArm, four_joint_arm

FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


def test_every_recording_says_the_same_within_its_errors(payload_fit):
    mass, scatter = payload_fit.value("m(payload)"), each_recording(payload_fit, FLANGE)
    assert [one.name for one in scatter] == ["log0", "log3", "log1", "log2"]
    assert [one.is_loaded for one in scatter] == [False, False, True, True]
    for one in scatter:
        assert abs(one.mass - mass) < 3.0 * one.noise_error
        assert one.noise_error < one.error < 0.1
        # The centre of mass is told in the flange frame, 5 cm further out.
        assert one.com == pytest.approx(PAYLOAD[1:4] / PAYLOAD[0] - [0, 0, 0.05], abs=0.01)


def test_bodies_are_those_on_the_arm(payload_fit, recordings):
    bodies, covariance = bodies_apart(payload_fit, payload_fit.samples)
    assert not np.any(bodies[0]) and not np.any(covariance[0]) and not np.any(covariance[:, :, 0])
    off = bodies[1:] - np.outer([each.is_loaded for each in recordings[1:]], PAYLOAD)
    errors = np.sqrt(np.diag(covariance[1:, :, 1:].reshape(30, 30)))
    assert np.max(np.abs(off.ravel()) / errors) < 4.0 and np.max(errors.reshape(3, 10)[:, 0]) < 0.05
    assert contradiction(payload_fit, FLANGE) == ""


def test_a_recording_on_the_wrong_side_is_named_with_all_that_the_arm_carries(recordings):
    wrong = list(recordings)
    wrong[0] = replace(wrong[0], is_loaded=True)
    wrong[1] = replace(wrong[1], is_loaded=False)
    told = contradiction(fitted(four_joint_arm(), wrong, loaded=True), FLANGE)
    assert " in mass; compared with log" in told
    carried = dict(re.findall(r"(log\d) (\S+) kg at", told))
    masses = [float(carried.get(f"log{k}", 0.0)) for k in range(4)]
    assert len(carried) == 2 and " nothing" in told
    assert masses == pytest.approx([0.0, 1.2, 1.2, 0.0], abs=0.05)


def turned(theta):
    """A body turned by half a turn about the flange's axis."""
    half = np.diag([-1.0, -1.0, 1.0])
    mass, com, inertia = spatial.com_from_theta(theta)
    return spatial.theta_from_com(mass, half @ com, half @ inertia @ half)


@pytest.mark.parametrize(
    ("place", "change", "what"),
    [
        (2, lambda theta: 1.01 * theta, ""),
        (2, lambda theta: 1.3 * theta, "log2 differs from log1 in mass"),
        (2, turned, "in centre of mass"),
        (2, lambda theta: theta + [0, 0, 0, 0, 0.05, 0, 0, 0.05, 0, 0.05], "in inertia"),
        (3, lambda theta: 0.2 * theta, "log3 differs from log0 in mass; compared with log0"),
    ],
)
def test_clear_differences_of_a_kind_are_named(place, change, what):
    """One of the two loaded recordings carries something else, or an empty one anything."""
    robot = four_joint_arm()
    found = list(TrueArm(robot, 7, wrong=0.03).abba(7, sigma=SIGMA))
    other = TrueArm(robot, 7, wrong=0.03, payload=change(PAYLOAD)).abba(7, sigma=SIGMA)
    with_it = {2: other[2], 3: replace(other[1], name="log3", is_loaded=False)}
    found[place] = with_it[place]
    told = contradiction(fitted(robot, found, loaded=True), FLANGE)
    assert what in told and bool(what) == bool(told)
    if change is turned:
        # The centre of mass is told in the flange frame, 5 cm further out.
        places = [[-30, 20, 30], [30, -20, 30]]
        said = re.findall(r"log[12] 1.2\d? kg at \((.+?)\)", told)
        found = sorted([float(x) for x in place.split(",")] for place in said)
        np.testing.assert_allclose(found, places, atol=5.0)


# ---- logs of the arm alone


def compared(plant, robot, *plants):
    logs = [
        log_of(each, plan_of(plant, 1 + k), k, noise_torque=0.1, encoder_resolution=1e-4)
        for k, each in enumerate(plants)
    ]
    datasets, options = datasets_of(robot, *logs, link_uncertainty=2.0)
    return logs_compared(fitted(robot, datasets, options), [d.name for d in datasets])


def test_logs_that_agree_are_said_to(plant, robot):
    (masses, said), tests = compared(plant, robot, plant, plant)
    assert masses.startswith("mass of each log alone: log0 ") and "; log1 0." in masses
    assert said.startswith("the logs agree")
    names = [f"log{k}, predicted from the other logs" for k in range(2)]
    assert [each.source for each in tests] == names
    assert all(each.relative_error < 0.1 for each in tests)


@pytest.mark.parametrize("alone", [(), (2,), (0, 2)])
def test_a_log_of_joints_that_move_in_it_alone_is_no_test_of_the_others(plant, robot, alone):
    logs = [log_of(plant, plan_of(plant, 1 + k), k, noise_torque=0.05) for k in range(2)]
    datasets, options = datasets_of(robot, *logs)
    used = np.ones(datasets[0].motion.q.shape, dtype=bool)
    used[:, list(alone)] = False
    first = replace(datasets[0], used=used)
    tests = logs_compared(fitted(robot, [first, datasets[1]], options), ["a", "b"])[1]
    assert [each.source[0] for each in tests] == (["a"] if alone else ["a", "b"])


def test_logs_that_do_not_agree_are_called_so(plant, robot):
    lighter = arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT).replace(
        'mass=".8"', 'mass=".5"'
    )
    (_, said), tests = compared(plant, robot, plant, arms.robot_of(lighter))
    assert said.startswith("the logs do not agree")
    assert max(each.relative_error for each in tests) > 0.1

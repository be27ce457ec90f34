"""Several recordings: those of a kind agree, and one that does not is named."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.identify import (
    bodies_apart,
    contradiction,
    payloads_by_recording,
)
from robot_sysid.estimation.log_comparison import compare_recordings
from robot_sysid.records import Flange
from tests.estimation.conftest import SIGMA
from tests.support import arms
from tests.support.core_fits import filter_logs, fit_recordings
from tests.support.measured_logs import XML, log_of, plan_of
from tests.support.payload_logs import PAYLOAD, TrueArm, four_joint_arm

WITHIN = 3.5
"""Standard errors that the worst of some numbers may be off."""
FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


def test_every_recording_says_the_same_within_its_errors(payload_fit):
    mass = payload_fit.value("m(payload)")
    scatter = payloads_by_recording(payload_fit, FLANGE)
    assert [one.name for one in scatter] == ["log0", "log3", "log1", "log2"]
    assert [one.is_loaded for one in scatter] == [False, False, True, True]
    for one in scatter:
        assert abs(one.mass - mass) < 3.0 * one.noise_error
        assert one.noise_error < one.error < 0.1
        # The centre of mass is told in the flange frame, 5 cm further out.
        assert one.com == pytest.approx(
            PAYLOAD[1:4] / PAYLOAD[0] - [0, 0, 0.05], abs=0.01
        )


def test_bodies_are_those_on_the_arm(payload_fit, recordings):
    bodies, covariance = bodies_apart(payload_fit, payload_fit.samples)
    assert (
        not np.any(bodies[0])
        and not np.any(covariance[0])
        and not np.any(covariance[:, :, 0])
    )
    off = bodies[1:] - np.outer([each.is_loaded for each in recordings[1:]], PAYLOAD)
    errors = np.sqrt(np.diag(covariance[1:, :, 1:].reshape(30, 30)))
    assert (
        np.max(np.abs(off.ravel()) / errors) < 4.0
        and np.max(errors.reshape(3, 10)[:, 0]) < 0.05
    )
    assert contradiction(payload_fit, FLANGE) == ""


def test_a_recording_on_the_wrong_side_is_named_with_all_that_the_arm_carries(
    recordings,
):
    wrong = list(recordings)
    wrong[0] = replace(wrong[0], is_loaded=True)
    wrong[1] = replace(wrong[1], is_loaded=False)
    told = contradiction(fit_recordings(four_joint_arm(), wrong, loaded=True), FLANGE)
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
        (
            2,
            lambda theta: theta + [0, 0, 0, 0, 0.05, 0, 0, 0.05, 0, 0.05],
            "in inertia",
        ),
        (
            3,
            lambda theta: 0.2 * theta,
            "log3 differs from log0 in mass; compared with log0",
        ),
    ],
)
def test_clear_differences_of_a_kind_are_named(place, change, what):
    """One of the two loaded recordings carries something else, or an empty one anything."""
    robot = four_joint_arm()
    found = list(TrueArm(robot, 7, model_error=0.03).abba(7, sigma=SIGMA))
    other = TrueArm(robot, 7, model_error=0.03, payload=change(PAYLOAD)).abba(
        7, sigma=SIGMA
    )
    with_it = {2: other[2], 3: replace(other[1], name="log3", is_loaded=False)}
    found[place] = with_it[place]
    told = contradiction(fit_recordings(robot, found, loaded=True), FLANGE)
    assert what in told and bool(what) == bool(told)
    if change is turned:
        # The centre of mass is told in the flange frame, 5 cm further out.
        places = [[-30, 20, 30], [30, -20, 30]]
        said = re.findall(r"log[12] 1.2\d? kg at \((.+?)\)", told)
        found = sorted([float(x) for x in place.split(",")] for place in said)
        assert_allclose(found, places, atol=5.0)


# ---- logs of the arm alone


def logs_of_days(plant, plants, seed=0):
    """One log of each arm; the motions differ."""
    sensors = {"noise_torque": 0.1, "encoder_resolution": 1e-4}
    plans = [plan_of(plant, 1 + seed + k) for k in range(len(plants))]
    return [
        log_of(*pair, seed + k, **sensors) for k, pair in enumerate(zip(plants, plans))
    ]


def compared(plant, robot, *plants):
    logs = logs_of_days(plant, plants)
    datasets, options = filter_logs(robot, *logs, link_uncertainty=2.0)
    return compare_recordings(
        fit_recordings(robot, datasets, options), [d.name for d in datasets]
    )


def test_logs_that_agree_are_said_to(plant, robot):
    comparison = compared(plant, robot, plant, plant)
    masses, said = comparison.notes
    tests = comparison.tests
    assert comparison.friction.differences == {}
    assert masses.startswith("mass of each log alone: log0 ") and "; log1 0." in masses
    assert said.startswith("the logs agree")
    names = [f"log{k}, predicted from the other logs" for k in range(2)]
    assert [each.source for each in tests] == names
    assert all(each.relative_error < 0.1 for each in tests)


@pytest.mark.parametrize("alone", [(), (2,), (0, 2)])
def test_a_log_of_joints_that_move_in_it_alone_is_no_test_of_the_others(
    plant, robot, alone
):
    logs = [
        log_of(plant, plan_of(plant, 1 + k), k, noise_torque=0.05) for k in range(2)
    ]
    datasets, options = filter_logs(robot, *logs)
    used = np.ones(datasets[0].motion.q.shape, dtype=bool)
    used[:, list(alone)] = False
    first = replace(datasets[0], used=used)
    tests = compare_recordings(
        fit_recordings(robot, [first, datasets[1]], options), ["a", "b"]
    ).tests
    assert [each.source[0] for each in tests] == (["a"] if alone else ["a", "b"])


def test_logs_that_do_not_agree_are_called_so(plant, robot):
    lighter = XML.replace('mass=".8"', 'mass=".5"')
    comparison = compared(plant, robot, plant, arms.robot_of(lighter))
    assert comparison.notes[1].startswith("the logs do not agree")
    assert max(each.relative_error for each in comparison.tests) > 0.1


def warmer(plant, rng, share):
    """The same arm on another day: friction differs by a share, of each joint and term anew."""
    factors = 1.0 + share * rng.standard_normal((2, plant.n_joints))
    friction = plant.friction
    changed = replace(
        friction,
        coulomb=factors[0] * friction.coulomb,
        viscous=factors[1] * friction.viscous,
    )
    return replace(plant, friction=changed)


def true_friction(plant, names):
    """Coulomb and viscous friction by name."""
    terms = {"coulomb": plant.friction.coulomb, "viscous": plant.friction.viscous}
    split = [name[:-1].split("[") for name in names]
    return np.array(
        [terms[term][plant.joint_names.index(joint)] for term, joint in split]
    )


def test_friction_that_differs_between_logs_is_said_and_their_masses_agree(
    plant, robot
):
    one_joint = np.array([1.0, 1.3, 1.0])
    friction = replace(plant.friction, coulomb=one_joint * plant.friction.coulomb)
    comparison = compared(plant, robot, plant, replace(plant, friction=friction))
    (joint,) = comparison.friction.differences
    assert joint == plant.joint_names[1]
    assert comparison.friction.differences[joint] == pytest.approx(0.2, abs=0.05)
    assert comparison.notes[1].startswith("the logs agree on the mass, not on friction")
    assert (
        f"friction differs between the logs by more than its errors: {joint} by"
        in (comparison.notes[2])
    )
    place = comparison.friction.terms_of(joint)["coulomb"]
    between = comparison.friction.between
    off = between.values[:, place] - true_friction(plant, [f"coulomb[{joint}]"]) * [
        1.0,
        1.3,
    ]
    assert np.all(np.abs(off) < WITHIN * between.errors[:, place])


@pytest.mark.parametrize("share", [0.0, pytest.param(0.2, marks=pytest.mark.slow)])
def test_the_error_on_another_day_covers_the_friction_of_a_third_log(
    plant, robot, share
):
    """Friction of all logs is drawn from one distribution; two of them are identified."""
    ratios = []
    excess = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        *plants, third = (warmer(plant, rng, share) for _ in range(3))
        datasets, options = filter_logs(robot, *logs_of_days(plant, plants, 10 * seed))
        fit = fit_recordings(robot, datasets, options)
        friction = compare_recordings(fit, [d.name for d in datasets]).friction
        names = [name for name in friction.names if not name.startswith("offset")]
        kept = [fit.unknowns.estimated_names.index(name) for name in names]
        own = [friction.names.index(name) for name in names]
        errors = np.zeros(len(friction.names))
        errors[own] = fit_errors(fit).total.standard_errors[kept]
        another_day = friction.between.next_log(errors)[own]
        off = fit.values[fit.unknowns.estimated[kept]] - true_friction(third, names)
        ratios += (off / another_day).tolist()
        excess += (another_day / errors[own]).tolist()
        assert bool(friction.differences) == (share > 0.0)
    coverage = np.mean(np.abs(ratios) < 1.96)
    assert coverage >= 0.93
    if share:
        assert coverage < 1.0
        assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.15
    else:
        assert np.median(excess) < 1.6

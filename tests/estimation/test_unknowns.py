"""Questions differ in what is estimated, what has a prior and what is held, and in nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.question import EstimationOptions, Priors, Question
from robot_sysid.estimation.unknowns import (
    COMMON,
    DELAY,
    DRIFT,
    FRICTION,
    LARGEST_LOSS,
    LINKS,
    SCALES,
    TILT,
    WEIGHT,
    ZEROS,
    build_unknowns,
)
from tests.support.core_fits import BASIC, NOISE_ONLY, choice_of
from tests.support.payload_logs import four_joint_arm

ROBOT = four_joint_arm()
COLUMNS = Columns(ROBOT, ())
JOINT = ROBOT.joint_names[0]
OF_LINK = {LINKS, SCALES, ZEROS, DELAY, TILT, FRICTION}


def unknowns_of(options=None, friction=BASIC, **question):
    """Return the unknowns of a question where the data shows every parameter."""
    question = Question(EstimationOptions(**options or {}), **question)
    choice = choice_of(ROBOT, friction)
    is_shown = np.ones(len(COLUMNS.names), dtype=bool)
    return build_unknowns(COLUMNS, question, choice, np.full(4, 5.0), is_shown)


def groups_of(**arguments):
    """Return the priors of a question by their causes."""
    return {group.cause: group for group in unknowns_of(**arguments).groups}


@pytest.mark.parametrize(
    ("question", "causes"),
    [
        ({}, OF_LINK),
        ({"loaded": True}, OF_LINK | {COMMON}),
        ({"loaded": True, "drifts": True}, OF_LINK | {COMMON, DRIFT}),
        ({"loaded": True, "known_mass": 1.0}, OF_LINK | {WEIGHT}),
        ({"loaded": True, "resting": True}, OF_LINK - {DELAY, FRICTION} | {COMMON}),
        ({"in_file": True}, {LINKS, TILT}),
        ({"in_file": True, "unchanged_parts": ("gravity", "links")}, set()),
        ({"options": NOISE_ONLY}, {DELAY}),
    ],
)
def test_a_question_has_the_priors_of_its_causes(question, causes):
    unknowns = unknowns_of(**question)
    assert {group.cause for group in unknowns.groups} == causes
    names = set(unknowns.estimated_names)
    for group in unknowns.groups:
        assert set(group.names) <= names
    assert ("m(payload)" in names) == bool(question.get("loaded"))
    if question.get("in_file"):
        sensors = ("scale", "zero", "load", "delay")
        assert not any(name.startswith(sensors) for name in names)


def test_priors_have_the_stated_sizes_in_si_units():
    options = {"priors": Priors(scale=4.0, zero=1.0, gravity=0.5, delay=3.0)}
    groups = groups_of(options=options)
    assert_allclose(groups[SCALES].factor, 0.04 * np.eye(4))
    assert_allclose(groups[ZEROS].factor, 1e-3 * np.eye(4))
    assert_allclose(groups[TILT].factor, np.radians(0.5) * np.eye(2))
    assert_allclose(groups[DELAY].factor, [[3e-3]])
    # Curved by five times two per cent of 2 % of its usual 5 N m, as no model friction is larger.
    friction = groups[FRICTION]
    deviation_of = dict(zip(friction.names, np.diag(friction.factor)))
    assert deviation_of[f"sqrt[{JOINT}]"] == pytest.approx(5.0 * 0.02 * 0.02 * 5.0)
    assert deviation_of[f"load[{JOINT}]"] == 0.02
    variance = np.sum(groups[LINKS].factor[0] ** 2)
    # Each link by itself, and all in common.
    expected = 2.0 * (0.05 * ROBOT.links[0].theta[0]) ** 2
    assert variance == pytest.approx(expected, rel=1e-6)


def test_a_known_mass_has_a_prior_and_lets_scales_differ():
    groups = groups_of(loaded=True, known_mass=2.0)
    assert_allclose(groups[SCALES].factor, 0.03 * np.eye(4))
    assert groups[WEIGHT].mean[0] == 2.0 and groups[WEIGHT].factor[0, 0] < 1e-5


def test_the_mean_of_torque_scales_is_held_by_the_best_known_joints():
    options = {"priors": Priors(scale=(1.0, 0.0, 2.0, 4.0))}
    scales = groups_of(options=options, loaded=True)[SCALES]
    assert_allclose(np.diag(scales.factor), [0.01, 1e-9, 0.02, 0.04])
    options = {"priors": Priors(scale=(1.0, 1.0, 2.0, 4.0))}
    factor = groups_of(options=options, loaded=True)[COMMON].factor
    # Deviations have no component along the mean weighted by 1 / variance.
    deviation = factor @ np.random.default_rng(1).standard_normal(4)
    assert np.linalg.norm(deviation) > 10.0
    assert_allclose([1.0, 1.0, 0.25, 0.0625] @ deviation, 0.0, atol=1e-4)


def test_bounds_keep_friction_positive_and_leave_other_signs_free():
    unknowns = unknowns_of(friction=f"{BASIC}-load-sqrt")
    basic = unknowns_of()

    def lower_bounds(unknowns, *terms):
        return unknowns.lower[COLUMNS.indices([f"{term}[{JOINT}]" for term in terms])]

    assert not np.any(lower_bounds(unknowns, "coulomb", "armature", "load"))
    # With a root of the speed only the sum has to brake.
    free = lower_bounds(unknowns, "offset", "sqrt", "viscous", "scale", "zero")
    inertial = unknowns.lower[COLUMNS.indices(["m", "Ixy"])]
    assert np.all(np.isinf([*free, *inertial]))
    assert lower_bounds(basic, "viscous") == [0.0]
    assert unknowns.upper[COLUMNS.index[f"load[{JOINT}]"]] == LARGEST_LOSS
    # A loss with a prior only may have either sign.
    assert np.isinf(lower_bounds(basic, "load"))

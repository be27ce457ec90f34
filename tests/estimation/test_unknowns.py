"""Questions differ in what is free, what has a prior and what is held, and in nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.estimation import unknowns as module
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import (
    COMMON,
    DELAY,
    DRIFT,
    FRICTION,
    LINKS,
    SCALES,
    TILT,
    WEIGHT,
    ZEROS,
    build_unknowns,
)
from tests.support.core_fits import NOISE_ONLY, choice_of
from tests.support.payload_logs import four_joint_arm

ROBOT = four_joint_arm()
COLUMNS = Columns(ROBOT, ())
PLAIN = EstimationOptions()


def asked(
    options=PLAIN,
    columns=COLUMNS,
    friction="coulomb-viscous-offset-armature",
    **question,
):
    shown = np.ones(len(columns.names), dtype=bool)
    choice = choice_of(columns.robot, friction)
    torque = np.full(columns.robot.n_joints, 5.0)
    return build_unknowns(columns, Question(options, **question), choice, torque, shown)


def causes(found):
    return {group.cause for group in found.groups}


LINK = {LINKS, SCALES, ZEROS, DELAY, TILT, FRICTION}


@pytest.mark.parametrize(
    ("question", "expected"),
    [
        ({}, LINK),
        ({"loaded": True}, LINK | {COMMON}),
        ({"loaded": True, "drifts": True}, LINK | {COMMON, DRIFT}),
        ({"loaded": True, "known_mass": 1.0}, LINK | {WEIGHT}),
        ({"loaded": True, "resting": True}, LINK - {DELAY, FRICTION} | {COMMON}),
        ({"in_file": True}, {LINKS, TILT}),
        ({"in_file": True, "unchanged_parts": ("gravity", "links")}, set()),
        ({"options": EstimationOptions(**NOISE_ONLY)}, {DELAY}),
        (
            {"options": EstimationOptions(**NOISE_ONLY, delay="auto", tilt="auto")},
            set(),
        ),
    ],
)
def test_a_question_has_the_priors_of_its_causes(question, expected):
    found = asked(**question)
    assert causes(found) == expected
    names = set(found.estimated_names)
    for group in found.groups:
        assert set(group.names) <= names
    assert ("m(payload)" in names) == bool(question.get("loaded"))
    if question.get("in_file"):
        assert not any(
            name.startswith(("scale", "zero", "load", "delay")) for name in names
        )


def test_sizes_are_those_that_were_said():
    options = EstimationOptions(scale_uncertainty=4.0, zero_uncertainty=1.0)
    groups = {group.cause: group for group in asked(options).groups}
    assert_allclose(groups[SCALES].factor, 0.04 * np.eye(4))
    assert_allclose(groups[ZEROS].factor, 1e-3 * np.eye(4))
    # Curved by five times two per cent of 2 % of its usual 5 N m, as no model friction is larger.
    own = dict(zip(groups[FRICTION].names, np.diag(groups[FRICTION].factor)))
    assert own["sqrt[joint0]"] == pytest.approx(5.0 * 0.02 * 0.02 * 5.0)
    assert own["load[joint0]"] == 0.02
    mass = groups[LINKS].factor @ groups[LINKS].factor.T
    # Each link on its own, and all in common.
    assert mass[0, 0] == pytest.approx(
        2.0 * (0.05 * ROBOT.links[0].theta[0]) ** 2, rel=1e-6
    )
    held = {g.cause: g for g in asked(loaded=True, known_mass=2.0).groups}
    assert_allclose(held[SCALES].factor, 0.03 * np.eye(4))
    assert held[WEIGHT].mean[0] == 2.0 and held[WEIGHT].factor[0, 0] < 1e-5


def test_the_mean_of_torque_scales_that_is_held_is_that_of_the_surest():
    sure = EstimationOptions(scale_uncertainty=(1.0, 0.0, 2.0, 4.0))
    groups = {group.cause: group for group in asked(sure, loaded=True).groups}
    assert_allclose(np.diag(groups[SCALES].factor), [0.01, 1e-9, 0.02, 0.04])
    sure = EstimationOptions(scale_uncertainty=(1.0, 1.0, 2.0, 4.0))
    (held,) = (
        group for group in asked(sure, loaded=True).groups if group.cause == COMMON
    )
    # What it allows has no part along the mean weighted by 1 / variance.
    allowed = held.factor @ np.random.default_rng(1).standard_normal(4)
    assert np.linalg.norm(allowed) > 10.0
    assert_allclose([1.0, 1.0, 0.25, 0.0625] @ allowed, 0.0, atol=1e-4)


def test_bounds_hold_friction_and_no_other_sign():
    found = asked(friction="coulomb-viscous-offset-armature-load-sqrt")
    lower = {name: found.lower[k] for k, name in enumerate(found.names)}
    joint = ROBOT.joint_names[0]
    bounded = [f"{term}[{joint}]" for term in ("coulomb", "armature", "load")]
    assert all(lower[name] == 0.0 for name in bounded)
    # With a root of the speed only the sum has to brake.
    free = [
        f"{term}[{joint}]" for term in ("offset", "sqrt", "viscous", "scale", "zero")
    ]
    assert np.all(np.isinf([lower[name] for name in (*free, "m", "Ixy")]))
    assert asked().lower[COLUMNS.index[f"viscous[{joint}]"]] == 0.0
    assert found.upper[COLUMNS.index[f"load[{joint}]"]] == module.LARGEST_LOSS
    # A loss that is only allowed for may come out either way.
    assert np.isinf(asked().lower[COLUMNS.index[f"load[{joint}]"]])

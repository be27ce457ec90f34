"""The friction model is chosen by prediction, and no richer than the data asks for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics.friction import PRESETS, friction_model
from robot_sysid.identify.friction_selection import choose_friction
from robot_sysid.signals.process import process
from tests.support.measured_logs import CUTOFF, guessed, log_of, plan_of, true_arm


@pytest.fixture(scope="module")
def plant():
    return true_arm()


def chosen(plant, more=lambda motion: 0.0, torques="chain", noise=0.02):
    """The choice for a log with further torque: ``more`` of the exact motion."""
    plan = plan_of(plant)
    log = log_of(plant, plan, noise_torque=noise)
    log = replace(log, tau=log.tau + more(plan.evaluate(log.time)))
    signals = process(log, plant.joint_names, CUTOFF)
    whole = np.ones(len(signals.decimated_time()), dtype=bool)
    return choose_friction(guessed(plant), torques, [signals], whole)


def test_coulomb_and_viscous_friction_are_enough_where_there_is_nothing_else(plant):
    model, choice = chosen(plant)
    assert model.name == "coulomb-viscous"
    assert set(choice.rmse) == set(PRESETS)
    assert choice.rmse["none"] > 3.0 * choice.rmse["coulomb-viscous"]


@pytest.mark.parametrize(
    ("term", "more"),
    [
        ("offset", lambda motion: np.full(motion.q.shape, 0.2)),
        ("armature", lambda motion: 0.1 * motion.qdd),
        ("sqrt", lambda motion: 0.5 * np.sign(motion.qd) * np.sqrt(np.abs(motion.qd))),
    ],
)
def test_a_term_that_is_there_is_chosen(plant, term, more):
    model, choice = chosen(plant, more)
    assert term in model.terms
    assert model.name in choice.note


def test_the_choice_is_made_for_the_last_joint_alone_too(plant):
    model, _ = chosen(plant, lambda m: 0.5 * np.sign(m.qd) * np.sqrt(np.abs(m.qd)), "terminal")
    assert "sqrt" in model.terms


def test_rows_outside_the_fitted_part_do_not_decide(plant):
    log = log_of(plant, noise_torque=0.02)
    spoiled = np.where(np.arange(len(log))[:, None] > 0.7 * len(log), 1e3, log.tau)
    signals = process(replace(log, tau=spoiled), plant.joint_names, CUTOFF)
    rows = len(signals.decimated_time())
    model, _ = choose_friction(
        guessed(plant), "chain", [signals], np.arange(rows) < int(0.6 * rows)
    )
    assert model == friction_model("coulomb-viscous")

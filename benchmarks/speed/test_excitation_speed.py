"""Time of the parts of an excitation search; never a pass or fail."""

from __future__ import annotations

from functools import cache

import pytest

from rigs.files.places import GUESS
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.expected.recording import prior_knowledge
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.motion.limit_check import check_limits
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.search import (
    Design,
    draw_trajectory,
    first_candidate,
    improve,
    penalised_objective,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.trajectory import TrajectoryOptions


def draw_twenty(design):
    """Return twenty random trajectories."""
    return [draw_trajectory(design, 0, number) for number in range(20)]


@cache
def kinova():
    """Return the design of the Kinova example and its best of 20 random trajectories."""
    problem = build_problem(load_robot_model(GUESS), LimitOptions())
    knowledge = prior_knowledge(problem, EstimationOptions(), "link")
    design = Design(problem, ExcitationOptions(), TrajectoryOptions(), knowledge)
    return design, min(draw_twenty(design), key=lambda d: d.score).x


@pytest.mark.benchmark(group="excitation")
def test_twenty_random_trajectories(benchmark):
    benchmark(draw_twenty, kinova()[0])


@pytest.mark.benchmark(group="excitation")
def test_objective_with_gradient(benchmark):
    design, x = kinova()
    benchmark(penalised_objective, design, first_candidate(design, x), x)


@pytest.mark.benchmark(group="excitation")
def test_criterion_alone(benchmark):
    design, x = kinova()
    benchmark(design.criterion_of, x)


@pytest.mark.benchmark(group="excitation")
def test_one_round(benchmark):
    design, x = kinova()
    benchmark.pedantic(improve, (design, first_candidate(design, x)), rounds=3)


@pytest.mark.benchmark(group="excitation")
def test_dense_check(benchmark):
    design, x = kinova()
    benchmark(check_limits, design.problem, design.trajectory(x))

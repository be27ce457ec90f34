"""Identifying a model from its own simulation: the tool at work, in constant memory."""

from __future__ import annotations

import math
from collections.abc import Callable

from robot_sysid.core.answer import traced
from robot_sysid.core.dataset import equations_at
from robot_sysid.core.result import about
from robot_sysid.core.verdict import of_own_simulation
from robot_sysid.dynamics.equations import (
    N_INERTIAL,
    NO_FRICTION,
    TERMINAL_FRICTION,
    Equations,
    friction_per_joint,
)
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.records import DataOrigin, Estimate, MotionPlan, RobotModel, Source
from robot_sysid.records.data import Traces
from robot_sysid.records.progress import Progress
from robot_sysid.results.record import LINK, JointEstimate, Result
from robot_sysid.simulator import collect_sysid_data, simulate_inverse
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count, spread_motion

_DRAWN = 2000
ITSELF = (
    "this run simulates the model itself, so it can only return the model's own values; give "
    "--measurements LOG.csv for a log of the real arm, or --plant-model for another model of it"
)


def identify_itself(
    robot: RobotModel,
    plan: MotionPlan,
    rate: float,
    seed: int,
    options: EstimationOptions,
    progress: Progress,
) -> tuple[Result, Callable[[], Traces]]:
    """Simulate the model along a trajectory and identify it.

    Args:
        rate: samples per second [Hz].
        seed: the trajectory was drawn with it.

    Returns:
        (the result, what makes its traces).
    """
    progress.stage("Running MuJoCo simulation...")
    model = NO_FRICTION if options.no_friction else TERMINAL_FRICTION
    equations = Equations(robot, options.torques, friction_per_joint(robot, "terminal", model))
    simulated = simulate_inverse(robot, motion_chunks(plan, rate))
    count = math.ceil(sample_count(plan.duration, rate) / CHUNK)
    tracked = progress.track(simulated, "Collecting regressor data", count)
    information = collect_sysid_data(equations, tracked)
    progress.stage("Solving for parameters...")
    estimate = identify_parameters(information, equations.prior, options.method or "ols", options)
    progress.note(ITSELF)
    own = zip(equations.names[N_INERTIAL:], equations.prior[N_INERTIAL:].tolist())
    before = {name.partition("[")[0]: value for name, value in own}
    result = Result(
        **about(robot),
        question=LINK,
        estimate=estimate,
        verdict=of_own_simulation(estimate),
        torques=options.torques,
        data=DataOrigin(Source.ITSELF, "", plan.duration, rate, seed),
        joints={robot.terminal_joint: JointEstimate(model.name, {}, before)},
        notes=robot.notes,
    )
    return result, lambda: _traces(robot, equations, plan, estimate)


def _traces(
    robot: RobotModel, equations: Equations, plan: MotionPlan, estimate: Estimate
) -> Traces:
    """Return what a report draws of the simulation, at some of its samples."""
    motion = spread_motion(plan, _DRAWN)
    (measurement,) = simulate_inverse(robot, [motion])
    samples = equations_at(equations, measurement)
    after, before = (dict(zip(equations.names, v)) for v in (estimate.values, equations.prior))
    return traced(robot, [samples], [motion], after, before)

"""The self-test: simulate the model itself, and identify it from that simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from robot_sysid.dynamics.equations import (
    N_INERTIAL,
    NO_FRICTION,
    TERMINAL_FRICTION,
    Equations,
    friction_per_joint,
)
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import DataOrigin, Estimate, MotionPlan, RobotModel, Source
from robot_sysid.records.data import Traces
from robot_sysid.records.progress import Progress
from robot_sysid.results.record import LINK, JointEstimate, Result, Verdict
from robot_sysid.simulator import collect_sysid_data, simulate_inverse
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count, spread_motion

# Samples of a simulation in a report.
_DRAWN = 2000


# Standard error of a mass that is always small enough [kg].
_KNOWN_MASS = 1e-6


def identify_itself(
    robot: RobotModel,
    plan: MotionPlan,
    rate: float,
    seed: int,
    options: EstimationOptions,
    progress: Progress,
) -> tuple[Result, Callable[[], Traces]]:
    """Simulate the model at a rate [Hz] along a trajectory that was drawn with a seed; identify it.

    Returns:
        (the result, a function that computes its traces).
    """
    progress.stage("Running MuJoCo simulation...")
    model = NO_FRICTION if options.no_friction else TERMINAL_FRICTION
    equations = Equations(
        robot, options.torques, friction_per_joint(robot, "terminal", model)
    )
    simulated = simulate_inverse(robot, motion_chunks(plan, rate))
    count = math.ceil(sample_count(plan.duration, rate) / CHUNK)
    tracked = progress.track(simulated, "Collecting regressor data", count)
    information = collect_sysid_data(equations, tracked)
    progress.stage("Solving for parameters...")
    estimate = identify_parameters(information, equations.prior, possible=True)
    values = zip(equations.names[N_INERTIAL:], equations.prior[N_INERTIAL:].tolist())
    friction = {name.partition("[")[0]: value for name, value in values}
    result = Result(
        robot=robot,
        question=LINK,
        estimate=estimate,
        verdict=of_own_simulation(estimate),
        torques=options.torques,
        data=DataOrigin(Source.ITSELF, "", plan.duration, rate, seed),
        joints={robot.terminal_joint: JointEstimate(model.name, {}, friction)},
        notes=robot.notes,
    )

    return result, partial(
        _traces_of_itself, robot, plan, options.torques, model, estimate
    )


def _traces_of_itself(
    robot: RobotModel,
    plan: MotionPlan,
    torques: str,
    model: FrictionModel,
    estimate: Estimate,
) -> Traces:
    """Return the traces for a report, from records alone: MuJoCo's data is not safely pickled."""
    from robot_sysid.estimation.build_result import make_traces
    from robot_sysid.estimation.dataset import equations_at

    equations = Equations(robot, torques, friction_per_joint(robot, "terminal", model))
    motion = spread_motion(plan, _DRAWN)
    (measurement,) = simulate_inverse(robot, [motion])
    samples = equations_at(equations, measurement)
    values, prior = (
        dict(zip(equations.names, v)) for v in (estimate.values, equations.prior)
    )
    return make_traces(robot, [samples], [motion], values, prior)


def of_own_simulation(estimate: Estimate) -> Verdict:
    """Return the verdict on the identification of a model's own simulation."""
    errors = estimate.standard_errors
    weak = np.inf if errors is None else errors[0]
    if np.isfinite(weak) and weak > max(_KNOWN_MASS, 0.5 * estimate.inertial.mass):
        return Verdict.TOO_WEAK
    identifiability = estimate.identifiability
    is_full = identifiability.rank >= identifiability.n_parameters
    return Verdict.OK if is_full else Verdict.PARTLY_FROM_MODEL

"""The self-test: simulate the model itself, and identify it from that simulation."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from robot_sysid.dynamics.equations import (
    NO_FRICTION,
    TERMINAL_FRICTION,
    Equations,
    friction_per_joint,
)
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.pipeline.outcome import Identification
from robot_sysid.records import DataOrigin, Estimate, MotionPlan, RobotModel, Source
from robot_sysid.records.data import Traces
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import LINK, JointEstimate, Result, Verdict
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.simulator import collect_sysid_data, simulate_inverse
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count, spread_motion

_DRAWN_SAMPLES = 2000
"""Samples of the simulation that a report draws."""
_NEGLIGIBLE_MASS_ERROR = 1e-6
"""Standard error of a mass that is small enough whatever the mass is [kg]."""


def run_self_test(
    robot: RobotModel,
    plan: MotionPlan,
    rate: float,
    seed: int,
    options: EstimationOptions,
    progress: Progress,
) -> Identification:
    """Simulate the model along a trajectory and identify its terminal link, in constant memory.

    Args:
        rate: of the simulated samples [Hz].
        seed: that the trajectory was drawn with, for the record.
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
    friction = {}
    for index in range(N_INERTIAL, len(equations.names)):
        term = equations.names[index].partition("[")[0]
        friction[term] = float(equations.prior[index])
    result = Result(
        robot=robot,
        question=LINK,
        estimate=estimate,
        verdict=self_test_verdict(estimate),
        torques=options.torques,
        data=DataOrigin(Source.ITSELF, "", plan.duration, rate, seed),
        joints={robot.terminal_joint: JointEstimate(model.name, {}, friction)},
        notes=robot.notes,
    )

    checkpoints = plan.evaluate(np.linspace(0.0, plan.duration, CHECKPOINTS))
    traces = partial(_traces, robot, plan, options.torques, model, estimate)
    return Identification(result, checkpoints, traces)


def _traces(
    robot: RobotModel,
    plan: MotionPlan,
    torques: str,
    model: FrictionModel,
    estimate: Estimate,
) -> Traces:
    """Return measured and predicted torques for a report.

    It simulates anew from records: MuJoCo's own data cannot be kept safely until then.
    """
    from robot_sysid.estimation.build_result import make_traces
    from robot_sysid.estimation.dataset import equations_at

    equations = Equations(robot, torques, friction_per_joint(robot, "terminal", model))
    motion = spread_motion(plan, _DRAWN_SAMPLES)
    (measurement,) = simulate_inverse(robot, [motion])
    samples = equations_at(equations, measurement)
    values = dict(zip(equations.names, estimate.values))
    prior = dict(zip(equations.names, equations.prior))
    return make_traces(robot, [samples], [motion], values, prior)


def self_test_verdict(estimate: Estimate) -> Verdict:
    """Return the verdict on the identification of a model from its own simulation."""
    errors = estimate.standard_errors
    mass_error = np.inf if errors is None else errors[0]
    largest = max(_NEGLIGIBLE_MASS_ERROR, 0.5 * estimate.inertial.mass)
    if np.isfinite(mass_error) and mass_error > largest:
        return Verdict.TOO_WEAK
    identifiability = estimate.identifiability
    if identifiability.rank < identifiability.n_parameters:
        return Verdict.PARTLY_FROM_MODEL
    return Verdict.OK

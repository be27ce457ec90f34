"""Identifying a model from its own simulation: what every identification starts from."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid import __version__
from robot_sysid.config import SysidConfig
from robot_sysid.dynamics.equations import Equations, friction_of_terminal_joint
from robot_sysid.dynamics.kinematics import MUJOCO_VERSION
from robot_sysid.records import (
    Estimate,
    Identification,
    Measurement,
    Motion,
    MotionPlan,
    RobotModel,
)
from robot_sysid.records.progress import Progress
from robot_sysid.simulator import collect_sysid_data, simulate_inverse
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count

CHECKPOINTS = 400
"""On how many samples of the motion a written model is compared with the prediction."""
ITSELF = (
    "this run simulates the model itself, so it can only return the model's own values; give "
    "--measurements LOG.csv for a log of the real arm, or --plant-model for another model of it"
)


@dataclass(frozen=True)
class Analysis:
    """What a source of data led to.

    Attributes:
        identification: the result.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
    """

    identification: Identification
    checkpoints: Motion


def analyse_itself(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan, seed: int, progress: Progress
) -> Analysis:
    """Simulate the model along the trajectory and identify it, in constant memory."""
    progress.stage("Running MuJoCo simulation...")
    equations = Equations(robot, config.torques, friction_of_terminal_joint(robot, config.friction))
    measurements = _own_simulation(config, robot, plan)
    count = math.ceil(sample_count(plan.duration, config.sample_rate) / CHUNK)
    tracked = progress.track(measurements, "Collecting regressor data", count)
    information = collect_sysid_data(equations, tracked)
    progress.stage("Solving for parameters...")
    estimate = identify_parameters(
        information, equations.prior, config.estimation_method, config.estimator
    )
    if config.save_measurements is not None:
        from robot_sysid.logs.reader import write_measurement_csv

        again = _own_simulation(config, robot, plan)
        write_measurement_csv(config.save_measurements, robot.joint_names, again)
    progress.note(ITSELF)
    found = describe(config, robot, estimate, plan.duration, config.sample_rate)
    checkpoints = plan.evaluate(np.linspace(0.0, plan.duration, CHECKPOINTS))
    return Analysis(replace(found, seed=seed), checkpoints)


def _own_simulation(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan
) -> Iterator[Measurement]:
    return simulate_inverse(robot, motion_chunks(plan, config.sample_rate))


def describe(
    config: SysidConfig, robot: RobotModel, estimate: Estimate, duration: float, rate: float
) -> Identification:
    """Return the estimate together with where it comes from."""
    return Identification(
        model_path=config.model,
        model_sha256=robot.sha256,
        joint_name=robot.terminal_joint,
        body_name=robot.body_name,
        joint_names=robot.joint_names,
        is_slide=bool(robot.is_slide[-1]),
        prior=robot.prior,
        estimate=estimate,
        torques=config.torques,
        friction=config.friction,
        seed=None,
        duration=duration,
        sample_rate=rate,
        versions=versions(),
        notes=robot.notes,
    )


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        "robot_sysid": __version__,
        "mujoco": MUJOCO_VERSION,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }

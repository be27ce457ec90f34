"""Identifying a model from its own simulation, and what every identification says of itself."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from robot_sysid import __version__
from robot_sysid.dynamics.equations import (
    NO_FRICTION,
    TERMINAL_FRICTION,
    Equations,
    friction_per_joint,
)
from robot_sysid.dynamics.kinematics import MUJOCO_VERSION
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.identify.traces import traced
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.output.model_writing import ModelTarget
from robot_sysid.records import (
    DataOrigin,
    Estimate,
    Identification,
    Measurement,
    Motion,
    MotionPlan,
    RobotModel,
    Source,
)
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import RolloutTest
from robot_sysid.records.traces import Traces
from robot_sysid.simulator import collect_sysid_data, simulate_inverse
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count, spread_motion

CHECKPOINTS = 400
"""On how many samples of the motion a written model is compared with the prediction."""
_DRAWN = 2000
ITSELF = (
    "this run simulates the model itself, so it can only return the model's own values; give "
    "--measurements LOG.csv for a log of the real arm, or --plant-model for another model of it"
)


class RolloutSource(Protocol):
    """What can play the model before and the one that is to be written."""

    def test(
        self,
        found: Identification,
        checkpoints: Motion,
        write: Callable[[Identification, ModelTarget], object],
        mesh_dir: Path | None,
    ) -> RolloutTest:
        """Return how they move beside the arm."""


@dataclass(frozen=True)
class Analysis:
    """What a source of data led to.

    Attributes:
        identification: the result.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: makes what a report draws.
        rollouts: plays the model before and after beside a log; None where there is no log.
    """

    identification: Identification
    checkpoints: Motion
    traces: Callable[[], Traces]
    rollouts: RolloutSource | None = None


@dataclass(frozen=True)
class SimulatedRun:
    """A motion that a simulation follows.

    Attributes:
        plan: the trajectory.
        sample_rate: samples per second [Hz].
        seed: of the trajectory and of simulated noise.
        save: file for the measurements, or None.
    """

    plan: MotionPlan
    sample_rate: float
    seed: int
    save: Path | None = None

    @property
    def n_chunks(self) -> int:
        """Number of chunks its samples come in."""
        return math.ceil(sample_count(self.plan.duration, self.sample_rate) / CHUNK)

    def origin(self, source: Source, detail: str = "") -> DataOrigin:
        """Return where its data comes from."""
        return DataOrigin(source, detail, self.plan.duration, self.sample_rate, self.seed)


def identify_itself(
    robot: RobotModel, run: SimulatedRun, options: EstimationOptions, progress: Progress
) -> Analysis:
    """Simulate the model along the trajectory and identify it, in constant memory."""
    progress.stage("Running MuJoCo simulation...")
    model = NO_FRICTION if options.no_friction else TERMINAL_FRICTION
    friction = friction_per_joint(robot, "terminal", model)
    equations = Equations(robot, options.torques, friction)
    tracked = progress.track(_simulated(robot, run), "Collecting regressor data", run.n_chunks)
    information = collect_sysid_data(equations, tracked)
    progress.stage("Solving for parameters...")
    method = options.method or "ols"
    estimate = identify_parameters(information, equations.prior, method, options)
    if run.save is not None:
        from robot_sysid.logs.reader import write_measurement_csv

        write_measurement_csv(run.save, robot.joint_names, _simulated(robot, run))
    progress.note(ITSELF)
    found = describe(robot, estimate, options.torques, run.origin(Source.ITSELF))
    checkpoints = run.plan.evaluate(np.linspace(0.0, run.plan.duration, CHECKPOINTS))
    return Analysis(found, checkpoints, lambda: _traces(robot, equations, run, estimate))


def _traces(
    robot: RobotModel, equations: Equations, run: SimulatedRun, estimate: Estimate
) -> Traces:
    """Return what a report draws of the simulation, at some of its samples."""
    motion = spread_motion(run.plan, _DRAWN)
    (measurement,) = simulate_inverse(robot, [motion])
    rows = tuple(equations.rows(measurement))
    samples = DecimatedSamples(
        equations.names,
        equations.joints,
        equations.columns,
        motion.time,
        tuple((block,) for block, _ in rows),
        tuple(tau for _, tau in rows),
        tuple(measurement.tau[:, joint] for joint in equations.rows_of),
    )
    after, before = (dict(zip(equations.names, v)) for v in (estimate.values, equations.prior))
    return traced(robot, [samples], [motion], after, before)


def _simulated(robot: RobotModel, run: SimulatedRun) -> Iterator[Measurement]:
    return simulate_inverse(robot, motion_chunks(run.plan, run.sample_rate))


def describe(
    robot: RobotModel,
    estimate: Estimate,
    torques: str,
    data: DataOrigin,
    notes: tuple[str, ...] = (),
    **measured: Any,
) -> Identification:
    """Return the estimate together with where it comes from.

    Args:
        robot: the arm.
        estimate: the result.
        torques: "chain" or "terminal".
        data: where the torques came from.
        notes: one sentence each, beside those about the model.
        measured: further fields of ``Identification`` that only measured data has.
    """
    return Identification(
        model_path=robot.path,
        model_sha256=robot.sha256,
        joint_name=robot.terminal_joint,
        body_name=robot.body_name,
        joint_names=robot.joint_names,
        slides=robot.slides,
        bodies=subtree_bodies(robot.mj_model, robot.reference_qpos, robot.body_id),
        model_friction=robot.friction,
        prior=robot.prior,
        estimate=estimate,
        torques=torques,
        data=data,
        versions=versions(),
        notes=robot.notes + notes,
        **measured,
    )


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        "robot_sysid": __version__,
        "mujoco": MUJOCO_VERSION,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }

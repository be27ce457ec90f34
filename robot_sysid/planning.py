"""Which trajectory the arm moves along: random, designed, or one from a file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.config import SysidConfig
from robot_sysid.model.contacts import CHECK_RATE_HZ, find_new_contacts
from robot_sysid.records import Motion, MotionPlan, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.simulator import inverse_torque
from robot_sysid.trajectory import (
    CHUNK,
    generate_excitation_trajectory,
    motion_chunks,
    sample_count,
)

if TYPE_CHECKING:
    from robot_sysid.excitation.limit_check import Certificate
    from robot_sysid.excitation.search import SearchState

PLAN_NAME = "trajectory.json"


@dataclass(frozen=True)
class PlanReport:
    """What a trajectory promises and whether it may be run.

    Attributes:
        lines: what the command line prints.
        certificate: the check of all limits.
    """

    lines: tuple[str, ...]
    certificate: Certificate


def make_plan(config: SysidConfig, robot: RobotModel, seed: int, progress: Progress) -> MotionPlan:
    """Return the trajectory of a run, and tell what the user should know about it."""
    if config.trajectory is not None:
        progress.stage(f"Loading excitation trajectory from {config.trajectory}...")
        plan = _loaded(config.trajectory, robot)
    elif config.excitation == "optimal":
        _announce(config, seed, progress, "Designing")
        plan = _designed(config, robot, seed, progress)
    else:
        _announce(config, seed, progress, "Generating")
        plan = _random(config, robot, seed, progress)
    if config.speed != 1.0:
        from robot_sysid.excitation.trajectory_files import at_speed

        plan = at_speed(plan, config.speed)
    if config.excitation == "sines" and not config.plan_only:
        _warn_of_contacts(robot, plan, progress)
    _save(config, robot, plan)
    return plan


def _announce(config: SysidConfig, seed: int, progress: Progress, what: str) -> None:
    rate = f"{config.sample_rate:g} Hz"
    progress.stage(f"{what} excitation trajectory ({config.duration:.1f}s, {rate})...")
    if config.seed is None:
        progress.stage(f"Random seed: {seed} (--seed {seed} repeats this run)")


def _loaded(path: Path, robot: RobotModel) -> MotionPlan:
    from robot_sysid.excitation.trajectory_files import load_trajectory

    saved = load_trajectory(path)
    saved.require_fits(robot.joint_names)
    return saved.plan


def _random(config: SysidConfig, robot: RobotModel, seed: int, progress: Progress) -> MotionPlan:
    rng = np.random.default_rng(seed)
    # Ends on a sample, so that the last one is at rest.
    duration = (sample_count(config.duration, config.sample_rate) - 1) / config.sample_rate
    plan, notes = generate_excitation_trajectory(robot, rng, duration, inverse_torque(robot))
    for note in notes:
        progress.note(note)
    return plan


def _designed(config: SysidConfig, robot: RobotModel, seed: int, progress: Progress) -> MotionPlan:
    from robot_sysid.excitation.problem import build_problem
    from robot_sysid.excitation.search import design_excitation

    problem = build_problem(robot, config.design)

    def tell(state: SearchState) -> None:
        text = f"{state.best} {state.objective:.3g}"
        progress.advance("Designing the trajectory", state.done, state.total, text)

    result = design_excitation(problem, config.design, np.random.default_rng(seed), tell)
    for note in result.notes:
        progress.note(note)
    gain = result.start_objective / result.objective
    progress.detail(
        f"Criterion {result.criterion}: {result.objective:.4g}, {gain:.2f} times better than the "
        f"best of {result.n_feasible} feasible random trajectories"
    )
    return result.trajectory


def _warn_of_contacts(robot: RobotModel, plan: MotionPlan, progress: Progress) -> None:
    motions = _counted(plan, progress)
    for contact in find_new_contacts(robot, motions):
        progress.note(f"{contact} along this trajectory; do not play it on the arm")


def _counted(plan: MotionPlan, progress: Progress) -> Iterator[Motion]:
    """Yield the motion that is checked for contacts, and tell how far it is."""
    total = math.ceil(sample_count(plan.duration, CHECK_RATE_HZ) / CHUNK)
    for done, motion in enumerate(motion_chunks(plan, CHECK_RATE_HZ), start=1):
        yield motion
        progress.advance("Looking for contacts", done, total, "")


def plan_files(config: SysidConfig) -> tuple[Path, ...]:
    """Return where a run writes its trajectory: coefficients and samples, or nothing."""
    path = config.save_trajectory
    if path is None and config.plan_only:
        path = config.output_dir / PLAN_NAME
    return () if path is None else (path, path.with_suffix(".csv"))


def _save(config: SysidConfig, robot: RobotModel, plan: MotionPlan) -> None:
    for path in plan_files(config)[:1]:
        from robot_sysid.excitation.trajectory_files import save_samples, save_trajectory

        save_trajectory(path, plan, robot.joint_names)
        save_samples(path.with_suffix(".csv"), plan, robot.joint_names, config.sample_rate)


def report_plan(config: SysidConfig, robot: RobotModel, plan: MotionPlan) -> PlanReport:
    """Check a trajectory against all limits and predict what it will tell."""
    from robot_sysid.excitation.prediction import predict, prediction_lines
    from robot_sysid.excitation.problem import build_problem

    problem = build_problem(robot, config.design)
    prediction = predict(problem, plan, config.sample_rate)
    lines = tuple(prediction_lines(prediction, problem.sigma))
    return PlanReport(lines, prediction.certificate)

"""Trajectory files: coefficients as JSON, and the tables that motors play."""

from __future__ import annotations

import functools
import io
import json
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.trust.fuzz.harness import Case, write_case
from benchmarks.trust.fuzz.mutations import damaged_json, damaged_table
from rigs.arms import small_arms
from robot_sysid.config import PlanConfig
from robot_sysid.damiao.checks.preflight import plan_checks
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.settings import Plan
from robot_sysid.damiao.trajectory import (
    export_damiao_trajectory,
    read_damiao_trajectory,
)
from robot_sysid.motion import ExcitationOptions
from robot_sysid.motion.trajectories import at_speed, load_trajectory, save_trajectory
from robot_sysid.pipeline.motions import design_motion
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import TrajectoryOptions, require_countable
from robot_sysid.trajectory import SineTrajectory, motion_chunks

RATE = 50.0
TABLE_SHARE = 0.4
ENOUGH_CHUNKS = 20
LONGEST = 60.0


@functools.cache
def _robot() -> Any:
    """Return an arm of two joints."""
    return small_arms.robot_of(small_arms.serial_arm((small_arms.Z, small_arms.Y)))


@functools.cache
def _texts() -> tuple[Any, ...]:
    """Return every kind of trajectory as JSON."""
    two = np.ones((2, 2))
    sines = SineTrajectory(np.zeros(2), 0.1 * two, two, two, 1.0, 0.25)
    return tuple(_describe(plan) for plan in (sines, at_speed(sines, 0.5)))


def _describe(plan: Any) -> Any:
    """Return a trajectory as the content of its JSON file."""
    file = io.StringIO()
    save_trajectory(file, plan, _robot().joint_names)
    return json.loads(file.getvalue())


@functools.cache
def _table() -> str:
    """Return a trajectory file of two motors."""
    file = io.StringIO()
    chunks = motion_chunks(
        SineTrajectory(*np.zeros((1, 2)), *0.1 * np.ones((3, 2, 1)), 1.0, 0.25), 20.0
    )
    motion = ((m.time, m.q, m.qd, 0.0 * m.q) for m in chunks)
    export_damiao_trajectory(motion, damiao_joints(["DM4340", "DM4310"], 2), file)
    return file.getvalue()


def case(random: Random) -> Case:
    """Return one trajectory file."""
    if random.random() < TABLE_SHARE:
        return {"motors.csv": damaged_table(random, _table())}
    return {"motion.json": damaged_json(random, random.choice(_texts()))}


def use(case: Case, folder: Path) -> None:
    """Read it, and check it against an arm as a run does."""
    input_folder = write_case(case, folder)
    if "motors.csv" in case:
        list(plan_checks(Plan(read_damiao_trajectory(input_folder / "motors.csv"))))
        return
    path = input_folder / "motion.json"
    saved = load_trajectory(path)
    require_countable(saved.plan.duration, RATE)
    for _ in zip(range(ENOUGH_CHUNKS), motion_chunks(saved.plan, RATE)):
        pass
    if len(case["motion.json"]) % 8:
        return  # the check takes ten times as long as all the rest
    faster = max(
        1.0, saved.plan.duration / LONGEST
    )  # a day's motion is checked for minutes
    options = TrajectoryOptions(sample_rate=RATE, file=path, speed=faster)
    settings = PlanConfig(
        trajectory=options, excitation=ExcitationOptions(kind="sines")
    )
    plan = design_motion(settings, _robot(), Progress())
    for _, motion in zip(range(ENOUGH_CHUNKS), motion_chunks(plan.plan, RATE)):
        assert np.all(np.isfinite(motion.q)) or plan.failure

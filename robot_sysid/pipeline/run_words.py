"""The words of a run's command line that its next step repeats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.config import Config, PayloadConfig, SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.trajectories import load_trajectory
from robot_sysid.pipeline import Identification
from robot_sysid.records import Motion
from robot_sysid.records.file_access import (
    MODEL_NAMES,
    PLAN_NAME,
    RUN_NAME,
    plan_settings,
    read_toml,
)
from robot_sysid.records.option_fields import (
    TrajectoryOptions,
    command_arguments,
    given_arguments,
    immutable_value,
)
from robot_sysid.results.next_steps import WEIGHT_STEM, RunWords, weighing_words
from robot_sysid.results.record import Result
from robot_sysid.results.verdict import UNKNOWN

READING = ("columns", "units", "torque_scale", "torque_constants", "topic")
"""Keys of the options that hold for every log of the same arm."""
_SAME_RANGE = 0.05
"""Difference between the range of a recorded and a planned motion, over the range, up to which both
count as the same motion: more than a controller lags behind."""
_COMPARED_TIMES = 2000
"""Number of moments at which a planned motion is compared with a recorded one."""


def words_of_run(config: Config, identification: Identification) -> RunWords:
    """Return what the next step repeats of an identification.

    Args:
        config: options of the run.
        identification: its result, whose recorded motion may be a planned one.
    """
    result = identification.result
    reading = list(READING)
    scales = config.log.torque_scale
    recordings = config.log.measurements
    empty: tuple[Path, ...] = ()
    if isinstance(config, PayloadConfig):
        empty = _files(config.payload.empty)
        recordings = config.payload.loaded
        if config.payload.known_mass is not None:
            scales = config.payload.save_torque_scale
            # The scales that the run began with are in those that it writes.
            reading.remove("torque_scale")
    plan = None
    purpose = None
    joint_names = result.robot.joint_names
    folders = [file.parent for file in _files(recordings)[:1]]
    for folder in (*folders, config.output.output_dir):
        if _is_planned(folder, joint_names, identification.checkpoints):
            plan, planned = plan_settings(folder) or (None, {})
            purpose = str(planned.get("for_", "link"))
            break
    is_out_of_reach = purpose is None and is_mass_out_of_reach(config, result)
    return RunWords(
        model=str(config.model.path),
        arm=tuple(given_arguments(config.model)),
        log=tuple(given_arguments(config.log, reading)),
        folder=config.output.output_dir,
        links=config.output.links,
        empty=tuple(map(str, empty)),
        scales=None if scales is None else str(scales),
        plan=plan,
        plan_purpose=purpose,
        is_out_of_reach=is_out_of_reach,
        is_static=isinstance(config, PayloadConfig) and config.payload.static,
    )


def is_mass_out_of_reach(config: Config, result: Result) -> bool:
    """Return whether a log leaves the terminal link's mass unknown and so would any other motion,
    because the links before it are not known well enough.
    """
    share = result.relative_mass_error
    is_unknown = share is None or share >= UNKNOWN
    if result.payload is not None or not result.is_measured or not is_unknown:
        return False
    # Only a run that asks takes the time to look at random motions.
    from robot_sysid.motion.expected_errors import RecordingPlan
    from robot_sysid.motion.improvements import least_errors
    from robot_sysid.motion.problem import build_problem

    options = config.estimation
    try:
        problem = build_problem(result.robot, LimitOptions(), options.torques)
        target = "arm" if config.output.links else "link"
        recording = RecordingPlan(TrajectoryOptions.sample_rate, options, target)
        mass_error, _ = least_errors(problem, recording)
    except InputError:  # No motion can be planned, which ``plan`` explains.
        return False
    mass = max(float(result.body.inertial.theta[0]), 0.0)
    return bool(mass_error > UNKNOWN * mass)


def words_of_plan(config: SysidConfig) -> RunWords:
    """Return what the next step repeats of a plan.

    A model that an identification has written is followed by logs in the form of those it was
    identified from, so that their options are taken from the file that repeats that run.
    """
    assert config.plan_file is not None
    model = config.model.path
    settings: Mapping[str, Any] = {}
    if model.name in MODEL_NAMES.values():
        settings = _read_settings(model.parent / RUN_NAME)
    log_values = {key: settings[key] for key in READING if key in settings}
    return RunWords(
        model=str(model),
        arm=tuple(given_arguments(config.model)),
        log=tuple(command_arguments(log_values, LogOptions)),
        folder=config.plan_file.parent,
        origin=_origin_of(settings),
        is_static=config.poses.static,
    )


def _origin_of(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return model and logs of an identification by its settings; () where a file is not there."""
    logs = settings.get("measurements", ())
    files = (str(settings.get("path", "")), *map(str, logs))
    return files if logs and all(Path(file).exists() for file in files) else ()


def add_weighing_commands(
    error: InputError,
    model: Path,
    arm: ModelOptions,
    options: LogOptions,
    log: Path,
    is_static: bool = False,
) -> None:
    """Add the command that weighs torque scales to an error whose options are for ``payload``.

    Args:
        error: what stopped the reading of a log; one with options for other commands is left.
        model: model file of the run.
        arm: which arm in the model.
        options: how the log was read.
        log: the log, of the arm without a weight.
        is_static: whether its motion rests at poses.
    """
    if error.command != "payload":
        return
    # The remedy's own options, such as the torque scales, replace those of the run.
    remedy_words = {word for option in error.options for word in option}
    reading = [
        key for key in READING if f"--{key.replace('_', '-')}" not in remedy_words
    ]
    run = RunWords(
        model=str(model),
        arm=tuple(given_arguments(arm)),
        log=tuple(given_arguments(options, reading)),
        empty=(str(log),),
        is_static=is_static,
    )
    # The recording with the weight has the form of the log, and lies beside it.
    recording = log.with_name(f"{WEIGHT_STEM}{log.suffix}")
    error.command_lines = [weighing_words(run, recording, o) for o in error.options]


def _files(logs: Sequence[Any]) -> tuple[Path, ...]:
    """Return those logs that are files; from Python, logs may be arrays in memory."""
    return tuple(log for log in logs if isinstance(log, Path))


def _read_settings(path: Path) -> dict[str, Any]:
    """Return key to value of the options in the file of a run; {} where it cannot be read."""
    try:
        content = read_toml(path) if path.is_file() else {}
    except InputError:
        return {}
    return {key: immutable_value(value) for key, value in content.items()}


def _is_planned(folder: Path, joint_names: tuple[str, ...], recorded: Motion) -> bool:
    """Return whether a recorded motion is the planned one in a folder: the same range per joint.

    False where the folder holds no plan for these joints.
    """
    path = folder / PLAN_NAME
    if not path.is_file():
        return False
    try:
        saved = load_trajectory(path)
    except InputError:
        return False
    if saved.joint_names != joint_names:
        return False
    times = np.linspace(0.0, saved.plan.duration, _COMPARED_TIMES)
    planned = saved.plan.evaluate(times).q
    tolerance = _SAME_RANGE * np.max(np.ptp(planned, axis=0))
    differences = [
        np.max(planned, axis=0) - np.max(recorded.q, axis=0),
        np.min(planned, axis=0) - np.min(recorded.q, axis=0),
    ]
    return bool(np.max(np.abs(differences)) <= tolerance)

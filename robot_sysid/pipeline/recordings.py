"""Identification from recorded motions: logs of a real arm, or another model that plays one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from robot_sysid.config import IdentifyConfig, SelfTestConfig
from robot_sysid.diagnosis.gate import judge, usable
from robot_sysid.estimate.choose import solved
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import predicted
from robot_sysid.estimate.options import FILE_FRICTION, FILE_ROTORS
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import errors_on, fit_file
from robot_sysid.estimate.result import link_result, traces_of
from robot_sysid.estimate.rows import Piece, low_pass_recordings
from robot_sysid.logs.reader import (
    MeasurementLog,
    open_log,
    origin_of,
    refuse_repeated_logs,
)
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records import DataOrigin, MotionPlan, RobotModel
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.results.record import Result
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.signals.resampling import join_measurements, piece_notes, split_at_gaps
from robot_sysid.simulation.plant import load_plant, plant_measurements
from robot_sysid.trajectory import CHUNK, sample_count


def identify_logs(
    config: IdentifyConfig, robot: RobotModel, progress: Progress
) -> Result:
    """Read the logs, diagnose each of them, and identify the arm from all.

    Args:
        config: names the logs, and says how they are read and fitted.
        robot: the arm as in the model.
        progress: receives stages and notes.

    Raises:
        InputError: a log cannot be read or is refused.
    """
    options = config.log
    read = []
    for path in options.measurements:
        progress.stage(f"Reading measurements from {path}...")
        read.append(open_log(robot, path, options, progress))
    if options.validation_measurements is not None:
        path = options.validation_measurements
        read.append(open_log(robot, path, options, progress))
    refuse_repeated_logs(read)
    question = Question(config.estimation)
    n_logs = len(options.measurements)
    logs, tests = read[:n_logs], read[n_logs:]
    progress.stage("Solving for parameters...")
    judged = judge(robot, logs, question, progress)
    fitted, notes = usable(judged, options.accept, progress)
    progress.note(*notes)
    for test in tests:
        of_test = judge(robot, [test], question, Progress())
        _, test_notes = usable(of_test, options.accept, progress)
        # A note keeps its type: a Detail stays one.
        progress.note(*(type(note)(f"validation log: {note}") for note in test_notes))
    origin = origin_of(logs)
    return _result(config, fitted, origin, notes, progress, tests)


def identify_plant(
    config: SelfTestConfig,
    robot: RobotModel,
    plan: MotionPlan,
    seed: int,
    progress: Progress,
) -> Result:
    """Let another model play the real arm along a motion, and identify from its sensors.

    Its samples are written to the file of ``--save-measurements``, if it is given.

    Args:
        config: names the other model, its sensors' noise, and how the samples are fitted.
        robot: the arm as in the model that is to be corrected.
        plan: the motion.
        seed: of the simulated noise, and of the motion, for the record.
        progress: receives stages and notes.
    """
    arm = config.arm
    rate = config.trajectory.sample_rate
    assert arm.plant_model is not None
    plant = load_plant(robot, arm.plant_model, config.model.mesh_dir)
    progress.stage(f"Running MuJoCo simulation of {arm.plant_model}...")
    # The 1 separates the random numbers of noise from those of the motion, drawn by one seed.
    rng = np.random.default_rng([seed, 1])
    simulation = plant_measurements(plant, plan, arm, rate, rng)
    n_chunks = math.ceil(sample_count(plan.duration, rate) / CHUNK)
    chunks = progress.track(simulation, "Collecting measurements", n_chunks)
    run = join_measurements(chunks)
    if arm.save_measurements is not None:
        write_measurement_csv(arm.save_measurements, robot.joint_names, [run])
    name = str(arm.plant_model)
    origin = DataOrigin(f"simulated plant {name}", plan.duration, rate, seed)
    stretches = split_at_gaps(run)
    pieces = [Piece(name, samples) for samples in stretches]
    options = config.estimation
    recordings, filter_notes = low_pass_recordings(robot, pieces, options.cutoff)
    notes = (*plant.notes, *piece_notes(run, stretches), *filter_notes)
    progress.note(*notes)
    progress.stage("Solving for parameters...")
    fitted = solved(robot, recordings, Question(options), progress)
    return _result(config, fitted, origin, notes, progress)


def _result(
    config: IdentifyConfig | SelfTestConfig,
    fitted: Fit,
    origin: DataOrigin,
    notes: Sequence[str],
    progress: Progress,
    tests: Sequence[MeasurementLog] = (),
) -> Result:
    """Return the result of a fit: the model file, its errors, and what is drawn.

    Args:
        config: says what of the model file stays.
        fitted: the fit of all terms.
        origin: where its recordings come from.
        notes: what reading and judging them had to say, one sentence each.
        progress: receives stages.
        tests: logs that only test the result; they get the cut-off of the others.
    """
    options = config.estimation
    robot = fitted.arm.robot
    signals = fitted.recordings[0].signals
    keep = options.keep
    if options.no_friction:
        keep += (FILE_FRICTION, FILE_ROTORS)
    progress.stage(Detail("Fitting the model file..."))
    file = fit_file(fitted, keep)
    errors = []
    of_file = []
    for log in tests:
        name = str(log.path)
        pieces = [Piece(name, samples) for samples in log.pieces]
        others, _ = low_pass_recordings(robot, pieces, signals.cutoff)
        errors.append(predicted(fitted, others, name))
        of_file.append(errors_on(file.fit, others, name))
    result = link_result(fitted, file, errors, origin, notes, of_file)
    checkpoints = signals.motion(
        np.linspace(0, len(signals) - 1, CHECKPOINTS).astype(int)
    )
    traces = partial(traces_of, file.fit)
    return replace(result, checkpoints=checkpoints, traces=traces)

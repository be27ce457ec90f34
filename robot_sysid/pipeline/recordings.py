"""Identification from recorded motions: logs of a real arm, or another model that plays one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from robot_sysid.config import IdentifyConfig, SelfTestConfig
from robot_sysid.diagnosis.log_checks import check_log
from robot_sysid.estimate.held_out import predicted
from robot_sysid.estimate.identify import (
    Piece,
    identify_link,
    low_pass_recordings,
    shared_notes,
)
from robot_sysid.estimate.options import FILE_FRICTION, FILE_ROTORS
from robot_sysid.estimate.restricted_fit import errors_on
from robot_sysid.estimate.result import link_result, traces_of
from robot_sysid.logs.reader import (
    MeasurementLog,
    open_log,
    origin_of,
    refuse_repeated_logs,
)
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records import DataOrigin, MotionPlan, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import Result
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.signals.resampling import join_measurements, piece_notes, split_at_gaps
from robot_sysid.simulation.plant import load_plant, plant_measurements
from robot_sysid.trajectory import CHUNK, sample_count

# Separates the random numbers of simulated noise from those of the motion, drawn by one seed.
_NOISE_STREAM = 1


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
    checked = []
    for log in read:
        log = check_log(robot, log, options.accept, progress, config.estimation)
        checked.append(log)
    n_logs = len(options.measurements)
    logs = checked[:n_logs]
    tests = checked[n_logs:]
    for test in tests:
        # A note keeps its type: a Detail stays one.
        progress.note(*(type(note)(f"validation log: {note}") for note in test.notes))
    origin = origin_of(logs)
    notes = shared_notes({str(log.path): log.notes for log in logs})
    pieces = []
    for log in logs:
        for samples in log.pieces:
            pieces.append(Piece(str(log.path), replace(samples, qd=None)))
    # This frees the recorded velocities before signals are made.
    del read, logs, checked, log, samples
    return _identify_pieces(config, robot, pieces, origin, notes, progress, tests)


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
    rng = np.random.default_rng([seed, _NOISE_STREAM])
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
    notes = (*plant.notes, *piece_notes(run, stretches))
    return _identify_pieces(config, robot, pieces, origin, notes, progress)


def _identify_pieces(
    config: IdentifyConfig | SelfTestConfig,
    robot: RobotModel,
    pieces: list[Piece],
    origin: DataOrigin,
    notes: Iterable[str],
    progress: Progress,
    tests: Sequence[MeasurementLog] = (),
) -> Result:
    """Low-pass recordings and identify an arm from them.

    Args:
        config: says how the recordings are filtered and fitted.
        robot: the arm as in the model.
        pieces: the recordings; the list is emptied, so that the raw samples need no memory any
            more when the estimate begins.
        origin: where the recordings come from.
        notes: what reading them had to say, one sentence each.
        progress: receives stages and notes.
        tests: logs that only test the result; they get the cut-off of the others.
    """
    options = config.estimation
    recordings, filter_notes = low_pass_recordings(robot, pieces, options.cutoff)
    pieces.clear()
    signals = recordings[0].signals
    test_recordings = {}
    for log in tests:
        name = str(log.path)
        test_pieces = [Piece(name, samples) for samples in log.pieces]
        test_recordings[name], _ = low_pass_recordings(
            robot, test_pieces, signals.cutoff
        )
    notes = (*notes, *filter_notes)
    progress.note(*notes)
    keep = options.keep
    if options.no_friction:
        keep += (FILE_FRICTION, FILE_ROTORS)
    fitted, file = identify_link(robot, recordings, options, progress, keep)
    errors = []
    of_file = []
    for name, others in test_recordings.items():
        errors.append(predicted(fitted, others, name))
        of_file.append(errors_on(file, others, name))
    result = link_result(fitted, file, errors, origin, notes, of_file)
    checkpoints = signals.motion(
        np.linspace(0, len(signals) - 1, CHECKPOINTS).astype(int)
    )
    traces = partial(traces_of, fitted, file)
    return replace(result, checkpoints=checkpoints, traces=traces)

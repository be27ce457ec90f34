"""Identification from recorded motions: an arm from its logs, a payload from logs without and with
it, or an arm that another model plays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.config import IdentifyConfig, PayloadConfig, SelfTestConfig
from robot_sysid.errors import InputError
from robot_sysid.estimate.choose import answer_of, solve_question
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import prediction_error
from robot_sysid.estimate.payload import written_payload
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.faults.gate import accepted_doubts, judge, usable_fit
from robot_sysid.logs.reader import open_logs, origin_of, refuse_repeated_logs
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.model.bodies import find_flange
from robot_sysid.records import (
    Array,
    DataOrigin,
    MotionPlan,
    Recording,
    RobotModel,
    join_recordings,
)
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Detail, Progress, Remark
from robot_sysid.records.option_fields import EMPTY, LOADED, SCALE, joint_factors
from robot_sysid.results import verdicts
from robot_sysid.results.identification import link_result, with_other_motions
from robot_sysid.results.payload import payload_result
from robot_sysid.results.record import Identification
from robot_sysid.results.rules import OF_ACCEPTED
from robot_sysid.signals.process import low_pass_recordings
from robot_sysid.signals.resampling import piece_notes, split_at_gaps
from robot_sysid.simulation.plant import load_plant, plant_measurements
from robot_sysid.trajectory import CHUNK, sample_count
from robot_sysid.wording import option_name, option_setting

LEAST_WITHIN = 0.15
"""Least share of the variance of the logs' positions that lies within the empty and within the
loaded ones, for a drift to be told from a payload: the order A A B B has 0.2, A B has none."""


def identify_logs(
    config: IdentifyConfig, robot: RobotModel, progress: Progress
) -> Identification:
    """Read the logs, diagnose each of them, and identify the arm from all.

    Args:
        config: names the logs, and says how they are read and fitted.
        robot: the arm as in the model.
        progress: receives stages and notes.

    Raises:
        InputError: a log cannot be read or is refused.
    """
    options = config.log
    kind = "measurements from"
    logs = open_logs(robot, options.measurements, options, progress, kind)
    tests = open_logs(robot, options.validation_measurements, options, progress)
    refuse_repeated_logs([*logs, *tests])
    question = Question(config.estimation)
    progress.stage(Detail("Solving for parameters..."))
    judged = judge(robot, logs, question, progress)
    fitted, notes = usable_fit(judged, options.accept, progress)
    progress.note(*notes)
    for test in tests:
        of_test = judge(robot, [test], question, Progress())
        _, test_notes = usable_fit(of_test, options.accept, progress)
        # A note keeps its type: a Detail stays one.
        progress.note(*(type(note)(f"validation log: {note}") for note in test_notes))
    origin = origin_of(logs, options.measurements)
    passed = accepted_doubts(judged.findings, options.accept)
    result = _result(fitted, origin, notes, progress, tests)
    return _with_doubts(result, passed)


def _with_doubts(result: Identification, doubts: Sequence[Remark]) -> Identification:
    """Return a result whose verdict counts the doubts that were accepted."""
    remarks = (*result.remarks, *verdicts.judge(OF_ACCEPTED, doubts))
    return replace(result, remarks=remarks)


def identify_plant(
    config: SelfTestConfig, robot: RobotModel, plan: MotionPlan, progress: Progress
) -> Identification:
    """Let another model play the real arm along a motion, and identify from its sensors.

    Its samples are written to the file of ``--save-measurements``, if it is given.

    Args:
        config: names the other model, its sensors' noise, and how the samples are fitted.
        robot: the arm as in the model that is to be corrected.
        plan: the motion.
        progress: receives stages and notes.
    """
    arm = config.arm
    rate = config.trajectory.sample_rate
    seed = config.trajectory.seed or 0
    assert arm.plant_model is not None
    plant = load_plant(robot, arm.plant_model, config.model.mesh_dir)
    progress.stage(f"Running MuJoCo simulation of {arm.plant_model}...")
    # The 1 separates the random numbers of noise from those of the motion, drawn by one seed.
    rng = np.random.default_rng([seed, 1])
    simulation = plant_measurements(plant, plan, arm, rate, rng)
    n_chunks = math.ceil(sample_count(plan.duration, rate) / CHUNK)
    chunks = progress.track(simulation, "Collecting measurements", n_chunks)
    run = replace(join_recordings(chunks), name=str(arm.plant_model))
    if arm.save_measurements is not None:
        write_measurement_csv(arm.save_measurements, robot.joint_names, [run])
    origin = DataOrigin(f"simulated plant {run}", plan.duration, rate, seed)
    pieces = split_at_gaps(run)
    options = config.estimation
    recordings, filter_notes = low_pass_recordings(robot, pieces, options.cutoff)
    notes = (*plant.notes, *piece_notes(run, pieces), *filter_notes)
    progress.note(*notes)
    progress.stage(Detail("Solving for parameters..."))
    fitted = answer_of(solve_question(robot, recordings, Question(options), progress))
    return _result(fitted, origin, notes, progress)


def _result(
    fitted: Fit,
    origin: DataOrigin,
    notes: Sequence[str],
    progress: Progress,
    tests: Sequence[Recording] = (),
) -> Identification:
    """Return the result of a fit: the model file, its errors, and what is drawn.

    Args:
        fitted: the fit of all terms.
        origin: where its recordings come from.
        notes: what reading and judging them had to say, one sentence each.
        progress: receives stages.
        tests: logs that only test the result; they get the lowest cut-off of the others.
    """
    cutoff = min(recording.cutoff for recording in fitted.recordings)
    progress.stage(Detail("Fitting the model file..."))
    file = fit_file(fitted)
    robot = fitted.arm.robot
    others = []
    for log in tests:
        pieces, _ = low_pass_recordings(robot, split_at_gaps(log), cutoff)
        others.append((pieces, log.name))
    errors = [prediction_error(fitted, *other) for other in others]
    result = link_result(fitted, file, errors, origin, notes, others)
    return with_other_motions(result, fitted, file)


def identify_payload(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> Identification:
    """Identify a payload from the logs that a configuration names; no file is written.

    Args:
        config: names the empty and the loaded logs, and how they are read and fitted.
        robot: the arm that carries the payload.
        progress: receives stages and notes.

    Raises:
        InputError: a log cannot be used, or is refused by the checks.
    """
    options = config.payload
    flange = find_flange(robot, options.flange)
    if flange.note:
        progress.note(flange.note)
    empty = open_logs(robot, options.empty, config.log, progress, "empty log")
    loaded = open_logs(robot, options.loaded, config.log, progress, "loaded log")
    logs = [*empty, *loaded]
    origin = origin_of(logs, (*options.empty, *options.loaded))
    refuse_repeated_logs(logs)
    is_loaded = np.arange(len(logs)) >= len(empty)
    letters = EMPTY * len(empty) + LOADED * len(loaded)
    if options.order is not None and sorted(options.order) != sorted(letters):
        raise InputError(
            f"{option_setting('order', options.order)}: needs {len(empty)} times A (the empty "
            f"logs) and {len(loaded)} times B (the loaded ones), such as {letters}"
        )
    positions = order_positions(logs, options.order)
    drifts = positions is not None and is_drift_identifiable(is_loaded, positions)
    # Where the order is not known, a drift may have come with the payload.
    order = np.where(is_loaded, 1.0, -1.0) if positions is None else positions
    question = Question(config.estimation, loaded=True, drifts=drifts)
    progress.stage(Detail("Estimating arm, friction and payload together..."))
    judged = judge(robot, logs, question, progress, is_loaded.tolist(), order.tolist())
    if options.known_mass is not None:
        # What a known mass is weighed for is no reason to refuse the weighing.
        doubts = (f for f in judged.findings if f.about is not FaultName.TORQUE_SCALE)
        judged = replace(judged, findings=tuple(doubts))
    weighed, of_logs = usable_fit(judged, config.log.accept, progress)
    notes = [*of_logs]
    if not drifts:
        reason = "in this order it looks like a payload"
        if positions is None and len(logs) != 2:
            reason = (
                "the order in which they were recorded is not known "
                f"({option_name('order')} tells it)"
            )
        notes.append(
            f"a drift of friction over the {len(logs)} logs is not estimated, nor in the ±: "
            f"{reason}; record in the order empty, loaded, loaded, empty "
            f"({option_setting('order', 'ABBA')})"
        )
    progress.note(*notes)
    fitted, file = weighed, None
    if options.known_mass is not None:
        known = replace(question, known_mass=options.known_mass)
        fitted = answer_of(solve_question(robot, weighed.recordings, known, progress))
    elif config.estimation.torques == "chain":
        progress.stage(Detail("Fitting the model file..."))
        carried, _ = written_payload(weighed)
        file = fit_file(weighed, carried)
    # Scales are those of the log before its torques were divided by known ones.
    divided, _ = joint_factors(config.log.torque_scale, robot.joint_names, SCALE)
    result = payload_result(fitted, weighed, file, flange, origin, notes, divided)
    if file is not None:
        result = with_other_motions(result, fitted, file)
    passed = accepted_doubts(judged.findings, config.log.accept)
    return _with_doubts(result, passed)


def order_positions(logs: Sequence[Recording], order: str | None) -> Array | None:
    """Return each log's position (k,) in the order of recording, from -1 to 1.

    None where the order is not known: without ``order`` and a clock that all logs share.

    Args:
        logs: empty ones first.
        order: a letter of ``--order`` for each log, A for an empty one; or None.
    """
    if order is not None:
        # The k-th A is the k-th empty log, and so for B: a stable sort keeps their order.
        is_loaded = np.array([letter == LOADED for letter in order])
        positions = np.argsort(is_loaded, kind="stable").astype(float)
    else:
        ends = np.array([log.time[[0, -1]] for log in logs])
        spans = ends[np.lexsort(ends.T[::-1])]
        # Logs that overlap in time do not share a clock.
        if np.any(spans[1:, 0] <= spans[:-1, 1]):
            return None
        positions = np.mean(ends, axis=1)
    return 2.0 * (positions - np.min(positions)) / np.ptp(positions) - 1.0


def is_drift_identifiable(is_loaded: NDArray[np.bool_], positions: Array) -> bool:
    """Return whether the order (k,) of empty and loaded recordings separates drift and payload.

    The variance of positions within the empty and within the loaded logs is 0 of the whole for the
    order A B, 0.2 for A A B B at equal distances, 1 for A B B A.
    """
    within = 0.0
    for loaded in (False, True):
        side_positions = positions[is_loaded == loaded]
        within += np.sum((side_positions - np.mean(side_positions)) ** 2)
    total = np.sum((positions - np.mean(positions)) ** 2)
    return bool(within >= LEAST_WITHIN * total > 0.0)

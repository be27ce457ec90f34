"""Identification of a payload from recordings without and with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.config import PayloadConfig
from robot_sysid.diagnosis.gate import judge, usable
from robot_sysid.estimate.choose import solved
from robot_sysid.estimate.payload import payload_result, written_payload
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.estimate.result import traces_of
from robot_sysid.logs.reader import (
    MeasurementLog,
    open_log,
    origin_of,
    refuse_repeated_logs,
)
from robot_sysid.model.bodies import find_flange
from robot_sysid.motion import LOADED
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.records.option_fields import SCALE, joint_factors
from robot_sysid.results.record import Result


def identify_payload(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> Result:
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
    logs = _read_logs(config, robot, progress)
    is_loaded = np.arange(len(logs)) >= len(options.empty)
    positions = order_positions(logs, options.order)
    drifts = positions is not None and is_drift_identifiable(is_loaded, positions)
    # Where the order is not known, a drift may have come with the payload.
    order = np.where(is_loaded, 1.0, -1.0) if positions is None else positions
    question = Question(config.estimation, loaded=True, drifts=drifts)
    progress.stage(Detail("Estimating arm, friction and payload together..."))
    judged = judge(robot, logs, question, progress, is_loaded.tolist(), order.tolist())
    weighed, of_logs = usable(judged, config.log.accept, progress)
    notes = [*of_logs]
    if not drifts:
        reason = "in this order it looks like a payload"
        if positions is None and len(logs) != 2:
            reason = (
                "the order in which they were recorded is not known (--order tells it)"
            )
        notes.append(
            f"a drift of friction over the {len(logs)} logs is not estimated, nor in the ±: "
            f"{reason}; record in the order empty, loaded, loaded, empty (--order ABBA)"
        )
    progress.note(*notes)
    fitted, file = weighed, None
    if options.known_mass is not None:
        known = replace(question, known_mass=options.known_mass)
        fitted = solved(robot, weighed.recordings, known, progress)
    elif config.estimation.torques == "chain":
        progress.stage(Detail("Fitting the model file..."))
        carried, _ = written_payload(weighed)
        file = fit_file(weighed, config.estimation.keep, carried)
    # Scales are those of the log before its torques were divided by known ones.
    divided = np.ones(robot.n_joints)
    if config.log.torque_scale is not None:
        divided, _ = joint_factors(config.log.torque_scale, robot.joint_names, SCALE)
    result = payload_result(
        fitted, weighed, file, flange, origin_of(logs), notes, divided
    )
    checkpoints = fitted.recordings[-1].motion
    traces = partial(traces_of, fitted)
    return replace(result, checkpoints=checkpoints, traces=traces)


def _read_logs(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> list[MeasurementLog]:
    """Return all logs, empty ones first.

    Args:
        config: names the logs, and how they are read and judged.
        robot: the arm.
        progress: receives a stage per log, and the findings.

    Raises:
        InputError: a log cannot be read.
    """
    payload = config.payload
    logs = []
    for side, paths in (("empty", payload.empty), ("loaded", payload.loaded)):
        for path in paths:
            progress.stage(f"Reading {side} log {path}...")
            logs.append(open_log(robot, path, config.log, progress))
    refuse_repeated_logs(logs)
    return logs


def order_positions(logs: Sequence[MeasurementLog], order: str | None) -> Array | None:
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
        ends = np.array([log.samples.time[[0, -1]] for log in logs])
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
    return bool(within >= 0.15 * total > 0.0)

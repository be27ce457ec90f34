"""The fit of measured data: process, choose friction, align, estimate, validate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.estimation.cross_validation import hold_out, validate
from robot_sysid.estimation.options import CHOSEN, EstimationOptions
from robot_sysid.identify.alignment import Aligner, Alignment, Mask
from robot_sysid.identify.friction_selection import choose_friction
from robot_sysid.identify.judgement.signs import compared_with_model
from robot_sysid.identify.samples import DecimatedSamples, JoinedSamples
from robot_sysid.identify.simulated import CHECKPOINTS
from robot_sysid.records import (
    Estimate,
    Measurement,
    Motion,
    NuisanceMisfit,
    RobotModel,
    Validation,
)
from robot_sysid.records.progress import Progress
from robot_sysid.records.traces import Traces
from robot_sysid.signals.process import (
    SLOW_SHARE_FOR_DELAY,
    ProcessedSignals,
    process,
    with_one_cutoff,
)

DELAY_CUTOFF = 10.0
"""Highest cut-off that is chosen where a delay is estimated [Hz]: beyond it the jumps of dry
friction, which no derivative describes, make the search slow or fail."""
MOVING = 0.05
"""Share of its peak speed above which a joint moves."""


@dataclass(frozen=True)
class MeasuredFit:
    """Result of a fit to measured data.

    Attributes:
        estimate: the result.
        friction: the friction model that was used.
        alignment: delay and gravity that were found (or assumed).
        misfits: what the data asks for that the model does not have.
        validation: prediction error on the part that was not fitted, if any.
        cutoff: of the low-pass [Hz].
        torque: joint name to root mean square of its measured torque [N m].
        acceleration_error: expected error of the acceleration, as a part of it.
        checkpoints: some of the measured motion.
        traces: makes what a report draws.
        notes: one sentence each.
    """

    estimate: Estimate
    friction: FrictionModel
    alignment: Alignment
    misfits: tuple[NuisanceMisfit, ...]
    validation: Validation | None
    cutoff: float
    torque: Mapping[str, float]
    acceleration_error: float
    checkpoints: Motion
    traces: Callable[[], Traces]
    notes: tuple[str, ...]


def fit_measured(
    robot: RobotModel,
    logs: Sequence[Measurement],
    options: EstimationOptions,
    progress: Progress,
    least_deadband: Sequence[float] = (),
) -> MeasuredFit:
    """Identify the terminal link from one log or from several together.

    Args:
        robot: the arm as its model describes it.
        logs: whole logs, each filtered on its own.
        options: how.
        progress: where to tell how far it is.
        least_deadband: (n,) see ``signals.process.process``.

    Raises:
        InputError: a log does not fit the arm or the options.
    """
    signals = _processed(robot, logs, options, least_deadband)
    notes = [note for log in signals for note in (*log.notes, *compared_with_model(robot, log))]
    fitted, held = _parts(signals, options.validate)
    model, chosen = _friction(robot, options, signals, fitted)
    notes += [*chosen, *(note for log in signals for note in one_way(robot, model, log))]
    progress.stage("Solving for parameters...")
    aligner = Aligner(robot, options, model, signals)
    fit, validation = aligner.fit(fitted), None
    if options.validate > 0.0:
        log = "the log" if len(signals) == 1 else "each log"
        source = f"{100.0 * options.validate:.0f} % of {log} that was not fitted for it"
        validation = validate_samples(fit.rows(held), fit.estimate, source)
        # What was held out has done its work; the numbers come from all that was recorded.
        fit = aligner.fit([np.ones(len(part), dtype=bool) for part in fitted], fit)
    return MeasuredFit(
        aligner.with_filtering(fit),
        model,
        fit.alignment,
        fit.misfits(),
        validation,
        signals[0].cutoff,
        dict(zip(robot.joint_names, aligner.torque.tolist())),
        max(log.acceleration_error for log in signals),
        signals[0].motion(signals[0].spread(CHECKPOINTS)),
        lambda: aligner.traces(fit),
        tuple(dict.fromkeys(notes)),
    )


def _processed(
    robot: RobotModel,
    logs: Sequence[Measurement],
    options: EstimationOptions,
    least_deadband: Sequence[float],
) -> list[ProcessedSignals]:
    """Return the signals, all with the lowest cut-off that one of the logs asks for.

    It is slow enough for a delay to act like a derivative where one is wanted.
    """

    late = options.delay == "auto"

    def processed(log: Measurement, cutoff: float | None) -> ProcessedSignals:
        band = options.velocity_deadband
        signals = process(log, robot.joint_names, cutoff, band, least_deadband)
        return replace(signals, largest_slow_share=SLOW_SHARE_FOR_DELAY) if late else signals

    return with_one_cutoff(logs, processed, options.cutoff, DELAY_CUTOFF if late else math.inf)


def validate_on(
    robot: RobotModel,
    measurement: Measurement,
    options: EstimationOptions,
    fit: MeasuredFit,
    name: str,
) -> Validation:
    """Return the prediction error of a fit on another log, processed like the fitted one."""
    band = options.velocity_deadband
    signals = process(measurement, robot.joint_names, fit.cutoff, band)
    aligner = Aligner(robot, options, fit.friction, (signals,))
    samples = aligner.samples(fit.alignment, fit.estimate.values)[0]
    return validate_samples(samples, fit.estimate, name)


def validate_samples(
    samples: DecimatedSamples | JoinedSamples, estimate: Estimate, source: str
) -> Validation:
    """Return the prediction error on samples whose parameters the estimate contains."""
    values = np.array([estimate.value(name) or 0.0 for name in samples.names])
    return validate(samples.information(), values, source, samples.squared_torque())


def _parts(signals: Sequence[ProcessedSignals], share: float) -> tuple[list[Mask], list[Mask]]:
    """Return which decimated rows (K,) of each log are fitted, and which are held out.

    What is held out is taken from where the arm moves; the two are a filter's length apart.
    """
    fitted, held = [], []
    for log in signals:
        fastest = np.maximum(np.max(np.abs(log.qd), axis=0), 1e-12)
        speed = np.abs(log.decimated_motion().qd) / fastest
        gap = -(-len(log.low_pass.kernel) // log.low_pass.step) if share > 0.0 else 0
        counts = np.any(speed > MOVING, axis=1) & np.any(log.usable(), axis=1)
        parts = hold_out(counts, share, gap)
        fitted.append(parts[0])
        held.append(parts[1])
    return fitted, held


def _friction(
    robot: RobotModel,
    options: EstimationOptions,
    signals: Sequence[ProcessedSignals],
    fitted: Sequence[Mask],
) -> tuple[FrictionModel, tuple[str, ...]]:
    if options.measured_friction != CHOSEN:
        return friction_model(options.measured_friction), ()
    model, choice = choose_friction(robot, options.torques, signals, np.concatenate(fitted))
    return model, (f"friction model {choice.note}",)


def one_way(robot: RobotModel, model: FrictionModel, signals: ProcessedSignals) -> Iterator[str]:
    """Yield a sentence per joint whose Coulomb friction looks like an offset in this log."""
    if {"coulomb", "offset"} <= set(model.terms):
        yield from signals.one_way_joints(robot.joint_names)

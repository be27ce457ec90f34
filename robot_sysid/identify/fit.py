"""The fit of measured data: process, choose friction, align, estimate, validate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, friction_per_joint
from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.dynamics.gravity import TILT_NAMES, TiltColumns, gravity, turned, with_gravity
from robot_sysid.errors import SysidError
from robot_sysid.estimation.cross_validation import hold_out, validate
from robot_sysid.estimation.options import CHOSEN, EstimationOptions
from robot_sysid.estimation.uncertainty import sensitivity
from robot_sysid.identify.friction_selection import choose_friction
from robot_sysid.identify.samples import (
    DecimatedSamples,
    SharedColumns,
    decimated_equations,
    joined,
)
from robot_sysid.logs.checks import sign_check
from robot_sysid.records import (
    DELAY_NAME,
    Array,
    Estimate,
    Measurement,
    Motion,
    RobotModel,
    Validation,
)
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import ProcessedSignals, delay_columns, process, with_delay
from robot_sysid.simulator import ArmTorque
from robot_sysid.solver import identify_parameters

DELAY_CUTOFF = 10.0
"""Highest cut-off that is chosen where a delay is estimated [Hz]: beyond it the jumps of dry
friction, which no derivative describes, make the search slow or fail."""
DEFAULT_METHOD = "wls"
_MOST_ROUNDS = 20
_SETTLED_DELAY = 1e-7
_SETTLED_TILT = 1e-7
_CHECKPOINTS = 400

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Alignment:
    """What is known so far about the delay of the logs and the base's tilt.

    Attributes:
        delay: by which torque lags position [s].
        gravity: (3,) gravity in the world frame of the model [m/s^2].
    """

    delay: float
    gravity: Array

    def moved(self, estimate: Estimate) -> Alignment:
        """Return the alignment after an estimate of what was left of both."""
        delay = self.delay + (estimate.value(DELAY_NAME) or 0.0)
        angles = np.array([estimate.value(name) or 0.0 for name in TILT_NAMES])
        return Alignment(delay, turned(self.gravity, angles) if np.any(angles) else self.gravity)

    def tilt_from(self, reference: Array) -> float:
        """Return the angle between this gravity and another [rad]."""
        cross = np.linalg.norm(np.cross(self.gravity, reference))
        return float(np.arctan2(cross, self.gravity @ reference))


@dataclass(frozen=True)
class MeasuredFit:
    """Result of a fit to measured data.

    Attributes:
        estimate: the result.
        friction: the friction model that was used.
        alignment: delay and gravity that were found (or assumed).
        validation: prediction error on the part that was not fitted, if any.
        cutoff: of the low-pass [Hz].
        sensitivity: how hidden errors would move the estimate, see ``uncertainty.sensitivity``.
        checkpoints: some of the measured motion.
        notes: one sentence each.
    """

    estimate: Estimate
    friction: FrictionModel
    alignment: Alignment
    validation: Validation | None
    cutoff: float
    sensitivity: Mapping[str, Mapping[str, float]]
    checkpoints: Motion
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
    notes = [note for log in signals for note in (*log.notes, *_compare_with_model(robot, log))]
    fitted, held = _parts(signals, options.validate)
    model, chosen = _friction(robot, options, signals, fitted)
    notes += [*chosen, *(note for log in signals for note in _one_way(robot, model, log))]
    progress.stage("Solving for parameters...")
    estimate, alignment, samples = _align(robot, options, model, signals, fitted)
    validation = None
    if options.validate > 0.0:
        log = "the log" if len(signals) == 1 else "each log"
        source = f"the last {100.0 * options.validate:.0f} % of {log}"
        validation = validate_samples(_chosen(samples, held), estimate, source)
    return MeasuredFit(
        estimate,
        model,
        alignment,
        validation,
        signals[0].cutoff,
        hidden_errors(_chosen(samples, fitted), estimate),
        _checkpoints(signals[0]),
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

    def processed(log: Measurement, cutoff: float | None) -> ProcessedSignals:
        band = options.velocity_deadband
        return process(log, robot.joint_names, cutoff, band, least_deadband)

    signals = [processed(log, options.cutoff) for log in logs]
    if options.cutoff is not None:
        return signals
    lowest = min(log.cutoff for log in signals)
    lowest = min(lowest, DELAY_CUTOFF) if options.delay == "auto" else lowest
    return [
        log if log.cutoff == lowest else processed(raw, lowest) for log, raw in zip(signals, logs)
    ]


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
    arm = with_gravity(robot, fit.alignment.gravity)
    per_joint = friction_per_joint(arm, options.torques, fit.friction)
    equations = Equations(arm, options.torques, per_joint)
    samples = decimated_equations(equations, with_delay(signals, fit.alignment.delay))
    return validate_samples(samples, fit.estimate, name)


def validate_samples(samples: DecimatedSamples, estimate: Estimate, source: str) -> Validation:
    """Return the prediction error on samples whose parameters the estimate contains."""
    values = np.array([estimate.value(name) or 0.0 for name in samples.names])
    return validate(samples.information(), values, source, samples.squared_torque())


def hidden_errors(
    samples: DecimatedSamples, estimate: Estimate
) -> Mapping[str, Mapping[str, float]]:
    """Return how errors of the other links and of torque scales would move an estimate."""
    used = samples.used()
    noise = estimate.noise_per_joint
    weights = np.array([1.0 / noise.get(joint, np.inf) for joint in used.joints])
    rest = [measured - tau for measured, tau in zip(used.measured, used.tau)]
    return sensitivity(used.information(), weights, used.rows, rest, used.measured)


def _parts(signals: Sequence[ProcessedSignals], share: float) -> tuple[list[Mask], list[Mask]]:
    """Return which decimated rows (K,) of each log are fitted, and which are held out.

    The two parts are a filter's length apart.
    """
    fitted: list[Mask] = []
    held: list[Mask] = []
    for log in signals:
        gap = -(-len(log.low_pass.kernel) // log.low_pass.step) if share > 0.0 else 0
        rows = len(log.decimated_time())
        for masks, part in zip((fitted, held), hold_out(rows, share, gap)):
            masks.append(np.zeros(rows, dtype=bool))
            masks[-1][part] = True
    return fitted, held


def _chosen(logs: Sequence[DecimatedSamples], parts: Sequence[Mask]) -> DecimatedSamples:
    """Return the samples of all logs with one part of each in use.

    A delay shortens logs at their ends; the parts then end earlier.
    """
    return joined([log.where(part[: len(log)]) for log, part in zip(logs, parts)])


def _compare_with_model(robot: RobotModel, signals: ProcessedSignals) -> tuple[str, ...]:
    motion = _checkpoints(signals)
    places = np.searchsorted(signals.time, motion.time)
    return sign_check(signals.tau[places], ArmTorque(robot)(motion), robot.joint_names)


def _checkpoints(signals: ProcessedSignals) -> Motion:
    places = np.unique(np.linspace(0, len(signals) - 1, _CHECKPOINTS).astype(int))
    return Motion(signals.time[places], signals.q[places], signals.qd[places], signals.qdd[places])


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


def _one_way(robot: RobotModel, model: FrictionModel, signals: ProcessedSignals) -> Iterator[str]:
    """Yield a sentence per joint whose Coulomb friction looks like an offset in this log."""
    if {"coulomb", "offset"} <= set(model.terms):
        yield from signals.one_way_joints(robot.joint_names)


def _align(
    robot: RobotModel,
    options: EstimationOptions,
    friction: FrictionModel,
    signals: Sequence[ProcessedSignals],
    fitted: Sequence[Mask],
) -> tuple[Estimate, Alignment, list[DecimatedSamples]]:
    """Estimate, put right what was found of delay and tilt, and repeat until neither moves.

    Raises:
        SysidError: they keep moving.
    """
    alignment, theta = Alignment(0.0, gravity(robot)), robot.prior.theta
    method = options.method or DEFAULT_METHOD
    for _ in range(_MOST_ROUNDS):
        samples, prior = _samples(robot, options, friction, signals, alignment, theta)
        rows = _chosen(samples, fitted)
        estimate = identify_parameters(rows.information(), prior, method, options, rows)
        moved = alignment.moved(estimate)
        if _is_settled(alignment, moved):
            return estimate, moved, samples
        alignment, theta = moved, estimate.values[:10]
    sought = " and ".join(shared_names(options))
    raise SysidError(
        f"the estimates of {sought} do not settle within {_MOST_ROUNDS} rounds (last delay "
        f"{1e3 * alignment.delay:.3g} ms): this log does not show them well enough; lower "
        "--cutoff, or leave --delay and --tilt off"
    )


def _is_settled(before: Alignment, after: Alignment) -> bool:
    slow = abs(after.delay - before.delay) < _SETTLED_DELAY
    return slow and after.tilt_from(before.gravity) < _SETTLED_TILT


def shared_names(options: EstimationOptions) -> tuple[str, ...]:
    """Return the names of the parameters that enter every joint's equations."""
    delay = (DELAY_NAME,) if options.delay == "auto" else ()
    return delay + (TILT_NAMES if options.tilt == "auto" else ())


def _samples(
    robot: RobotModel,
    options: EstimationOptions,
    friction: FrictionModel,
    signals: Sequence[ProcessedSignals],
    alignment: Alignment,
    theta: Array,
) -> tuple[list[DecimatedSamples], Array]:
    """Return each log's equations around an alignment, and the prior of their parameters."""
    arm = with_gravity(robot, alignment.gravity)
    per_joint = friction_per_joint(arm, options.torques, friction)
    equations = Equations(arm, options.torques, per_joint, shared_names(options))
    parts = []
    for log in signals:
        shifted = with_delay(log, alignment.delay) if alignment.delay else log
        shared = _shared_columns(arm, options, shifted, theta)
        parts.append(decimated_equations(equations, shifted, shared))
    return parts, equations.prior


def _shared_columns(
    arm: RobotModel, options: EstimationOptions, signals: ProcessedSignals, theta: Array
) -> SharedColumns | None:
    if not shared_names(options):
        return None
    late = delay_columns(signals)[:, :, None] if options.delay == "auto" else None
    tilted = TiltColumns(arm, _thetas(arm, theta)) if options.tilt == "auto" else None

    def columns(motion: Motion, place: slice) -> Array:
        parts = [] if late is None else [late[place]]
        parts += [] if tilted is None else [tilted.evaluate(motion.q)]
        return np.concatenate(parts, axis=-1)

    return columns


def _thetas(robot: RobotModel, terminal: Array) -> Array:
    """Return (n, 10) the model's links with another terminal one (10,)."""
    return np.array([*(link.theta for link in robot.links[:-1]), terminal])

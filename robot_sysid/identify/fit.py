"""Identification from a measured log: process, choose friction, align, estimate, validate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.equations import Equations
from robot_sysid.dynamics.friction import DEFAULT_MEASURED, FrictionModel, friction_model
from robot_sysid.dynamics.gravity import TILT_NAMES, TiltColumns, gravity, turned, with_gravity
from robot_sysid.errors import SysidError
from robot_sysid.estimation.cross_validation import Validation, hold_out, validate
from robot_sysid.estimation.least_squares import EstimatorOptions
from robot_sysid.estimation.uncertainty import sensitivity
from robot_sysid.identify.friction_selection import choose_friction, friction_per_joint
from robot_sysid.identify.samples import SharedColumns, ThinnedSamples, thin_equations
from robot_sysid.logs.checks import sign_check
from robot_sysid.records import DELAY_NAME, Array, Estimate, Measurement, Motion, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import (
    ProcessedSignals,
    SignalOptions,
    delay_columns,
    process,
    with_delay,
)
from robot_sysid.simulator import inverse_torque
from robot_sysid.solver import identify_parameters

DELAY_CUTOFF = 10.0
"""Highest cut-off that is chosen where a delay is estimated [Hz]: beyond it the jumps of dry
friction, which no derivative describes, make the search slow or fail."""
_MOST_ROUNDS = 20
_SETTLED_DELAY = 1e-7
_SETTLED_TILT = 1e-7
_CHECKPOINTS = 400


@dataclass(frozen=True)
class MeasuredOptions:
    """How a measured log is turned into an estimate.

    Attributes:
        torques: "chain" or "terminal".
        friction: name of the friction model of every joint, "auto" to choose it, or "none".
        method: estimator's name.
        estimator: choices that apply to every method.
        signals: filtering.
        estimate_delay: whether torque may lag position by an unknown time.
        estimate_tilt: whether the base may be tilted by unknown small angles.
        held_out: share of the log, at its end, that is not fitted.
    """

    torques: str = "chain"
    friction: str = DEFAULT_MEASURED
    method: str = "wls"
    estimator: EstimatorOptions = EstimatorOptions()
    signals: SignalOptions = SignalOptions()
    estimate_delay: bool = False
    estimate_tilt: bool = False
    held_out: float = 0.2

    @property
    def shared(self) -> tuple[str, ...]:
        """Names of the parameters that enter every joint's equations."""
        delay = (DELAY_NAME,) if self.estimate_delay else ()
        return delay + (TILT_NAMES if self.estimate_tilt else ())


@dataclass(frozen=True)
class Alignment:
    """What is known so far about the log's delay and the base's tilt.

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
    """Result of an identification from a log.

    Attributes:
        estimate: the result.
        friction: the friction model that was used.
        alignment: delay and gravity that were found (or assumed).
        validation: prediction error on the part that was not fitted, if any.
        cutoff: of the low-pass [Hz].
        sensitivity: how hidden errors would move the estimate, see ``sensitivity``.
        checkpoints: some of the log's motion.
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


def identify_measured(
    robot: RobotModel, measurement: Measurement, options: MeasuredOptions, progress: Progress
) -> MeasuredFit:
    """Identify the terminal link from a whole log.

    Args:
        robot: the arm as its model describes it.
        measurement: the log.
        options: how.
        progress: where to tell how far it is.

    Raises:
        InputError: the log does not fit the arm or the options.
    """
    signals = _processed(robot, measurement, options)
    notes = list(signals.notes)
    notes += _compare_with_model(robot, signals)
    fitted, held = _parts(signals, options)
    model, chosen = _friction(robot, options, signals, fitted)
    notes += chosen
    progress.stage("Solving for parameters...")
    estimate, alignment, samples = _align(robot, options, model, signals, fitted)
    validation = None
    if held.stop > held.start:
        share = f"the last {100.0 * options.held_out:.0f} % of the log"
        validation = validate_samples(_marked(samples, held), estimate, share)
    return MeasuredFit(
        estimate,
        model,
        alignment,
        validation,
        signals.cutoff,
        hidden_errors(_marked(samples, fitted), estimate),
        _checkpoints(signals),
        tuple(notes),
    )


def _processed(
    robot: RobotModel, measurement: Measurement, options: MeasuredOptions
) -> ProcessedSignals:
    """Return the signals; slow enough for a delay to act like a derivative where one is wanted."""
    signals = process(measurement, options.signals, robot.joint_names)
    chosen = options.signals.cutoff is None
    if not (chosen and options.estimate_delay and signals.cutoff > DELAY_CUTOFF):
        return signals
    slower = replace(options.signals, cutoff=DELAY_CUTOFF)
    return process(measurement, slower, robot.joint_names)


def validate_on(
    robot: RobotModel,
    measurement: Measurement,
    options: MeasuredOptions,
    fit: MeasuredFit,
    name: str,
) -> Validation:
    """Return the prediction error of a fit on another log, processed like the fitted one."""
    settings = replace(options.signals, cutoff=fit.cutoff)
    signals = with_delay(process(measurement, settings, robot.joint_names), fit.alignment.delay)
    arm = with_gravity(robot, fit.alignment.gravity)
    equations = Equations(
        arm, options.torques, friction_per_joint(arm, options.torques, fit.friction)
    )
    return validate_samples(thin_equations(equations, signals), fit.estimate, name)


def validate_samples(samples: ThinnedSamples, estimate: Estimate, source: str) -> Validation:
    """Return the prediction error on samples whose parameters the estimate contains."""
    values = np.array([estimate.value(name) or 0.0 for name in samples.names])
    return validate(samples.information(), values, source, list(samples.squared_torque()))


def hidden_errors(samples: ThinnedSamples, estimate: Estimate) -> Mapping[str, Mapping[str, float]]:
    """Return how errors of the other links and of torque scales would move an estimate."""
    used = samples.used()
    noise = estimate.noise_per_joint
    weights = np.array([1.0 / noise.get(joint, np.inf) for joint in used.joints])
    rest = [measured - tau for measured, tau in zip(used.measured, used.tau)]
    return sensitivity(used.information(), weights, used.rows, rest, used.measured)


def _parts(signals: ProcessedSignals, options: MeasuredOptions) -> tuple[slice, slice]:
    """Return which thinned rows are fitted and which are held out, a filter's length apart."""
    gap = -(-len(signals.low_pass.kernel) // signals.low_pass.step)
    gap = gap if options.held_out > 0.0 else 0
    return hold_out(len(signals.thinned_time()), options.held_out, gap)


def _compare_with_model(robot: RobotModel, signals: ProcessedSignals) -> tuple[str, ...]:
    motion = _checkpoints(signals)
    places = np.searchsorted(signals.time, motion.time)
    return sign_check(signals.tau[places], inverse_torque(robot)(motion), robot.joint_names)


def _checkpoints(signals: ProcessedSignals) -> Motion:
    places = np.unique(np.linspace(0, len(signals) - 1, _CHECKPOINTS).astype(int))
    return Motion(signals.time[places], signals.q[places], signals.qd[places], signals.qdd[places])


def _friction(
    robot: RobotModel, options: MeasuredOptions, signals: ProcessedSignals, fitted: slice
) -> tuple[FrictionModel, tuple[str, ...]]:
    if options.friction != "auto":
        return friction_model(options.friction), ()
    model, choice = choose_friction(robot, options.torques, signals, fitted)
    return model, (f"friction model {choice.note}",)


def _marked(samples: ThinnedSamples, part: slice) -> ThinnedSamples:
    used = np.zeros(len(samples), dtype=bool)
    used[part] = True
    return samples.where(used)


def _align(
    robot: RobotModel,
    options: MeasuredOptions,
    friction: FrictionModel,
    signals: ProcessedSignals,
    fitted: slice,
) -> tuple[Estimate, Alignment, ThinnedSamples]:
    """Estimate, put right what was found of delay and tilt, and repeat until neither moves.

    Raises:
        SysidError: they keep moving.
    """
    alignment, theta = Alignment(0.0, gravity(robot)), robot.prior.theta
    for _ in range(_MOST_ROUNDS):
        samples, prior = _samples(robot, options, friction, signals, alignment, theta)
        rows = _marked(samples, slice(fitted.start, min(fitted.stop, len(samples))))
        estimate = _estimate(options, rows, prior)
        moved = alignment.moved(estimate)
        if _is_settled(alignment, moved):
            return estimate, moved, samples
        alignment, theta = moved, estimate.values[:10]
    sought = " and ".join(options.shared)
    raise SysidError(
        f"the estimates of {sought} do not settle within {_MOST_ROUNDS} rounds (last delay "
        f"{1e3 * alignment.delay:.3g} ms): this log does not show them well enough; lower "
        "--cutoff, or leave --delay and --tilt off"
    )


def _is_settled(before: Alignment, after: Alignment) -> bool:
    slow = abs(after.delay - before.delay) < _SETTLED_DELAY
    return slow and after.tilt_from(before.gravity) < _SETTLED_TILT


def _estimate(options: MeasuredOptions, rows: ThinnedSamples, prior: Array) -> Estimate:
    return identify_parameters(
        rows.information(), prior, options.method, options.estimator, rows, rows.joints[-1]
    )


def _samples(
    robot: RobotModel,
    options: MeasuredOptions,
    friction: FrictionModel,
    signals: ProcessedSignals,
    alignment: Alignment,
    theta: Array,
) -> tuple[ThinnedSamples, Array]:
    """Return the equations around an alignment, and the prior of their parameters."""
    arm = with_gravity(robot, alignment.gravity)
    shifted = with_delay(signals, alignment.delay) if alignment.delay else signals
    per_joint = friction_per_joint(arm, options.torques, friction)
    equations = Equations(arm, options.torques, per_joint, options.shared)
    shared = _shared_columns(arm, options, shifted, theta) if options.shared else None
    return thin_equations(equations, shifted, shared), equations.prior


def _shared_columns(
    arm: RobotModel, options: MeasuredOptions, signals: ProcessedSignals, theta: Array
) -> SharedColumns:
    late = delay_columns(signals)[:, :, None] if options.estimate_delay else None
    tilted = TiltColumns(arm, theta) if options.estimate_tilt else None

    def columns(motion: Motion, place: slice) -> Array:
        parts = [] if late is None else [late[place]]
        parts += [] if tilted is None else [tilted.evaluate(motion.q)]
        return np.concatenate(parts, axis=-1)

    return columns

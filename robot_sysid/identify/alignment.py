"""The estimate of a log, repeated until what it says of delay, tilt and load is taken out of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, friction_per_joint
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.gravity import TILT_NAMES, TiltColumns, gravity, turned, with_gravity
from robot_sysid.dynamics.nuisances import NuisanceColumns
from robot_sysid.errors import SysidError
from robot_sysid.estimation.autocorrelation import JointResiduals
from robot_sysid.estimation.nuisances import NuisanceGroup, misfits, widened_groups
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.judgement.filtering import filtering_pull, with_filtering
from robot_sysid.identify.nuisances import (
    known_links,
    nuisance_groups,
    sought_links,
    with_nuisances,
)
from robot_sysid.identify.samples import (
    DecimatedSamples,
    JoinedSamples,
    SharedColumns,
    decimated_equations,
)
from robot_sysid.identify.traces import traced
from robot_sysid.records import (
    DELAY_NAME,
    Array,
    Estimate,
    Motion,
    NuisanceMisfit,
    RobotModel,
    SampleSource,
    SquareRootInformation,
)
from robot_sysid.records.traces import Traces
from robot_sysid.signals.process import ProcessedSignals, delay_columns, with_delay
from robot_sysid.signals.repetition import visits
from robot_sysid.solver import identify_parameters

DEFAULT_METHOD = "wls"
_MOST_ROUNDS = 20
_LOAD_ROUNDS, _WIDENING_ROUNDS = 3, 2
_SETTLED_DELAY, _SETTLED_SHARE = 1e-7, 0.02
_SETTLED_TILT = 1e-7

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
class AlignedFit:
    """An estimate and what it was made from.

    Attributes:
        estimate: the result.
        alignment: delay and gravity that were found (or assumed).
        samples: the equations of each log, all rows of it.
        nuisances: what was known of the nuisances, as wide as the data asked for.
        noise: (joints,) noise as it counts: more than it is where the same residuals come again
            [N m].
    """

    estimate: Estimate
    alignment: Alignment
    samples: tuple[DecimatedSamples, ...]
    nuisances: tuple[NuisanceGroup, ...]
    noise: Array

    def rows(self, parts: Sequence[Mask]) -> JoinedSamples:
        """Return the samples of all logs with one part (K,) of each in use."""
        return chosen_rows(self.samples, parts)

    def misfits(self) -> tuple[NuisanceMisfit, ...]:
        """Return what all rows ask for that the model does not have."""
        return misfits(JoinedSamples(self.samples).information(), self.noise, self.nuisances)


class Aligner:
    """Estimates, puts right what was found of delay, tilt and load, and estimates again.

    Args:
        robot: the arm.
        options: how.
        friction: terms of every joint.
        signals: the processed logs.

    Attributes:
        torque: (n,) root mean square of each joint's measured torque [N m].
        groups: what is known of the nuisances.
    """

    def __init__(
        self,
        robot: RobotModel,
        options: EstimationOptions,
        friction: FrictionModel,
        signals: Sequence[ProcessedSignals],
    ) -> None:
        self._robot, self._options, self._logs = robot, options, tuple(signals)
        self._friction = friction
        self._with_load = "load" in friction.terms
        self._base: tuple[Alignment, tuple[DecimatedSamples, ...]] | None = None
        count = max(sum(len(log) for log in signals), 1)
        squares = [np.sum(log.tau**2, axis=0) for log in signals]
        self.torque: Array = np.sqrt(sum(squares, np.zeros(robot.n_joints)) / count)
        self.groups = nuisance_groups(robot, options, friction, self.torque)
        self._plain = self._equations(robot, None)
        self._rounds = _LOAD_ROUNDS if self._with_load else 2 if self.groups else 1

    def fit(self, parts: Sequence[Mask], before: AlignedFit | None = None) -> AlignedFit:
        """Return the fit of one part (K,) of each log.

        Args:
            parts: which rows of each log are fitted.
            before: another fit of the same logs to start from.

        Raises:
            SysidError: delay or tilt keep moving.
        """
        alignment, values = Alignment(0.0, gravity(self._robot)), None
        samples: tuple[DecimatedSamples, ...] = ()
        if before is not None:
            alignment, samples = before.alignment, before.samples
        for done in range(1, _MOST_ROUNDS + 1):
            samples = samples or self.samples(alignment, values)
            estimate, nuisances, noise = self._estimate(chosen_rows(samples, parts))
            moved = alignment.moved(estimate)
            settled = _is_settled(alignment, moved, estimate.error(DELAY_NAME) or 0.0)
            if settled and (before is not None or done >= self._rounds):
                return AlignedFit(estimate, moved, samples, nuisances, noise)
            alignment = alignment if settled else moved
            values, samples = estimate.values, ()
        raise SysidError(
            f"the estimates of {' and '.join(shared_names(self._options))} do not settle within "
            f"{_MOST_ROUNDS} rounds (last delay {1e3 * alignment.delay:.3g} ms): this log does not "
            "show them well enough; lower --cutoff, or leave --delay and --tilt off"
        )

    def with_filtering(self, fit: AlignedFit) -> Estimate:
        """Return the estimate of a fit with what the low-pass may have moved it by."""
        pull = self.filtering_pull(fit.alignment, fit.samples, fit.estimate.values)
        information = JoinedSamples(fit.samples).information()
        return with_filtering(fit.estimate, information, fit.nuisances, fit.noise, pull)

    def filtering_pull(
        self, alignment: Alignment, samples: Sequence[DecimatedSamples], values: Array
    ) -> Array:
        """Return the sum of all logs' (joints, p), see ``judgement.filtering``."""
        arm = with_gravity(self._robot, alignment.gravity)
        equations = self._equations(arm, values[: len(self._plain.names)])
        logs = zip(samples, self._delayed(alignment))
        return np.sum([filtering_pull(s, equations, log, values) for s, log in logs], axis=0)

    def traces(self, fit: AlignedFit) -> Traces:
        """Return what was measured and what a fit predicts, for a report."""
        names, estimate = fit.samples[0].names, fit.estimate
        after = dict(zip(estimate.names, estimate.values))
        motions = [log.decimated_motion() for log in self._logs]
        before = dict(zip(names, self.prior(names)))
        return traced(self._robot, fit.samples, motions, after, before)

    def _estimate(self, rows: JoinedSamples) -> tuple[Estimate, tuple[NuisanceGroup, ...], Array]:
        """Return the estimate, with priors as wide as the data asks for, these, and the noise."""
        information = rows.information()

        def inflation(values: Array) -> Array:
            return self._visits.inflation(information, rows, values)

        prior = self.prior(rows.names)
        return widened_estimate(information, prior, self._options, self.groups, inflation, rows)

    def prior(self, names: Sequence[str]) -> Array:
        """Return the model's own value of each parameter (p,); zero for what it does not know."""
        known = dict(zip(self._plain.names, self._plain.prior))
        return np.array([known.get(name, 0.0) for name in names])

    def _equations(self, arm: RobotModel, values: Array | None) -> Equations:
        options = self._options
        friction = friction_per_joint(arm, options.torques, self._friction)
        shared, links = shared_names(options), sought_links(arm, options)
        return Equations(arm, options.torques, friction, shared, links, values)

    def samples(self, alignment: Alignment, values: Array | None) -> tuple[DecimatedSamples, ...]:
        """Return each log's equations around an alignment and values (p,), None for the model's."""
        arm = with_gravity(self._robot, alignment.gravity)
        known = None if values is None else values[: len(self._plain.names)]
        equations = self._equations(arm, known)
        thetas = known_links(arm, equations.names, known)
        columns = NuisanceColumns(arm, thetas)
        logs = self._delayed(alignment)
        if self._base is None or self._with_load or self._base[0] is not alignment:
            self._base = alignment, self._without_nuisances(arm, equations, thetas, logs)
            self._visits = visits([log.decimated_motion() for log in logs])
        return tuple(
            with_nuisances(samples, columns, log, equations, self.groups)
            for samples, log in zip(self._base[1], logs)
        )

    def _delayed(self, alignment: Alignment) -> list[ProcessedSignals]:
        """Return the logs with the delay taken out."""
        delay = alignment.delay
        return [with_delay(log, delay) if delay else log for log in self._logs]

    def _without_nuisances(
        self, arm: RobotModel, equations: Equations, thetas: Array, logs: Sequence[ProcessedSignals]
    ) -> tuple[DecimatedSamples, ...]:
        return tuple(
            decimated_equations(equations, log, _shared_columns(arm, self._options, log, thetas))
            for log in logs
        )


def widened_estimate(
    information: SquareRootInformation,
    prior: Array,
    options: EstimationOptions,
    groups: tuple[NuisanceGroup, ...],
    inflation_at: Callable[[Array], Array],
    samples: SampleSource | None = None,
    residuals: Sequence[JointResiduals] | None = None,
) -> tuple[Estimate, tuple[NuisanceGroup, ...], Array]:
    """Return the estimate, with priors as wide as the data asks for, these, and the noise.

    Args:
        information: the data.
        prior: (p,) the model's values.
        options: how.
        groups: what is known of the nuisances.
        inflation_at: D (joints,) of residuals at values (p,), see ``signals.repetition``.
        samples, residuals: as ``solver.identify_parameters`` takes them.
    """
    inflation, method = np.ones(len(information.joints)), options.method or DEFAULT_METHOD
    joints = [joint.joint for joint in information.joints]
    for _ in range(_WIDENING_ROUNDS):
        counted, used = inflation, groups
        estimate = identify_parameters(
            information, prior, method, options, samples, used, counted, residuals
        )
        inflation = inflation_at(estimate.values)
        noise = _noise(estimate, joints) * np.sqrt(inflation)
        groups = widened_groups(information, noise, used)
        widened = any(a.widened != b.widened for a, b in zip(used, groups))
        if not widened and np.array_equal(counted, inflation):
            break
    return estimate, used, noise


def _noise(estimate: Estimate, joints: Sequence[str]) -> Array:
    """Return (joints,) the noise of an estimate; infinite where a joint had no samples [N m]."""
    return np.array([estimate.noise_per_joint.get(joint, np.inf) for joint in joints])


def _is_settled(before: Alignment, after: Alignment, error: float) -> bool:
    """Tell whether neither moves by more than nothing or, the delay, a part of its error [s]."""
    slow = abs(after.delay - before.delay) < max(_SETTLED_DELAY, _SETTLED_SHARE * error)
    return slow and after.tilt_from(before.gravity) < _SETTLED_TILT


def chosen_rows(logs: Sequence[DecimatedSamples], parts: Sequence[Mask]) -> JoinedSamples:
    """Return the samples of all logs with one part (K,) of each in use.

    A delay shortens logs at their ends; the parts then end earlier.
    """
    return JoinedSamples(tuple(log.where(part[: len(log)]) for log, part in zip(logs, parts)))


def shared_names(options: EstimationOptions) -> tuple[str, ...]:
    """Return the names of the parameters that enter every joint's equations."""
    delay = (DELAY_NAME,) if options.delay == "auto" else ()
    return delay + (TILT_NAMES if options.tilt == "auto" else ())


def _shared_columns(
    arm: RobotModel, options: EstimationOptions, signals: ProcessedSignals, thetas: Array
) -> SharedColumns | None:
    if not shared_names(options):
        return None
    late = delay_columns(signals)[:, :, None] if options.delay == "auto" else None
    tilted = TiltColumns(arm, thetas) if options.tilt == "auto" else None

    def columns(motion: Motion, place: slice) -> Array:
        parts = [] if late is None else [late[place]]
        parts += [] if tilted is None else [tilted.evaluate(motion.q)]
        return np.concatenate(parts, axis=-1)

    return columns

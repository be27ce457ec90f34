"""What follows from a fit: bodies with their errors, prediction, agreement of the recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.information import joint_rmse, sample_counts
from robot_sysid.identify.payload.checks.agreement import contradictions
from robot_sysid.identify.payload.checks.held_out import held_out_error
from robot_sysid.identify.payload.checks.judge import verdict
from robot_sysid.identify.payload.checks.scatter import each_recording
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES, Recording
from robot_sysid.identify.payload.errors import FitErrors, fit_errors
from robot_sysid.identify.payload.joint_fit import JointFit
from robot_sysid.identify.payload.nuisances import BOUNDS, COMMON, SCALE
from robot_sysid.records import Array, Flange, InertialParameters, RobotModel, Validation
from robot_sysid.records.payload import BodyEstimate, OneRecording, PayloadStatus


@dataclass(frozen=True)
class Result:
    """A fit and all that is said of it.

    Attributes:
        fit: the estimate.
        flange: frame of the payload.
        recordings: they.
    """

    fit: JointFit
    flange: Flange
    recordings: Sequence[Recording]

    @cached_property
    def errors(self) -> FitErrors:
        """How far off all parameters may be."""
        return fit_errors(self.fit, self.recordings)

    @cached_property
    def free(self) -> BodyEstimate:
        """The payload before it was made a possible body."""
        return self.payload(self.fit.values)

    @cached_property
    def validation(self) -> Validation:
        """The prediction of stretches that were not fitted."""
        return held_out_error(self.fit)

    @cached_property
    def scatter(self) -> tuple[OneRecording, ...]:
        """The payload according to each recording alone."""
        return each_recording(self.fit, self.recordings, self.flange, self._inflation())

    @property
    def rmse(self) -> float:
        """Root mean square residual [N m]."""
        information = self.fit.weighted.information
        squares = joint_rmse(information, self.fit.values) ** 2
        return float(np.sqrt(np.average(squares, weights=sample_counts(information))))

    def verdict(self, robot: RobotModel) -> tuple[PayloadStatus, tuple[str, ...]]:
        """Return whether the payload may be used, and why not."""
        misfit = contradictions(self.fit, self.recordings)
        return verdict(robot, self.free, misfit, self.validation, self.rmse)

    def payload(self, values: Array) -> BodyEstimate:
        """Return the payload of some values (p,), in the flange frame."""
        change = np.stack([self.flange.to_flange(unit) for unit in np.eye(10)], axis=1)
        return self._body(change @ self._pick(PAYLOAD_NAMES), values)

    def link(self, values: Array) -> BodyEstimate:
        """Return the terminal link without the payload, in the terminal body's frame."""
        return self._body(self._pick(PARAMETER_NAMES), values)

    def total(self, values: Array) -> BodyEstimate:
        """Return both together, in the terminal body's frame."""
        return self._body(self._pick(PARAMETER_NAMES) + self._pick(PAYLOAD_NAMES), values)

    def _inflation(self) -> float:
        """Return by how much correlated noise makes the mass's error larger than white noise."""
        change = self._pick(PAYLOAD_NAMES)[:1]
        _, noise, _ = self.errors.of(change)
        white = float(self.errors.white(change)[0])
        return float(max(noise[0] / white, 1.0)) if white > 0.0 else 1.0

    def _pick(self, names: Sequence[str]) -> Array:
        return np.eye(len(self.fit.values))[self.fit.equations.places(names)]

    def _body(self, change: Array, values: Array) -> BodyEstimate:
        theta = change @ values
        covariance, noise, budget = self.errors.of(change)
        budget = {cause: each for cause, each in budget.items() if cause != COMMON}
        common = self._common()
        if common:
            covariance = covariance + common**2 * np.outer(theta, theta)
            budget[SCALE] = np.hypot(budget[SCALE], common * np.abs(theta))
        shown = self.errors.shown(change)
        return BodyEstimate(InertialParameters(theta), covariance, shown, noise, budget)

    def _common(self) -> float:
        """Return how far all torque scales may be off together, where nothing tells it."""
        if all(group.cause != COMMON for group in self.fit.fixed):
            return 0.0
        scale = next(group for group in self.fit.widened if group.cause == SCALE)
        size = scale.widened * float(scale.factor[0, 0])
        return size / float(np.sqrt(len(scale.names)))

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Return friction, drift and nuisances with their standard errors.

        The error of what was held at a bound is not known.
        """
        fit, spread = self.fit, self.errors.whole.standard_errors
        held = {name for group in fit.fixed if group.cause == BOUNDS for name in group.names}
        return {
            name: (float(value), float("nan") if name in held else float(error))
            for name, value, error in zip(fit.equations.names, fit.values, spread)
            if name not in PARAMETER_NAMES and "(" not in name
        }

    def torque_scale(self) -> Mapping[str, tuple[float, float]]:
        """Return joint name to (torque scale, standard error)."""
        fit, spread = self.fit, self.errors.whole.standard_errors
        places = fit.equations.places(fit.equations.scale_names)
        return {
            joint: (1.0 + float(fit.values[k]), float(spread[k]))
            for joint, k in zip(fit.equations.joint_names, places)
        }

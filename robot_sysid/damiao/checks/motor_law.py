"""The gains by which a motor makes the torque that it reports, whatever the ages of its signals.

A motor in MIT mode makes tau = t + kp (p - q) + kd (v - qd) of the command in force. A frame of its
has tau, q and qd, which need not be of the same moment: a reported torque may be older than the
position beside it, a velocity is low-passed, and what is reported may be that of the last command.
How old each is no register says. At kp 400 a joint that turns at 1 rad/s has 0.4 N m more after
every millisecond, which looks like a wrong gain. So the ages are estimated together with the gains,
one of each for a run, by least squares of

    tau_k = f t + a kp (p - q) + b kd (v - qd)    p, v, t one age back, q another, qd a third one

linearised in ages. Signals between rows are interpolated. What the joint does within a cycle, after
the step that each command makes, is in proportion to that step, whose column is that of the
command's age.

The motor's own loop knows position and velocity finer, and with less noise, than it reports them.
A column with such errors in it makes its factor too small. So least squares have two stages
(instrumental variables; Wooldridge, "Econometric analysis of cross section and panel data", 2010,
chapter 5): each column has an instrument, which is the same quantity by other measurements: the
mean of positions around a row for the position at it, their slope for the velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.safety.plausibility import Mask
from robot_sysid.records import Array

PARTS = ("feed-forward torque", "stiffness kp", "damping kd")
"""Parts of the law, in the order of their factors."""
_MEASURED = ("time", "pos", "vel", "tau")
# Standard deviations of what is not known before: factors may be anything; ages are 0 to 2 cycles,
# and differences of two of them -2 to 2, with a standard deviation of 0.8.
_FACTOR_ERROR = 1.0
_AGE_CYCLES = 1.0
# Ages within which columns are linearised, in cycles: of the command, which is in force from the
# row before on, and of position and velocity, which may be older than the torque, or younger.
_YOUNGEST = np.array([0.0, -2.0, -2.0])
_OLDEST = np.array([2.0, 2.0, 2.0])
# Linearisations: ages change no more after three.
_ITERATIONS = 5
# Longest time between two rows that follow one another, in cycles.
_LONGEST_STEP = 1.5
# Distance of the positions by which an instrument is made, in cycles: none is one of those between
# which the row's own is interpolated.
_APART = 1.5
# Rows around a judged one that have to be answered, on each side: as far as ages and ``_APART`` go.
_MARGIN = 4
# Variance of an error that is uniform within a step, over the square of the step.
_STEP_VARIANCE = 1.0 / 12.0
# Least share of a recording in which rounding is alike. What a joint does within a cycle is not
# quite in proportion to the command's step, and what is left is no noise either. It is smaller than
# the steps, so that it counts for parts that are as small.
_LEAST_MEMORY = 0.015
# Torque of the last digit in a recording [N m].
_LAST_DIGIT = 1e-6
# Share of a recording over which residuals may be alike.
_LONGEST_MEMORY = 0.25


class MotorSteps(NamedTuple):
    """Steps in which a motor reports position [rad], velocity [rad/s] and torque [N m]."""

    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0


@dataclass(frozen=True)
class MotorRows:
    """Rows of a joint's recording that were answered, and which of them are judged.

    A row is judged where those around it were answered, one cycle after the other: near a lost
    frame nobody knows which command the motor had.

    Attributes:
        signals: columns (N,) by what they have, such as "pos" and "cmd_tau".
        kp, kd: commanded gains [N m/rad, N m s/rad].
        period: time between two rows [s].
        is_judged: whether each row (N,) is.
    """

    signals: Mapping[str, Array]
    kp: float
    kd: float
    period: float
    is_judged: Mask

    @classmethod
    def of(cls, columns: Mapping[str, Array], kp: float, kd: float) -> MotorRows:
        """Return the rows of columns that are NaN where the joint did not answer."""
        measured = np.array([columns[name] for name in _MEASURED])
        numbers = np.flatnonzero(np.all(np.isfinite(measured), axis=0))
        signals = {name: values[numbers] for name, values in columns.items()}
        steps = np.diff(signals["time"])
        period = float(np.median(steps)) if len(steps) else 0.0
        is_broken = (np.diff(numbers) > 1) | (steps > _LONGEST_STEP * period)
        # Before the first row and behind the last one, too.
        breaks = np.flatnonzero(np.concatenate(([True], is_broken, [True])))
        rows = np.arange(len(numbers))
        following = np.searchsorted(breaks, rows, "right")
        n_before = rows - breaks[following - 1]
        n_behind = breaks[following] - 1 - rows
        is_judged = np.minimum(n_before, n_behind) >= _MARGIN
        return cls(signals, kp, kd, period, is_judged)

    @property
    def reported_torque(self) -> Array:
        """Torque that the motor reported in judged rows; recorded is the mean of held commands."""
        return (self.signals["tau"] - self.signals["cmd_mean"])[self.is_judged]

    def rounding_density(self, steps: MotorSteps) -> float:
        """Return the variance of the torque by rounding, times the rows in which it is alike.

        A signal is rounded alike for as many rows as it stays within a step: in a slow run for
        many, and then rounding is no noise that averages out.
        """
        density = 0.0
        signals = (
            ("pos", steps.position, self.kp),
            ("vel", steps.velocity, self.kd),
            ("tau", steps.torque, 1.0),
        )
        for name, step, gain in signals:
            values = self.signals[name][self.is_judged]
            path = float(np.sum(np.abs(np.diff(values))))
            memory = max(step / path if path > step else 1.0, _LEAST_MEMORY)
            variance = _STEP_VARIANCE * (gain * step) ** 2
            density += variance * memory * len(values)
        return density

    def _earlier(self, name: str, age: float) -> Array:
        """Return a signal of judged rows at an age [s]."""
        time = self.signals["time"]
        return np.interp(time[self.is_judged] - age, time, self.signals[name])

    def _slope(self, name: str, age: float, apart: float) -> Array:
        """Return the slope of a signal of judged rows at an age, by values so far from it [s]."""
        younger = self._earlier(name, age - apart)
        return (younger - self._earlier(name, age + apart)) / (2.0 * apart)

    def parts(self, ages: Array) -> Array:
        """Return feed-forward torque, stiffness and damping (N, 3) at ages (3,) [N m]."""
        of_command, of_position, of_velocity = ages
        position = self._earlier("pos", of_position)
        return self._law(of_command, position, self._earlier("vel", of_velocity))

    def _law(self, age: float, position: Array, speed: Array) -> Array:
        """Return the parts (N, 3) of the command at an age, by positions and speeds (N,) [N m]."""
        return np.column_stack(
            (
                self._earlier("cmd_tau", age),
                self.kp * (self._earlier("cmd_pos", age) - position),
                self.kd * (self._earlier("cmd_vel", age) - speed),
            )
        )

    def columns(self, ages: Array) -> Array:
        """Return the derivatives (N, 6) of the torque by factors and by ages (3,)."""
        of_command, of_position, of_velocity = ages
        by_position = self.kp * self._earlier("vel", of_position)
        by_velocity = self.kd * self._slope("vel", of_velocity, 0.5 * self.period)
        return np.column_stack(
            (self.parts(ages), self._by_command(of_command), by_position, by_velocity)
        )

    def _by_command(self, age: float) -> Array:
        """Return the derivative (N,) of the torque by the command's age [N m/s]."""
        half = 0.5 * self.period
        fed_rate = self._slope("cmd_tau", age, half)
        stiffness_rate = self.kp * self._slope("cmd_pos", age, half)
        damping_rate = self.kd * self._slope("cmd_vel", age, half)
        return -(fed_rate + stiffness_rate + damping_rate)

    def instruments(self, ages: Array) -> Array:
        """Return the columns (N, 6) with positions around each row for those and speeds at it."""
        of_command, of_position, of_velocity = ages
        apart = _APART * self.period
        younger = self._earlier("pos", of_position - apart)
        older = self._earlier("pos", of_position + apart)
        position = 0.5 * (younger + older)
        speed = self._slope("pos", of_velocity, apart)
        return np.column_stack(
            (
                self._law(of_command, position, speed),
                self._by_command(of_command),
                self.kp * self._slope("pos", of_position, apart),
                self.kd * self._slope("vel", of_velocity, apart),
            )
        )


def estimate_factors(rows: MotorRows, steps: MotorSteps) -> tuple[Array, Array]:
    """Return the factors (3,) of ``PARTS`` in the reported torque, and their standard errors.

    The errors contain what the ages leave open.

    Args:
        rows: of the joint.
        steps: in which its motor reports.
    """
    reported = rows.reported_torque - np.mean(rows.reported_torque)
    n_factors = len(PARTS)
    prior_error = np.full(2 * n_factors, _FACTOR_ERROR)
    prior_error[n_factors:] = _AGE_CYCLES * rows.period
    estimate = np.repeat((1.0, 0.0), n_factors)
    covariance = np.diag(prior_error**2)
    rounding = rows.rounding_density(steps)
    for _ in range(_ITERATIONS):
        ages = estimate[n_factors:]
        around = np.clip(ages, _YOUNGEST * rows.period, _OLDEST * rows.period)
        # What is known before, and the last estimate, of factors and of ages beside ``around``.
        shift = np.append(np.zeros(n_factors), around)
        prior = np.repeat((1.0, 0.0), n_factors) - shift
        columns = rows.columns(around)
        columns = columns - np.mean(columns, axis=0)
        instruments = rows.instruments(around)
        instruments = instruments - np.mean(instruments, axis=0)
        predicted = _project(columns, instruments)
        residual = reported - columns @ (estimate - shift)
        noise = _noise_density(residual) + _LAST_DIGIT**2
        noise += rounding
        precision = predicted.T @ predicted / noise + np.diag(prior_error**-2)
        covariance = np.linalg.inv(precision)
        right = predicted.T @ reported / noise + prior / prior_error**2
        estimate = covariance @ right + shift
    errors = np.sqrt(np.diag(covariance))
    return estimate[:n_factors], errors[:n_factors]


def _project(columns: Array, instruments: Array) -> Array:
    """Return what the instruments (N, m) predict of columns (N, k) by least squares."""
    scale = np.sqrt(np.mean(instruments**2, axis=0))
    scaled = instruments / np.where(scale > 0.0, scale, 1.0)
    coefficients, *_ = np.linalg.lstsq(scaled, columns, rcond=None)
    return scaled @ coefficients


def _noise_density(residual: Array) -> float:
    """Return the variance of a residual (N,) times the number of rows in which it is alike.

    That is 1 + 2 (sum of the autocorrelations until the first that is not positive).
    """
    n_rows = len(residual)
    density = float(np.mean(residual**2))
    for lag in range(1, round(_LONGEST_MEMORY * n_rows)):
        covariance = float(residual[lag:] @ residual[:-lag]) / n_rows
        if covariance <= 0.0:
            break
        density += 2.0 * covariance
    return density

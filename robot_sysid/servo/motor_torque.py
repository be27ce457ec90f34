"""Gains of servos by torques that a log has beside its commands, as from motor currents.

A current shows the torque of the motor, before any friction of the gears. A servo's is its gain K
times what is left of its position error e behind dead zone and limit, so that it shows the gain
whatever the links weigh:

    torque = K clip(beyond(e, dead zone), +-limit) - damping qd + offset

with the offset of the sensor and that part of the damping which a current shows, as back-EMF is.
Currents are read later than positions, or averaged: that one of the times in ``LATE`` is taken that
explains the torque best, and the others make the error that do so as well, as far as a servo's
torque is known to be this. All signals pass the low-pass of ``loop``.

A column named as a torque may be of another joint, of another unit, or no measurement. One is used
where the joint's own position error explains it, and does so better than those of other joints and
than the model's links, and where the gain does not contradict that by the links.

n is the number of joints, k that of joints that move, M that of samples of all pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import compress

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.fit import correlation_times
from robot_sysid.faults.misfits import EXACT_TORQUE
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.levels import SURE
from robot_sysid.records.messages import percent
from robot_sysid.servo.loop import commands, low_pass, low_pass_motion, stretches
from robot_sysid.servo.play import LINK_ERROR
from robot_sysid.servo.played_fit import Solved
from robot_sysid.servo.setting import gain_of, links_of, strength_of
from robot_sysid.servo.unknowns import (
    DEVIATIONS,
    LEAST,
    MOST,
    UNKNOWNS,
    column,
    numbers_at,
)
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import interpolate
from robot_sysid.wording import with_option_names

_GAIN = column("gain")
IN_ANGLE = ("torque_limit", "dead_zone", "command_delay", "loop_lag")
"""Unknowns on which the torque over the gain depends."""
LATE = (
    *((delay, 0.0) for delay in (0.0, 0.005, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08)),
    *((0.0, lag) for lag in (0.005, 0.01, 0.02, 0.03, 0.04, 0.06, 0.1)),
)
"""Delays, and time constants of averages, of torques beside positions that are tried [s]."""


MOST_COMPUTED = 0.5
"""Share of torques that were computed from which on all are taken to be."""


class TorqueFault(Enum):
    """Why a recorded torque is not used."""

    ZERO = "zero"
    APART = "apart"
    COMPUTED = "computed"
    OTHER_SIZE = "other size"


@dataclass(frozen=True)
class TorqueGains:
    """Gains by recorded torques.

    Attributes:
        joint_names: (k,) of the joints that move.
        x: (k,) gains as the fit has them (``unknowns``); by the links where a torque is not used.
        error: (k,) their standard errors, those of torque constants included; infinite where a
            torque is not used.
        faults: (k,) why torques are not used; None for those that are.
    """

    joint_names: tuple[str, ...]
    x: Array
    error: Array
    faults: tuple[TorqueFault | None, ...]

    @property
    def is_used(self) -> NDArray[np.bool_]:
        """Which torques (k,) are used."""
        return np.isfinite(self.error)

    def beside(self, mean: Array, deviation: Array) -> tuple[Array, Array]:
        """Return mean and deviation (k,) of the gain, known by the torques and as before.

        Args:
            mean, deviation: (k, u) of all unknowns, as known before.
        """
        before = mean[:, _GAIN]
        over_error = (deviation[:, _GAIN] / self.error) ** 2
        weight = over_error / (1.0 + over_error)
        narrower = (1.0 + over_error) ** -0.5
        return before + weight * (self.x - before), narrower * deviation[:, _GAIN]

    def weigh_into(self, solved: Solved) -> Solved:
        """Return what was found without torques, of unknowns and link errors, with them.

        The measurement is linear, and so is this (Kalman). The search would have to follow it along
        a valley in which gain and links change together, and sticking friction makes that rough.
        """
        u = solved.at.x.shape[1]
        shared = solved.covariance[:, :, _GAIN]
        weight = shared / (shared[:, [_GAIN]] + self.error[:, None] ** 2)
        change = weight * (self.x - solved.at.x[:, _GAIN])[:, None]
        at = replace(
            solved.at,
            x=np.clip(solved.at.x + change[:, :u], LEAST, MOST),
            links=solved.at.links + change[:, u:],
        )
        told = weight[:, :, None] * shared[:, None, :]
        return replace(solved, at=at, covariance=solved.covariance - told)

    @property
    def notes(self) -> Iterator[str]:
        """Yield a sentence on the torques that are used, and one on each fault of others."""
        errors = (DEVIATIONS[_GAIN] * self.error).tolist()
        gains = [
            f"{name} ± {percent(error)}"
            for name, error in zip(self.joint_names, errors)
        ]
        if np.any(self.is_used):
            yield (
                "recorded torques are one more measurement of gains, by themselves "
                f"{', '.join(compress(gains, self.is_used))}"
            )
        for fault, text in _FAULT_TEXTS.items():
            is_its = [own is fault for own in self.faults]
            if any(is_its):
                names = ", ".join(compress(self.joint_names, is_its))
                reason = with_option_names(text)
                yield f"recorded torques of {names} are not used: {reason}"


_FAULT_TEXTS = {
    TorqueFault.ZERO: "they do not change",
    TorqueFault.APART: (
        "they do not follow the position errors of their joints, as those of motors do; check "
        "signs and columns ({columns FILE} with lines such as 'torque.JOINT = -1 * TITLE')"
    ),
    TorqueFault.COMPUTED: (
        "they follow commands and positions, or the model's links, as numbers do that were "
        "computed; record motor currents"
    ),
    TorqueFault.OTHER_SIZE: (
        "the gains that they show, or those of other joints, contradict the model's links; check "
        "units ({columns FILE} with lines such as 'torque.JOINT = 0.001 * TITLE') and masses"
    ),
}


@dataclass(frozen=True)
class _Regression:
    """A torque by one signal, beside damping and an offset.

    Attributes:
        slope: of the torque by the signal.
        residual: (M,) of the torque [N m].
        squares: their sum.
        per_variance: variance of the slope, over that of a residual.
    """

    slope: float
    residual: Array
    squares: float
    per_variance: float


def gains_by_torque(
    robot: RobotModel,
    pieces: Sequence[Recording],
    moving: NDArray[np.int64],
    likely_gain: Array,
    x: Array,
    x_error: Array,
) -> TorqueGains | None:
    """Return the gains that recorded torques show; None where no piece has any.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands; the gain is that of the first one's setting.
        moving: (k,) numbers of the joints that move.
        likely_gain: (k,) gains of which ``x`` has a factor [N m/rad].
        x: (k, u) of their servos (``unknowns``), if the links are those of the file.
        x_error: (k, u) standard errors of ``x``.
    """
    measured = [
        piece[rows]
        for piece in pieces
        if piece.motor_torque is not None
        for rows in stretches(piece)
    ]
    if not measured:
        return None
    logs = _MotorLogs(robot, measured, pieces[0], moving)
    angles = logs.angles(x)
    shifted = []
    for name in IN_ANGLE:
        moved = x.copy()
        moved[:, column(name)] += x_error[:, column(name)]
        shifted.append(logs.angles(moved))
    scale = DEVIATIONS[_GAIN]
    links_error = np.hypot(x_error[:, _GAIN], LINK_ERROR / scale)
    gain = x[:, _GAIN].copy()
    error = np.full(len(moving), np.inf)
    faults: list[TorqueFault | None] = []
    for joint in range(len(moving)):
        slope, slope_error = logs.slope(joint, angles, shifted)
        fault = logs.fault(joint, slope, slope_error, angles)
        faults.append(fault)
        if fault is None:
            relative = np.hypot(slope_error / slope, usual_errors.TORQUE_FROM_CURRENT)
            gain[joint] = np.log(slope / likely_gain[joint]) / scale
            error[joint] = relative / scale
    if faults.count(TorqueFault.COMPUTED) >= MOST_COMPUTED * len(faults):
        # What computes most torques computes all.
        faults = [TorqueFault.COMPUTED] * len(faults)
    is_used = np.array([fault is None for fault in faults])
    off = np.where(is_used, np.abs(gain - x[:, _GAIN]), 0.0)
    unseen = SURE * np.hypot(error, links_error)
    is_off = off > unseen
    # A unit is that of all columns: what is wrong with one may be where no link shows it.
    is_other = is_off | (unseen > np.min(off[is_off], initial=np.inf))
    for joint in np.flatnonzero(is_other & is_used).tolist():
        faults[joint] = TorqueFault.OTHER_SIZE
    is_used &= ~is_other
    gain = np.where(is_used, gain, x[:, _GAIN])
    error = np.where(is_used, error, np.inf)
    names = tuple(robot.joint_names[joint] for joint in moving.tolist())
    return TorqueGains(names, gain, error, tuple(faults))


class _MotorLogs:
    """Torques of logs beside what may explain them.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands and torques.
        first: the piece of whose setting gains are.
        moving: (k,) numbers of the joints.
    """

    def __init__(
        self,
        robot: RobotModel,
        pieces: Sequence[Recording],
        first: Recording,
        moving: NDArray[np.int64],
    ) -> None:
        self._pieces = pieces
        self._first = first
        self._moving = moving
        self._edges = np.cumsum([len(piece) for piece in pieces])[:-1]
        raw = [_motor_torque(piece)[:, moving] for piece in pieces]
        self._raw = np.concatenate(raw)
        self._torque = np.concatenate(
            [low_pass(piece.time, tau) for piece, tau in zip(pieces, raw)]
        )
        dynamics = LinkDynamics(robot)
        speeds = []
        by_links = []
        for piece in pieces:
            q, qd, qdd = low_pass_motion(piece)
            thetas, _ = links_of(robot, piece.setting)
            speeds.append(qd[:, moving])
            by_links.append(dynamics.motion(q, qd, qdd).torque(thetas)[:, moving])
        self._speed = np.concatenate(speeds)
        self._by_links = np.concatenate(by_links)

    def angles(self, x: Array) -> Array:
        """Return the motors' torques over the gain (M, k) of servos x (k, u) [rad]."""
        angles = []
        limit, dead_zone, delay, lag = (
            numbers_at(x)[:, column(name)] for name in IN_ANGLE
        )
        for piece in self._pieces:
            scale = gain_of(piece.setting, self._first.setting)
            strength = strength_of(piece.setting, self._first.setting)
            goals = np.empty((len(piece), len(self._moving)))
            for k, late in enumerate((delay + lag).tolist()):
                at = np.searchsorted(piece.time, piece.time - late, side="right") - 1
                goals[:, k] = commands(piece)[np.maximum(at, 0), self._moving[k]]
            errors = goals - piece.q[:, self._moving]
            beyond = errors - np.clip(errors, -dead_zone, dead_zone)
            reach = limit * strength
            angle = np.clip(scale * beyond, -reach, reach)
            angles.append(low_pass(piece.time, angle))
        return np.concatenate(angles)

    def slope(
        self, joint: int, angles: Array, shifted: Sequence[Array]
    ) -> tuple[float, float]:
        """Return the slope of a joint's torque by its angle [N m/rad], and its standard error.

        Args:
            joint: its number among those that move.
            angles: (M, k) torques of all motors over the gain [rad].
            shifted: the same with one of the unknowns in it changed by its standard error.
        """
        tried = self._tried(joint, angles[:, joint])
        squares = np.array([regression.squares for regression in tried])
        slopes = np.array([regression.slope for regression in tried])
        best = int(np.argmin(squares))
        residual = tried[best].residual
        times = correlation_times(np.split(residual[:, None], self._edges))
        independent = max(len(residual) / float(times[0]), 1.0)
        noise = squares[best] / independent
        # What servos do otherwise explains as much of a torque.
        misfit = UNKNOWNS["gain"].misfit ** 2 * len(residual)
        otherwise = misfit * np.var(self._torque[:, joint])
        is_alike = squares <= squares[best] + otherwise + SURE**2 * noise
        variances = [
            noise * tried[best].per_variance,
            np.mean((slopes[is_alike] - slopes[best]) ** 2),
        ]
        for moved in shifted:
            also = self._regress(joint, moved[:, joint], LATE[best])
            variances.append((also.slope - slopes[best]) ** 2)
        return float(slopes[best]), float(np.sqrt(np.sum(variances)))

    def _tried(self, joint: int, signal: Array) -> list[_Regression]:
        """Return the regressions of a joint's torque on a signal (M,), one for each of ``LATE``."""
        return [self._regress(joint, signal, late) for late in LATE]

    def _least_squares(self, joint: int, signal: Array) -> float:
        """Return the least sum of squared residuals of these."""
        return min(regression.squares for regression in self._tried(joint, signal))

    def _late(self, signals: Array, delay: float, lag: float) -> Array:
        """Return signals (M, 2) some time later, or behind a low-pass of first order [s]."""
        from scipy.signal import lfilter

        late = []
        for piece, own in zip(self._pieces, np.split(signals, self._edges)):
            moved = interpolate(piece.time - delay, piece.time, own)
            follows = 1.0 / (1.0 + lag / sampling_period(piece.time))
            rest = (1.0 - follows) * moved[:1]
            smooth, _ = lfilter([follows], [1.0, follows - 1.0], moved, 0, zi=rest)
            late.append(smooth)
        return np.concatenate(late)

    def _regress(
        self, joint: int, signal: Array, late: tuple[float, float]
    ) -> _Regression:
        """Return the regression of a joint's torque on a signal (M,), late by one of ``LATE``."""
        signals = np.stack((signal, self._speed[:, joint]), axis=1)
        columns = np.column_stack((self._late(signals, *late), np.ones(len(signals))))
        torque = self._torque[:, joint]
        inverse = np.linalg.pinv(columns.T @ columns)
        solution = inverse @ (columns.T @ torque)
        residual = torque - columns @ solution
        squares = float(residual @ residual)
        return _Regression(float(solution[0]), residual, squares, float(inverse[0, 0]))

    def fault(
        self, joint: int, slope: float, slope_error: float, angles: Array
    ) -> TorqueFault | None:
        """Return what speaks against a joint's torque, whatever the size of the gain.

        Args:
            joint: its number among those that move.
            slope, slope_error: see ``slope``.
            angles: (M, k) torques of all motors over the gain [rad].
        """
        if not np.ptp(self._raw[:, joint]):
            return TorqueFault.ZERO
        if self._is_formula(joint):
            return TorqueFault.COMPUTED
        if not slope > SURE * slope_error:
            return TorqueFault.APART
        own = self._least_squares(joint, angles[:, joint])
        others = np.delete(angles, joint, axis=1).T
        if any(self._least_squares(joint, other) < own for other in others):
            return TorqueFault.APART
        if self._least_squares(joint, self._by_links[:, joint]) < own:
            return TorqueFault.COMPUTED
        return None

    def _is_formula(self, joint: int) -> bool:
        """Return whether a torque is proportional to the recorded position error, without noise."""
        number = self._moving[joint]
        errors = [(commands(piece) - piece.q)[:, number] for piece in self._pieces]
        error = np.concatenate(errors)
        columns = np.stack((error, np.ones(len(error))), axis=1)
        torque = self._raw[:, joint]
        residual = torque - columns @ np.linalg.lstsq(columns, torque, rcond=None)[0]
        return bool(np.std(residual) < EXACT_TORQUE * np.std(torque))


def _motor_torque(piece: Recording) -> Array:
    """Return the torques (N, n) that were recorded beside the commands of a piece [N m]."""
    assert piece.motor_torque is not None
    return piece.motor_torque

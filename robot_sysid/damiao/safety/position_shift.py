"""Search for a joint that is not where it says, from the torques during a motion.

A joint whose zero has moved, whose encoder drifts or whose gear slips has a position other than its
encoder reports, so that it and the joints nearer to the base need other torques than the model
expects. Other things change the torques too: wrong links, loads, friction, weak motors, a tilted
base. Each of them is an explanation of the mean torques tau of the windows of time so far,

    tau = model(q, qd, qdd) + X x + C c + noise,   x ~ N(0, 1),   c ~ a random walk from N(0, c0^2).

X has the torque of one standard deviation of a link's inertial parameters, of a load at the end and
of friction; all explanations share it. C is the explanation's own: a shift of one joint's position,
a torque in a single joint, and so on. A random walk has no shape: it finds a jump, a fast slip and
a slow drift alike, whenever they begin.

One Kalman filter per explanation predicts each window from the ones before it. What an explanation
gains is the sum of the log likelihoods of its predictions minus those of the model alone, X x; a
sum that falls below zero begins again at zero, because what is to be found may begin at any time
(Page, "Continuous inspection schemes", Biometrika 41, 1954). A shift is reported where it gains
much, and clearly more than anything else.

It is an estimator of its own beside the fit of ``estimate``, because it runs while the arm moves,
window by window within control cycles of 4 ms, and has to find what begins at any time. It shares
the columns of links (``LinkDynamics``) and the priors of links and friction (``estimate.links``,
``records.usual_errors``). Its other priors and its levels are its own: a missed shift costs an arm
and a false one a run, so that it decides at less evidence than what is asked of a finished log.

The doubt of a joint is the torque that friction alone may explain; torques are divided by it: they
are in doubts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    LinkDynamics,
    gravity_vector,
    other_links,
    tilt_axes,
)
from robot_sysid.estimate.links import LARGEST, link_factor
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.usual_errors import FADING, LARGEST_USUAL_LOSS, LINK, LOAD_LOSS

# Time over which signals are averaged [s]; a window that takes twice as long is discarded.
_WINDOW = 0.1
# An arm that is slower shows nothing: dry friction hides its load [rad/s].
_SLOWEST = 0.05
# Dry friction is rounded off below this speed [rad/s].
_TURN = 0.02
# Speed over which the friction of rest fades [rad/s], and what is unknown of the friction of a
# joint below it [doubts] (a judgement).
_REST_SPEED = 0.1
_REST = 0.3
# Friction that fades with speed, over dry friction.
_FADING = 0.01 * LOAD_LOSS * FADING
# Inertia of a rotor that no file knows [doubts s^2/rad] (a judgement).
_ROTOR = 0.1
# Offset of a joint's torque [doubts] (a judgement).
_OFFSET = 0.2
# Noise of a window's mean torque before any window, and least noise [doubts].
_FIRST_NOISE = 0.07
_LEAST_NOISE = 0.01
# Variance that a window's scatter adds to its noise, over the variance of that scatter: what
# happens within a window, as a blow does, makes three times as much noise in its mean.
_SCATTER = 9.0
# Number of windows over which the model's errors are correlated: a turn of a joint and back.
_CORRELATED = 5.0
# Share of a window in the noise so far; its least value lets earlier windows fade.
_FRESH = 0.05
# An outlier counts as so many times the variance of the noise.
_OUTLIER = 30.0

# Standard deviations at the beginning of a run, and of the changes within a second (judgements).
# Zeros are measured with a ruler, or are wrong [rad].
_ZERO = 0.02
_WRONG_ZERO = 0.3
# Change of a position that drifts or slips within a second [rad].
_DRIFT = 0.125
# A load at the end: mass [kg] and its distance from the last joint [m].
_LOAD_MASS = 3.0
_LOAD_REACH = 0.2
# Torque of a single joint, friction or not [doubts].
_SINGLE = 2.0
_SINGLE_CHANGE = 0.5
# Share of its torque that a motor does not make, and change of that.
_WEAK = 0.3
_WEAK_CHANGE = 0.15
# Angle of a tilted base [rad].
_TILT = 0.3

# Gain in log likelihood from which a shift is certain, and how much more that has to be than any
# other explanation gains (judgements): undisturbed runs do not come near, with such a lead.
_CERTAIN_GAIN = 8.0
_LEAD = 3.0
# A smaller shift is no fault [rad], nor is one that no joint's torque feels [doubts].
_LEAST_SHIFT = 0.06
_LEAST_FELT = 0.15


class _Window(NamedTuple):
    """Mean signals of a window of time for n joints.

    Attributes:
        duration: from the window before [s].
        columns: torque (n, k) of one standard deviation of each error x [doubts].
        residual: measured minus modelled torque (n,) [doubts].
        scatter: variance (n,) of the noise by scatter within the window and rest [doubts^2].
    """

    duration: float
    columns: Array
    residual: Array
    scatter: Array


class _Explanation:
    """A Kalman filter of the model's errors x and of one explanation's own unknowns c.

    Args:
        n_errors: number k of the model's errors.
        sizes: standard deviations (e,) of c at the beginning of a run.
        changes: standard deviations (e,) of the change of c within a second.

    Attributes:
        gain: log likelihood of the windows so far over that of the model alone, from zero on.
    """

    def __init__(self, n_errors: int, sizes: Array, changes: Array) -> None:
        self._n_errors = n_errors
        self._mean = np.zeros(n_errors + len(sizes))
        self._covariance = np.diag(np.append(np.ones(n_errors), sizes**2))
        self._growth = np.append(np.zeros(n_errors), changes**2)
        self.gain = 0.0
        # Squared error (n,) of the last prediction beyond what the filter expected [doubts^2].
        self.unexplained = np.empty(0)

    @property
    def unknowns(self) -> Array:
        """Estimate (e,) of the explanation's own unknowns c."""
        return self._mean[self._n_errors :]

    def update(self, window: _Window, own: Array, noise: Array) -> float:
        """Take in a window and return the log likelihood of its prediction.

        Args:
            window: the window's signals.
            own: torque (n, e) per unit of c [doubts].
            noise: variance (n,) of the noise, without the window's scatter [doubts^2].
        """
        columns = np.hstack([window.columns, own])
        diagonal = np.einsum("ii->i", self._covariance)
        diagonal += self._growth * window.duration
        innovation = window.residual - columns @ self._mean
        shared = columns @ self._covariance
        predicted = shared @ columns.T
        total = predicted + np.diag(_CORRELATED * noise + window.scatter)
        weighted = np.linalg.solve(total, np.column_stack([innovation, shared]))
        self._mean = self._mean + shared.T @ weighted[:, 0]
        covariance = self._covariance - shared.T @ weighted[:, 1:]
        # Rounding errors grow where it is not symmetric.
        self._covariance = 0.5 * (covariance + covariance.T)
        self.unexplained = innovation**2 - np.diag(predicted) - window.scatter
        return -0.5 * float(innovation @ weighted[:, 0] + np.linalg.slogdet(total)[1])


class PositionShift:
    """Finds a joint whose position is not the reported one, from the torques in a run's cycles.

    A window is evaluated in steps, in the control cycles of the next window, because a control
    cycle is too short for all of them.

    Args:
        robot: model of the arm with n joints.
        doubt: torque (n,) that friction alone may explain [N m].
    """

    def __init__(self, robot: RobotModel, doubt: Array) -> None:
        n = robot.n_joints
        self._thetas = robot.thetas
        self._needed_torque = ArmDynamics(robot)
        self._dynamics = LinkDynamics(robot)
        self._links = [*other_links(robot), n - 1]
        factor = link_factor(robot, self._links, 0.01 * LINK, LARGEST)
        # A load adds to mass and first moment of the last link.
        load = np.zeros((len(factor), 4))
        load[-10:-6] = _LOAD_MASS * np.diag([1.0, *[_LOAD_REACH] * 3])
        self._factor = np.column_stack([factor, load])
        self._n_load = load.shape[1]
        self._doubt = doubt
        gravity = gravity_vector(robot)
        turned = np.zeros((0, 3))
        if np.any(gravity):
            turned = np.cross(tilt_axes(gravity), gravity)
        self._tilts = [LinkDynamics(robot, vector) for vector in turned]
        # Time [s] and q, qd, tau (3, n) of the cycles of the present window.
        self._samples: list[tuple[float, Array]] = []
        # Remaining steps of the last window's evaluation.
        self._work: Iterator[None] = iter(())
        self._steps_per_cycle = 0
        self._finding: tuple[int, float] | None = None
        # Time of the last window [s], number of windows, and variance of the noise [doubts^2].
        self._last_time = np.nan
        self._n_windows = 0
        self._noise = np.full(n, _FIRST_NOISE**2)
        self._model_alone, *self._explanations = self._new_explanations()

    def _new_explanations(self) -> list[_Explanation]:
        """Return the filter of the model alone, and those of all explanations.

        Their order is that of ``_own_columns``: n zeros and n drifts, then what is no shift.
        """
        n = len(self._doubt)
        n_errors = self._factor.shape[1] + 6 * n
        rows: list[tuple[tuple[float, ...], tuple[float, ...]]] = [((), ())]
        rows += [((_WRONG_ZERO,), (0.0,))] * n
        rows += [((_ZERO,), (_DRIFT,))] * n
        rows += [((_SINGLE,) * 2, (_SINGLE_CHANGE,) * 2)] * n
        rows += [((_WEAK,), (_WEAK_CHANGE,))] * n
        rows += [((_WEAK,) * n, (_WEAK_CHANGE,) * n)]
        rows += [((0.0,) * self._n_load, (1.0,) * self._n_load)]
        rows += [((_TILT,) * len(self._tilts), (0.0,) * len(self._tilts))]
        return [
            _Explanation(n_errors, np.array(sizes), np.array(changes))
            for sizes, changes in rows
        ]

    def __call__(
        self, time: float, q: Array, qd: Array, tau: Array
    ) -> tuple[int, float] | None:
        """Add one control cycle; return the joint that is not where it says, or None.

        Once a joint has been found, every further call returns it.

        Args:
            time: time of the cycle [s]; a cycle with a NaN in any argument is left out.
            q: reported positions (n,) [rad].
            qd: reported velocities (n,) [rad/s].
            tau: commanded torques (n,) [N m].

        Returns:
            The joint's index and its position minus the reported one [rad], or None.
        """
        for _ in range(self._steps_per_cycle):
            next(self._work, None)
        sample = np.stack([q, qd, tau])
        if np.isfinite(time) and np.all(np.isfinite(sample)):
            self._samples.append((time, sample))
            duration = time - self._samples[0][0]
            if duration >= _WINDOW:
                window = self._samples
                self._samples = []
                if duration < 2.0 * _WINDOW and len(window) >= 3:
                    # Where cycles were skipped, unfinished steps of the last window are lost.
                    self._work = self._take_in(window)
                    # All steps take at most three quarters of the next window.
                    n_steps = len(self._explanations) + 6
                    self._steps_per_cycle = 1 + 4 * n_steps // (3 * len(window))
        return self._finding

    def _take_in(self, window: Sequence[tuple[float, Array]]) -> Iterator[None]:
        """Update all explanations with one window; each ``yield`` ends one step of the computation.

        ``window`` has the time [s] and q, qd, tau (3, n) of each cycle. ``_finding`` is set at the
        last step. An arm at rest shows nothing.
        """
        times, signals = map(np.array, zip(*window))
        since = times - np.mean(times)
        q, qd, tau = np.mean(signals, axis=0)
        if np.max(np.abs(qd)) <= _SLOWEST:
            return
        _, qdd, trend = np.tensordot(since, signals, 1) / (since @ since)
        # Distance of the torques from a straight line over time.
        distance = signals[:, 2] - tau - np.outer(since, trend)
        scatter = _SCATTER * np.mean(distance**2, axis=0) / self._doubt**2
        at_rest = _REST * np.exp(-((qd / _REST_SPEED) ** 2))
        state = q[None], qd[None], qdd[None]
        needed = self._needed_torque(Motion(np.zeros(1), *state))[0]
        motion = self._dynamics.motion(*state)
        yield
        slopes = motion.slopes(self._thetas, qd[None])[0]
        yield
        links = motion.columns(self._links)[0] @ self._factor
        yield
        still = q[None], np.zeros((1, len(q))), np.zeros((1, len(q)))
        tilts = [
            tilt.motion(*still).torque(self._thetas)[0] / self._doubt
            for tilt in self._tilts
        ]
        yield
        sign = np.tanh(qd / _TURN)
        # Dry and viscous friction, what the load adds to it, what fades with speed; rotors;
        # an offset, as of friction that is larger one way.
        friction = np.array(
            [
                self._doubt * sign,
                self._doubt * qd,
                0.01 * LOAD_LOSS * LARGEST_USUAL_LOSS * np.abs(needed) * sign,
                _FADING * self._doubt * sign * np.exp(-np.abs(qd) / _REST_SPEED),
                _ROTOR * self._doubt * qdd,
                _OFFSET * self._doubt,
            ]
        )
        columns = np.hstack([links, *map(np.diag, friction)]) / self._doubt[:, None]
        duration = 0.0
        if self._n_windows:
            duration = min(times[-1] - self._last_time, 1.0)
        self._last_time = times[-1]
        self._n_windows += 1
        residual = (tau - needed) / self._doubt
        taken = _Window(duration, columns, residual, scatter + at_rest**2)
        owns = self._own_columns(
            slopes / self._doubt[:, None], columns, needed / self._doubt, sign, tilts
        )
        noise = np.maximum(self._noise, _LEAST_NOISE**2)
        alone = self._model_alone.update(taken, np.zeros((len(q), 0)), noise)
        yield
        for explanation, own in zip(self._explanations, owns):
            gain = explanation.update(taken, own, noise) - alone
            explanation.gain = max(explanation.gain + gain, 0.0)
            yield
        self._update_noise(noise)
        self._finding = self._judge(
            np.max(np.abs(slopes / self._doubt[:, None]), axis=0)
        )

    def _own_columns(
        self,
        slopes: Array,
        columns: Array,
        needed: Array,
        sign: Array,
        tilts: Sequence[Array],
    ) -> Iterator[Array]:
        """Yield the torque (n, e) per unit of each explanation's own unknowns [doubts].

        Args:
            slopes: torque (n, n) of joint i per shift of joint j [doubts/rad].
            columns: those of the model's errors.
            needed: torque (n,) that the model needs [doubts].
            sign: sign (n,) of the joints' speeds.
            tilts: torques (n,) per angle of a tilted base [doubts/rad].
        """
        n = len(sign)
        # A zero that is wrong, then a position that drifts.
        for _ in range(2):
            for joint in range(n):
                yield slopes[:, joint, None]
        unit = np.eye(n)
        for joint in range(n):
            yield np.outer(unit[joint], [1.0, sign[joint]])
        for joint in range(n):
            yield unit[:, joint, None] * needed[joint]
        yield np.diag(needed)
        end = self._factor.shape[1]
        yield columns[:, end - self._n_load : end]
        yield np.reshape(tilts, (len(tilts), n)).T

    def _update_noise(self, noise: Array) -> None:
        """Update the variance of the noise by the errors of what explains the torques best.

        ``noise`` (n,) is the variance that the filters were given [doubts^2]. By the errors of the
        model alone, a slow drift would count as noise and never be found.
        """
        best = max(self._explanations, key=lambda explanation: explanation.gain)
        if best.gain == 0.0:
            best = self._model_alone
        unexplained = np.clip(best.unexplained, 0.0, _OUTLIER * noise)
        share = max(_FRESH, 1.0 / (2.0 + self._n_windows))
        self._noise += share * (unexplained - self._noise)

    def _judge(self, felt: Array) -> tuple[int, float] | None:
        """Return the index of the joint whose position is shifted and the shift [rad], or None.

        ``felt`` (n,) is the largest torque that a joint feels per shift of each one [doubts/rad].
        """
        n = len(self._doubt)
        gains = np.array([explanation.gain for explanation in self._explanations])
        best = int(np.argmax(gains[: 2 * n]))
        joint = best % n
        is_rival = np.arange(len(gains)) % n != joint
        is_rival[2 * n :] = True
        lead = gains[best] - np.max(gains[is_rival])
        shift = float(self._explanations[best].unknowns[0])
        is_sure = gains[best] > _CERTAIN_GAIN and lead > _LEAD
        if (
            is_sure
            and abs(shift) > _LEAST_SHIFT
            and abs(shift) * felt[joint] > _LEAST_FELT
        ):
            return joint, shift
        return None

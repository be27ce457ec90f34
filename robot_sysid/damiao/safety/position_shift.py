"""Search for a joint that is not where it says, from the torques during a motion.

A joint whose zero has moved, or whose gear slips, has a position other than its encoder reports, so
that it and the joints nearer to the base need other torques than the model expects. Wrong inertial
parameters of the model change the torques too, so the mean torques tau of each window of time are
modelled as

    tau = model(q, qd, qdd) + X x + C c + noise,   x, c ~ N(0, 1),

where a column of X is the torque of one standard deviation of a link's inertial parameters, of a
load at the end or of friction, and C that of one change: a shift of a joint's position, a load
that is picked up, a force at the end, a motor that makes only a share of its torque, a torque in a
single joint, such as friction. A change is there from the beginning, or began in one of the last
windows. With M = W - W X P X' W, W the weights of
all windows and P the covariance of x, the log likelihood ratio of a change against none is

    a' (1 + B)^-1 a / 2 - log det(1 + B) / 2,   a = C' M (tau - model),   B = C' M C

(Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of
jumps in linear systems", IEEE Transactions on Automatic Control 21(1), 1976). A shift is reported
where its ratio is large, and clearly larger than that of any other change.

The doubt of a joint is the torque that friction alone may explain; torques are divided by it: they
are in doubts. Columns of changes have the order: n shifts, the load's mass and first moment (4),
the force at the end (3), n weak motors, n torques in single joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics, other_links
from robot_sysid.estimate.links import LARGEST, link_factor
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.usual_errors import LINK

# Time over which signals are averaged [s]; a window that takes twice as long is discarded.
_WINDOW = 0.1
# Prior standard deviation of a shift [rad] (a judgement).
_SHIFT = 0.3
# Number of last windows in which a change may have begun.
_ONSETS = 14
_AGES = np.arange(_ONSETS + 1) - np.arange(_ONSETS - 1)[:, None]
# Share (onsets, windows) of its size that a change has in each of the last windows: it grows within
# a second. The first window stands for all that are older, the first onset is before the run.
_GROWTH = np.clip(_WINDOW * (_AGES + 0.5), 0.0, 1.0) * (_AGES >= 0)
_GROWTH[0] = 1.0
# Log likelihood ratio from which a change is certain (a judgement).
_SURE = 12.0


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
        # A load at the end adds to mass and first moment of the last link; the prior standard
        # deviations of an unknown one are 3 kg, 0.2 m from the end (a judgement).
        load = np.zeros((len(factor), 4))
        load[-10:-6] = 3.0 * np.diag([1.0, 0.2, 0.2, 0.2])
        self._factor = np.column_stack([factor, load])
        self._doubt = doubt
        # Time [s] and q, qd, tau (3, n) of the cycles of the present window.
        self._samples: list[tuple[float, Array]] = []
        # Remaining steps of the last window's evaluation.
        self._work: Iterator[None] = iter(())
        self._steps_per_cycle = 0
        self._finding: tuple[int, float] | None = None
        # Whether a change that began during the run was certain.
        self._has_changed = False
        self._n_windows = 0
        # Mean and covariance of the model's errors x, and variance of the noise [doubts^2].
        n_errors = self._factor.shape[1] + 2 * n
        self._mean = np.zeros(n_errors)
        self._covariance = np.eye(n_errors)
        self._noise = np.full(n, 0.15**2)
        # X' W C, y' W C and C' W C of each window.
        n_changes = 3 * n + 7
        self._sums = np.zeros((1 + _ONSETS, n_errors + 1 + n_changes, n_changes))

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
                    # A window has less than 20 steps, which take half of the next window.
                    self._steps_per_cycle = 1 + 40 // len(window)
        return self._finding

    def _take_in(self, window: Sequence[tuple[float, Array]]) -> Iterator[None]:
        """Update all estimates with one window; each ``yield`` ends one step of the computation.

        ``window`` has the time [s] and q, qd, tau (3, n) of each cycle. ``_finding`` is set at the
        last step. An arm at rest shows nothing.
        """
        times, signals = map(np.array, zip(*window))
        since = times - np.mean(times)
        q, qd, tau = np.mean(signals, axis=0)
        # Dry friction hides the load of an arm that is slower [rad/s].
        if np.max(np.abs(qd)) <= 0.05:
            return
        _, qdd, trend = np.tensordot(since, signals, 1) / (since @ since)
        # Distance of the torques from a straight line over time.
        distance = signals[:, 2] - tau - np.outer(since, trend)
        scatter = np.mean(distance**2, axis=0) / self._doubt**2
        state = q[None], qd[None], qdd[None]
        needed = self._needed_torque(Motion(np.zeros(1), *state))[0]
        motion = self._dynamics.motion(*state)
        yield
        slopes = motion.slopes(self._thetas, qd[None])[0]
        yield
        columns = motion.columns(self._links)[0] @ self._factor
        yield
        # A force at the end does work with the linear velocity (rows 3 to 5) of the last link.
        *_, twists = motion.jacobians()
        load = columns[:, -4:]
        # Dry friction is rounded off below 0.02 rad/s.
        friction = np.diag(self._doubt * np.tanh(qd / 0.02)), np.diag(self._doubt * qd)
        errors = np.hstack([columns, *friction]) / self._doubt[:, None]
        # Prior standard deviations (judgements) of a shift, of a load that is picked up over that
        # of an unknown load, of a force [N], of the share of its torque that a motor lacks, of a
        # torque in a single joint [doubts].
        changes = np.hstack(
            [
                _SHIFT * slopes,
                1.5 * load,
                20.0 * twists[:, 3:, 0],
                0.5 * np.diag(needed),
                0.5 * np.diag(self._doubt),
            ]
        )
        residual = (tau - needed) / self._doubt
        self._update(errors, changes / self._doubt[:, None], residual, 9.0 * scatter)
        yield
        # The first windows show how well the model fits.
        if self._n_windows < 15:
            return
        estimates = []
        for growth in _GROWTH:
            estimates.append(self._estimate(growth))
            yield
        ratios, sizes, errors = np.swapaxes(estimates, 0, 1)
        self._finding = self._judge(
            ratios, sizes, errors, slopes / self._doubt[:, None]
        )

    def _update(
        self, errors: Array, changes: Array, residual: Array, scattered: Array
    ) -> None:
        """Update the model's errors x, the noise and the sums.

        Args:
            errors: torque (n, k) per standard deviation of each of k errors x [doubts].
            changes: torque (n, c) per prior standard deviation of c changes [doubts].
            residual: measured minus modelled torque (n,) [doubts].
            scattered: variance (n,) of the noise by scatter within the window [doubts^2].
        """
        # Model errors of about five windows are correlated.
        noise = np.maximum(self._noise, 0.03**2)
        variance = 5.0 * noise + scattered
        innovation = residual - errors @ self._mean
        shared = errors @ self._covariance
        predicted = shared @ errors.T
        gain = np.linalg.solve(predicted + np.diag(variance), shared).T
        self._mean = self._mean + gain @ innovation
        self._covariance = self._covariance - gain @ shared
        # An outlier counts as 30 times the variance so far.
        unexplained = innovation**2 - np.diag(predicted) - scattered
        unexplained = np.clip(unexplained, 0.0, 30.0 * noise)
        # Earlier windows count less and less, and the first ones are no proof.
        self._n_windows += 1
        self._noise += max(0.05, 1.0 / (2.0 + self._n_windows)) * (
            unexplained - self._noise
        )
        weighted = changes / variance[:, None]
        sums = np.vstack([errors.T, residual, changes.T]) @ weighted
        older = self._sums[0] + self._sums[1]
        self._sums = np.array([older, *self._sums[2:], sums])

    def _estimate(self, growth: Array) -> tuple[Array, ...]:
        """Return log likelihood ratio, size and standard error of each of c changes, (c,) each.

        Size and error are in prior standard deviations; ``growth`` (windows,) is a row of
        ``_GROWTH``. The ratios of load and force are those of all their columns together.
        """
        n = len(self._doubt)
        n_errors = len(self._mean)
        sums = np.tensordot(growth, self._sums[:, : n_errors + 1], 1)
        information = np.tensordot(growth**2, self._sums[:, n_errors + 1 :], 1)
        # What the model's errors explain is taken out.
        score = sums[-1] - self._mean @ sums[:-1]
        information -= sums[:-1].T @ self._covariance @ sums[:-1]
        information += np.eye(len(score))
        variance = 1.0 / np.diag(information)
        ratios = 0.5 * (score**2 * variance + np.log(variance))
        for columns in (slice(n, n + 4), slice(n + 4, n + 7)):
            block = information[columns, columns]
            gain = score[columns] @ np.linalg.solve(block, score[columns])
            ratios[columns] = 0.5 * (gain - np.linalg.slogdet(block)[1])
        return ratios, score * variance, np.sqrt(variance)

    def _judge(
        self, ratios: Array, sizes: Array, errors: Array, slopes: Array
    ) -> tuple[int, float] | None:
        """Return the index of the joint whose position is shifted and the shift [rad], or None.

        The first arguments are those of ``_estimate`` (onsets, c); ``slopes`` (n, n) are the
        torques of joint i per shift of joint j [doubts/rad].
        """
        n = len(slopes)
        has_changed = np.max(ratios[1]) > _SURE
        if self._has_changed:
            # A change has been found during the run, so none is attributed to the time before it.
            ratios[0] = 0.0
        onset, joint = divmod(int(np.argmax(ratios[:, :n])), n)
        best = ratios[onset, joint]
        # Where the noise is underestimated, all log likelihood ratios are too large by a factor.
        other = np.max(np.delete(ratios, joint, axis=1))
        shift = _SHIFT * sizes[onset, joint]
        # People measure zeros with a ruler.
        least = 0.08 + INTERVAL * _SHIFT * errors[onset, joint]
        is_felt = abs(shift) * np.max(np.abs(slopes[:, joint])) > 0.3
        is_sure = best > _SURE and other < 0.55 * best
        if is_sure and is_felt and abs(shift) > least:
            return joint, float(shift)
        self._has_changed |= bool(has_changed)
        return None

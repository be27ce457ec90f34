"""Detection of a joint whose zero has moved, from the torques during a motion.

A joint whose zero has moved, or whose gear slips, has a position other than its encoder reports, so
that it and the joints nearer to the base need other torques than the model expects. Wrong inertial
parameters of the model change the torques too, so the mean torques tau of each window of time are
modelled as

    tau = model(q, qd, qdd) + X x + noise,   x ~ N(0, 1),

where a column of X is the torque of one standard deviation of a link's inertial parameters, of a
load at the end or of friction. x is estimated recursively, by a Kalman filter of a nearly
constant state. A change that began in some window adds columns C times an unknown size. The
filter turns C into innovations C~ as it turns the torques into innovations e with covariance S, so
that the log likelihood ratio of the change against no change is

    a^T (1 + B)^-1 a / 2 - log det(1 + B) / 2,   a = sum C~^T S^-1 e,   B = sum C~^T S^-1 C~,

over the windows since (Willsky and Jones, "A generalized likelihood ratio approach to the detection
and estimation of jumps in linear systems", IEEE Transactions on Automatic Control 21(1), 1976).
Changes are moved zeros, a load that is picked up, a force at the end, motors that make only a share
of their torque, and torques in single joints, such as friction. A moved zero is reported where its
ratio is large, and clearly larger than that of any other change.

The doubt of a joint is the torque that friction alone may explain; torques are divided by it: they
are in doubts. An onset is a window in which a change may have begun. Columns of changes have the
order: n moved zeros, the load's mass and first moment (4), the force at the end (3), n weak motors,
n torques in single joints. The model's errors x have the order: links, load, dry friction (n),
viscous friction (n).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics, other_links
from robot_sysid.estimate.links import LARGEST, link_factor
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.usual_errors import LINK

# Time over which signals are averaged [s]; a window that takes twice as long is discarded.
_WINDOW = 0.1
# Prior standard deviation of a moved zero [rad] (a judgement).
_SHIFT = 0.3
# Number of last windows in which a change may have begun.
_ONSETS = 14
_SLIPS = (
    "has come about {:.1f} rad off the angle that it reports, as the torques of this motion say: "
    "its gear slips"
)
_MOVED = (
    "stands about {:.1f} rad off the angle that it reports, as the torques of this motion say: its "
    "zero has moved since its map was made; look at its mounting and make the map again: see "
    "'motors map'"
)


class MovedZeroCheck:
    """Finds a joint whose position is not the reported one, from the torques in a run's cycles.

    A window is evaluated in steps, two in each control cycle of the next window, because a control
    cycle is too short for all of them.

    Args:
        robot: model of the arm with n joints.
        doubt: torque (n,) that friction alone may explain [N m].
    """

    def __init__(self, robot: RobotModel, doubt: Array) -> None:
        n = robot.n_joints
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
        self._finding: tuple[int, str] | None = None
        # Whether a change that began during the run was certain.
        self._has_changed = False
        # Number of windows that were evaluated.
        self._windows = 0
        # Mean and covariance of the model's errors x.
        n_errors = self._factor.shape[1] + 2 * n
        self._mean = np.zeros(n_errors)
        self._covariance = np.eye(n_errors)
        # Weighted sum of squared noise (n,) [doubts^2] and of its weights: at the beginning two
        # windows with a standard deviation of 0.15 are assumed.
        self._weight = 2.0
        self._squares = np.full(n, self._weight * 0.15**2)
        # Columns of each change: of one parameter, but for the load and the force.
        sizes = [1] * n + [4, 3] + [1] * (2 * n)
        self._changes = np.split(np.arange(3 * n + 7), np.cumsum(sizes)[:-1])
        # Arrays by onset: index 0 is a change before the run, the others are a ring buffer of the
        # last windows. First the time of the begin [s] and the number of windows since.
        n_onsets = 1 + _ONSETS
        self._begin = np.zeros(n_onsets)
        self._age = np.zeros(n_onsets, int)
        # How much each change, at its prior standard deviation, has shifted the mean of x.
        self._state_shift = np.zeros((n_onsets, n_errors, 3 * n + 7))
        # a and B of the module's text.
        self._score = np.zeros((n_onsets, 3 * n + 7))
        self._information = np.zeros((n_onsets, 3 * n + 7, 3 * n + 7))

    def __call__(
        self, time: float, q: Array, qd: Array, tau: Array
    ) -> tuple[int, str] | None:
        """Add one control cycle; return the joint whose zero has moved, or None.

        Once a joint has been found, every further call returns it.

        Args:
            time: time of the cycle [s]; a cycle with a NaN in any argument is left out.
            q: reported positions (n,) [rad].
            qd: reported velocities (n,) [rad/s].
            tau: commanded torques (n,) [N m].

        Returns:
            The joint's index and a sentence about it without its name, or None.
        """
        # A window's six steps, in the fewest cycles that a window has.
        for _ in range(2):
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
        return self._finding

    def _take_in(self, window: Sequence[tuple[float, Array]]) -> Iterator[None]:
        """Update all estimates with one window; each ``yield`` ends one step of the computation.

        ``window`` has the time [s] and q, qd, tau (3, n) of each cycle. ``_finding`` is set at the
        last step. An arm at rest shows nothing.
        """
        times, signals = map(np.array, zip(*window))
        time = np.mean(times)
        since = times - time
        q, qd, tau = np.mean(signals, axis=0)
        # Dry friction hides the load of an arm that is slower [rad/s].
        if np.max(np.abs(qd)) <= 0.05:
            return
        _, qdd, trend = np.tensordot(since, signals, 1) / (since @ since)
        # Distance of the torques from a straight line over time.
        distance = signals[:, 2] - tau - np.outer(since, trend)
        scatter = np.sqrt(np.mean(distance**2, axis=0))
        # The mean positions, then with each joint shifted by plus, then by minus the difference.
        n = len(q)
        difference = 0.01
        step = difference * np.eye(n)
        poses = q + np.vstack([np.zeros(n), step, -step])
        still = np.zeros(len(poses))
        torques = self._needed_torque(
            Motion(still, poses, qd + 0.0 * poses, qdd + 0.0 * poses)
        )
        slopes = (torques[1 : n + 1] - torques[n + 1 :]).T / (2.0 * difference)
        slopes /= self._doubt[:, None]
        yield
        motion = self._dynamics.motion(q[None], qd[None], qdd[None])
        columns = motion.columns(self._links)[0]
        yield
        # A force at the end does work with the linear velocity (rows 3 to 5) of the last link.
        *_, twists = motion.jacobians()
        errors = np.hstack([columns @ self._factor, twists[:, 3:, 0]])
        errors /= self._doubt[:, None]
        links, load, force = np.split(errors, [-7, -3], axis=1)
        # Dry friction is rounded off below 0.02 rad/s.
        friction = np.diag(np.tanh(qd / 0.02)), np.diag(qd)
        errors = np.hstack([links, load, *friction])
        needed = np.diag(torques[0] / self._doubt)
        # Prior standard deviations (judgements) of a moved zero, of a load that is picked up over
        # that of an unknown load, of a force [N], of the share of its torque that a motor lacks, of
        # a torque in a single joint [doubts].
        changes = np.hstack(
            [_SHIFT * slopes, 1.5 * load, 20.0 * force]
            + [0.5 * needed, 0.5 * np.eye(n)]
        )
        residual = (tau - torques[0]) / self._doubt
        yield
        self._update(time, errors, changes, residual, scatter / self._doubt)
        yield
        self._finding = self._finding or self._judge(time, slopes)

    def _update(
        self,
        time: float,
        errors: Array,
        changes: Array,
        residual: Array,
        scatter: Array,
    ) -> None:
        """Update the model's errors x, the noise, and score and information of each change.

        The oldest onset makes room for this window.

        Args:
            time: mean time of the window [s].
            errors: torque (n, k) per standard deviation of each of k errors x [doubts].
            changes: torque (n, c) per prior standard deviation of c columns of changes [doubts].
            residual: measured minus modelled torque (n,) [doubts].
            scatter: rms scatter (n,) of the torque within the window [doubts].
        """
        # Scatter within a window, by a blow for instance, makes three times as much noise.
        scattered = (3.0 * scatter) ** 2
        noise = np.maximum(self._squares / self._weight, 0.03**2)
        innovation = residual - errors @ self._mean
        shared = errors @ self._covariance
        predicted = shared @ errors.T
        # Model errors of about five windows are correlated.
        inverse = np.linalg.inv(predicted + np.diag(5.0 * noise + scattered))
        gain = shared.T @ inverse
        self._mean = self._mean + gain @ innovation
        # In each window, because motors become warm.
        drift = 1e-6 * np.eye(len(self._mean))
        self._covariance = self._covariance - gain @ shared + drift
        unexplained = innovation**2 - np.diag(predicted) - scattered
        # An outlier counts as 30 times the variance so far.
        noise_squares = np.clip(unexplained, 0.0, 30.0 * noise)
        # Earlier windows count less and less.
        self._squares = 0.95 * self._squares + noise_squares
        self._weight = 0.95 * self._weight + 1.0
        newest = 1 + self._windows % _ONSETS
        self._windows += 1
        self._begin[newest] = time - 0.5 * _WINDOW
        self._age += 1
        for values in (self._age, self._state_shift, self._score, self._information):
            values[newest] = 0
        # Torque (onsets, n, c), then what the filter lets pass of it into the innovation.
        grown = self._growth(time)[:, None, None] * changes
        passed = grown - errors @ self._state_shift
        weighted = inverse @ passed
        self._score += innovation @ weighted
        self._information += np.swapaxes(passed, 1, 2) @ weighted
        self._state_shift += gain @ passed

    def _growth(self, time: float) -> Array:
        """Return the share (onsets,) of its full size that a change has at ``time`` [s].

        It grows within a second; a change before the run (index 0) has its full size.
        """
        grown = np.minimum(time - self._begin, 1.0)
        grown[0] = 1.0
        return grown

    def _gains(self) -> Array:
        """Return the log likelihood ratio (onsets, changes) of each change against no change."""
        gains = []
        for columns in self._changes:
            score = self._score[:, columns]
            information = self._information[:, columns][:, :, columns]
            information = information + np.eye(len(columns))
            explained = np.linalg.solve(information, score[:, :, None])[:, :, 0]
            log_determinant = np.linalg.slogdet(information)[1]
            gains.append(np.sum(score * explained, axis=1) - log_determinant)
        return 0.5 * np.transpose(gains)

    def _judge(self, time: float, slopes: Array) -> tuple[int, str] | None:
        """Return the index of the joint whose zero has moved and a sentence; None unless certain.

        Without a moved zero, ``_has_changed`` is set where any change that began at the oldest
        onset is certain.

        Args:
            time: mean time of the window [s].
            slopes: torque (n, n) of joint i per shift of joint j's zero [doubts/rad].
        """
        # These windows show how well the model fits.
        if self._windows < 15:
            return None
        n = len(slopes)
        gains = self._gains()
        # A moved zero is judged from three windows on.
        gains[1:][self._age[1:] < 3, :n] = 0.0
        if self._has_changed:
            # A change has been found during the run, so none is attributed to the time before it.
            gains[0] = 0.0
        best = np.max(gains, axis=0)
        joint = int(np.argmax(best[:n]))
        onset = np.argmax(gains[:, joint])
        # The shift's mean and standard error follow from a, B and the prior N(0, unit^2).
        variance = 1.0 / (1.0 + self._information[onset, joint, joint])
        unit = _SHIFT * self._growth(time)[onset]
        shift = unit * abs(self._score[onset, joint]) * variance
        # Log likelihood ratio against no change from which a change is certain.
        margin = 12.0
        is_sure = best[joint] > margin
        # Where the noise is underestimated, all log likelihood ratios are too large by a factor.
        others = np.max(np.delete(best, joint))
        is_sure &= others < min(best[joint] - 8.0, 0.55 * best[joint])
        # Large enough by two standard errors; people measure zeros with a ruler.
        is_sure &= shift > 0.08 + 2.0 * unit * np.sqrt(variance)
        is_sure &= shift * np.max(np.abs(slopes[:, joint])) > 0.3
        if is_sure:
            return joint, (_SLIPS if onset > 0 else _MOVED).format(shift)
        # The onset in whose place the next window comes.
        oldest = 1 + self._windows % _ONSETS
        self._has_changed |= bool(np.max(gains[oldest]) > margin)
        return None

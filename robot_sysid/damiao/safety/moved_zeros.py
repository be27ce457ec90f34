"""Detection of a joint whose zero has moved, from the torques during a motion.

A joint whose zero has moved, or whose gear slips, has a position other than its encoder reports, so
that it and the joints nearer to the base need other torques than the model expects. Wrong inertial
parameters of the model change the torques too, so the mean torques tau of each window of time are
modelled as

    tau = model(q, qd, qdd) + X x + noise,   x ~ N(0, 1),

where a column of X is the torque of one standard deviation of a link's inertial parameters, of a
load at the end or of friction. x is estimated recursively, by a Kalman filter of a nearly
constant state. A change that began in some window adds a column c times an unknown size. The
filter turns c into innovations c~ as it turns the torques into innovations e with covariance S, so
that the log likelihood ratio of the change against no change is

    a^2 / (2 (1 + b)) - log(1 + b) / 2,   a = sum c~^T S^-1 e,   b = sum c~^T S^-1 c~,

over the windows since (Willsky and Jones, "A generalized likelihood ratio approach to the detection
and estimation of jumps in linear systems", IEEE Transactions on Automatic Control 21(1), 1976).
Changes are moved zeros, a load that is picked up, a force at the end, motors that make only a share
of their torque, and torques in single joints, such as friction. A moved zero is reported where its
ratio is large, and clearly larger than that of any other change.

The doubt of a joint is the torque that friction alone may explain; torques are divided by it: they
are in doubts. An onset is a window in which a change may have begun. Arrays over changes have the
order: n moved zeros, n weak motors, the load's mass and first moment (4), the force at the end (3),
n torques in single joints. Arrays over the model's errors x have the order: links, load, dry
friction (n), viscous friction (n).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.references import torque_doubt
from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.inverse_dynamics import (
    BeyondRigidBodies,
    LinkDynamics,
    LinksMotion,
)
from robot_sysid.estimate.links import model_link_factor
from robot_sysid.records import Array, RobotModel
from robot_sysid.regressor import wrench_regressor

_WINDOW = 0.1
"""Time over which signals are averaged [s]; a window that takes twice as long is discarded."""
_LEAST_SAMPLES = 3
"""Least number of control cycles in a window."""
_MOVING = 0.05
"""Velocity of the fastest joint [rad/s] below which dry friction hides the load of the arm."""
_LEAST_WINDOWS = 15
"""Number of windows with motion, which show how well the model fits, before anything is judged."""
_LINKS = 0.3
"""Prior standard deviation of the links of a guessed model, relative (a judgement)."""
_LOAD = 3.0
"""Prior standard deviation of an unknown load at the end [kg] (a judgement)."""
_LEVER = 0.2
"""Prior standard deviation of the load's distance from the end [m] (a judgement)."""
_SHIFT = 0.3
"""Prior standard deviation of a moved zero [rad] (a judgement)."""
_TORQUE = 0.5
"""Prior standard deviation of a change of torque in a single joint [doubts] (a judgement)."""
_SHARE = 0.5
"""Prior standard deviation of the share of its torque that a motor lacks (a judgement)."""
_NEW_LOAD = 1.5
"""Prior standard deviation of a load that is picked up, relative to ``_LOAD`` (a judgement)."""
_FORCE = 20.0
"""Prior standard deviation of a force at the end [N] (a judgement)."""
_NOISE = 0.15
"""Standard deviation of the noise that is assumed at the beginning [doubts]."""
_NOISE_WINDOWS = 2.0
"""Weight of this assumption, in windows."""
_LEAST_NOISE = 0.03
"""Least standard deviation of the noise [doubts]."""
_REMEMBER = 0.95
"""Factor per window by which the weight of earlier windows in the noise estimate decays."""
_OUTLIER = 30.0
"""Largest square of a window in the noise estimate, in units of the variance so far."""
_SCATTER = 3.0
"""Standard deviation of the noise that is added for scatter of the torque within a window (by a
blow, for instance), relative to the rms scatter."""
_DRIFT = 1e-6
"""Variance that x gains in each window, because motors become warm."""
_ALIKE = 5.0
"""Factor of the noise variance: model errors of about this many windows are correlated."""
_ONSETS = 14
"""Number of last windows in which a change may have begun."""
_LEAST_AGE = 3
"""Number of windows after its begin from which a moved zero is judged."""
_GROWTH = 1.0
"""Time in which a change grows to its full size [s]."""
_MARGIN = 12.0
"""Least log likelihood ratio of a moved zero against no change."""
_APART = 8.0
"""Least difference of a moved zero's log likelihood ratio from that of any other change."""
_OTHERS = 0.55
"""Largest ratio of another change's log likelihood ratio to the moved zero's.

Where the noise is underestimated, all log likelihood ratios are too large by a factor.
"""
_LEAST_SHIFT = 0.08
"""Least shift of a zero that is reported [rad]; people measure zeros with a ruler."""
_LEAST_TORQUE = 0.3
"""Least torque of a shift that is reported [doubts]."""
_DIFFERENCE = 0.01
"""Step of central differences by position [rad]."""
_OTHER_STEPS = 8
"""Number of steps in which a window is computed, besides one for each link."""
_LOAD_PARAMETERS = 4
"""Number of parameters of a load at the end: mass and first moment."""
_END_PARAMETERS = _LOAD_PARAMETERS + 3
"""Number of parameters of changes at the end: load and force."""


class MovedZeroCheck:
    """Finds a joint whose position is not the reported one, from the torques in a run's cycles.

    A window is evaluated in small steps, one or a few in each control cycle of the next window,
    because a control cycle is too short for all of them.

    Args:
        robot: model of the arm with n joints.
        joints: joints of the arm with their motors, base to terminal.
    """

    def __init__(self, robot: RobotModel, joints: Sequence[DamiaoJoint]) -> None:
        n = robot.n_joints
        self._robot = robot
        self._dynamics = LinkDynamics(robot)
        self._beyond = BeyondRigidBodies(robot)
        self._links = [*other_links(robot), n - 1]
        factor = model_link_factor(robot, self._links, _LINKS)
        # A load at the end adds to mass and first moment of the last link.
        load = np.zeros((len(factor), _LOAD_PARAMETERS))
        load[-10:-6] = _LOAD * np.diag([1.0, _LEVER, _LEVER, _LEVER])
        self._factor = np.column_stack([factor, load])
        self._doubt = torque_doubt(joints) + robot.friction.largest_dry
        # Time [s] and q, qd, tau (3, n) of the cycles of the present window.
        self._samples: list[tuple[float, Array]] = []
        # Remaining steps of the last window's evaluation, and how many are done per cycle.
        self._work: Iterator[None] = iter(())
        self._steps_per_cycle = 1
        self._finding: tuple[int, str] | None = None
        # Whether a change that began during the run was certain.
        self._has_changed = False
        # Number of windows that were evaluated.
        self._windows = 0
        n_errors = self._factor.shape[1] + 2 * n
        # Mean and covariance of the model's errors x.
        self._mean = np.zeros(n_errors)
        self._covariance = np.eye(n_errors)
        # Weighted sum of squared noise (n,) [doubts^2] and of its weights.
        self._squares = np.full(n, _NOISE_WINDOWS * _NOISE**2)
        self._weight = _NOISE_WINDOWS
        # The load and the force at the end among the changes.
        self._end = slice(2 * n, 2 * n + _END_PARAMETERS)
        # Arrays by onset: index 0 is a change before the run, the others are a ring buffer of the
        # last windows.
        n_onsets = 1 + _ONSETS
        n_changes = 3 * n + _END_PARAMETERS
        # Time of the begin [s] and number of windows since.
        self._begin = np.zeros(n_onsets)
        self._age = np.zeros(n_onsets, int)
        # How much each change, at its prior standard deviation, has shifted the mean of x.
        self._state_shift = np.zeros((n_onsets, n_errors, n_changes))
        # a and b of the module's text for each change; b as a matrix for load and force together.
        self._score = np.zeros((n_onsets, n_changes))
        self._information = np.zeros((n_onsets, n_changes))
        self._end_information = np.zeros((n_onsets, _END_PARAMETERS, _END_PARAMETERS))

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
        for _ in range(self._steps_per_cycle):
            next(self._work, None)
        sample = np.stack([q, qd, tau])
        if not (np.isfinite(time) and np.all(np.isfinite(sample))):
            return self._finding
        self._samples.append((time, sample))
        duration = time - self._samples[0][0]
        if duration < _WINDOW:
            return self._finding
        window = self._samples
        self._samples = []
        if duration < 2.0 * _WINDOW and len(window) >= _LEAST_SAMPLES:
            average = _average(window)
            if np.max(np.abs(average.qd)) > _MOVING:
                # Where cycles were skipped, unfinished steps of the last window are lost.
                self._work = self._take_in(average)
                n_steps = self._robot.n_joints + _OTHER_STEPS
                self._steps_per_cycle = 1 + n_steps // len(window)
        return self._finding

    def _take_in(self, window: _Window) -> Iterator[None]:
        """Update all estimates with one window; each ``yield`` ends one step of the computation.

        ``_finding`` is set at the last step. Torques are computed at 2 n + 1 poses: the mean
        positions, then with each joint shifted by plus, then by minus ``_DIFFERENCE``.
        """
        robot = self._robot
        time, q, qd, qdd, tau, scatter = window
        n = robot.n_joints
        step = _DIFFERENCE * np.eye(n)
        # The methods of ``LinksMotion`` for slopes, columns and torques are not used: each takes
        # 0.5 to 2 ms for one sample, which is too long for a control cycle.
        poses = q + np.vstack([np.zeros(n), step, -step])
        moves = []
        # Velocities and accelerations are the same in all poses.
        for move in self._dynamics.moves(poses, qd + 0.0 * poses, qdd + 0.0 * poses):
            moves.append(move)
            yield
        motion = LinksMotion(*zip(*moves))
        to_links = motion.to_links
        yield
        wrenches = _base_wrenches(motion, to_links)
        yield
        twists = motion.joint_twists
        yield
        link_wrenches = np.einsum("lnak,lk->lna", wrenches, robot.thetas)
        torques = _joint_torques(twists, link_wrenches)
        slopes = (torques[1 : n + 1] - torques[n + 1 :]).T / (2.0 * _DIFFERENCE)
        beyond_links = self._beyond.torque(q[None], qd[None], qdd[None])[0]
        needed = torques[0] + beyond_links + robot.friction.torque(qd[None])[0]
        yield
        # Torque (n, n, 10) of each joint per inertial parameter of each link; a joint carries its
        # own link and those after it.
        columns = np.einsum("aj,lak->jlk", twists[:, :, 0], wrenches[:, 0])
        columns *= np.triu(np.ones((n, n)))[:, :, None]
        # A force at the end does work with the linear velocity (rows 3 to 5) of the last link.
        force = (to_links[-1, 0] @ twists[:, :, 0])[3:].T
        errors, changes = self._deviation_torques(columns, force, slopes, needed, qd)
        residual = (tau - needed) / self._doubt
        yield
        innovation, covariance, gain = self._update(errors, residual, scatter)
        yield
        self._update_changes(time, changes, errors, innovation, covariance, gain)
        yield
        weighted_slopes = slopes / self._doubt[:, None]
        self._finding = self._finding or self._judge(time, weighted_slopes)

    def _deviation_torques(
        self, columns: Array, force: Array, slopes: Array, needed: Array, qd: Array
    ) -> tuple[Array, Array]:
        """Return the torque (n, k) per standard deviation of each of k model errors x [doubts],
        and the torque (n, changes) per prior standard deviation of each change [doubts].

        Args:
            columns: torque (n, n, 10) of each joint per inertial parameter of each link.
            force: torque (n, 3) of each joint per force at the end, in the last link's frame [m].
            slopes: torque (n, n) of joint i per shift of joint j's zero [N m/rad].
            needed: torque (n,) that the model needs [N m].
            qd: velocities (n,) [rad/s].
        """
        link_errors = columns[:, self._links].reshape(len(qd), -1) @ self._factor
        # Dry friction, rounded off below 0.02 rad/s.
        dry = np.diag(np.tanh(qd / 0.02))
        viscous = np.diag(qd)
        errors = np.hstack([link_errors / self._doubt[:, None], dry, viscous])
        load = link_errors[:, -_LOAD_PARAMETERS:]
        at_end = np.hstack([_NEW_LOAD * load, _FORCE * force])
        alone = _TORQUE * np.diag(self._doubt)
        changes = np.hstack([_SHIFT * slopes, _SHARE * np.diag(needed), at_end, alone])
        changes /= self._doubt[:, None]
        return errors, changes

    def _update(
        self, errors: Array, residual: Array, scatter: Array
    ) -> tuple[Array, Array, Array]:
        """Update the mean and covariance of the model's errors x, and the noise, with one window.

        Args:
            errors: torque (n, k) per standard deviation of each of k errors [doubts].
            residual: measured minus modelled torque (n,) [doubts].
            scatter: rms scatter (n,) of the torque within the window [N m].

        Returns:
            Innovation (n,) [doubts], its covariance (n, n) and the gain (k, n).
        """
        scattered = (_SCATTER * scatter / self._doubt) ** 2
        noise = np.maximum(self._squares / self._weight, _LEAST_NOISE**2)
        innovation = residual - errors @ self._mean
        shared = errors @ self._covariance
        predicted = shared @ errors.T
        covariance = predicted + np.diag(_ALIKE * noise + scattered)
        gain = np.asarray(np.linalg.solve(covariance, shared).T, dtype=float)
        self._mean = self._mean + gain @ innovation
        drift = _DRIFT * np.eye(len(self._mean))
        self._covariance = self._covariance - gain @ shared + drift
        unexplained = innovation**2 - np.diag(predicted) - scattered
        noise_squares = np.clip(unexplained, 0.0, _OUTLIER * noise)
        self._squares = _REMEMBER * self._squares + noise_squares
        self._weight = _REMEMBER * self._weight + 1.0
        return innovation, covariance, gain

    def _update_changes(
        self,
        time: float,
        changes: Array,
        errors: Array,
        innovation: Array,
        covariance: Array,
        gain: Array,
    ) -> None:
        """Update score a and information b of each change, for each possible onset.

        The oldest onset makes room for this window.

        Args:
            time: mean time of the window [s].
            changes: torque (n, changes) per prior standard deviation of each change [doubts].
            errors: torque (n, k) per standard deviation of each of k errors x [doubts].
            innovation: (n,) [doubts], from ``_update`` like the next two.
            covariance: (n, n) of the innovation.
            gain: (k, n) of the filter.
        """
        newest = 1 + self._windows % _ONSETS
        self._windows += 1
        self._begin[newest] = time - 0.5 * _WINDOW
        self._age += 1
        self._age[newest] = 0
        self._state_shift[newest] = 0.0
        self._score[newest] = 0.0
        self._information[newest] = 0.0
        self._end_information[newest] = 0.0
        # Torque (onsets, n, changes), then what the filter lets pass of it into the innovation.
        grown = self._growth(time)[:, None, None] * changes
        passed = grown - errors @ self._state_shift
        weighted = np.linalg.inv(covariance) @ passed
        self._score += innovation @ weighted
        self._information += np.sum(passed * weighted, axis=1)
        end = self._end
        self._end_information += (
            passed[:, :, end].transpose(0, 2, 1) @ weighted[:, :, end]
        )
        self._state_shift += gain @ passed

    def _growth(self, time: float) -> Array:
        """Return the share (onsets,) of its full size that a change has at ``time`` [s].

        A change before the run (index 0) has its full size.
        """
        grown = np.minimum((time - self._begin) / _GROWTH, 1.0)
        grown[0] = 1.0
        return grown

    def _judge(self, time: float, slopes: Array) -> tuple[int, str] | None:
        """Return the index of the joint whose zero has moved and a sentence; None unless certain.

        Without a moved zero, ``_has_changed`` is set where any change that began at the oldest
        onset is certain.

        Args:
            time: mean time of the window [s].
            slopes: torque (n, n) of joint i per shift of joint j's zero [doubts/rad].
        """
        if self._windows < _LEAST_WINDOWS:
            return None
        n = self._robot.n_joints
        # Log likelihood ratio (onsets, changes) of each change against no change.
        gains = 0.5 * self._score**2 / (1.0 + self._information)
        gains -= 0.5 * np.log1p(self._information)
        # All parameters of the load, or of the force, change together and share one ratio.
        load = slice(0, _LOAD_PARAMETERS)
        force = slice(_LOAD_PARAMETERS, _END_PARAMETERS)
        end_gains = gains[:, self._end]
        end_gains[:, load] = self._end_gains(load)[:, None]
        end_gains[:, force] = self._end_gains(force)[:, None]
        gains[1:][self._age[1:] < _LEAST_AGE, :n] = 0.0
        if self._has_changed:
            # A change has been found during the run, so none is attributed to the time before it.
            gains[0] = 0.0
        best = np.max(gains, axis=0)
        joint = int(np.argmax(best[:n]))
        onset = int(np.argmax(gains[:, joint]))
        # The shift's mean and standard error follow from a, b and the prior N(0, unit^2).
        variance = 1.0 / (1.0 + self._information[onset, joint])
        unit = _SHIFT * self._growth(time)[onset]
        shift = unit * abs(self._score[onset, joint]) * variance
        is_sure = best[joint] > _MARGIN
        others = np.max(np.delete(best, joint))
        is_sure &= others < min(best[joint] - _APART, _OTHERS * best[joint])
        # Large enough by two standard errors.
        is_sure &= shift > _LEAST_SHIFT + 2.0 * unit * np.sqrt(variance)
        is_sure &= shift * np.max(np.abs(slopes[:, joint])) > _LEAST_TORQUE
        if is_sure:
            return joint, (_SLIPS if onset > 0 else _MOVED).format(shift)
        # The onset in whose place the next window comes.
        oldest = 1 + self._windows % _ONSETS
        self._has_changed |= bool(np.max(gains[oldest]) > _MARGIN)
        return None

    def _end_gains(self, group: slice) -> Array:
        """Return the log likelihood ratio (onsets,) of a load or force with all its parameters.

        ``group`` selects the parameters of the load or of the force among those at the end.
        """
        score = self._score[:, self._end][:, group]
        information = self._end_information[:, group, group]
        information = information + np.eye(information.shape[1])
        explained = np.linalg.solve(information, score[:, :, None])[:, :, 0]
        log_determinant = np.linalg.slogdet(information)[1]
        return 0.5 * np.sum(score * explained, axis=1) - 0.5 * log_determinant


_SLIPS = (
    "has come about {:.1f} rad off the angle that it reports, as the torques of this motion say: "
    "its gear slips"
)
_MOVED = (
    "stands about {:.1f} rad off the angle that it reports, as the torques of this motion say: its "
    "zero has moved since its map was made; look at its mounting and make the map again: see "
    "'motors map'"
)


class _Window(NamedTuple):
    """Averages over a window of time.

    Attributes:
        time: mean time [s].
        q: mean positions (n,) [rad].
        qd: mean velocities (n,) [rad/s].
        qdd: mean accelerations (n,), the slope of the velocities over time [rad/s^2].
        tau: mean torques (n,) [N m].
        scatter: rms distance (n,) of the torques from a straight line over time [N m].
    """

    time: float
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    scatter: Array


def _average(samples: Sequence[tuple[float, Array]]) -> _Window:
    """Return the averages over control cycles: pairs of time [s] and q, qd, tau (3, n)."""
    times = np.array([time for time, _ in samples])
    signals = np.array([signal for _, signal in samples])
    time = float(np.mean(times))
    since = times - time
    mean = np.mean(signals, axis=0)
    slope = np.tensordot(since, signals, 1) / (since @ since)
    q, qd, tau = mean
    deviation = signals[:, 2] - tau - np.outer(since, slope[2])
    scatter = np.sqrt(np.mean(deviation**2, axis=0))
    return _Window(time, q, qd, slope[1], tau, scatter)


def _base_wrenches(motion: LinksMotion, to_links: Array) -> Array:
    """Return wrenches (n, N, 6, 10) of n links per inertial parameter, in the base's frame.

    Args:
        motion: velocities and accelerations of the links at N samples.
        to_links: matrices (n, N, 6, 6) from the base's frame to the links' frames.
    """
    velocity = np.moveaxis(np.array(motion.velocity), 1, -1)
    acceleration = np.moveaxis(np.array(motion.acceleration), 1, -1)
    regressor = wrench_regressor(velocity.reshape(-1, 6), acceleration.reshape(-1, 6))
    wrenches = np.moveaxis(regressor, -1, 0).reshape(*velocity.shape, -1)
    # The transpose of a matrix that takes twists to a link takes the link's wrenches back.
    return np.swapaxes(to_links, -1, -2) @ wrenches


def _joint_torques(twists: Array, wrenches: Array) -> Array:
    """Return joint torques (N, n) of joint twists (6, n, N) and wrenches (n, N, 6) of the links.

    Both are in the base's frame. A joint carries the wrenches of all links after it.
    """
    carried = np.cumsum(wrenches[::-1], axis=0)[::-1]
    return np.einsum("ajn,jna->nj", twists, carried)

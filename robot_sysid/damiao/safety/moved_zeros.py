"""Whether a joint is elsewhere than its encoder says, from the torques during a motion.

A joint whose zero has moved, or whose gear slips, loads itself and the joints below it in another
way than the model expects. Links that weigh something else do that too, so the torques tau of each
window of time are taken for

    tau = model(q, qd, qdd) + X x + noise,   x ~ N(0, 1),

where X holds what one standard deviation of each link, of a load at the end and of friction makes.
x is estimated recursively (the Kalman filter of a state that hardly changes). A change that began
at some window adds a column c times an unknown size; the filter turns c into innovations c~ just as
it turns the torques into theirs, e with covariance S, so that each change has a log likelihood
ratio against none of

    a^2 / (2 (1 + b)) - log(1 + b) / 2,   a = sum c~^T S^-1 e,   b = sum c~^T S^-1 c~,

over the windows since (Willsky and Jones, "A generalized likelihood ratio approach to the detection
and estimation of jumps in linear systems", IEEE Transactions on Automatic Control 21(1), 1976).
Moved zeros compete with a load that is taken up, with a force at the end, with motors that make
another share of their torque, and with torques in single joints, such as friction. One is named
where its ratio is large, and clearly larger than that of any other change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.references import torque_doubt
from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.inverse_dynamics import BeyondRigidBodies
from robot_sysid.dynamics.newton_euler import LinkDynamics, LinksMotion
from robot_sysid.estimation.algebra.priors import model_link_factor
from robot_sysid.records import Array, RobotModel
from robot_sysid.regressor import wrench_regressor

# Over so long signals are averaged [s]; within twice that a window has to be full.
_WINDOW = 0.1
_LEAST_SAMPLES = 3
# Slower than this [rad/s] dry friction holds the arm, and hides what it carries. So many windows in
# which it moves have to show how well the model fits before anything is judged.
_MOVING = 0.05
_LEAST_WINDOWS = 15
# Judgements, standard deviations: links of a guessed model [share], an unknown load at the end [kg]
# and how far from there its mass is [m].
_LINKS = 0.3
_LOAD = 3.0
_LEVER = 0.2
# Of changes: a zero [rad], a torque in one joint [of what says nothing], the share of its torque
# that a motor does not make, a load, in standard deviations of the unknown one, and a force [N].
_SHIFT = 0.3
_TORQUE = 0.5
_SHARE = 0.5
_NEW_LOAD = 1.5
_FORCE = 20.0
# Noise, of the torque that says nothing: at the beginning, where it counts as so many windows, and
# at least; what share of its estimate stays in each window.
_NOISE = 0.15
_NOISE_WINDOWS = 2.0
_LEAST_NOISE = 0.03
_REMEMBER = 0.95
# One window may show so many times the variance of before; where torques scatter within it, by a
# blow for instance, so many times their scatter is taken for noise.
_OUTLIER = 30.0
_SCATTER = 3.0
# Variance that x gains in a window: motors become warm.
_DRIFT = 1e-6
# What a model lacks changes more slowly than windows do: errors of this many are alike.
_ALIKE = 5.0
# Changes may have begun in each of the last windows; one is judged after some. It grows for up to
# so long [s].
_ONSETS = 14
_LEAST_AGE = 3
_GROWTH = 1.0
# In nats: how much better than no change, and than any other. Of the best, what others may have:
# where noise is larger than it seems, all of them are too large.
_MARGIN = 12.0
_APART = 8.0
_OTHERS = 0.55
# A smaller shift is within what people measure with a ruler [rad]; of the torque that says nothing:
# what it has to make.
_LEAST_SHIFT = 0.08
_LEAST_TORQUE = 0.3
# For slopes [rad].
_DIFFERENCE = 0.01
# In how many parts a window is computed, beside one for each link.
_OTHER_PARTS = 8
_LOAD_PARAMETERS = 4
_END_PARAMETERS = _LOAD_PARAMETERS + 3


class MovedZeroCheck:
    """Finds a joint that is elsewhere than it reports, from the torques in the cycles of a run.

    What a window shows is computed in small parts, one or a few in each cycle of the next window:
    a control cycle has no room for all of it.

    Args:
        robot: the arm's model.
        joints: its motors, base to terminal.
    """

    def __init__(self, robot: RobotModel, joints: Sequence[DamiaoJoint]) -> None:
        n = robot.n_joints
        self._robot = robot
        self._dynamics = LinkDynamics(robot)
        self._beyond = BeyondRigidBodies(robot)
        self._links = [*other_links(robot), n - 1]
        factor = model_link_factor(robot, self._links, _LINKS)
        load = np.zeros((len(factor), _LOAD_PARAMETERS))
        load[-10:-6] = _LOAD * np.diag([1.0, _LEVER, _LEVER, _LEVER])
        self._factor = np.column_stack([factor, load])
        self._doubt = torque_doubt(joints) + robot.friction.largest_dry
        self._samples: list[tuple[float, Array]] = []
        self._work: Iterator[None] = iter(())
        self._parts_per_cycle = 1
        self._finding: tuple[int, str] | None = None
        self._has_changed = False
        self._windows = 0
        n_errors = self._factor.shape[1] + 2 * n
        self._mean = np.zeros(n_errors)
        self._covariance = np.eye(n_errors)
        self._squares = np.full(n, _NOISE_WINDOWS * _NOISE**2)
        self._weight = _NOISE_WINDOWS
        # Where changes at the end stand among all: behind the zeros and the motors.
        self._end = slice(2 * n, 2 * n + _END_PARAMETERS)
        # Changes by their onset: the first one is since before the run, the others take turns.
        n_onsets = 1 + _ONSETS
        n_changes = 3 * n + _END_PARAMETERS
        self._begin = np.zeros(n_onsets)
        self._age = np.zeros(n_onsets, int)
        self._state_shift = np.zeros((n_onsets, n_errors, n_changes))
        self._score = np.zeros((n_onsets, n_changes))
        self._information = np.zeros((n_onsets, n_changes))
        self._end_information = np.zeros((n_onsets, _END_PARAMETERS, _END_PARAMETERS))

    def __call__(
        self, time: float, q: Array, qd: Array, tau: Array
    ) -> tuple[int, str] | None:
        """Take in one cycle; return the joint that is elsewhere than it reports, if any.

        Args:
            time: of the cycle [s].
            q, qd, tau: positions, velocities and commanded torques (n,) [rad, rad/s, N m]; a cycle
                with a NaN is left out.

        Returns:
            The joint's number and a sentence about it without its name, or None.
        """
        for _ in range(self._parts_per_cycle):
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
                # What is left of the last window is lost where the computer has skipped cycles.
                self._work = self._take_in(average)
                self._parts_per_cycle = 1 + (
                    self._robot.n_joints + _OTHER_PARTS
                ) // len(window)
        return self._finding

    def _take_in(self, window: _Window) -> Iterator[None]:
        """Update all estimates with one window; a generator, so that it can be done in parts."""
        robot = self._robot
        time, q, qd, qdd, tau, scatter = window
        n = robot.n_joints
        step = _DIFFERENCE * np.eye(n)
        # ``LinksMotion`` has slopes, columns and torques too, made for many samples: of one they
        # take 2, 0.5 and 0.5 ms at once, which a control cycle does not have.
        poses = q + np.vstack([np.zeros(n), step, -step])
        moves = []
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
        torques = _joint_torques(
            twists, np.einsum("lnak,lk->lna", wrenches, robot.thetas)
        )
        slopes = (torques[1 : n + 1] - torques[n + 1 :]).T / (2.0 * _DIFFERENCE)
        beyond_links = self._beyond.torque(q[None], qd[None], qdd[None])[0]
        needed = torques[0] + beyond_links + robot.friction.torque(qd[None])[0]
        yield
        columns = np.einsum("aj,lak->jlk", twists[:, :, 0], wrenches[:, 0])
        columns *= np.triu(np.ones((n, n)))[:, :, None]
        link_errors = columns[:, self._links].reshape(n, -1) @ self._factor
        dry = np.diag(np.tanh(qd / 0.02))
        viscous = np.diag(qd)
        errors = np.hstack([link_errors / self._doubt[:, None], dry, viscous])
        load = link_errors[:, -_LOAD_PARAMETERS:]
        force = (to_links[-1, 0] @ twists[:, :, 0])[3:].T
        at_end = np.hstack([_NEW_LOAD * load, _FORCE * force])
        alone = _TORQUE * np.diag(self._doubt)
        changes = np.hstack([_SHIFT * slopes, _SHARE * np.diag(needed), at_end, alone])
        changes /= self._doubt[:, None]
        residual = (tau - needed) / self._doubt
        yield
        innovation, covariance, gain = self._update(errors, residual, scatter)
        yield
        self._update_changes(time, changes, errors, innovation, covariance, gain)
        yield
        self._finding = self._finding or self._judge(
            time, slopes / self._doubt[:, None]
        )

    def _update(
        self, errors: Array, residual: Array, scatter: Array
    ) -> tuple[Array, Array, Array]:
        """Update the mean and covariance of the model's errors x by the Kalman filter.

        Args:
            errors: torque (n, x) per standard deviation of each error, in units of the doubt.
            residual: measured minus modelled torque (n,), in the same units.
            scatter: of the torque within the window (n,) [N m].

        Returns:
            Innovation (n,), its covariance (n, n) and the gain (x, n).
        """
        scattered = (_SCATTER * scatter / self._doubt) ** 2
        noise = np.maximum(self._squares / self._weight, _LEAST_NOISE**2)
        innovation = residual - errors @ self._mean
        shared = errors @ self._covariance
        predicted = shared @ errors.T
        covariance = predicted + np.diag(_ALIKE * noise + scattered)
        gain = np.linalg.solve(covariance, shared).T
        self._mean = self._mean + gain @ innovation
        self._covariance = (
            self._covariance - gain @ shared + _DRIFT * np.eye(len(self._mean))
        )
        unexplained = innovation**2 - np.diag(predicted) - scattered
        self._squares = _REMEMBER * self._squares + np.clip(
            unexplained, 0.0, _OUTLIER * noise
        )
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
        """Update scores and information of each change (n, changes), for each possible onset."""
        newest = 1 + self._windows % _ONSETS
        self._windows += 1
        self._begin[newest] = time - 0.5 * _WINDOW
        self._age += 1
        for state in (
            self._age,
            self._state_shift,
            self._score,
            self._information,
            self._end_information,
        ):
            state[newest] = 0
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
        """Return the share (onsets,) of their full size to which changes have grown."""
        grown = np.minimum((time - self._begin) / _GROWTH, 1.0)
        grown[0] = 1.0
        return grown

    def _judge(self, time: float, slopes: Array) -> tuple[int, str] | None:
        """Return the joint whose zero has moved, and a sentence; None unless it is certain.

        ``slopes`` (n, n) are torque per radian of each joint's zero, in units of the doubt.
        """
        if self._windows < _LEAST_WINDOWS:
            return None
        n = self._robot.n_joints
        gains = 0.5 * self._score**2 / (1.0 + self._information)
        gains -= 0.5 * np.log1p(self._information)
        ends = gains[:, self._end]
        for group in (
            slice(0, _LOAD_PARAMETERS),
            slice(_LOAD_PARAMETERS, _END_PARAMETERS),
        ):
            ends[:, group] = self._end_gains(group)[:, None]
        gains[1:][self._age[1:] < _LEAST_AGE, :n] = 0.0
        if self._has_changed:
            # What is off now need not have been off before the run.
            gains[0] = 0.0
        best = np.max(gains, axis=0)
        joint = int(np.argmax(best[:n]))
        onset = int(np.argmax(gains[:, joint]))
        variance = 1.0 / (1.0 + self._information[onset, joint])
        unit = _SHIFT * self._growth(time)[onset]
        shift = unit * abs(self._score[onset, joint]) * variance
        is_sure = best[joint] > _MARGIN
        others = np.max(np.delete(best, joint))
        is_sure &= others < min(best[joint] - _APART, _OTHERS * best[joint])
        is_sure &= shift > _LEAST_SHIFT + 2.0 * unit * np.sqrt(variance)
        is_sure &= shift * np.max(np.abs(slopes[:, joint])) > _LEAST_TORQUE
        if is_sure:
            return joint, (_SLIPS if onset > 0 else _MOVED).format(shift)
        oldest = 1 + self._windows % _ONSETS
        self._has_changed |= bool(np.max(gains[oldest]) > _MARGIN)
        return None

    def _end_gains(self, group: slice) -> Array:
        """Return the log likelihood ratios (onsets,) of a load or a force with all parameters."""
        score = self._score[:, self._end][:, group]
        information = self._end_information[:, group, group]
        information = information + np.eye(information.shape[1])
        explained = np.linalg.solve(information, score[:, :, None])[:, :, 0]
        return (
            0.5 * np.sum(score * explained, axis=1)
            - 0.5 * np.linalg.slogdet(information)[1]
        )


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
        q, qd, qdd, tau: mean positions, velocities, accelerations and torques (n,).
        scatter: rms distance (n,) of the torques from a straight line over time [N m].
    """

    time: float
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    scatter: Array


def _average(samples: Sequence[tuple[float, Array]]) -> _Window:
    """Return the averages of a window's cycles: time [s] and q, qd, tau (3, n) of each."""
    times = np.array([time for time, _ in samples])
    signals = np.array([signal for _, signal in samples])
    time = float(np.mean(times))
    since = times - time
    mean = np.mean(signals, axis=0)
    slope = np.tensordot(since, signals, 1) / (since @ since)
    q, qd, tau = mean
    bend = signals[:, 2] - tau - np.outer(since, slope[2])
    return _Window(time, q, qd, slope[1], tau, np.sqrt(np.mean(bend**2, axis=0)))


def _base_wrenches(motion: LinksMotion, to_links: Array) -> Array:
    """Return the wrench of each link, in the base's frame, per inertial parameter (n, N, 6, 10)."""
    moves = (
        np.moveaxis(np.array(move), 1, -1)
        for move in (motion.velocity, motion.acceleration)
    )
    velocity, acceleration = moves
    regressor = wrench_regressor(velocity.reshape(-1, 6), acceleration.reshape(-1, 6))
    wrenches = np.moveaxis(regressor, -1, 0).reshape(*velocity.shape, -1)
    return np.swapaxes(to_links, -1, -2) @ wrenches


def _joint_torques(twists: Array, wrenches: Array) -> Array:
    """Return joint torques (N, n) of twists (6, n, N) and links' wrenches (n, N, 6) in the base."""
    carried = np.cumsum(wrenches[::-1], axis=0)[::-1]
    return np.einsum("ajn,jna->nj", twists, carried)

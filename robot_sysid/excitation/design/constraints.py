"""The constraints of an excitation as numbers g <= 0 on a time grid, with gradients.

Six families in the columns of one array (N, 4 n + 2): position, velocity, acceleration and torque
of each joint and the speed of the tool as share of the limit minus one, and the slack towards
obstacles over a length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.screws import ChainMotion
from robot_sysid.excitation.problem import OBSTACLE_LENGTH, ExcitationProblem
from robot_sysid.records import Array, Motion

_TORQUE_STEP = 1e-6


@dataclass(frozen=True)
class ConstraintCache:
    """Constraint values of a motion, and what their gradient needs.

    Attributes:
        value: (N, 4 n + 2) g; fulfilled where <= 0.
        motion: (q, qd, qdd), each (N, n).
        torque: (N, n) [N m].
        slack_gradient: (N, n) of the slack with respect to q.
        tool: motion of the terminal body; None where its speed has no limit.
    """

    value: Array
    motion: tuple[Array, Array, Array]
    torque: Array
    slack_gradient: Array
    tool: ChainMotion | None = None


def constraint_count(joints: int) -> int:
    """Return the number of columns for so many joints."""
    return 4 * joints + 2


class MotionConstraints:
    """Evaluates the constraints of one problem.

    Args:
        problem: the arm and its limits.
        share: share of the limits to use; a little less than 1 leaves room for what happens
            between grid points.
        extra_slack: distance to keep beside the obstacles' own requirement [m].
    """

    def __init__(self, problem: ExcitationProblem, share: float, extra_slack: float) -> None:
        self._problem, self._extra = problem, extra_slack
        self._center, self._allowed = problem.limits.center, share * problem.limits.largest
        self._tool_speed = share * problem.limits.tool_speed
        self._nearby = _SlackMemory(problem)

    def evaluate(self, motion: tuple[Array, Array, Array]) -> ConstraintCache:
        """Return all constraints of a motion (q, qd, qdd), each (N, n)."""
        q, qd, qdd = motion
        torque = np.zeros_like(q)
        if np.any(np.isfinite(self._allowed[3])):
            torque = self._torque(*motion)
        signals = (q - self._center, qd, qdd, torque)
        shares = [np.abs(signal) / allowed - 1.0 for signal, allowed in zip(signals, self._allowed)]
        slack, gradient = self._nearby.slack(q)
        fast, tool = -np.ones(len(q)), None
        if np.isfinite(self._tool_speed):
            tool = self._problem.chain.evaluate(*motion)
            fast = self._problem.tool.speed(tool.velocity) / self._tool_speed - 1.0
        towards = (self._extra - slack) / OBSTACLE_LENGTH
        value = np.hstack((*shares, fast[:, None], towards[:, None]))
        return ConstraintCache(value, motion, torque, gradient, tool)

    def vjp(self, cache: ConstraintCache, weight: Array) -> tuple[Array, Array, Array]:
        """Return the gradient (N, n) of sum(weight * g) with respect to q, qd and qdd."""
        n = self._problem.n_joints
        q, qd, qdd = cache.motion
        signals = (q - self._center, qd, qdd, cache.torque)
        adjoints = [
            weight[:, i * n : (i + 1) * n] * np.sign(signal) / allowed
            for i, (signal, allowed) in enumerate(zip(signals, self._allowed))
        ]
        adjoints[0] = adjoints[0] - weight[:, -1:] * cache.slack_gradient / OBSTACLE_LENGTH
        parts = zip(adjoints, self._torque_vjp(cache, adjoints[3]))
        position, velocity, acceleration = (a + b for a, b in parts)
        if cache.tool is None or not np.any(weight[:, -2]):
            return position, velocity, acceleration
        twist, none = cache.tool.velocity, np.zeros_like(cache.tool.jacobian)
        adjoint = self._problem.tool.speed_vjp(twist, weight[:, -2] / self._tool_speed)
        from_tool = cache.tool.vjp(none, adjoint, np.zeros_like(twist))
        return position + from_tool[0], velocity + from_tool[1], acceleration + from_tool[2]

    def _torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        return self._problem.torque(Motion(np.arange(float(len(q))), q, qd, qdd))

    def _torque_vjp(self, cache: ConstraintCache, adjoint: Array) -> tuple[Array, Array, Array]:
        """Gradient through the torque by one-sided differences, at the active samples only."""
        active = np.flatnonzero(np.any(adjoint != 0.0, axis=1))
        result = (np.zeros_like(adjoint), np.zeros_like(adjoint), np.zeros_like(adjoint))
        if len(active) == 0:
            return result
        at = [signal[active] for signal in cache.motion]
        # The friction torque jumps where a joint reverses; a step across the jump would be noise.
        for which in range(3):
            for joint in range(self._problem.n_joints):
                moved = [signal.copy() for signal in at]
                moved[which][:, joint] += _TORQUE_STEP * _away(moved[which][:, joint])
                change = (self._torque(*moved) - cache.torque[active]) / _TORQUE_STEP
                change *= _away(at[which][:, joint])[:, None]
                result[which][active, joint] = np.sum(change * adjoint[active], axis=1)
        return result


class _SlackMemory:
    """Slack along a trajectory that changes little from one call to the next.

    A sample whose joints have moved by less than its last known slack allows cannot have become
    tight; it keeps what is certain of its slack and needs no collision test.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        self._obstacles = problem.obstacles
        # Slack that no constraint will ever ask for [m].
        self._enough = 0.5 * problem.obstacles.horizon
        self._q = np.zeros((0, problem.n_joints))
        self._budget = np.zeros((0, len(problem.obstacles.rates)))

    def slack(self, q: Array) -> tuple[Array, Array]:
        """Return slack (N,), exact where it is small, and its gradient (N, n)."""
        if self._q.shape != q.shape:
            self._q, self._budget = q.copy(), np.full((len(q), self._budget.shape[1]), -np.inf)
        moved = np.abs(q - self._q) @ self._obstacles.rates.T
        certain = np.min(self._budget - moved, axis=1)
        gradient = np.zeros_like(q)
        tight = np.flatnonzero(~(certain > self._enough))
        if len(tight):
            found = self._obstacles.slack(q[tight])
            certain[tight], gradient[tight] = found.value, found.gradient
            self._q[tight], self._budget[tight] = q[tight], found.budget
        return certain, gradient


def _away(value: Array) -> Array:
    """Return the direction (+1 or -1) that leads away from zero."""
    return np.where(value < 0.0, -1.0, 1.0)

"""How far a command may go: the one place that every command to a motor passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# Relative; what rounding to frames and back leaves of a command that is at its bound.
_ROUNDING = 1e-6


class BeyondBounds(HardwareAbort):
    """A command that asks too much of a joint was not sent."""


class Overload(BeyondBounds):
    """It asks for more torque than the joint's motor makes."""


@dataclass(frozen=True)
class CommandRange:
    """Where commands of n joints may go, each (n,).

    Attributes:
        lower, upper: positions: the model's range, or else that of the file [rad].
        speed: how fast a commanded position may move, and may be told to [rad/s].
    """

    lower: Array
    upper: Array
    speed: Array

    def within(self, other: CommandRange) -> CommandRange:
        """Return the part of this range that is also in another one."""
        lower = np.maximum(self.lower, other.lower)
        upper = np.minimum(self.upper, other.upper)
        return CommandRange(lower, upper, np.minimum(self.speed, other.speed))


@dataclass(frozen=True)
class CommandBounds:
    """What commands of n joints stay within, each (n,).

    Attributes:
        command_range: how far and how fast positions may go.
        torque: what kp times error and feed-forward may add up to [N m].
        position_step: one quantisation step of a commanded position [rad].
        velocity_step: one quantisation step of a commanded velocity [rad/s].
        torque_step: one quantisation step of a commanded torque [N m].
    """

    command_range: CommandRange
    torque: Array
    position_step: Array
    velocity_step: Array
    torque_step: Array

    def including(self, q: Array) -> CommandBounds:
        """Return bounds whose range also holds the positions q (n,): where an arm stands."""
        current = self.command_range
        lower = np.fmin(current.lower, q)
        upper = np.fmax(current.upper, q)
        return replace(self, command_range=CommandRange(lower, upper, current.speed))

    def _reach(self, last: Array, elapsed: Array) -> tuple[Array, Array]:
        """Return the least and the greatest position (n,) that may be commanded now [rad]."""
        current = self.command_range
        reach = current.speed * elapsed
        last = np.clip(last, current.lower, current.upper)
        return np.maximum(current.lower, last - reach), np.minimum(
            current.upper, last + reach
        )

    def require(
        self,
        labels: Sequence[str],
        command: MitCommand,
        last: Array,
        elapsed: Array,
        q: Array,
    ) -> None:
        """Raise BeyondBounds for the first joint that a command asks too much of.

        Args:
            labels: names of the n joints, for messages.
            command: what is to be sent.
            last: (n,) positions commanded last [rad].
            elapsed: (n,) time since then [s].
            q: (n,) where the joints are believed to be [rad].

        Raises:
            Overload: it asks for more torque than the motor makes.
        """
        lowest, highest = self._reach(last, elapsed)
        slack = self.position_step + _ROUNDING
        below = lowest - slack - command.position
        beyond = np.maximum(below, command.position - highest - slack)
        # Written so that a NaN counts as too much.
        for j in np.flatnonzero(~(beyond <= 0.0)).tolist():
            raise BeyondBounds(
                f"{labels[j]} would be sent to {command.position[j]:.3f} rad; from the last "
                f"command it may go from {lowest[j]:.3f} to {highest[j]:.3f}"
            )
        too_fast = ~(
            np.abs(command.velocity) <= self.command_range.speed + self.velocity_step
        )
        for j in np.flatnonzero(too_fast).tolist():
            limit = self.command_range.speed[j]
            told = f"would be told {command.velocity[j]:.2f} rad/s, limit {limit:.2f}"
            raise BeyondBounds(f"{labels[j]} {told}")
        # Where a joint has never been heard, nothing is known of its error.
        error = np.nan_to_num(command.position - q)
        requested = np.abs(command.kp * error + command.torque)
        available = self.torque + self.torque_step + command.kp * self.position_step
        for j in np.flatnonzero(~(requested <= available * (1.0 + _ROUNDING))).tolist():
            raise Overload(
                f"{labels[j]} would be asked for {requested[j]:.1f} N m and makes "
                f"{self.torque[j]:.1f} at most: the arm needs more than this motor has, or "
                "something holds it back"
            )

    def confine(
        self, command: MitCommand, last: Array, elapsed: Array, q: Array
    ) -> MitCommand:
        """Return the nearest command within the bounds; for the arguments see ``require``."""
        lowest, highest = self._reach(last, elapsed)
        position = np.where(np.isfinite(command.position), command.position, last)
        position = np.clip(position, lowest, highest)
        top_speed = self.command_range.speed
        velocity = np.clip(np.nan_to_num(command.velocity), -top_speed, top_speed)
        error = np.nan_to_num(position - q)
        stiffness = np.minimum(
            command.kp, self.torque / np.maximum(np.abs(error), 1e-9)
        )
        pull = stiffness * error
        fed = np.clip(np.nan_to_num(command.torque), -self.torque, self.torque)
        fed = np.clip(fed, -self.torque - pull, self.torque - pull)
        return MitCommand(position, velocity, stiffness, command.kd, fed)

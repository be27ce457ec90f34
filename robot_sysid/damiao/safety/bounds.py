"""How far a command may go: the one place that every command to a motor passes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.records import Array

# Relative; what rounding to frames and back leaves of a command that is at its bound.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Room:
    """Where commands of n joints may go, each (n,).

    Attributes:
        lower, upper: positions: the model's range, or else that of the file [rad].
        speed: how fast a commanded position may move, and may be told to [rad/s].
    """

    lower: Array
    upper: Array
    speed: Array


@dataclass(frozen=True)
class CommandBounds:
    """What commands of n joints stay within, each (n,).

    Attributes:
        room: how far and how fast positions may go.
        torque: what kp times error and feed-forward may add up to [N m].
        position_step: one quantisation step of a commanded position [rad].
        velocity_step: one quantisation step of a commanded velocity [rad/s].
        torque_step: one quantisation step of a commanded torque [N m].
    """

    room: Room
    torque: Array
    position_step: Array
    velocity_step: Array
    torque_step: Array

    def including(self, q: Array) -> CommandBounds:
        """Return bounds whose range also holds the positions q (n,): where an arm stands."""
        room = self.room
        wider = Room(np.fmin(room.lower, q), np.fmax(room.upper, q), room.speed)
        return replace(self, room=wider)

    def _reach(self, last: Array, elapsed: Array) -> tuple[Array, Array]:
        """Return the least and the greatest position (n,) that may be commanded now [rad]."""
        room = self.room
        reach = room.speed * elapsed
        last = np.clip(last, room.lower, room.upper)
        return np.maximum(room.lower, last - reach), np.minimum(room.upper, last + reach)

    def excess(
        self, command: MitCommand, last: Array, elapsed: Array, q: Array
    ) -> tuple[int, str] | None:
        """Return which joint a command asks too much of, and what in words; None if it does not.

        Args:
            command: what is to be sent.
            last: (n,) positions commanded last [rad].
            elapsed: (n,) time since then [s].
            q: (n,) where the joints are believed to be [rad].
        """
        lowest, highest = self._reach(last, elapsed)
        slack = self.position_step + _ROUNDING
        below = lowest - slack - command.position
        beyond = np.maximum(below, command.position - highest - slack)
        # Written so that a NaN counts as too much.
        for j in np.flatnonzero(~(beyond <= 0.0)).tolist():
            return j, (
                f"would be sent to {command.position[j]:.3f} rad; from the last command it may go "
                f"from {lowest[j]:.3f} to {highest[j]:.3f}"
            )
        too_fast = ~(np.abs(command.velocity) <= self.room.speed + self.velocity_step)
        for j in np.flatnonzero(too_fast).tolist():
            limit = self.room.speed[j]
            return j, f"would be told {command.velocity[j]:.2f} rad/s, limit {limit:.2f}"
        # Where a joint has never been heard, nothing is known of its error.
        error = np.nan_to_num(command.position - q)
        asked = np.abs(command.kp * error + command.torque)
        room = self.torque + self.torque_step + command.kp * self.position_step
        for j in np.flatnonzero(~(asked <= room * (1.0 + _ROUNDING))).tolist():
            return j, (
                f"would be asked for {asked[j]:.1f} N m and makes {self.torque[j]:.1f} at most: "
                "the arm needs more than this motor has, or something holds it back"
            )
        return None

    def confine(self, command: MitCommand, last: Array, elapsed: Array, q: Array) -> MitCommand:
        """Return the nearest command within the bounds; for the arguments see ``excess``."""
        lowest, highest = self._reach(last, elapsed)
        position = np.where(np.isfinite(command.position), command.position, last)
        position = np.clip(position, lowest, highest)
        velocity = np.clip(np.nan_to_num(command.velocity), -self.room.speed, self.room.speed)
        error = np.nan_to_num(position - q)
        stiffness = np.minimum(command.kp, self.torque / np.maximum(np.abs(error), 1e-9))
        pull = stiffness * error
        fed = np.clip(np.nan_to_num(command.torque), -self.torque, self.torque)
        fed = np.clip(fed, -self.torque - pull, self.torque - pull)
        return MitCommand(position, velocity, stiffness, command.kd, fed)

"""From a model's joints to the motors that drive them, and back.

A motor may turn the other way than its joint in the model, have its zero elsewhere, and deliver
another torque than it believes:

    motor position = direction * joint position + offset
    motor velocity = direction * joint velocity
    joint torque   = direction * torque ratio * motor torque

Stiffness and damping ask for motor torque, so they are divided by the ratio. Everything above the
frames is in joint space; only here and in the frames are motors' own numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from robot_sysid.damiao.protocol.codec import Feedback, MitCommand, Scaling
from robot_sysid.records import Array


class Mounted(Protocol):
    """What says how a motor is mounted."""

    @property
    def direction(self) -> int:
        """+1 or -1."""

    @property
    def offset(self) -> float:
        """Motor position where the joint is at zero [rad]."""

    @property
    def torque_ratio(self) -> float:
        """Joint torque per torque that the motor believes in."""


@dataclass(frozen=True)
class JointSpace:
    """How n motors are mounted.

    Attributes:
        direction: (n,) +1 or -1.
        offset: (n,) motor position where the joint is at zero [rad].
        ratio: (n,) joint torque per torque that the motor believes in.
    """

    direction: Array
    offset: Array
    ratio: Array

    @classmethod
    def of(cls, joints: Sequence[Mounted]) -> JointSpace:
        """Return how the motors of these joints are mounted."""
        rows = [(joint.direction, joint.offset, joint.torque_ratio) for joint in joints]
        return cls(*np.array(rows, dtype=float).reshape(-1, 3).T)

    def to_motors(self, command: MitCommand) -> MitCommand:
        """Return a command for joints as one for motors."""
        return MitCommand(
            self.motor_position(command.position),
            self.direction * command.velocity,
            command.kp / self.ratio,
            command.kd / self.ratio,
            self.motor_torque(command.torque),
        )

    def from_motors(self, command: MitCommand) -> MitCommand:
        """Return a command for motors as one for joints."""
        return MitCommand(
            self.joint_position(command.position),
            self.direction * command.velocity,
            command.kp * self.ratio,
            command.kd * self.ratio,
            self.joint_torque(command.torque),
        )

    def measured(self, feedback: Feedback) -> Feedback:
        """Return what motors measure as what their joints do."""
        return replace(
            feedback,
            position=self.joint_position(feedback.position),
            velocity=self.direction * feedback.velocity,
            torque=self.joint_torque(feedback.torque),
        )

    def motor_position(self, q: Array) -> Array:
        """Return the motors' positions (n,) at joint positions (n,) [rad]."""
        return np.asarray(self.direction * q + self.offset)

    def joint_position(self, position: Array) -> Array:
        """Return the joint positions (n,) at motor positions (n,) [rad]."""
        return np.asarray(self.direction * (position - self.offset))

    def motor_torque(self, torque: Array) -> Array:
        """Return what motors have to believe in for these joint torques (n,) [N m]."""
        return np.asarray(self.direction * torque / self.ratio)

    def joint_torque(self, torque: Array) -> Array:
        """Return the joint torques (n,) of what motors believe in [N m]."""
        return np.asarray(self.direction * self.ratio * torque)

    def clipped(self, q: Array, qd: Array, tau: Array, scaling: Scaling) -> tuple[Array, ...]:
        """Return positions, velocities and torques of joints (n,) that the motors' frames carry."""
        motor = self.motor_position(q), self.direction * qd, self.motor_torque(tau)
        limits = scaling.position, scaling.velocity, scaling.torque
        p, v, t = (np.clip(x, -limit, limit) for x, limit in zip(motor, limits))
        return self.joint_position(p), np.asarray(self.direction * v), self.joint_torque(t)

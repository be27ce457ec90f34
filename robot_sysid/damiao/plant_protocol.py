"""What the simulated arm needs from physics, so that it works with any of it."""

from __future__ import annotations

from typing import Protocol

from robot_sysid.records import Array


class Plant(Protocol):
    """A mechanism with n joints that is moved by joint torques."""

    @property
    def n_joints(self) -> int:
        """Number of joints n."""

    @property
    def timestep(self) -> float:
        """Length of one step [s]."""

    @property
    def q(self) -> Array:
        """Joint positions (n,) [rad]."""

    @property
    def qd(self) -> Array:
        """Joint velocities (n,) [rad/s]."""

    def step(self, torque: Array, damping: Array) -> Array:
        """Advance one step under the joint torque ``torque - damping qd``.

        Args:
            torque: (n,) [N m].
            damping: (n,) [N m s/rad], taken at the end of the step, so that any value is stable.

        Returns:
            the joint torque (n,) that acted during the step [N m].
        """

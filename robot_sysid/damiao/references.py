"""Joint references as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.safety.holding import HoldingTorque
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.records import Array

UNKNOWN = np.array(np.nan)
"""A torque of all joints that is not known."""


class Reference(NamedTuple):
    """State commanded to n joints at one moment.

    Attributes:
        position: (n,) [rad].
        velocity: (n,) [rad/s].
        torque: feed-forward torque (n,) [N m].
        weight: torque (n,) that carries the arm at rest in this pose [N m]; NaN where that is not
            known.
        weight_error: standard error (n,) of the weight, as wrong as models usually are [N m].
    """

    position: Array
    velocity: Array
    torque: Array
    weight: Array = UNKNOWN
    weight_error: Array = UNKNOWN

    @classmethod
    def at_rest(cls, position: Array, holding: HoldingTorque) -> Reference:
        """Return the state of an arm at rest in a pose (n,) [rad] that its weight is fed in."""
        weight = holding.torque(position)
        still = np.zeros_like(position)
        return cls(position, still, weight, weight, holding.error(position))


ReferenceFunction = Callable[[float], Reference]
"""Returns the reference at a time since its phase began [s]; called with non-decreasing times."""


def trajectory_reference(
    trajectory: DamiaoTrajectory, speed: float
) -> ReferenceFunction:
    """Return a trajectory, interpolated between its rows, as a function of time.

    The feed-forward torque is what the motion needs at the speed at which it is played, see
    ``DamiaoTrajectory.needed_torque``: never the model's friction, which other arms of the type do
    not have, and which would push a joint that turns round or stands.

    Args:
        trajectory: trajectory with at least two rows.
        speed: factor of the file's velocities; its times are divided by this factor.
    """

    def reference(time: float) -> Reference:
        """Return the trajectory's state at ``time`` [s] of playing since its first row."""
        moment = np.array(time * speed)
        position, velocity, _ = trajectory.state_at(moment)
        needed = trajectory.needed_torque(moment, speed)
        return Reference(position, velocity * speed, *needed)

    return reference


def transfer_reference(
    start: Reference,
    target: Reference,
    speed: float,
    shortest: float,
    holding: HoldingTorque,
) -> tuple[ReferenceFunction, float]:
    """Return a straight motion from rest at ``start`` to rest at ``target``, and its duration [s].

    After a share s of the time it has covered the share 10 s^3 - 15 s^4 + 6 s^5 of the line; the
    peak speed is 15/8 = 1.875 of the mean speed.

    Args:
        start: begin; its velocity is ignored.
        target: end; its velocity is ignored.
        speed: velocity that no joint exceeds [rad/s].
        shortest: least duration [s].
        holding: computes the torque that carries the arm in a pose. The feed-forward torque is
            this plus a difference, interpolated along the line, so that it equals the torques of
            ``start`` and ``target`` at the ends.
    """
    line = target.position - start.position
    duration = max(shortest, 15.0 / 8.0 * np.max(np.abs(line)) / speed)
    extra_at_start = start.torque - holding.torque(start.position)
    extra_at_target = target.torque - holding.torque(target.position)
    # The weight is judged along the whole line, by the larger error of both ends.
    error = np.fmax(start.weight_error, target.weight_error)

    def reference(time: float) -> Reference:
        """Return the state at ``time`` [s] after the beginning."""
        s = min(max(time / duration, 0.0), 1.0)
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        share_per_second = 30.0 * s * s * (1.0 - s) ** 2 / duration
        q = start.position + share * line
        extra = (1.0 - share) * extra_at_start + share * extra_at_target
        torque = holding.torque(q) + extra
        return Reference(q, share_per_second * line, torque, torque, error)

    return reference, duration


def hold_reference(reference: Reference) -> ReferenceFunction:
    """Return a function of time that always returns a reference's position and torque, at rest."""
    at_rest = reference._replace(velocity=np.zeros_like(reference.velocity))
    return lambda time: at_rest


@dataclass(frozen=True)
class Activity:
    """What a run does with an arm that it holds.

    Attributes:
        announcement: what is said when it begins.
        begin: returns the reference from the one in which the arm stands.
        duration: longest time that it takes [s].
        first: reference to which the arm is moved before; None where it stays.
    """

    announcement: str
    begin: Callable[[Reference], ReferenceFunction]
    duration: float
    first: Reference | None = None


class Follower:
    """Base of references that depend on the arm's state, which they get in every cycle.

    The base itself stands for one that does not: it uses no state, and the whole stiffness.

    Attributes:
        stiffness: share of the motors' stiffness, of all joints or of each (n,).
        damping: share of the motors' damping.
    """

    stiffness: Array | float = 1.0
    damping = 1.0

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take believed positions and velocities, and torques commanded last, (n,) each.

        They are NaN where they are unknown [rad, rad/s, N m].
        """

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] of its phase; times never go back."""
        raise NotImplementedError

    @property
    def is_done(self) -> bool:
        """Whether its phase may end before its time."""
        return False

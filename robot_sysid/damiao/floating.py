"""An arm that its gravity torque alone carries: how fast its joints drift, and what that says.

The torque with which stiffness and damping held a joint beside the model's gravity fades, and then
nothing holds the joint but its gravity torque and its friction. A joint that moves with velocity v
and acceleration a obeys

    M a + friction(v) + gravity = commanded torque,

so that the error of the model's gravity is the commanded torque minus the model's torque of that
motion. A joint that stands has an error below its dry friction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.references import Follower, Reference
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array, Limits, Motion, RobotModel
from robot_sysid.records.messages import percent

SETTLING = 3.0
"""Longest time for which the arm is held until it stands still [s]."""
FADE = 1.0
"""Time in which the stiffness is then taken away [s]."""


class Floating(Follower):
    """A reference that stands until the arm does, and then follows it with less and less stiffness.

    It raises HardwareAbort for a joint that moves farther than ``max_tracking_error``, or faster
    than ``approach_speed``, as commands may not follow any faster.

    Args:
        joints: the n joints, base to terminal.
        settings: of the run.
        carries: returns the torque (n,) that carries the arm in a pose (n,) [N m].
        limits: of commanded positions.
        lifetime: time for which the arm floats without stiffness [s].

    Attributes:
        duration: longest time that all takes [s].
        samples: time since the stiffness began to fade [s], and position, velocity and commanded
            torque (3, n) of each cycle since then [rad, rad/s, N m].
    """

    def __init__(
        self,
        joints: Sequence[DamiaoJoint],
        settings: PlaySettings,
        carries: Callable[[Array], Array],
        limits: Limits,
        lifetime: float,
    ) -> None:
        self._joints = joints
        self._settings = settings
        self._carries = carries
        self._limits = limits
        self.duration = SETTLING + FADE + lifetime
        self._lifetime = lifetime
        self.samples: list[tuple[float, Array]] = []
        # Number of cycles in a row in which each joint was too fast.
        self._fast = np.zeros(len(joints), int)
        self._time = 0.0
        # Time at which a joint last moved, and at which the stiffness began to fade [s].
        self._moved_at = 0.0
        self._began_at = np.inf

    def begin(self, standing: Reference) -> Floating:
        """Take the reference in which the arm stands, and return this reference."""
        self._limits = self._limits.including(standing.position)
        self._position = standing.position
        # Last believed positions of the joints, their means over the last quarter of a second, and
        # those from which they float (n,) each [rad].
        self._q = self._mean = self._first = standing.position
        return self

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take positions, velocities and torques of a cycle, see ``Follower``."""
        self._q = np.where(np.isfinite(q), q, self._q)
        if self._time < self._began_at:
            self._settle()
            return
        self.samples.append((self._time - self._began_at, np.stack([q, qd, torque])))
        is_fast = np.abs(qd) > self._settings.approach_speed
        self._fast = np.where(is_fast, self._fast + 1, 0)

    def _settle(self) -> None:
        """Let the stiffness fade if the arm has stood still for a quarter of a second."""
        patience = 0.25
        share = min(self._settings.period / patience, 1.0)
        self._mean = self._mean + share * (self._q - self._mean)
        # Some steps of a position.
        if np.any(np.abs(self._q - self._mean) > 1e-3):
            self._moved_at = self._time
        if self._time > min(self._moved_at + patience, SETTLING):
            self._began_at = self._time
            self._first = self._q
            # With it goes the mean torque that stiffness adds, not that of the arm's last swing.
            self._offset = self._position - self._mean

    @property
    def is_done(self) -> bool:
        """Whether the arm has floated for its time."""
        return self._time >= self._began_at + FADE + self._lifetime

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s]; HardwareAbort for a joint that falls."""
        reach = self._settings.approach_speed * (time - self._time)
        self._time = time
        if time > self._began_at:
            share = min((time - self._began_at) / FADE, 1.0)
            stiffness = 0.5 + 0.5 * np.cos(np.pi * share)
            # Less would be rounded to nothing.
            self.stiffness = self.damping = stiffness if stiffness > 0.01 else 0.0
            position = self._q + self.stiffness * self._offset
            position = np.clip(position, self._position - reach, self._position + reach)
            self._position = np.clip(position, self._limits.lower, self._limits.upper)
            self._catch()
        still = np.zeros_like(self._q)
        return Reference(self._position, still, self._carries(self._q))

    def _catch(self) -> None:
        """Raise HardwareAbort for the first joint that is too far or, for two cycles, too fast."""
        moved = self._q - self._first
        is_far = np.abs(moved) > self._settings.max_tracking_error
        # A single velocity may be a damaged one.
        for j in np.flatnonzero(is_far | (self._fast > 1)).tolist():
            time, signals = self.samples[-1]
            raise HardwareAbort(
                f"{self._joints[j].label} is not carried by the model's gravity: it has moved by "
                f"{np.degrees(moved[j]):.1f} deg in {time:.1f} s, at last by "
                f"{np.degrees(signals[1, j]):.1f} deg/s, and was caught"
            )


@dataclass(frozen=True)
class Drift:
    """How n joints drift, and what explains it.

    Attributes:
        speed: mean velocity (n,) without stiffness [rad/s].
        end_speed: velocity (n,) at the end [rad/s]; 0 where a joint stands.
        gravity: torque (n,) that holds the arm at the end, by the model [N m].
        error: true minus modelled gravity (n,), if the model's friction is right [N m]; where a
            joint stands, what stiffness still adds, and its friction is in it.
        friction: friction (n,) at the end by the model, dry friction where a joint stands [N m].
    """

    speed: Array
    end_speed: Array
    gravity: Array
    error: Array
    friction: Array

    def sentences(self, joint_names: Sequence[str]) -> Iterator[str]:
        """Yield a sentence for each joint: how it moves, and what that says of the model."""
        for j, name in enumerate(joint_names):
            mean, end = np.degrees(np.abs([self.speed[j], self.end_speed[j]]))
            if end == 0.0:
                yield f"{name} stands (mean drift {mean:.2f} deg/s): {self._doubt(j)}"
            else:
                yield f"{name} {self._verb(j)} at {end:.2f} deg/s: {self._deviation(j)}"

    def _doubt(self, j: int) -> str:
        """Return how well a joint j that stands shows its gravity."""
        dry = self.friction[j]
        if dry == 0.0:
            return "how right its gravity is, is not known without its dry friction"
        # Stiffness that had not faded yet, when another joint was caught, has held it too.
        bound = abs(self.error[j]) + dry
        return (
            f"its gravity is right to within {bound:.2g} N·m, if its dry friction is the model's "
            f"{dry:.2g}"
        )

    def _verb(self, j: int) -> str:
        """Return how joint j moves: with its gravity, against it, or without much of it."""
        if abs(self.gravity[j]) < abs(self.error[j]):
            return "drifts"
        return "sinks" if self.gravity[j] * self.end_speed[j] < 0.0 else "rises"

    def _deviation(self, j: int) -> str:
        """Return how far the gravity of a joint j that moves is from the model's."""
        gravity = self.gravity[j]
        error = self.error[j]
        size = abs(error)
        share = f" ({percent(size / abs(gravity))})" if size < abs(gravity) else ""
        side = "more" if gravity * error > 0.0 else "less"
        text = f"{size:.2g} N·m{share} {side} than the model's {abs(gravity):.2g} N·m"
        if self.friction[j] == 0.0:
            return f"its gravity is at least {text}, which has no friction"
        return (
            f"its gravity is about {text}; by the model its friction takes {self.friction[j]:.2g} "
            "N·m at this speed"
        )


def measure_drift(
    samples: Sequence[tuple[float, Array]], robot: RobotModel
) -> Drift | None:
    """Return how the joints of an arm drift; None where it did not float long enough.

    Args:
        samples: of ``Floating``.
        robot: model of the arm with n joints, whose gravity torque carried it.
    """
    from robot_sysid.dynamics.inverse_dynamics import ArmDynamics

    complete = [sample for sample in samples if np.all(np.isfinite(sample[1]))]
    free = [sample for sample in complete if sample[0] >= FADE]
    # An arm that was caught earlier has moved while its stiffness faded.
    used = free if len(free) > 10 else complete
    if len(used) < 5:
        return None
    time, signals = map(np.array, zip(*used))
    q = signals[:, 0]
    speed = (q[-1] - q[0]) / (time[-1] - time[0])
    last = time > time[-1] - 0.5
    since = time[last] - np.mean(time[last])
    half_acceleration, mean_speed, middle = np.polyfit(since, q[last], 2)
    # A tenth of a degree per second is more than two steps of a position in half a second.
    moves = np.abs(mean_speed) > np.radians(0.1)
    zero = np.zeros_like(middle)
    velocity = np.stack([moves * mean_speed, zero])
    acceleration = np.stack([moves * 2.0 * half_acceleration, zero])
    end_speed = velocity[0] + since[-1] * acceleration[0]
    motion = Motion(np.zeros(2), np.stack([middle, middle]), velocity, acceleration)
    needed, gravity = ArmDynamics(robot)(motion)
    error = np.mean(signals[last, 2], axis=0) - needed
    friction = np.where(
        moves, np.abs(robot.friction.torque(velocity)[0]), robot.friction.largest_dry
    )
    return Drift(speed, end_speed, gravity, error, friction)

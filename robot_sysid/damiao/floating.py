"""An arm that its gravity torque alone carries: how fast its joints drift, and what that says.

The torque with which stiffness and damping held a joint beside the model's gravity fades, and then
nothing holds the joint but its gravity torque and its friction. A joint that moves with velocity v
and acceleration a obeys

    M a + friction(v) + gravity = commanded torque,

so that the error of the model's gravity is the commanded torque minus the model's torque of that
motion. A joint that stands has an error below its dry friction.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.references import Follower, Reference
from robot_sysid.damiao.settings import TRACKING, Plan
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.messages import number_text, with_error

SETTLING = 2.0
"""Time for which the arm is held until it stands still [s]."""
FADE = 1.0
"""Time in which the stiffness is then taken away [s]."""
LAST = 0.5
"""Time at the end from which the drift is measured [s]."""
AT_END = 0.02
"""Distance from an end of its range at which a joint is held by its stop, perhaps [rad]."""
MEAN_TIME = 0.25
"""Time constant of the mean position of an arm that settles [s]. With less, the stiffness would
take the torque of the arm's last swing with it; with more, where the arm came from would count,
which an eighth of ``SETTLING`` forgets."""
LEAST_SAMPLES = 5
"""Least number of samples that a drift is measured from: three make a parabola."""
SLOWEST_DRIFT = 0.1
"""Slowest drift that is told from standing [deg/s]: more than two steps of a position in half a
second."""
_NOT_SHOWN = "the test does not show its gravity"


class Floating(Follower):
    """A reference that stands until the arm does, and then follows it with less and less stiffness.

    It raises HardwareAbort for a joint that moves farther than ``max_tracking_error``, or faster
    than ``approach_speed``, as commands may not follow any faster, or out of the model's range, to
    which its position would be pulled back at the end. An error larger than the default one does
    not count: an arm that falls is caught.

    Args:
        plan: of the n joints, base to terminal; the arm floats without stiffness for its duration.
        carries: returns the torque (n,) that carries the arm in a pose (n,) [N m].

    Attributes:
        duration: time that all takes [s].
        samples: time since the stiffness began to fade [s], and position, velocity and commanded
            torque (3, n) of each of the last cycles since then [rad, rad/s, N m].
    """

    def __init__(self, plan: Plan, carries: Callable[[Array], Array]) -> None:
        self._plan = plan
        self._settings = plan.settings
        self._carries = carries
        self.duration = SETTLING + FADE + plan.duration
        n_samples = max(round(LAST / plan.settings.period), LEAST_SAMPLES)
        self.samples: deque[tuple[float, Array]] = deque(maxlen=n_samples)
        # Number of cycles in a row in which each joint was too fast.
        self._fast = np.zeros(plan.trajectory.n_joints, int)
        self._time = 0.0

    def begin(self, standing: Reference) -> Floating:
        """Take the reference in which the arm stands, and return this reference."""
        self._limits = self._plan.command_limits.with_positions(standing.position)
        self._position = standing.position
        # Last believed positions of the joints, their means over ``MEAN_TIME``, and those
        # from which they float (n,) each [rad].
        self._q = self._mean = self._first = standing.position
        self._offset = 0.0 * standing.position
        return self

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take positions, velocities and torques of a cycle, see ``Follower``."""
        self._q = np.where(np.isfinite(q), q, self._q)
        self._qd = qd
        since = self._time - SETTLING
        if since < 0.0:
            share = min(self._settings.period / MEAN_TIME, 1.0)
            self._mean = self._mean + share * (self._q - self._mean)
            # Stiffness takes its mean torque with it, not that of the arm's last swing.
            self._offset = self._position - self._mean
            self._first = self._q
            return
        self.samples.append((since, np.stack([q, qd, torque])))
        self._fast = (self._fast + 1) * (np.abs(qd) > self._settings.approach_speed)

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s]; HardwareAbort for a joint that falls."""
        reach = self._settings.approach_speed * (time - self._time)
        self._time = time
        if time > SETTLING:
            self._catch()
            self.stiffness = max(1.0 - (time - SETTLING) / FADE, 0.0)
            self.damping = self.stiffness
            position = self._q + self.stiffness * self._offset
            position = np.clip(position, self._position - reach, self._position + reach)
            self._position = np.clip(position, self._limits.lower, self._limits.upper)
        return Reference(self._position, 0.0 * self._q, self._carries(self._q))

    def _catch(self) -> None:
        """Raise HardwareAbort for the first joint that is too far or, for two cycles, too fast."""
        moved = self._q - self._first
        inside = np.clip(self._q, self._limits.lower, self._limits.upper)
        # At its end a joint may rest, and its zero be off by as much.
        has_left = np.abs(self._q - inside) > AT_END
        farthest = min(self._settings.max_tracking_error or TRACKING, TRACKING)
        # A single velocity may be a damaged one.
        is_falling = (np.abs(moved) > farthest) | (self._fast > 1)
        for j in np.flatnonzero(is_falling | has_left).tolist():
            what = "is not carried by the model's gravity"
            if has_left[j]:
                what = "leaves the model's range"
            raise HardwareAbort(
                f"{self._plan.trajectory.joints[j].label} {what}: it has moved by "
                f"{np.degrees(moved[j]):.1f} deg in {self._time - SETTLING:.1f} s, at last "
                f"by {np.degrees(self._qd[j]):.1f} deg/s, and was caught"
            )


class Drift(NamedTuple):
    """How a joint drifts, and what that says of its model's gravity.

    Only a joint that moves shows its gravity, and only where the model states the friction that it
    moves against. Friction holds one that stands with whatever error is smaller.

    Attributes:
        joint: its name.
        end_speed: velocity at the end [rad/s]; 0 where it stands.
        gravity: torque that holds it at the end, by the model [N m].
        error: true minus modelled gravity, if the model's friction is right [N m]; NaN where it
            stands.
        doubt: what ``error`` may be off by, or where it stands how large an error does not show
            [N m]: the model's friction at that speed, dry friction where it stands, and half a step
            of the commanded torque; infinite where the model has no friction, or a stop may hold
            the joint.
        is_at_end: whether it is at an end of its range, where a stop may hold it.
    """

    joint: str
    end_speed: float
    gravity: float
    error: float
    doubt: float
    is_at_end: bool

    def __str__(self) -> str:
        """Return a sentence: how the joint moves, and what that says of the model."""
        motion = "stands"
        if self.end_speed:
            motion = f"drifts at {np.degrees(abs(self.end_speed)):.2f} deg/s"
        if self.is_at_end:
            motion += " at an end of its range"
        return f"{self.joint} {motion}: {self._finding}"

    @property
    def _finding(self) -> str:
        """What the joint's motion says of its gravity."""
        is_known = np.isfinite(self.doubt)
        if self.is_at_end:
            return f"a stop may hold it, {_NOT_SHOWN}"
        if not self.end_speed:
            hidden = f"friction holds it, {_NOT_SHOWN}"
            if is_known:
                size = number_text(self.doubt, self.doubt)
                hidden += (
                    f"; by the model's friction, errors below {size} N·m do not show"
                )
            return hidden
        if not is_known:
            return f"the model states no friction for it, {_NOT_SHOWN}"
        # Positive where it is heavier than the model; the model's may be zero.
        excess = np.copysign(1.0, self.gravity) * self.error
        return (
            f"its gravity differs from the model's {abs(self.gravity):.2g} N·m by "
            f"{with_error(excess, self.doubt, 'N·m')}"
        )


def measure_drift(
    samples: Iterable[tuple[float, Array]], robot: RobotModel, step: Array
) -> list[Drift]:
    """Return how the joints of an arm drift; nothing where it did not float long enough.

    Args:
        samples: of ``Floating``.
        robot: model of the arm with n joints, whose gravity torque carried it.
        step: of the torques (n,) that motors are commanded [N m].
    """
    from robot_sysid.dynamics.inverse_dynamics import ArmDynamics

    complete = [sample for sample in samples if np.all(np.isfinite(sample[1]))]
    if len(complete) < LEAST_SAMPLES:
        return []
    time, signals = map(np.array, zip(*complete))
    since = time - np.mean(time)
    half_acceleration, speed, middle = np.polyfit(since, signals[:, 0], 2)
    moves = np.abs(speed) > np.radians(SLOWEST_DRIFT)
    # As it moves, and at rest.
    velocity = np.outer([1.0, 0.0], moves * speed)
    acceleration = np.outer([1.0, 0.0], moves * 2.0 * half_acceleration)
    q = np.array([middle, middle])
    needed, gravity = ArmDynamics(robot)(Motion(np.zeros(2), q, velocity, acceleration))
    friction = np.abs(robot.friction.torque(velocity)[0])
    friction = np.where(moves, friction, robot.friction.largest_dry)
    ends = np.array([robot.limits.lower, robot.limits.upper])
    is_at_end = np.any(np.abs(middle - ends) < AT_END, axis=0)
    is_known = (friction > 0.0) & ~is_at_end
    columns = (
        velocity[0] + since[-1] * acceleration[0],
        gravity,
        np.where(moves, np.mean(signals[:, 2], axis=0) - needed, np.nan),
        np.where(is_known, friction + 0.5 * step, np.inf),
        is_at_end,
    )
    return [Drift(*row) for row in zip(robot.joint_names, *columns)]

"""From torques sampled at the end of each command to the mean torque of held commands.

A motor samples its torque when the next command arrives, after the joint has used up what the last
one asked for; then that command steps the torque up again. What acts on the arm at frequencies far
below those of the commands differs from the samples in three ways:

- Half a step is missing: kp qd / (2 rate) for a steadily moving joint, which passes for negative
  viscous friction. It is known exactly, because position and velocity do not jump.
- Where steps grow, both sides of one are on average above the commands' mean, by a twelfth of the
  growth: an apparent armature of kp / (12 rate^2).
- Between commands the torque falls by a step. The joints' velocities follow, by up to
  step / (12 rate inertia) at the moment of sampling, and damping makes torque of it. That passes
  for viscous friction of kd kp / (12 rate^2 inertia), and for armature in proportion. A joint so
  light that it swings on its stiffness within a few periods (0.001 kg m^2 on 180 N m/rad: 15 ms)
  takes back most of a step before it is sampled. Where joints are coupled and sampled one after the
  other, their positions follow each other's steps too.

Commands tell the first two; the third takes the arm's inertia. Measured velocities would show it
too, but a motor's filter delays them by an unknown time, which would pass for armature.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.damiao.session import Replies
from robot_sysid.records import Array

# Product of a mode's rate and the period below which its change is lost in rounding.
_SLOWEST_CHANGE = 1e-3


class SamplingRipple:
    """What steps of torque that recur add to the motion of an arm at the moments of sampling.

    Args:
        mobility: returns the inverse mass matrix (n, n) at positions (n,).
        viscous: (n,) the joints' own viscous friction [N m s/rad].
    """

    def __init__(self, mobility: Callable[[Array], Array], viscous: Array) -> None:
        self.n_joints = len(viscous)
        self._mobility = mobility
        self._viscous = viscous

    def motion(
        self,
        q: Array,
        acted: MitCommand,
        step: Array,
        growth: Array,
        time: Array,
        period: float,
    ) -> tuple[Array, Array]:
        """Return the positions and velocities (n,) that are added [rad, rad/s].

        At positions q (n,) and under a command (n,) each joint is sampled at its ``time`` (n,), and
        has its torque step (n,) then, every period, by ``growth`` (n,) more each time. A period
        after its step, at a share u of it, joint j has the torque
        -step_j B1(u) + growth_j / 2 B2(u) beside the mean of held commands, with Bernoulli's
        polynomials B1(u) = u - 1/2 and B2(u) = u^2 - u + 1/6.
        """
        n = self.n_joints
        mobility = self._mobility(q)
        if not (
            np.all(np.isfinite(mobility)) and np.linalg.eigvalsh(mobility)[0] > 0.0
        ):
            # The model states no inertia that could tell.
            return np.zeros(n), np.zeros(n)

        # Positions and velocities (2n,) change at the rates of these modes, driven by torques.
        stiffness = mobility * acted.kp[:n]
        damping = mobility * (acted.kd[:n] + self._viscous)
        system = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -damping]])
        rates, modes = np.linalg.eig(system)
        try:
            drive = np.linalg.solve(modes, np.vstack((np.zeros((n, n)), mobility)))
        except np.linalg.LinAlgError:
            # Two modes in one, as of a joint without gains: a sample is not worth the run.
            return np.zeros(n), np.zeros(n)
        change = rates * period
        change = np.where(np.abs(change) < _SLOWEST_CHANGE, -_SLOWEST_CHANGE, change)

        # The periodic response (n, n, modes) of each mode to -B1, and to B2 / 2 by way of it, at
        # the share of a period that has passed when joint i is sampled since j was.
        share = ((time[:, None] - time) / period % 1.0)[..., None]
        fading = np.exp(change * share) / -np.expm1(change)
        to_step = period / change * (share - 0.5 + 1.0 / change + fading)
        second = share**2 - share + 1.0 / 6.0
        to_growth = -(0.5 * period * second + to_step) / change

        response = to_step * step[:, None] + to_growth * growth[:, None]
        amplitudes = np.sum(response * drive.T, axis=1)
        added = np.sum(modes.reshape(2, n, -1) * amplitudes, axis=-1).real
        return added[0], added[1]


class Centring:
    """Makes mean torques of the samples of a run, cycle by cycle.

    Without a ``ripple``, where the arm's inertia is not known, the module's third part is left out.
    """

    def __init__(self, period: float, ripple: SamplingRipple | None = None) -> None:
        self._period = period
        self._ripple = ripple
        self._last: Array | None = None

    def torques(self, replies: Replies, acted: MitCommand) -> tuple[Array, Array]:
        """Return a cycle's torque steps, and what to add to its sampled torques (n,) [N m]."""
        step = torque_step(replies, acted)
        state = np.array([replies.feedback.position, replies.time, step])
        last = state if self._last is None else self._last
        # A joint that did not answer is where it was, and steps as it did.
        state = np.where(np.isfinite(state), state, last)
        growth = np.nan_to_num(state[2] - last[2])
        self._last = state
        rippling = self._ripple_torque(state, growth, acted)
        return step, 0.5 * step - growth / 12.0 + rippling

    def _ripple_torque(self, state: Array, growth: Array, acted: MitCommand) -> Array:
        """Return what ripple takes from the samples (n,) at positions, times and steps (3, n).

        The steps have grown by ``growth`` (n,) since the last cycle.
        """
        torque = np.zeros(state.shape[1])
        if self._ripple is None:
            return torque
        arm = slice(self._ripple.n_joints)
        q, time, step = state[:, arm]
        if np.all(np.isfinite(state[:, arm])):
            steps = step, growth[arm]
            position, velocity = self._ripple.motion(
                q, acted, *steps, time, self._period
            )
            torque[arm] = acted.kp[arm] * position + acted.kd[arm] * velocity
        return torque


def torque_step(replies: Replies, acted: MitCommand) -> Array:
    """Return the torque step (n,) that the command just sent makes in each motor [N m]."""
    command = replies.command or acted
    q = replies.feedback.position
    qd = replies.feedback.velocity
    return command.motor_torque(q, qd) - acted.motor_torque(q, qd)

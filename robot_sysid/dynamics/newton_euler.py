"""Motion and torque of all links at once, in numpy on whole chunks: recursive Newton-Euler.

With T_i the pose of link i in link i-1 and S_i the screw of its joint in its own frame (Lynch and
Park, "Modern Robotics", 2017, eq. 8.50 to 8.53, A_0 = [0, -g]):

    V_i = Ad(T_i^-1) V_{i-1} + S_i qd_i,
    A_i = Ad(T_i^-1) A_{i-1} - ad(S_i) V_i qd_i + S_i qdd_i,
    F_i = Y6(V_i, A_i) theta_i + Ad(T_{i+1}^-1)^T F_{i+1},   tau_i = S_i^T F_i.

The regressor of a link's own parameters needs the twist of each joint below it:

    J_ij = Ad(T_i^-1) J_{i-1,j},   J_ii = S_i,   d tau_j / d theta_i = J_ij^T Y6(V_i, A_i).

Turning by an angle d about an axis, Ad(exp([S] d)^-1) = 1 - ad(S) sin d + ad(S)^2 (1 - cos d);
ad(S) of a slide has no square, and d stands for the sine.

In the base's frame a joint's screw is the same for all links that it moves. There link i turns by
X_i = sum_{k <= i} S_k dq_k, and

    dS_i = ad(X_i) S_i,   V_i = sum_{k <= i} S_k qd_k,
    A_i = sum_{k <= i} (S_k qdd_k + ad(V_k) S_k qd_k) + A_0.

Arrays are component first: (6, N) holds N samples of a twist [omega, v].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import mujoco
import numpy as np

from robot_sysid.dynamics.spatial import (
    PARAMETER_NAMES,
    cross,
    skew,
    symmetric_from_six,
)
from robot_sysid.records import Array, RobotModel
from robot_sysid.regressor import wrench_regressor

N_PARAMETERS = len(PARAMETER_NAMES)
# Numbers in an array at once: a long arm's take more memory than all that is known of it.
_NUMBERS = 1_000_000


@dataclass(frozen=True)
class LinksMotion:
    """Motion of all links over N samples: velocity and spatial acceleration minus gravity (6, N),
    each in the link's own frame, what takes twists there from the link before it, Ad(T^-1)
    (6, 6, N), and its joint's screw (6,).
    """

    velocity: tuple[Array, ...]
    acceleration: tuple[Array, ...]
    steps: tuple[Array, ...]
    screws: tuple[Array, ...]

    @cached_property
    def to_links(self) -> Array:
        """What takes twists from the base's frame to each link's (n, N, 6, 6)."""
        steps = (np.moveaxis(each, -1, 0) for each in self.steps)
        return np.array([*accumulate(steps, lambda before, step: step @ before)])

    @cached_property
    def joint_twists(self) -> Array:
        """Each joint's screw in the base's frame (6, n, N)."""
        screws = np.array(self.screws).T[:, :, None]
        return self._from_links(np.tile(screws, self.velocity[0].shape[1]))

    def _from_links(self, twists: Array) -> Array:
        """Return twists (6, n, N) of the links' frames in the base's."""
        blocks = self.to_links.reshape(*self.to_links.shape[:2], 2, 3, 2, 3)
        # Ad(T) has the blocks of Ad(T^-1) transposed.
        back = blocks.swapaxes(-1, -3).reshape(self.to_links.shape)
        return np.einsum("inab,bin->ain", back, twists)

    def gradient(
        self,
        rates: Sequence[Array],
        screws: Array,
        twists: Sequence[Array],
        turns: Array,
    ) -> tuple[Array, Array, Array]:
        """Return a scalar's gradient (N, n) by q, qd and qdd, in reverse mode, at rates qd and qdd
        (N, n) from that by ``joint_twists``, by links' ``velocity`` and ``acceleration``, and by
        how links turn in the base's frame, (6, n, N) each.
        """
        (speed, change) = (each.T for each in rates)
        own = self.joint_twists
        moves = (np.stack(each, axis=1) for each in (self.velocity, self.acceleration))
        here, faster = map(self._from_links, moves)
        velocity, acceleration = (
            np.einsum("inba,bin->ain", self.to_links, x) for x in twists
        )
        turns = turns + bracket_transposed(here, velocity)
        turns += bracket_transposed(faster, acceleration)
        acceleration = _beyond(acceleration)
        velocity = _beyond(velocity - bracket_transposed(own, acceleration) * speed)
        screws = screws + acceleration * change + velocity * speed
        screws += bracket_transposed(here, acceleration) * speed
        turns -= bracket_transposed(own, screws)
        by_speed = np.sum(own * velocity + bracket(here, own) * acceleration, axis=0)
        by_place, by_change = (
            np.sum(own * x, axis=0) for x in (_beyond(turns), acceleration)
        )
        return by_place.T, by_speed.T, by_change.T

    def columns(self, links: Sequence[int]) -> Array:
        """Return the joint torque regressor (N, n, 10 len(links)) of some links [N m].

        Samples of one number stand side by side in memory.
        """
        joints = len(self.velocity)
        samples = self.velocity[0].shape[1]
        columns = np.zeros((joints, len(links), N_PARAMETERS, samples))
        jacobian = np.empty((joints, 6, samples))
        for link in range(max(links, default=-1) + 1):
            for twist in jacobian[:link]:
                twist[:] = np.einsum("abn,bn->an", self.steps[link], twist)
            jacobian[link] = self.screws[link][:, None]
            for place in np.flatnonzero(np.equal(links, link)):
                wrench = wrench_regressor(
                    self.velocity[link].T, self.acceleration[link].T
                )
                for twist, own in zip(jacobian[: link + 1], columns[:, place]):
                    np.einsum("in,ikn->kn", twist, wrench, out=own)
        return columns.reshape(joints, -1, samples).transpose(2, 0, 1)

    def torque(self, thetas: Array) -> Array:
        """Return the joint torque (N, n) [N m] of links theta (n, 10), rigid bodies only."""
        samples = self.velocity[0].shape[1]
        tau = np.zeros((samples, len(thetas)))
        wrench = np.zeros((6, samples))
        for link in reversed(range(len(thetas))):
            if np.any(thetas[link]):
                move = self.velocity[link], self.acceleration[link]
                wrench = wrench + _wrench(thetas[link], *move)
            tau[:, link] = self.screws[link] @ wrench
            wrench = np.einsum("abn,an->bn", self.steps[link], wrench)
        return tau

    def slopes(self, thetas: Array, qd: Array) -> Array:
        """Return (N, n, n) by how much each joint's torque grows per turn of another one, of links
        theta (n, 10), at joint speeds (N, n) [N m/rad].

        With d_j the derivative by q_j: d_j V_j = -ad(S_j) V_j, d_j A_j = -ad(S_j) A_j, which pass
        on as V and A do, and d_j Ad(T_j^-1) = -ad(S_j) Ad(T_j^-1).
        """
        samples, count = qd.shape
        twists = np.zeros((2, 6, 0, samples))
        slopes = np.zeros((samples, count, count))
        bodies = []
        for link, theta in enumerate(thetas):
            screw = self.screws[link][:, None]
            here = self.velocity[link][:, None]
            twists = np.einsum("abn,mbjn->majn", self.steps[link], twists)
            twists[1] -= bracket(screw[:, None], twists[0] * qd[:, link])
            moves = self.velocity[link], self.acceleration[link]
            own = -np.stack([bracket(screw, each) for each in moves])
            twists = np.concatenate((twists, own[:, :, None]), axis=2)
            inertia = _inertia(theta)
            (velocity, acceleration) = twists
            change = np.tensordot(inertia, acceleration, 1)
            change -= bracket_transposed(velocity, np.tensordot(inertia, here, 1))
            change -= bracket_transposed(here, np.tensordot(inertia, velocity, 1))
            bodies.append(change)
        wrench = np.zeros((6, samples))
        turned = np.zeros((6, count, samples))
        for link in reversed(range(count)):
            wrench = wrench + _wrench(
                thetas[link], self.velocity[link], self.acceleration[link]
            )
            turned[:, : link + 1] += bodies[link]
            slopes[:, link] = np.tensordot(self.screws[link], turned, 1).T
            turned[:, link] -= bracket_transposed(self.screws[link][:, None], wrench)
            turned = np.einsum("abn,ajn->bjn", self.steps[link], turned)
            wrench = np.einsum("abn,an->bn", self.steps[link], wrench)
        return slopes


class LinkDynamics:
    """Recursive Newton-Euler of one arm; another gravity (3,), or each sample's (3, N), may stand
    for its own [m/s^2].
    """

    def __init__(self, robot: RobotModel, gravity: Array | None = None) -> None:
        self._home = robot.reference
        self._slides = robot.is_slide
        self._screws = tuple(link.screw for link in robot.links)
        # ad(S), and what Ad(T^-1) has of 1, sin d and 1 - cos d, by that at home.
        self._brackets = [
            _lower(skew(screw[:3]), skew(screw[3:])) for screw in self._screws
        ]
        self._steps = []
        for ad, link in zip(self._brackets, robot.links):
            at_home = _lower(link.rotation.T, -link.rotation.T @ skew(link.translation))
            self._steps.append(
                np.stack((at_home, -ad @ at_home, ad @ ad @ at_home), axis=-1)
            )
        options = robot.mj_model.opt
        weightless = options.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        there = np.array(options.gravity) if gravity is None else gravity
        self._gravity = np.reshape((not weightless) * there, (3, -1))

    def motion(self, q: Array, qd: Array, qdd: Array) -> LinksMotion:
        """Return the motion of all links for chain motions (N, n) [rad, rad/s, rad/s^2]."""
        return LinksMotion(*zip(*self.moves(q, qd, qdd)))

    def moves(
        self, q: Array, qd: Array, qdd: Array
    ) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Yield velocity, acceleration, step and screw of each link, see ``LinksMotion``."""
        velocity, acceleration = np.zeros((2, 6, len(q)))
        acceleration[3:] = -self._gravity
        turns = (q - self._home).T
        sines = np.where(self._slides[:, None], turns, np.sin(turns))
        versines = 1.0 - np.cos(turns)
        for i, screw in enumerate(self._screws):
            grown = np.stack((np.ones(len(q)), sines[i], versines[i]))
            step = np.tensordot(self._steps[i], grown, 1)
            velocity = np.einsum("abn,bn->an", step, velocity) + np.outer(
                screw, qd[:, i]
            )
            acceleration = np.einsum("abn,bn->an", step, acceleration) + np.outer(
                screw, qdd[:, i]
            )
            acceleration -= (self._brackets[i] @ velocity) * qd[:, i]
            yield velocity, acceleration, step, screw


def in_parts(width: int, *motion: Array) -> Iterator[tuple[Array, ...]]:
    """Yield arrays (N, ...) of a motion in parts, so that what has so many numbers a sample stays
    small.
    """
    parts = 1 + len(motion[0]) * width // _NUMBERS
    yield from zip(*(np.array_split(each, parts) for each in motion))


def bracket(a: Array, b: Array) -> Array:
    """Return ad(a) b = [w_a x w_b, v_a x w_b + w_a x v_b] for twists (6, ...)."""
    return np.concatenate(
        (cross(a[:3], b[:3]), cross(a[3:], b[:3]) + cross(a[:3], b[3:])), axis=0
    )


def bracket_transposed(a: Array, b: Array) -> Array:
    """Return ad(a)^T b = -[w_a x m + v_a x f, w_a x f] for b = [m, f] (6, ...)."""
    return -np.concatenate(
        (cross(a[:3], b[:3]) + cross(a[3:], b[3:]), cross(a[:3], b[3:])), axis=0
    )


def _beyond(values: Array) -> Array:
    """Return sums (6, n, N) over each link and all that it carries."""
    return np.cumsum(values[:, ::-1], axis=1)[:, ::-1]


def _lower(turn: Array, shift: Array) -> Array:
    """Return [[turn, 0], [shift, turn]] (6, 6)."""
    found = np.zeros((6, 6))
    found[:3, :3] = found[3:, 3:] = turn
    found[3:, :3] = shift
    return found


def _inertia(theta: Array) -> Array:
    """Return G = [[I, [h]x], [-[h]x, m 1]] (6, 6)."""
    inertia = np.diag(np.repeat((0.0, theta[0]), 3))
    inertia[:3, :3] = symmetric_from_six(theta[4:])
    inertia[:3, 3:] = skew(theta[1:4])
    inertia[3:, :3] = -inertia[:3, 3:]
    return inertia


def _wrench(theta: Array, velocity: Array, acceleration: Array) -> Array:
    """Return G A - ad(V)^T G V (6, N)."""
    inertia = _inertia(theta)
    return inertia @ acceleration - bracket_transposed(velocity, inertia @ velocity)

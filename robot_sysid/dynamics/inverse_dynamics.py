"""Inverse dynamics of an arm: by a recursion over its links in numpy, and by MuJoCo.

MuJoCo gives the torque of an entire arm, and that of armature, springs, tendons and actuators
alone. The recursion of Newton and Euler gives motion and torque of all links at once, on chunks
of samples.

With T_i the pose of link i in link i-1 and S_i the screw of its joint in its own frame (Lynch and
Park, "Modern Robotics", 2017, eq. 8.50 to 8.53, A_0 = [0, -g]):

    V_i = Ad(T_i^-1) V_{i-1} + S_i qd_i,
    A_i = Ad(T_i^-1) A_{i-1} - ad(S_i) V_i qd_i + S_i qdd_i,
    F_i = Y6(V_i, A_i) theta_i + Ad(T_{i+1}^-1)^T F_{i+1},   tau_i = S_i^T F_i.

The regressor of a link's own parameters needs the twist of each joint below it:

    J_ij = Ad(T_i^-1) J_{i-1,j},   J_ii = S_i,   d tau_j / d theta_i = J_ij^T Y6(V_i, A_i).

Turning by an angle d about an axis, Ad(exp([S] d)^-1) = 1 - ad(S) sin d + ad(S)^2 (1 - cos d);
ad(S) of a slide has no square, and d stands for the sine.

Arrays are component first: (6, N) holds N samples of a twist [omega, v].

Two errors of a real arm change its torques to first order by a column times an unknown: the zero
of an encoder, by -d tau / d q_joint [N m/rad], and a base that is tilted by two angles. Joint
torques are linear in gravity g. Turning it by small angles a1, a2 about two axes e1, e2
perpendicular to it adds a1 tau(e1 x g) + a2 tau(e2 x g), tau(.) the torque of the resting arm under
that gravity. Estimated, applied and estimated again, this converges in a few rounds.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.passive import acts_by_itself, leave_passive_actuators
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.parameters import TILTS, keys_of, of_body
from robot_sysid.regressor import wrench_regressor
from robot_sysid.spatial import N_INERTIAL, cross

ARRAY_SIZE = 1_000_000
"""Largest size of an array of intermediate results [numbers], beyond which a motion is split: it
bounds the memory for arms with many joints, and changes no result."""
EARTH_GRAVITY = 9.81
"""Gravity on Earth, as MuJoCo has it where a model states none [m/s^2]."""
TILT_NAMES = keys_of(TILTS)
"""Names of the two angles by which a base is tilted."""
# Angle over which slopes of the weight are taken [rad].
_TURN = 0.01
# Spatial inertia (6, 10, 6) per parameter: wrenches of unit accelerations of a resting body.
_UNIT_WRENCHES = wrench_regressor(np.zeros((6, 6)), np.eye(6))


def analysis_copy(
    mj_model: Any, disabled: Sequence[str] = ("CONSTRAINT", "CONTACT", "SENSOR")
) -> Any:
    """Return a copy of a compiled model reduced to rigid-body dynamics, armature, springs and
    actuators that act whatever their control is.

    Switched off: constraints (contacts, limits, equalities, and MuJoCo's own frictionloss, which is
    a ramp in acceleration and velocity and not Coulomb's law), gravity compensation (a real joint
    carries the weight), fluid drag, and linear joint damping (friction is added by the caller).

    ``disabled``: what of MuJoCo does not act, by the names of its flags, beside what the file
    disables; of constraints and actuators this alone decides.
    """
    model = copy.copy(mj_model)
    leave_passive_actuators(model)
    options = model.opt
    bits = mujoco.mjtDisableBit
    for flag in (bits.mjDSBL_CONSTRAINT, bits.mjDSBL_ACTUATION):
        options.disableflags &= ~int(flag)
    for name in disabled:
        # Older releases lack some of these flags.
        options.disableflags |= int(getattr(bits, f"mjDSBL_{name}", 0))
    # "invdiscrete" would reinterpret qacc, "fwdinv" and "energy" only cost time.
    options.enableflags = 0
    options.density = options.viscosity = 0.0
    model.body_gravcomp[:] = 0.0
    model.dof_damping[:] = 0.0
    return model


def data_at_pose(mj_model: Any, qpos: Array) -> Any:
    """Return new MuJoCo data of a model at ``qpos`` (nq,), with all frames computed."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    return data


def subtree(mj_model: Any, body_id: int) -> list[int]:
    """Return the ids of a body and all its descendants, which MuJoCo numbers consecutively."""
    end = body_id + 1
    while end < mj_model.nbody and mj_model.body_parentid[end] >= body_id:
        end += 1
    return list(range(body_id, end))


def has_only_armature(mj_model: Any) -> bool:
    """Return whether joint armature is the only torque beside rigid-body dynamics.

    Springs, nonlinear damping, tendons and passive actuators need MuJoCo's full inverse dynamics;
    without them a cheaper formula gives the same torque. Rotors and damping of actuators are in the
    joints.
    """
    fields = (
        "jnt_stiffness jnt_stiffnesspoly dof_dampingpoly tendon_stiffness "
        "tendon_stiffnesspoly tendon_damping tendon_dampingpoly tendon_armature"
    )
    # Older releases of MuJoCo lack some of these fields.
    has_more = any(np.any(getattr(mj_model, name, 0.0)) for name in fields.split())
    return not has_more and not np.any(acts_by_itself(mj_model))


class ArmDynamics:
    """Inverse dynamics of an entire arm, by MuJoCo; as a function of a motion, with friction.

    It is pickled as its arguments alone: a pickle of MuJoCo's data ends the process in MuJoCo 3.0.

    Args:
        robot: the arm.
        mj_model: another compiled model of it; None for its own.

    Attributes:
        model: the copy of the compiled model that torques are computed with, see
            ``analysis_copy``.
        data: its MuJoCo data, which every call changes.
        chain: addresses (n,) of the arm's joints in qpos, and in qvel.
    """

    def __init__(self, robot: RobotModel, mj_model: Any = None) -> None:
        self._arguments = robot, mj_model
        self.model = analysis_copy(mj_model or robot.mj_model)
        self._has_passive_actuators = bool(np.any(self.model.actuator_gear))
        self.data = data_at_pose(self.model, robot.reference_qpos)
        self.chain = robot.qpos_index, robot.dof_index

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how pickle makes the object again: its class and its arguments."""
        return type(self), self._arguments

    def __call__(self, motion: Motion) -> Array:
        """Return the joint torques (N, n) of a motion, the model's friction included [N m]."""
        robot, _ = self._arguments
        rigid = self.torque(motion.q, motion.qd, motion.qdd)
        return rigid + robot.friction.torque(motion.qd)

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return MuJoCo's joint torques (N, n) for motions (N, n) [N m].

        Joints outside the chain keep their positions, velocities and accelerations.
        """
        tau = np.empty_like(q)
        qpos_index, dof_index = self.chain
        # Looked up once: an attribute of ``data`` takes as long to find as the row takes to write.
        data = self.data
        qpos = data.qpos
        qvel = data.qvel
        qacc = data.qacc
        for k in range(len(q)):
            qpos[qpos_index] = q[k]
            qvel[dof_index] = qd[k]
            qacc[dof_index] = qdd[k]
            mujoco.mj_inverse(self.model, data)
            tau[k] = data.qfrc_inverse[dof_index]
            if self._has_passive_actuators:
                mujoco.mj_fwdActuation(self.model, data)
                tau[k] -= data.qfrc_actuator[dof_index]
        return tau

    def weight_and_inertia(self, motion: Motion) -> tuple[Array, Array]:
        """Return two parts (N, n) of the torque of a motion, without friction and damping [N m].

        The first is the torque at rest in each pose: gravity and springs. The second is that of
        accelerations, Coriolis and rotors, which grows with the square of the speed at which the
        same path is followed. All damping is odd in the velocity, and these are even: so the mean
        of a motion forwards and backwards has none of a model's nonlinear damping or tendons.
        """
        q = motion.q
        at_rest = np.zeros_like(q)
        weight = self.torque(q, at_rest, at_rest)
        forwards = self.torque(q, motion.qd, motion.qdd)
        backwards = self.torque(q, -motion.qd, motion.qdd)
        return weight, 0.5 * (forwards + backwards) - weight

    def weight_slopes(self, q: Array) -> Array:
        """Return by how much each joint's weight grows as it sinks (n,), at most in poses (N, n).

        [N m/rad]; 0 of a joint that hangs. With a stiffness below this a joint topples.
        """
        still = np.zeros_like(q)
        slopes = []
        for j, turn in enumerate(_TURN * np.eye(q.shape[1])):
            ahead, behind = (
                self.torque(q + way, still, still) for way in (turn, -turn)
            )
            slopes.append(np.max(behind[:, j] - ahead[:, j]) / (2.0 * _TURN))
        return np.maximum(slopes, 0.0)


class BeyondRigidBodies:
    """Torque of armature, springs, tendons and actuators, which no link's parameters make.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._armature = robot.armature
        self._arm = None if has_only_armature(robot.mj_model) else ArmDynamics(robot)

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque (N, n) of armature, springs, tendons and actuators for motions (N, n)
        [N m].
        """
        if self._arm is None:
            return self._armature * qdd
        model = self._arm.model
        rigid = np.empty(model.nv)
        torque = np.empty_like(q)
        for k in range(len(q)):
            # Leaves the sample's motion in ``data``, of which MuJoCo's Newton-Euler recursion (1:
            # with accelerations) then computes the torque of the rigid bodies alone.
            total = self._arm.torque(q[k, None], qd[k, None], qdd[k, None])
            mujoco.mj_rne(model, self._arm.data, 1, rigid)
            torque[k] = total - rigid[self._arm.chain[1]]
        return torque


@dataclass(frozen=True)
class LinksMotion:
    """Motion of the n links of an arm over N samples, each in the link's own frame.

    Attributes:
        velocity: (n, 6, N) twist of each link [rad/s, m/s].
        acceleration: (n, 6, N) spatial acceleration of each link minus gravity [rad/s^2, m/s^2].
        steps: (n, 6, 6, N) Ad(T^-1) of each link, which takes twists from the previous link's frame
            (the base's for the first link) to its own.
        screws: per link the screw (6,) of its joint in the link's frame.
        brackets: per link ad(S) (6, 6) of this screw.
    """

    velocity: Array
    acceleration: Array
    steps: Array
    screws: tuple[Array, ...]
    brackets: tuple[Array, ...]

    def jacobians(self) -> Iterator[Array]:
        """Yield, link by link, the twists J_ij (n, 6, N) of the joints up to it in its frame.

        It is one array, which the next step changes; entries of joints beyond the link are not set.
        """
        jacobian = np.empty_like(self.velocity)
        for link, (step, screw) in enumerate(zip(self.steps, self.screws)):
            jacobian[:link] = np.einsum("abn,jbn->jan", step, jacobian[:link])
            jacobian[link] = screw[:, None]
            yield jacobian

    def columns(self, links: Sequence[int]) -> Array:
        """Return the joint torque regressor (N, n, 10 len(links)) of the links with these indices,
        in their order.

        In memory the N samples of one entry lie side by side.
        """
        joints, _, samples = self.velocity.shape
        columns = np.zeros((joints, len(links), N_INERTIAL, samples))
        # Of all links at once, one behind the other.
        velocity, acceleration = (
            np.swapaxes(motion[list(links)], 0, 1).reshape(6, -1).T
            for motion in (self.velocity, self.acceleration)
        )
        regressors = wrench_regressor(velocity, acceleration)
        wrenches = regressors.reshape(6, N_INERTIAL, len(links), samples)
        for link, jacobian in enumerate(self.jacobians()):
            if link in links:
                number = links.index(link)
                np.einsum(
                    "jin,ikn->jkn",
                    jacobian[: link + 1],
                    wrenches[:, :, number],
                    out=columns[: link + 1, number],
                )
        return columns.reshape(joints, -1, samples).transpose(2, 0, 1)

    def torque(self, thetas: Array) -> Array:
        """Return the joint torque (N, n) [N m] of rigid links with inertial parameters ``thetas``
        (n, 10), base to terminal; a link with zeros has no effect.
        """
        torques = [self.screws[link] @ wrench for link, wrench in self.wrenches(thetas)]
        return np.stack(torques[::-1], axis=-1)

    def wrenches(self, thetas: Array) -> Iterator[tuple[int, Array]]:
        """Yield, from the last link inwards, its index and the wrench (6, N) that moves it and all
        beyond it, in its frame; ``thetas`` as in ``torque``.
        """
        own = wrench_of(thetas, self.velocity, self.acceleration)
        wrench = np.zeros_like(own[0])
        for link in reversed(range(len(thetas))):
            wrench = wrench + own[link]
            yield link, wrench
            wrench = np.einsum("abn,an->bn", self.steps[link], wrench)

    def torque_at_rest(self, thetas: Array, gravities: Array) -> Array:
        """Return the joint torque (N, n, k) [N m] of resting links under k gravities (k, 3).

        The links rest in the positions of this motion; ``thetas`` as in ``torque``.
        """
        joints, _, samples = self.velocity.shape
        twists = np.zeros((len(gravities), 6, samples))
        twists[:, 3:] = -gravities[:, :, None]
        wrenches = []
        for step, inertia in zip(self.steps, spatial_inertias(thetas)):
            twists = np.einsum("abn,kbn->kan", step, twists)
            wrenches.append(inertia @ twists)
        torque = np.empty((joints, len(gravities), samples))
        wrench = np.zeros_like(twists)
        for link in reversed(range(joints)):
            wrench = wrench + wrenches[link]
            torque[link] = self.screws[link] @ wrench
            wrench = np.einsum("abn,kan->kbn", self.steps[link], wrench)
        return torque.transpose(2, 0, 1)

    def slopes(self, thetas: Array, qd: Array) -> Array:
        """Return the derivative (N, n, n) of joint torques by joint positions [N m/rad].

        Entry [:, i, j] is the derivative of tau_i by q_j. With d_j the derivative by q_j:
        d_j V_j = -ad(S_j) V_j, d_j A_j = -ad(S_j) A_j, which are passed on to the next links by the
        recursion of V and A, and d_j Ad(T_j^-1) = -ad(S_j) Ad(T_j^-1).

        Args:
            thetas: (n, 10) inertial parameters of the links, base to terminal, in the order of
                ``spatial.PARAMETER_NAMES``, inertia about the link frame's origin.
            qd: (N, n) joint speeds of this motion.
        """
        samples, count = qd.shape
        # The derivatives (2, j, 6, N) of the present link's velocity and acceleration by q_j.
        twists = np.zeros((2, 0, 6, samples))
        slopes = np.zeros((samples, count, count))
        wrench_slopes = []
        inertias = spatial_inertias(thetas)
        # The derivative (n, 6, 6, N) of each link's own wrench by its velocity.
        by_velocity = thetas @ _BY_VELOCITIES.reshape(N_INERTIAL, -1)
        by_velocity = by_velocity.reshape(count, 36, 6) @ self.velocity
        by_velocity = by_velocity.reshape(count, 6, 6, samples)
        # Outwards: the derivative (j, 6, N) of each link's own wrench by q_j, j up to the link.
        for link, inertia in enumerate(inertias):
            bracket = self.brackets[link]
            motion = np.stack((self.velocity[link], self.acceleration[link]))[:, None]
            twists = np.einsum("abn,mjbn->mjan", self.steps[link], twists)
            twists[1] -= bracket @ twists[0] * qd[:, link]
            twists = np.concatenate((twists, -bracket @ motion), axis=1)
            of_velocity = np.einsum("acn,jcn->jan", by_velocity[link], twists[0])
            wrench_slopes.append(inertia @ twists[1] + of_velocity)
        # Inwards: the wrench of a link and all beyond it, and the derivative of that sum.
        total = np.zeros_like(self.velocity)
        for link, wrench in self.wrenches(thetas):
            total[: link + 1] += wrench_slopes[link]
            slopes[:, link] = (self.screws[link] @ total).T
            total[link] -= self.brackets[link].T @ wrench
            total = np.einsum("abn,jan->jbn", self.steps[link], total)
        return slopes

    def weighted_gradient(
        self, links: Sequence[int], weights: Array, qd: Array
    ) -> Array:
        """Return the gradient (3, N, n) by q, qd and qdd of the weighted sum of ``columns``.

        Reverse differentiation of the recursions: with G_ij the spatial inertia whose parameters
        are the weights of joint j's torque by link i, the sum is

            sum_ij J_ij . (G_ij A_i - ad(V_i)^T G_ij V_i).

        Its derivatives by J_ij, V_i and A_i are passed on inwards by Ad(T_i^-1)^T, and
        d Ad(T_i^-1) / d q_i = -ad(S_i) Ad(T_i^-1).

        Args:
            links: as of ``columns``.
            weights: (n, 10 len(links), N) of the columns.
            qd: (N, n) joint speeds of this motion.
        """
        joints, _, samples = self.velocity.shape
        # One pair per link and joint up to it, link by link, components first.
        link_of_pair, joint_of_pair = np.tril_indices(joints)
        twists = [
            twist[: link + 1].copy() for link, twist in enumerate(self.jacobians())
        ]
        jacobian = np.concatenate(twists).swapaxes(0, 1)
        parameters = np.zeros((joints, joints, N_INERTIAL, samples))
        blocks = weights.reshape(joints, len(links), N_INERTIAL, samples)
        parameters[list(links)] = blocks.swapaxes(0, 1)
        inertia = parameters[link_of_pair, joint_of_pair].swapaxes(0, 1)
        velocity = self.velocity[link_of_pair].swapaxes(0, 1)
        acceleration = self.acceleration[link_of_pair].swapaxes(0, 1)

        momentum = _momentum(inertia, velocity)
        wrench = _momentum(inertia, acceleration) - _coadjoint(velocity, momentum)
        bracket = _bracket(velocity, jacobian)
        own_of_velocity = _coadjoint(jacobian, momentum) - _momentum(inertia, bracket)
        own_of_acceleration = _momentum(inertia, jacobian)
        first_pairs = np.flatnonzero(joint_of_pair == 0)
        sums = np.stack((own_of_velocity, own_of_acceleration))
        # Per link the derivatives (2, 6, N) by its velocity and its acceleration.
        by_motion = np.add.reduceat(sums, first_pairs, axis=2).transpose(2, 0, 1, 3)

        gradient = np.empty((3, joints, samples))
        # Derivatives (2 + joints, 6, N) by V and A, then by J, that come from the next link.
        passed = np.zeros((2 + joints, 6, samples))
        for link in reversed(range(joints)):
            screw = self.screws[link]
            turn = self.brackets[link]
            inner = slice(first_pairs[link], first_pairs[link] + link)
            passed = passed[: 2 + link]
            passed[:2] += by_motion[link]
            passed[2:] += wrench[:, inner].swapaxes(0, 1)
            of_velocity, of_acceleration = passed[:2]
            speed = qd[:, link]
            turned_velocity = turn @ self.velocity[link]
            of_velocity -= speed * (turn.T @ of_acceleration)
            gradient[2, link] = screw @ of_acceleration
            gradient[1, link] = screw @ of_velocity
            gradient[1, link] -= np.sum(of_acceleration * turned_velocity, axis=0)
            # d / d q of what comes from the link before: its twists, turned.
            turned_acceleration = turn @ (
                self.acceleration[link] + speed * turned_velocity
            )
            turned = np.stack((turned_velocity, turned_acceleration))
            gradient[0, link] = -np.sum(passed[:2] * turned, axis=(0, 1))
            turned_jacobian = turn @ jacobian[:, inner].swapaxes(0, 1)
            gradient[0, link] -= np.sum(passed[2:] * turned_jacobian, axis=(0, 1))
            passed = np.einsum("abn,jan->jbn", self.steps[link], passed)
        return gradient.swapaxes(1, 2)


def _momentum(inertia: Array, twist: Array) -> Array:
    """Return G V (6, ...) of spatial inertias with the parameters ``inertia`` (10, ...), and twists
    (6, ...): [I w + h x v, m v - h x w].
    """
    mass, hx, hy, hz, xx, xy, xz, yy, yz, zz = inertia
    wx, wy, wz, vx, vy, vz = twist
    return np.stack(
        (
            xx * wx + xy * wy + xz * wz + hy * vz - hz * vy,
            xy * wx + yy * wy + yz * wz + hz * vx - hx * vz,
            xz * wx + yz * wy + zz * wz + hx * vy - hy * vx,
            mass * vx - hy * wz + hz * wy,
            mass * vy - hz * wx + hx * wz,
            mass * vz - hx * wy + hy * wx,
        )
    )


def _bracket(first: Array, second: Array) -> Array:
    """Return ad(V) W (6, ...) of twists V = [w, v] and W (6, ...)."""
    w, v = first[:3], first[3:]
    turn, shift = second[:3], second[3:]
    return np.concatenate((cross(w, turn), cross(v, turn) + cross(w, shift)))


def _coadjoint(twist: Array, momentum: Array) -> Array:
    """Return ad(V)^T [m, f] (6, ...) = -[w x m + v x f, w x f] of V = [w, v]."""
    w, v = twist[:3], twist[3:]
    m, f = momentum[:3], momentum[3:]
    return -np.concatenate((cross(w, m) + cross(v, f), cross(w, f)))


def _by_velocities() -> Array:
    """Return the derivative (10, 6, 6, 6) of -ad(V)^T G V by V, per inertial parameter.

    It is linear in V, whose components are last; those by which it is derived are before them.
    """
    units = np.eye(6)[:, None, None]
    half = -_coadjoint(units, _UNIT_WRENCHES[..., None])
    return np.swapaxes(half + np.swapaxes(half, 2, 3), 0, 1)


_BY_VELOCITIES = _by_velocities()


class LinkDynamics:
    """The motion of all links of one arm, by the outward recursion of Newton and Euler.

    Args:
        robot: the arm.
        gravity: (3,) for all samples, or (3, N) for each sample [m/s^2]; None for the model's own.
            It counts as zero where the model switches gravity off.
    """

    def __init__(self, robot: RobotModel, gravity: Array | None = None) -> None:
        self._home = robot.reference
        self._slides = robot.is_slide
        self._links = robot.links
        vector = gravity_vector(robot) if gravity is None else gravity
        self._gravity = np.reshape(acting_gravity(robot, vector), (3, -1))

    def motion(self, q: Array, qd: Array, qdd: Array) -> LinksMotion:
        """Return the motion of all links for joint motions q, qd, qdd (N, n) each [rad, rad/s,
        rad/s^2].
        """
        turns = (q - self._home).T
        sines = np.where(self._slides[:, None], turns, np.sin(turns))
        coefficients = np.stack(
            (np.ones_like(turns), sines, 1.0 - np.cos(turns)), axis=1
        )
        factors = np.stack([link.step_factors for link in self._links])
        steps = factors @ coefficients[:, None]
        # Velocity and acceleration of the base and of each link.
        twists = np.zeros((len(steps) + 1, 2, 6, len(q)))
        twists[0, 1, 3:] = -self._gravity
        for i, link in enumerate(self._links):
            own = np.einsum("abn,mbn->man", steps[i], twists[i], out=twists[i + 1])
            own[0] += np.outer(link.screw, qd[:, i])
            own[1] += np.outer(link.screw, qdd[:, i])
            own[1] -= link.bracket @ own[0] * qd[:, i]
        velocity, acceleration = np.swapaxes(twists[1:], 0, 1)
        screws = tuple(link.screw for link in self._links)
        brackets = tuple(link.bracket for link in self._links)
        return LinksMotion(velocity, acceleration, steps, screws, brackets)


def wrench_of(thetas: Array, velocity: Array, acceleration: Array) -> Array:
    """Return the wrench G A - ad(V)^T G V (..., 6, N) that moves a link with twists (..., 6, N).

    G is the spatial inertia of its inertial parameters ``thetas`` (..., 10). With V = [w, v] and
    G V = [m, f], -ad(V)^T G V = [w x m + v x f, w x f].
    """
    inertia = spatial_inertias(thetas)
    momentum = inertia @ velocity
    # Components come first.
    w, v = np.split(np.swapaxes(velocity, 0, -2), 2)
    m, f = np.split(np.swapaxes(momentum, 0, -2), 2)
    gyroscopic = np.concatenate((cross(w, m) + cross(v, f), cross(w, f)))
    return inertia @ acceleration + np.swapaxes(gyroscopic, 0, -2)


def spatial_inertias(thetas: Array) -> Array:
    """Return the spatial inertia G (..., 6, 6) of inertial parameters ``thetas`` (..., 10)."""
    return np.einsum("aib,...i->...ab", _UNIT_WRENCHES, thetas)


def link_names(robot: RobotModel, link: int) -> tuple[str, ...]:
    """Return the ten parameter names of a link other than the terminal one, such as ``m(forearm)``.

    ``link`` is the link's index in ``robot.links``.
    """
    return keys_of(of_body(robot.links[link].body_name))


def other_links(robot: RobotModel) -> tuple[int, ...]:
    """Return the indices, ascending, of all links but the terminal one that have a mass."""
    return tuple(i for i, link in enumerate(robot.links[:-1]) if link.has_mass)


def gravity_vector(robot: RobotModel) -> Array:
    """Return the model's gravity (3,) in the world frame [m/s^2]."""
    return np.array(robot.mj_model.opt.gravity)


def acting_gravity(robot: RobotModel, gravity: Array) -> Array:
    """Return gravities as they act on an arm: zero where its model switches gravity off."""
    flags = robot.mj_model.opt.disableflags
    is_weightless = flags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return (not is_weightless) * gravity


def with_gravity(robot: RobotModel, gravity: Array) -> RobotModel:
    """Return the arm under another gravity (3,) [m/s^2], with a MuJoCo model of its own."""
    mj_model = copy.copy(robot.mj_model)
    mj_model.opt.gravity[:] = gravity
    return replace(robot, mj_model=mj_model, gravity=gravity)


def tilt_axes(gravity: Array) -> Array:
    """Return two unit vectors (2, 3) perpendicular to gravity (3,) and to each other.

    Raises:
        InputError: there is no gravity.
    """
    size = np.linalg.norm(gravity)
    if size == 0.0:
        raise InputError("the model has no gravity against which a tilt could show")
    down = gravity / size
    # Perpendicular to gravity and to the world's axis that is farthest from gravity's direction.
    first = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(down, first)])


def turn_gravity(gravity: Array, angles: Array) -> Array:
    """Return gravity (3,) [m/s^2] turned by two angles (2,) [rad] about ``tilt_axes(gravity)``."""
    turn = angles @ tilt_axes(gravity)
    # Rodrigues' formula for a perpendicular axis; numpy's sinc(x) is that of pi x.
    size = np.linalg.norm(turn)
    return np.cos(size) * gravity + np.sinc(size / np.pi) * np.cross(turn, gravity)

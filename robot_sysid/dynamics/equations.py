"""The linear equations of every joint: regressor, friction and known torques of a motion.

The parameters are the ten inertial parameters of the terminal link, the friction terms of each
joint, the friction terms of motors that turn with several joints and, last, the ten inertial
parameters of every other link that is estimated too (``link_names``).

The torque of the links that are not estimated is computed by Newton-Euler recursion, without the
regressor: a wrong regressor then shows as a wrong result, also on the model's own simulation, whose
torques are MuJoCo's.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import Coupling, FrictionModel
from robot_sysid.dynamics.inverse_dynamics import (
    BeyondRigidBodies,
    LinkDynamics,
    LinksMotion,
)
from robot_sysid.dynamics.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, Motion, RobotModel

TERMINAL_FRICTION = FrictionModel(("coulomb", "viscous"))
"""Friction terms that are estimated of the terminal joint from simulated data."""
NO_FRICTION = FrictionModel(terms=())
"""No friction terms are estimated: the friction of the robot's model is taken as known."""


def friction_per_joint(
    robot: RobotModel, torques: str, model: FrictionModel
) -> tuple[FrictionModel, ...]:
    """Return the friction terms that are estimated of each chain joint: n models, base to terminal.

    Args:
        robot: the arm.
        torques: "chain" where the torques of all joints are used; "terminal" where only that of the
            last joint is, so that the other joints get ``NO_FRICTION``.
        model: friction terms of each joint whose torque is used.
    """
    others = model if torques == "chain" else NO_FRICTION
    return (others,) * (robot.n_joints - 1) + (model,)


def split_name(name: str) -> tuple[str, str]:
    """Return (term, joint or motor) of a parameter's name such as "coulomb[joint6]".

    The second one is "" for a parameter without brackets, such as one of a body.
    """
    term, _, owner = name.partition("[")
    return term, owner[:-1]


def names_of(term: str, joints: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a term's parameters, one per joint, such as "scale[joint6]"."""
    return tuple(f"{term}[{joint}]" for joint in joints)


def link_names(robot: RobotModel, link: int) -> tuple[str, ...]:
    """Return the ten parameter names of a link other than the terminal one, such as ``m(forearm)``.

    ``link`` is the link's index in ``robot.links``.
    """
    return tuple(f"{name}({robot.links[link].body_name})" for name in PARAMETER_NAMES)


def other_links(robot: RobotModel) -> tuple[int, ...]:
    """Return the indices, ascending, of all links but the terminal one that have a mass."""
    return tuple(i for i, link in enumerate(robot.links[:-1]) if link.has_mass)


class Equations:
    """The linear equations rows x = right-hand side of one arm, x being p parameters.

    The ten parameters of the terminal link are always estimated.

    Args:
        robot: the arm, with n chain joints.
        torques: "chain" for the equations of all chain joints, "terminal" for the last joint's
            only.
        friction: n friction models, the terms to estimate of each chain joint; where a joint has no
            terms, the friction of the robot's model is taken as known.
        motors: motors that turn with several joints, whose parameters are estimated.
        links: indices in ``robot.links``, ascending, of other links whose parameters are estimated
            too.

    Attributes:
        joint_indices: chain indices of the joints whose torques are used, one equation per sample
            each.
        joints: names of these joints.
        names: names of all p parameters.
        columns: per joint the indices (k,) in ``names`` of the parameters in its equation, in the
            order of the columns of its rows.
    """

    def __init__(
        self,
        robot: RobotModel,
        torques: str,
        friction: Sequence[FrictionModel],
        motors: Sequence[Coupling] = (),
        links: Sequence[int] = (),
    ) -> None:
        self._robot = robot
        self._friction = tuple(friction)
        # The model's friction at the joints whose friction is not estimated; zero at the others.
        is_known = np.array([not model.terms for model in friction])
        coulomb = np.where(is_known, robot.friction.coulomb, 0.0)
        viscous = np.where(is_known, robot.friction.viscous, 0.0)
        known_friction = replace(robot.friction, coulomb=coulomb, viscous=viscous)
        self._known_friction = known_friction
        # (n,) rotor inertia in the model, of the joints whose rotor inertia is estimated.
        is_estimated = np.array(["armature" in model.terms for model in friction])
        self._estimated_armature = np.where(is_estimated, robot.armature, 0.0)
        self._links = tuple(links)
        self._dynamics = LinkDynamics(robot)
        self._beyond = BeyondRigidBodies(robot)
        # (n, 10) inertial parameters of the links that are not estimated; zero for the estimated
        # ones, of which -1 is the terminal link. ``robot.thetas`` is a new array in every call, so
        # the model stays as it is.
        self._known_thetas = robot.thetas
        self._known_thetas[[*self._links, -1]] = 0.0
        n = robot.n_joints
        self.joint_indices = tuple(range(0 if torques == "chain" else n - 1, n))
        self.joints = tuple(robot.joint_names[j] for j in self.joint_indices)
        self._motors = tuple(motors)
        self.names, self.columns = self._parameters()
        # The model's parameters of the L other estimated links: (10 L,), ten per link, ascending.
        self._link_thetas = robot.thetas[list(self._links)].ravel()

    def _parameters(self) -> tuple[tuple[str, ...], tuple[NDArray[np.int64], ...]]:
        """Return the names of all p parameters, and per joint of ``joints`` the indices (k,) of the
        parameters in its equation, of other links only where the joint carries them.
        """
        every_joint = np.arange(self._robot.n_joints)
        # Names of parameters, and whether they are in the equation of each joint (n,): those of the
        # terminal link are in all equations.
        blocks: list[tuple[tuple[str, ...], NDArray[np.bool_]]]
        blocks = [(PARAMETER_NAMES, np.ones(len(every_joint), dtype=bool))]
        for joint, name in zip(self.joint_indices, self.joints):
            friction_names = self._friction[joint].parameter_names(name)
            blocks.append((friction_names, every_joint == joint))
        for motor in self._motors:
            blocks.append((motor.parameter_names, motor.ratios != 0.0))
        for link in self._links:
            blocks.append((link_names(self._robot, link), every_joint <= link))
        names: list[str] = []
        columns: list[list[int]] = [[] for _ in self.joint_indices]
        for block, is_in_equation in blocks:
            indices = range(len(names), len(names) + len(block))
            names += block
            for joint, joint_columns in zip(self.joint_indices, columns):
                if is_in_equation[joint]:
                    joint_columns += indices
        return tuple(names), tuple(map(np.array, columns))

    @property
    def prior(self) -> Array:
        """The model's own values (p,) of all parameters; zero for friction terms that the model
        does not have.
        """
        robot = self._robot
        values = dict(zip(PARAMETER_NAMES, robot.prior.theta))
        armature = robot.armature
        for j, joint in zip(self.joint_indices, self.joints):
            values[f"coulomb[{joint}]"] = robot.friction.coulomb[j]
            values[f"viscous[{joint}]"] = robot.friction.viscous[j]
            values[f"armature[{joint}]"] = armature[j]
        for motor in self._motors:
            values.update(zip(motor.parameter_names, motor.model))
        for link in self._links:
            values.update(zip(link_names(robot, link), robot.links[link].theta))
        return np.array([float(values.get(name, 0.0)) for name in self.names])

    def rows(self, measurement: Measurement) -> Iterator[tuple[Array, Array]]:
        """Yield (rows (N, k), right-hand side (N,) [N m]) per joint of ``joints``.

        The k columns are those of ``columns``; the right-hand side is the measured torque without
        the torque of everything that is taken as known.

        Args:
            measurement: N samples of all chain joints, with velocities and accelerations.

        Raises:
            InputError: the measurement has no velocities or accelerations.
        """
        qd = measurement.qd
        qdd = measurement.qdd
        if qd is None or qdd is None:
            raise InputError(
                "a log without velocities or accelerations; differentiate it first"
            )
        motion = Motion(measurement.time, measurement.q, qd, qdd)
        # Joint by joint, by iterators that are read in step: the rows of a long arm take far more
        # memory than those of one joint. ``tee`` gives the arrays of each joint to both readers.
        bodies, same_bodies = itertools.tee(self.bodies(motion))
        # The gear's load is computed from the model: the measured torque includes friction.
        loads = map(self._model_torque, same_bodies)
        tau = measurement.tau[:, list(self.joint_indices)].T
        yield from map(assemble_rows, bodies, self.friction(motion, loads), tau)

    def _model_torque(self, bodies: Array) -> Array:
        """Return the torque (N,) that the model's links make at one joint [N m].

        Args:
            bodies: as ``self.bodies`` yields it for the joint.
        """
        columns = bodies[:, :-1]
        n_carried = columns.shape[1] - N_INERTIAL
        # Links ascend, and a joint carries those from its own to the last.
        first_carried = len(self._link_thetas) - n_carried
        carried = self._link_thetas[first_carried:]
        values = np.concatenate((self._robot.prior.theta, carried))
        return columns @ values + bodies[:, -1]

    def bodies(self, motion: Motion) -> Iterator[Array]:
        """Yield (N, 10 + 10 c + 1) per joint of ``joints``: columns of the terminal link, columns
        of the c other estimated links that the joint carries, and the torque of all other bodies,
        springs and rotors [N m].

        All of these are smooth functions of the motion (no sign of a speed), so that fewer samples
        are enough to filter them.
        """
        series = motion.q, motion.qd, motion.qdd
        links = self._dynamics.motion(*series)
        torque = self._beyond.torque(*series)
        if np.any(self._known_thetas):
            torque = torque + links.torque(self._known_thetas)
        for j, (terminal, carried) in zip(self.joint_indices, self._columns(links)):
            # Transposed, so that the N samples of each column lie side by side in memory.
            rows = (terminal.T, carried.T, torque[None, :, j])
            yield np.concatenate(rows).T

    def friction(self, motion: Motion, loads: Iterable[Array]) -> Iterator[Array]:
        """Yield (N, f + 1) per joint of ``joints``: columns of its f friction parameters, those of
        the motors that turn with this joint and others included, and the known torque of friction
        [N m].

        The known torque is the model's friction of joints whose friction is not estimated, minus
        the model's torque of rotors and shared motors that are estimated: the torque that
        ``bodies`` yields includes it.

        Args:
            motion: of N samples.
            loads: per joint the torque (N,) that its gear transmits [N m].
        """
        qd = motion.qd
        qdd = motion.qdd
        known_torque = self._known_friction.torque(qd)
        known_torque -= self._estimated_armature * qdd
        motor_columns = []
        for motor in self._motors:
            columns = motor.columns(qd, qdd).T
            motor_columns.append(columns)
            known_torque -= np.outer(motor.model @ columns, motor.ratios)
        for load, j in zip(loads, self.joint_indices):
            blocks = [self._friction[j].columns(qd[:, j], qdd[:, j], load).T]
            for motor, columns in zip(self._motors, motor_columns):
                if motor.ratios[j]:
                    blocks.append(motor.ratios[j] * columns)
            yield np.concatenate((*blocks, known_torque[None, :, j])).T

    def rows_of_gravity(self, q: Array, gravity: Array) -> Iterator[Array]:
        """Yield per joint of ``joints`` the rows (N, k) of the arm at rest under a gravity, with
        the columns of ``columns``; friction's columns are zero. The rows are linear in gravity.

        Args:
            q: (N, n) joint positions [rad or m].
            gravity: (3,) in the world [m/s^2].
        """
        zeros = np.zeros_like(q)
        dynamics = LinkDynamics(self._robot, gravity)
        columns = self._columns(dynamics.motion(q, zeros, zeros))
        for indices, (terminal, carried) in zip(self.columns, columns):
            rows = np.zeros((len(q), len(indices)))
            rows[:, :N_INERTIAL] = terminal
            rows[:, len(indices) - carried.shape[1] :] = carried
            yield rows

    def _columns(self, motion: LinksMotion) -> Iterator[tuple[Array, Array]]:
        """Yield per joint of ``joints`` the columns (N, 10) of the terminal link, and the columns
        (N, 10 c) of the c other estimated links that the joint carries.
        """
        columns = motion.columns((*self._links, len(motion.screws) - 1))
        for j in self.joint_indices:
            # A joint carries no link before its own.
            first_carried = N_INERTIAL * np.searchsorted(self._links, j)
            carried = columns[:, j, first_carried:-N_INERTIAL]
            yield columns[:, j, -N_INERTIAL:], carried


def assemble_rows(bodies: Array, friction: Array, tau: Array) -> tuple[Array, Array]:
    """Return (rows (N, k), right-hand side (N,) [N m]) of one joint's equations in k parameters:
    the torque without what is known, and columns in the order of ``Equations.columns``.

    Args:
        bodies: as ``Equations.bodies`` yields it for the joint.
        friction: as ``Equations.friction`` yields it.
        tau: (N,) torque of the joint [N m].
    """
    edges = (N_INERTIAL, bodies.shape[1] - 1)
    terminal, carried, known_torque = np.split(bodies, edges, axis=1)
    rows = np.concatenate((terminal, friction[:, :-1], carried), axis=1)
    return rows, tau - known_torque[:, 0] - friction[:, -1]

"""The linear equations of every joint of a simulated arm, and the names of parameters.

The parameters of the equations are the ten inertial parameters of the terminal link and the
friction terms of each joint. The torque of all other links is computed by Newton-Euler recursion,
without the regressor: a wrong regressor then shows as a wrong result, also on the model's own
simulation, whose torques are MuJoCo's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.inverse_dynamics import BeyondRigidBodies, LinkDynamics
from robot_sysid.dynamics.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, RobotModel

TERMINAL_FRICTION = FrictionModel(("coulomb", "viscous"))
"""Friction terms that are estimated of the terminal joint from simulated data."""
NO_FRICTION = FrictionModel(terms=())
"""No friction terms are estimated: the friction of the robot's model is taken as known."""


def friction_per_joint(
    robot: RobotModel, model: FrictionModel
) -> tuple[FrictionModel, ...]:
    """Return the friction terms that are estimated of each chain joint: n models, base to terminal.

    Those of ``model`` are estimated of the terminal joint; the others keep the model's friction.
    """
    return (NO_FRICTION,) * (robot.n_joints - 1) + (model,)


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

    Args:
        robot: the arm, with n chain joints.
        torques: "chain" for the equations of all chain joints, "terminal" for the last joint's
            only.
        friction: n friction models, the terms to estimate of each chain joint; where a joint has no
            terms, the friction of the robot's model is taken as known.

    Attributes:
        joint_indices: chain indices of the joints whose torques are used, one equation per sample
            each.
        joints: names of these joints.
        names: names of all p parameters, those of the terminal link first.
        columns: per joint the indices (k,) in ``names`` of the parameters in its equation, in the
            order of the columns of its rows.
        prior: (p,) the model's own values; zero for friction terms that the model does not have.
    """

    def __init__(
        self, robot: RobotModel, torques: str, friction: Sequence[FrictionModel]
    ) -> None:
        self._friction = tuple(friction)
        # The model's friction at the joints whose friction is not estimated; zero at the others.
        is_known = np.array([not model.terms for model in friction])
        coulomb = np.where(is_known, robot.friction.coulomb, 0.0)
        viscous = np.where(is_known, robot.friction.viscous, 0.0)
        self._known = replace(robot.friction, coulomb=coulomb, viscous=viscous)
        # (n,) rotor inertia in the model, of the joints whose rotor inertia is estimated.
        is_estimated = np.array(["armature" in model.terms for model in friction])
        self._estimated_armature = np.where(is_estimated, robot.armature, 0.0)
        self._dynamics = LinkDynamics(robot)
        self._beyond = BeyondRigidBodies(robot)
        self._model_thetas = robot.thetas
        self._known_thetas = robot.thetas
        self._known_thetas[-1] = 0.0
        n = robot.n_joints
        self.joint_indices = tuple(range(0 if torques == "chain" else n - 1, n))
        self.joints = tuple(robot.joint_names[j] for j in self.joint_indices)
        model = {**vars(robot.friction), "armature": robot.armature}
        names = list(PARAMETER_NAMES)
        prior = robot.prior.theta.tolist()
        columns: list[NDArray[np.int64]] = []
        for j, joint in zip(self.joint_indices, self.joints):
            terms = self._friction[j].terms
            own = np.arange(len(terms)) + len(names)
            names += self._friction[j].parameter_names(joint)
            prior += [model.get(term, np.zeros(n))[j] for term in terms]
            columns.append(np.concatenate((np.arange(N_INERTIAL), own)))
        self.names = tuple(names)
        self.columns = tuple(columns)
        self.prior = np.array(prior)

    def rows(self, measurement: Measurement) -> Iterator[tuple[Array, Array]]:
        """Yield (rows (N, k), right-hand side (N,) [N m]) per joint of ``joints``.

        The k columns are those of ``columns``; the right-hand side is the measured torque without
        the torque of everything that is taken as known.

        Args:
            measurement: N samples of all chain joints, with velocities and accelerations.

        Raises:
            InputError: the measurement has no velocities or accelerations.
        """
        q, qd, qdd = measurement.q, measurement.qd, measurement.qdd
        if qd is None or qdd is None:
            raise InputError(
                "a log without velocities or accelerations; differentiate it first"
            )
        links = self._dynamics.motion(q, qd, qdd)
        beyond = self._beyond.torque(q, qd, qdd)
        known = beyond + links.torque(self._known_thetas)
        known += self._known.torque(qd) - self._estimated_armature * qdd
        # The gear's load is computed from the model: the measured torque includes friction.
        load = beyond + links.torque(self._model_thetas)
        terminal = links.columns([len(links.screws) - 1])
        for j in self.joint_indices:
            friction = self._friction[j].columns(qd[:, j], qdd[:, j], load[:, j])
            rows = np.concatenate((terminal[:, j], friction), axis=1)
            yield rows, measurement.tau[:, j] - known[:, j]

"""The linear equations of every joint of a simulated arm, and the names of parameters.

The parameters of the equations are the ten inertial parameters of the terminal link and the
friction terms of each joint. The torque of all other links is computed by Newton-Euler recursion,
without the regressor: a wrong regressor then shows as a wrong result, also on the model's own
simulation, whose torques are MuJoCo's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.inverse_dynamics import BeyondRigidBodies, LinkDynamics
from robot_sysid.dynamics.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, RobotModel

TERMINAL_FRICTION = ("coulomb", "viscous")
"""Friction terms that are estimated of the terminal joint from simulated data."""


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
        friction: joint to the friction terms, names of ``friction.TERMS`` but the load, that are
            estimated of it; all else of the model's friction is taken as known.

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
        self, robot: RobotModel, torques: str, friction: Mapping[str, Sequence[str]]
    ) -> None:
        self._dynamics = LinkDynamics(robot)
        self._beyond = BeyondRigidBodies(robot)
        self._friction = robot.friction
        self._known_thetas = robot.thetas
        self._known_thetas[-1] = 0.0
        n = robot.n_joints
        self.joint_indices = tuple(range(0 if torques == "chain" else n - 1, n))
        self.joints = tuple(robot.joint_names[j] for j in self.joint_indices)
        self._terms = [friction.get(joint, ()) for joint in self.joints]
        model = {**vars(robot.friction), "armature": robot.armature}
        names = list(PARAMETER_NAMES)
        prior = robot.prior.theta.tolist()
        columns: list[NDArray[np.int64]] = []
        for j, joint, terms in zip(self.joint_indices, self.joints, self._terms):
            own = np.arange(len(terms)) + len(names)
            names += [f"{term}[{joint}]" for term in terms]
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
        known = self._beyond.torque(q, qd, qdd) + links.torque(self._known_thetas)
        known += self._friction.torque(qd)
        terminal = links.columns([len(links.screws) - 1])
        no_load = np.zeros(len(q))
        for j, terms, at in zip(self.joint_indices, self._terms, self.columns):
            friction = [TERMS[term](qd[:, j], qdd[:, j], no_load) for term in terms]
            rows = np.column_stack((terminal[:, j], *friction))
            # What is estimated of the model's friction is not known.
            estimated = rows[:, N_INERTIAL:] @ self.prior[at[N_INERTIAL:]]
            yield rows, measurement.tau[:, j] - known[:, j] + estimated

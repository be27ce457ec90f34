"""The linear equations of every joint: regressor, friction and known torques of a chunk.

The parameters are the terminal link's ten, each joint's friction terms, those of motors that turn
with several joints, and last, where they are sought, the ten of other links (``link_names``).

The torque of the rest of the arm is Newton's and Euler's, without the regressor: a wrong regressor
shows as a wrong result, also on the model's own simulation, whose torques are MuJoCo's.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import Coupling, FrictionModel
from robot_sysid.dynamics.inverse_dynamics import BeyondRigidBodies
from robot_sysid.dynamics.newton_euler import LinkDynamics, LinksMotion
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, Motion, RobotModel

TERMINAL_FRICTION = FrictionModel(("coulomb", "viscous"))
NO_FRICTION = FrictionModel(())
N_INERTIAL = len(PARAMETER_NAMES)


def friction_per_joint(
    robot: RobotModel, torques: str, model: FrictionModel
) -> tuple[FrictionModel, ...]:
    """Return the friction terms of each chain joint: all of them, or the last one's only."""
    others = model if torques == "chain" else NO_FRICTION
    return (others,) * (robot.n_joints - 1) + (model,)


def link_names(robot: RobotModel, link: int) -> tuple[str, ...]:
    """Return the names of another link's ten parameters, for instance ``m(forearm)``."""
    return tuple(f"{name}({robot.links[link].body_name})" for name in PARAMETER_NAMES)


def other_links(robot: RobotModel) -> tuple[int, ...]:
    """Return the numbers of all links but the terminal one that have a mass."""
    return tuple(i for i, link in enumerate(robot.links[:-1]) if link.has_mass)


class Equations:
    """The linear equations rows x = tau of one arm: parameter names, priors, and rows of a chunk.

    Args:
        torques: "chain" for every joint that carries the link, "terminal" for the last one only.
        friction: terms to estimate, one model per chain joint; where a joint has none, the model's
            own friction is taken as known.
        motors: those that turn with several joints.
        links: numbers of other links whose parameters are sought too.
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
        is_known = np.array([not model.terms for model in friction])
        self._known_friction = replace(
            robot.friction,
            coulomb=np.where(is_known, robot.friction.coulomb, 0.0),
            viscous=np.where(is_known, robot.friction.viscous, 0.0),
        )
        self._armature_sought = np.array(
            ["armature" in model.terms for model in friction]
        )
        self._links = tuple(links)
        self._dynamics = LinkDynamics(robot)
        self._beyond = BeyondRigidBodies(robot)
        self._rest = robot.thetas
        self._rest[[*self._links, -1]] = 0.0
        last = robot.n_joints - 1
        self.rows_of = tuple(range(robot.n_joints)) if torques == "chain" else (last,)
        self.joints = tuple(robot.joint_names[j] for j in self.rows_of)
        self._motors = tuple(motors)
        names = zip(self._friction, robot.joint_names)
        own = [model.parameter_names(name) for model, name in names]
        others = {link: link_names(robot, link) for link in self._links}
        of_rows = (name for j in self.rows_of for name in own[j])
        of_motors = (name for each in self._motors for name in each.parameter_names)
        of_links = (name for each in others.values() for name in each)
        self.names = (*PARAMETER_NAMES, *of_rows, *of_motors, *of_links)
        place = {name: index for index, name in enumerate(self.names)}
        # Which parameters (k,) each joint's equations contain: of links those that it carries.
        self.columns: tuple[NDArray[np.int64], ...] = ()
        for j in self.rows_of:
            beyond = (
                name for link, each in others.items() if link >= j for name in each
            )
            turned = (
                n
                for each in self._motors
                if each.ratios[j]
                for n in each.parameter_names
            )
            mine = (*PARAMETER_NAMES, *own[j], *turned, *beyond)
            self.columns += (np.array([place[name] for name in mine]),)
        thetas = [robot.links[link].theta for link in self._links]
        self._known_links = np.concatenate([np.zeros(0), *thetas])

    @property
    def prior(self) -> Array:
        """The model's own values of all parameters (p,)."""
        values = dict(zip(PARAMETER_NAMES, self._robot.prior.theta))
        for j in self.rows_of:
            joint = self._robot.joint_names[j]
            values[f"coulomb[{joint}]"] = self._robot.friction.coulomb[j]
            values[f"viscous[{joint}]"] = self._robot.friction.viscous[j]
            values[f"armature[{joint}]"] = self._robot.armature[j]
        for motor in self._motors:
            values.update(zip(motor.parameter_names, motor.model))
        for link in self._links:
            values.update(
                zip(link_names(self._robot, link), self._robot.links[link].theta)
            )
        return np.array([float(values.get(name, 0.0)) for name in self.names])

    def rows(self, measurement: Measurement) -> Iterator[tuple[Array, Array]]:
        """Yield (rows (N, k), right-hand side (N,)) per joint of ``joints``."""
        qd = measurement.qd
        qdd = measurement.qdd
        if qd is None or qdd is None:
            raise InputError(
                "a log without velocities or accelerations; differentiate it first"
            )
        motion = Motion(measurement.time, measurement.q, qd, qdd)
        # Joint by joint: all of a long arm's rows are far more than one's.
        bodies, same = itertools.tee(self.bodies(motion))
        # The model's own: the measured torque has friction in it already.
        carried = (each[:, :-1] @ self._known(each) + each[:, -1] for each in same)
        tau = measurement.tau[:, list(self.rows_of)].T
        yield from map(joined, bodies, self.friction(motion, carried), tau)

    def _known(self, bodies: Array) -> Array:
        """Return the model's own values (k,) of the links in one joint's equation."""
        carried = bodies.shape[1] - 1 - N_INERTIAL
        beyond = self._known_links[len(self._known_links) - carried :]
        return np.concatenate((self._robot.prior.theta, beyond))

    def bodies(self, motion: Motion) -> Iterator[Array]:
        """Yield (N, k + 1) per joint of ``joints``: columns of the terminal link, of other links
        that it carries, and the torque of the rest of the arm [N m]. They follow the motion
        smoothly.
        """
        moved = motion.q, motion.qd, motion.qdd
        links = self._dynamics.motion(*moved)
        rest = self._beyond.torque(*moved)
        if np.any(self._rest):
            rest = rest + links.torque(self._rest)
        for j, (own, beyond) in zip(self.rows_of, self._columns(links)):
            yield np.concatenate((own.T, beyond.T, rest[None, :, j])).T

    def friction(self, motion: Motion, carried: Iterable[Array]) -> Iterator[Array]:
        """Yield (N, k + 1) per joint of ``joints``: columns of its friction and of motors that turn
        with several joints, and the torque of friction that is known, less what the model has of
        rotors and shared motors that are sought
        [N m]. ``carried`` (N,) is the torque that each joint's gear transmits [N m].
        """
        qd = motion.qd
        qdd = motion.qdd
        known = self._known_friction.torque(qd)
        known -= np.where(self._armature_sought, self._robot.armature * qdd, 0.0)
        shared = [(each.ratios, each.columns(qd, qdd).T) for each in self._motors]
        for (ratios, columns), motor in zip(shared, self._motors):
            known -= np.outer(motor.model @ columns, ratios)
        for load, j in zip(carried, self.rows_of):
            own = self._friction[j].columns(qd[:, j], qdd[:, j], load)
            turned = [ratios[j] * torque for ratios, torque in shared if ratios[j]]
            yield np.concatenate((own.T, *turned, known[None, :, j])).T

    def rows_of_gravity(self, q: Array, gravity: Array) -> Iterator[Array]:
        """Yield the part (N, k) of the rows of each joint of ``joints`` that is made by a gravity
        (3,) [m/s^2] at positions (N, n), which is linear in it.
        """
        still = np.zeros_like(q)
        dynamics = LinkDynamics(self._robot, gravity)
        each = self._columns(dynamics.motion(q, still, still))
        for places, (own, beyond) in zip(self.columns, each):
            rows = np.zeros((len(q), len(places)))
            rows[:, :N_INERTIAL] = own
            rows[:, len(places) - beyond.shape[1] :] = beyond
            yield rows

    def _columns(self, motion: LinksMotion) -> Iterator[tuple[Array, Array]]:
        """Yield columns of the terminal link (N, 10), and of other links that are carried, per
        joint of ``joints``.
        """
        columns = motion.columns((*self._links, len(motion.screws) - 1))
        for j in self.rows_of:
            first = N_INERTIAL * sum(link < j for link in self._links)
            yield columns[:, j, -N_INERTIAL:], columns[:, j, first:-N_INERTIAL]


def joined(bodies: Array, friction: Array, tau: Array) -> tuple[Array, Array]:
    """Return (rows (N, k), right-hand side (N,)) of a joint from what ``Equations`` says of its
    bodies and friction, and its torque (N,) [N m].
    """
    links, beyond, rest = np.split(bodies, (N_INERTIAL, bodies.shape[1] - 1), axis=1)
    rows = np.concatenate((links, friction[:, :-1], beyond), axis=1)
    return rows, tau - rest[:, 0] - friction[:, -1]

"""The equations of all links on some logs, with the columns that depend on what is known so far.

Beside the ten parameters of every link, each joint's friction and each coupled motor's, three kinds
of columns need the links themselves: the loss of a gear that grows with its load, the torque that
a joint whose zero is a little off reads too much, and that of a base that is a little tilted. They
are made anew whenever the links are known better.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, link_names, other_links
from robot_sysid.dynamics.friction import TERMS, FrictionModel
from robot_sysid.dynamics.gravity import TILT_NAMES, gravity
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.nuisances import NuisanceColumns, zero_names
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.identify.arm.couplings import Coupling
from robot_sysid.identify.samples import DecimatedSamples, decimated_equations
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

_CHUNK = 2048
_OWN = FrictionModel(tuple(term for term in TERMS if term != "load"))


class ArmColumns:
    """All columns on all logs; choices leave some of them out.

    Args:
        robot: the arm.
        signals: the processed logs.
        couplings: motors that turn with several joints, or may do so.
    """

    def __init__(
        self,
        robot: RobotModel,
        signals: Sequence[ProcessedSignals],
        couplings: Sequence[Coupling] = (),
    ) -> None:
        self._robot, self._signals, self._couplings = robot, tuple(signals), tuple(couplings)
        self._dynamics = LinkDynamics(robot)
        shared = [name for each in couplings for name in each.parameter_names]
        friction = (_OWN,) * robot.n_joints
        equations = Equations(robot, "chain", friction, shared, other_links(robot))

        def motors(motion: Motion, place: slice) -> Array:
            return np.concatenate([each.columns(motion) for each in couplings], axis=-1)

        own = motors if couplings else None
        self._take([decimated_equations(equations, log, own) for log in signals], equations.prior)

    def with_couplings(self, couplings: Sequence[Coupling]) -> ArmColumns:
        """Return the columns with some of the couplings alone."""
        chosen = {name for each in couplings for name in each.parameter_names}
        mine = {name for each in self._couplings for name in each.parameter_names}
        own = self._parts[0].names
        kept = [index for index, name in enumerate(own) if name not in mine - chosen]
        fewer = copy.copy(self)
        fewer._couplings = tuple(couplings)
        fewer._take([_some(part, kept) for part in self._parts], self.prior[kept])
        return fewer

    def _take(self, parts: list[DecimatedSamples], prior: Array) -> None:
        robot, self._parts = self._robot, parts
        loads = tuple(f"load[{joint}]" for joint in robot.joint_names)
        tilt = TILT_NAMES if np.any(gravity(robot)) else ()
        self._later = (*loads, *zero_names(robot), *tilt)
        self.names = (*parts[0].names, *self._later)
        self.prior = np.append(prior, np.zeros(len(self._later)))

    def samples(self, thetas: Array, load: bool = True) -> list[DecimatedSamples]:
        """Return the samples of each log, around links (n, 10).

        Args:
            thetas: what is known of the links.
            load: whether the columns of the gears' load are needed; they are zero otherwise.
        """
        made = []
        for part, log in zip(self._parts, self._signals):
            joints = self._robot.n_joints
            loads = self._load(log, thetas) if load else np.zeros((len(part), joints, joints))
            columns = np.concatenate((loads, self._off(log, thetas)), axis=-1)
            blocks = [columns[:, joint] for joint in range(self._robot.n_joints)]
            made.append(part.with_columns(self._later, blocks))
        return made

    def links(self) -> tuple[tuple[int, NDArray[np.int64]], ...]:
        """Return (number of a link, where its ten parameters stand) of each link with mass."""
        place = {name: index for index, name in enumerate(self.names)}
        found = [(k, link_names(self._robot, k)) for k in other_links(self._robot)]
        found.append((self._robot.n_joints - 1, PARAMETER_NAMES))
        return tuple((k, np.array([place[name] for name in names])) for k, names in found)

    def thetas(self, values: Array) -> Array:
        """Return the links (n, 10) of an estimate (p,)."""
        thetas = np.zeros((self._robot.n_joints, len(PARAMETER_NAMES)))
        for link, place in self.links():
            thetas[link] = values[place]
        return thetas

    def _load(self, log: ProcessedSignals, thetas: Array) -> Array:
        """Return (K, n, n) the column of each gear's loss, in its own joint's equation."""
        decimator, parts = log.decimator(), []
        for motion, _ in log.chunks(_CHUNK):
            torque = self._dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)
            parts.append(decimator.push(np.sign(motion.qd) * np.abs(torque)))
        return np.concatenate(parts)[:, :, None] * np.eye(self._robot.n_joints)

    def _off(self, log: ProcessedSignals, thetas: Array) -> Array:
        """Return (K, n, n + 2) the columns of zeros and tilt.

        They are smooth and small, so that the motion at a row's own instant stands for all that its
        filter sees.
        """
        rows = log.low_pass.centres(len(log))
        motion = Motion(log.time[rows], log.q[rows], log.qd[rows], log.qdd[rows])
        nuisances = NuisanceColumns(self._robot, thetas)
        both = [nuisances.zero(motion)]
        both += [nuisances.tilt(motion)] if TILT_NAMES[0] in self._later else []
        return np.concatenate(both, axis=-1)


def _some(samples: DecimatedSamples, kept: Sequence[int]) -> DecimatedSamples:
    """Return the samples with some of the parameters alone, in the same order."""
    number = {old: new for new, old in enumerate(kept)}
    stay = [np.isin(columns, kept) for columns in samples.columns]
    return replace(
        samples,
        names=tuple(samples.names[index] for index in kept),
        columns=tuple(
            np.array([number[int(c)] for c in columns[mask]])
            for columns, mask in zip(samples.columns, stay)
        ),
        rows=tuple(rows[:, mask] for rows, mask in zip(samples.rows, stay)),
    )

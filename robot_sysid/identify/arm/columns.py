"""The equations of all links on some logs, with the columns that depend on what is known so far.

Beside the ten parameters of every link, each joint's friction and each coupled motor's, some
columns depend on what is sought: the loss of a gear that grows with its load, friction that is
nonlinear in a speed (with its derivative by that speed, which makes each fit a Gauss-Newton step),
the torque that a joint whose zero is a little off reads too much, and that of a base that is a
little tilted. They are made anew whenever links and speeds are known better.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, link_names, other_links
from robot_sysid.dynamics.friction import BENT, TERMS, FrictionModel, speed_name
from robot_sysid.dynamics.gravity import TILT_NAMES, gravity
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.nuisances import NuisanceColumns, zero_names
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.identify.arm.couplings import Coupling
from robot_sysid.identify.judgement.filtering import filtering_pull
from robot_sysid.identify.nuisances import known_links
from robot_sysid.identify.samples import DecimatedSamples, decimated_equations
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

_CHUNK = 2048
_OWN = FrictionModel(tuple(term for term in TERMS if term not in ("load", *BENT)))


@dataclass(frozen=True)
class Bends:
    """What is known of the terms that are nonlinear in a speed.

    Attributes:
        speed: term to (n,) its speed at each joint [rad/s].
        size: term to (n,) its coefficient, which the derivative by the speed is multiplied by.
    """

    speed: Mapping[str, Array]
    size: Mapping[str, Array]


def usual_bends(joints: int, **speeds: float) -> Bends:
    """Return what is taken before anything is known: one speed per term, the usual if not given."""
    each = {term: np.full(joints, speeds.get(term, bent.usual)) for term, bent in BENT.items()}
    return Bends(each, {term: np.zeros(joints) for term in BENT})


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
        equations = self._equations()

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

    def _equations(self) -> Equations:
        """Return those of all columns that do not depend on what is sought."""
        shared = [name for each in self._couplings for name in each.parameter_names]
        friction = (_OWN,) * self._robot.n_joints
        return Equations(self._robot, "chain", friction, shared, other_links(self._robot))

    def filtering_pull(self, samples: Sequence[DecimatedSamples], values: Array) -> Array:
        """Return the sum of all logs' (joints, p), see ``judgement.filtering``."""
        equations, logs = self._equations(), zip(samples, self._signals)
        return np.sum([filtering_pull(each, equations, log, values) for each, log in logs], axis=0)

    def _take(self, parts: list[DecimatedSamples], prior: Array) -> None:
        robot, self._parts = self._robot, parts
        tilt = TILT_NAMES if np.any(gravity(robot)) else ()
        self._own = tuple(name for joint in robot.joint_names for name in _later_names(joint))
        self._common = (*zero_names(robot), *tilt)
        self.names = (*parts[0].names, *self._own, *self._common)
        self.prior = np.append(prior, np.zeros(len(self._own) + len(self._common)))

    def samples(
        self, thetas: Array, load: bool = True, bends: Bends | None = None
    ) -> list[DecimatedSamples]:
        """Return the samples of each log, around links (n, 10).

        Args:
            thetas: what is known of the links.
            load: whether the columns of the gears' load are needed; they are zero otherwise.
            bends: what is known of terms that are nonlinear in a speed; None where their columns
                are not needed: they are zero then.
        """
        joints = range(self._robot.n_joints)
        made = []
        for part, log in zip(self._parts, self._signals):
            own, common = self._friction(log, thetas, load, bends), self._off(log, thetas)
            width = own.shape[-1]
            places = [np.arange(width) + width * joint for joint in joints]
            mine = part.with_columns(self._own, [own[:, joint] for joint in joints], places)
            made.append(mine.with_columns(self._common, [common[:, joint] for joint in joints]))
        return made

    def links(self) -> tuple[tuple[int, NDArray[np.int64]], ...]:
        """Return (number of a link, where its ten parameters stand) of each link with mass."""
        place = {name: index for index, name in enumerate(self.names)}
        found = [(k, link_names(self._robot, k)) for k in other_links(self._robot)]
        found.append((self._robot.n_joints - 1, PARAMETER_NAMES))
        return tuple((k, np.array([place[name] for name in names])) for k, names in found)

    def thetas(self, values: Array) -> Array:
        """Return the links (n, 10) of an estimate (p,)."""
        return known_links(self._robot, self.names, values)

    def _friction(
        self, log: ProcessedSignals, thetas: Array, load: bool, bends: Bends | None
    ) -> Array:
        """Return (K, n, t) the columns of ``_later_names`` in each joint's own equation."""
        joints, later = self._robot.n_joints, 1 + 2 * len(BENT)
        if not load and bends is None:
            return np.zeros((len(log.decimated_time()), joints, later))
        decimator, parts = log.decimator(), []
        for motion, _ in log.chunks(_CHUNK):
            columns = np.zeros((later, *motion.qd.shape))
            if load:
                torque = self._dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)
                columns[0] = np.sign(motion.qd) * np.abs(torque)
            for place, (term, bent) in enumerate(BENT.items() if bends is not None else ()):
                assert bends is not None
                speed, size = bends.speed[term], bends.size[term]
                columns[2 * place + 1] = bent.column(motion.qd, speed)
                columns[2 * place + 2] = size * bent.slope(motion.qd, speed)
            parts.append(decimator.push(np.moveaxis(columns, 0, -1)))
        return np.concatenate(parts)

    def _off(self, log: ProcessedSignals, thetas: Array) -> Array:
        """Return (K, n, n + 2) the columns of zeros and tilt.

        They are smooth and small, so that the motion at a row's own instant stands for all that its
        filter sees.
        """
        motion = log.decimated_motion()
        nuisances = NuisanceColumns(self._robot, thetas)
        both = [nuisances.zero(motion)]
        both += [nuisances.tilt(motion)] if TILT_NAMES[0] in self._common else []
        return np.concatenate(both, axis=-1)


def _later_names(joint: str) -> tuple[str, ...]:
    """Return the names of a joint's friction parameters whose columns depend on what is sought."""
    bent = [name for term in BENT for name in (f"{term}[{joint}]", speed_name(term, joint))]
    return (f"load[{joint}]", *bent)


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
        blocks=tuple((rows[:, mask],) for rows, mask in zip(samples.rows, stay)),
    )

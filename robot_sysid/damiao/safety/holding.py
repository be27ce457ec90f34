"""The torque that carries an arm at rest, of its model or of its trajectory file.

A motor that turns opposite to its joint, or that drives another joint, moves an arm along another
path than the checked one. Where gravity loads the joint, the torque that holds it shows this.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.joints import DamiaoJoint, peak_torques
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.usual_errors import LINK, WEIGHT

if TYPE_CHECKING:
    from robot_sysid.damiao.safety.position_shift import PositionShift

LOADED = 2.0
"""Expected torque above which a joint's load is judged, in units of the torque doubt.

With this value a guessed model may be twice too heavy.
"""

DOUBT = 0.06
"""Torque that friction alone may explain, as a share of a motor's peak torque: 1.6 N m of a DM4340,
about the ``LARGEST_FRICTION`` that small motors have (a judgement). With less, the friction of a
stiff gear would be taken for a load with the wrong sign, with more, a joint that turns the other
way would have to be loaded more before it is noticed."""


def torque_doubt(joints: Sequence[DamiaoJoint]) -> Array:
    """Return the torque (n,) that friction alone may explain at each joint [N m]."""
    return DOUBT * peak_torques(joints)


# Distance from a pose in which its torque holds the arm [rad]: 2 N m at 20 N m/rad.
_NEAR = 0.1


@dataclass(frozen=True)
class HoldingTorque:
    """What torques hold an arm still.

    Attributes:
        joints: the n joints of the arm, base to terminal.
        torque: returns the torque (n,) [N m] that should hold the arm in a pose (n,) [rad].
        doubt: torque (n,) that friction alone may explain [N m].
        pose: pose (n,) [rad] near which the torque is known; None where in every pose.
        carries_arm: whether the torque may carry an arm that has weight.
        robot: model of the arm; None without one.
        slope: by how much each joint's weight grows as it sinks (n,) [N m/rad]; None where it is
            not known.
        inertia: returns that of each joint with those behind it (n,) [kg m^2] in a pose (n,).
    """

    joints: Sequence[DamiaoJoint]
    torque: Callable[[Array], Array]
    doubt: Array
    pose: Array | None = None
    carries_arm: bool = True
    robot: RobotModel | None = None
    slope: Array | None = None
    inertia: Callable[[Array], Array] = np.zeros_like

    @property
    def is_model(self) -> bool:
        """Whether a model of the arm gives the expected torque in every pose."""
        return self.pose is None

    def error(self, q: Array) -> Array:
        """Return the standard error (n,) of the torque in a pose q (n,) [N m].

        It is that of models as wrong as they usually are.
        """
        if self.robot is None:
            return WEIGHT * np.abs(self.torque(q))
        return weight_errors(self.robot, q[None])[0]

    def contradicts(self, q: Array, tau: Array) -> NDArray[np.bool_]:
        """Return which joints (n,) torques tau (n,) [N m] cannot hold still at q (n,) [rad].

        A joint is judged where more torque is expected than friction may explain, and where the
        torques that are fed forward could never carry an arm.
        """
        if not self.carries_arm:
            return np.abs(tau) > LOADED * self.doubt
        if self.pose is not None and not np.all(np.abs(q - self.pose) <= _NEAR):
            return np.zeros(len(q), bool)
        expected = self.torque(q)
        size = np.abs(expected) / self.doubt
        # Below half of the doubt a loaded joint counts as unloaded.
        least = np.where(size > LOADED, 0.5, -1.0) * self.doubt
        if self.pose is not None:
            least = least - self.change_of_weight(q - self.pose)
        return (size > 1.0) & (np.sign(expected) * tau < least)

    def change_of_weight(self, moved: Array) -> Array:
        """Return by how much weights (n,) may change where joints have moved by (n,) [N m].

        The weight is the slope of a potential: its slopes by other joints are at most about the
        geometric means of those by the joints themselves. 0 where no slope is known.
        """
        if self.slope is None:
            return np.zeros_like(moved)
        roots = np.sqrt(self.slope)
        return roots * np.sum(roots * np.abs(moved))

    def unverified_joints(self, q: Array) -> list[DamiaoJoint]:
        """Return the unverified joints whose load at q (n,) [rad] does not show how they turn."""
        is_bare = np.abs(self.torque(q)) <= LOADED * self.doubt
        return [
            joint
            for joint, bare in zip(self.joints, is_bare)
            if bare and not joint.verified
        ]

    def position_shift(self) -> PositionShift | None:
        """Return a new search for shifted positions in a run's motion; None without a model."""
        if self.robot is None:
            return None
        from robot_sysid.damiao.safety.position_shift import PositionShift

        return PositionShift(self.robot, self.doubt)


def refuse_guessed_masses(robot: RobotModel) -> None:
    """Raise InputError where bodies of the links' geometry stand for the masses of an arm.

    Their weight may be off by as much as itself, and no motor carries an arm by it.
    """
    if robot.lacks_masses:
        raise InputError(
            f"{robot.path} states no masses that motors could carry the arm by: identify the arm "
            "from a log of its own controller first, and pass the model that is written"
        )


def gravity_holding(
    robot: RobotModel, joints: tuple[DamiaoJoint, ...]
) -> HoldingTorque:
    """Return the torques that hold an arm by its model's gravity.

    Args:
        robot: model of the arm with n joints.
        joints: joints of the arm with their motors, base to terminal.
    """
    from robot_sysid.dynamics.inverse_dynamics import ArmDynamics

    arm = ArmDynamics(robot)

    def holding_torque(q: Array) -> Array:
        """Return the torque (n,) that holds the arm at rest in a pose q (n,) [N m]."""
        zero = np.zeros((1, len(q)))
        return arm(Motion(np.zeros(1), q[None], zero, zero))[0]

    def inertia(q: Array) -> Array:
        """Return the inertia of each joint with those behind it (n,) in a pose q (n,) [kg m^2]."""
        n = len(q)
        still = np.zeros((n, n))
        poses = np.tile(q, (n, 1))
        torque = arm(Motion(np.arange(float(n)), poses, still, np.eye(n)))
        return np.diag(torque) - holding_torque(q)

    doubt = torque_doubt(joints) + robot.friction.largest_dry
    return HoldingTorque(joints, holding_torque, doubt, robot=robot, inertia=inertia)


def weight_errors(robot: RobotModel, q: Array) -> Array:
    """Return the standard errors (N, n) of an arm's weight torque in poses q (N, n) [N m].

    They are those of a model whose links are as wrong as models usually are
    (``records.usual_errors``); no multiple of the torque itself, which may be small where the
    weights of two links cancel.
    """
    from robot_sysid.dynamics.inverse_dynamics import LinkDynamics, other_links
    from robot_sysid.estimate.links import link_factor

    links = [*other_links(robot), robot.n_joints - 1]
    factor = link_factor(robot, links, 0.01 * LINK)
    still = np.zeros_like(q)
    columns = LinkDynamics(robot).motion(q, still, still).columns(links)
    return np.sqrt(np.sum((columns @ factor) ** 2, axis=-1))


def file_holding(trajectory: DamiaoTrajectory) -> HoldingTorque:
    """Return the torques that hold an arm near a trajectory's first point, by the trajectory.

    They are the feed-forward torque of the row with the least acceleration near the first point;
    unknown where this row still accelerates. A trajectory whose torque never exceeds any joint's
    doubt cannot carry an arm that has weight.
    """
    q = trajectory.q
    is_near = np.all(np.abs(q - q[0]) <= _NEAR, axis=1)
    acceleration = np.max(np.abs(trajectory.qdd), axis=1)
    row = np.argmin(np.where(is_near, acceleration, np.inf))
    torque = trajectory.tau[row]
    doubt = torque_doubt(trajectory.joints)
    # Slower, a torque is that at rest: 1 N m at 2 kg m^2.
    is_at_rest = acceleration[row] < 0.5
    inertia = mean_inertia(trajectory)
    return HoldingTorque(
        trajectory.joints,
        lambda q: torque,
        doubt,
        pose=q[0] if is_at_rest else np.full_like(q[0], np.nan),
        carries_arm=bool(np.any(np.abs(trajectory.tau) > doubt)),
        slope=trajectory.weight_slope,
        inertia=lambda q: inertia,
    )


def mean_inertia(trajectory: DamiaoTrajectory) -> Array:
    """Return the inertia of each joint (n,) that the torques of a trajectory show [kg m^2].

    It is the slope of a joint's torque without its weight over its own acceleration: the other
    joints' accelerations go by turns with it and against it. 0 where the weight is not known.
    """
    if trajectory.weight is None:
        return np.zeros(trajectory.n_joints)
    qdd = trajectory.qdd
    cross = np.sum(qdd * (trajectory.tau - trajectory.weight), axis=0)
    size = np.sum(qdd**2, axis=0)
    return np.maximum(cross, 0.0) / np.where(size > 0.0, size, 1.0)

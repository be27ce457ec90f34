"""The linear equations of every joint: regressor, friction and known torques of a chunk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.kinematics import ChainKinematics
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.regressor import joint_regressor

TERMINAL_FRICTION = FrictionModel(("coulomb", "viscous"))
NO_FRICTION = FrictionModel(())


def friction_per_joint(
    robot: RobotModel, torques: str, model: FrictionModel
) -> tuple[FrictionModel, ...]:
    """Return the friction terms of each chain joint: all of them, or the last one's only."""
    others = model if torques == "chain" else NO_FRICTION
    return (others,) * (robot.n_joints - 1) + (model,)


class Equations:
    """The linear equations rows x = tau of one arm: parameter names, priors, and rows of a chunk.

    Args:
        robot: the arm.
        torques: "chain" for every joint that carries the link, "terminal" for the last one only.
        friction: terms to estimate, one model per chain joint; where a joint has none, the model's
            own friction is taken as known.
        shared: names of further parameters that enter every joint's equations; whoever asks for
            rows brings their columns.
    """

    def __init__(
        self,
        robot: RobotModel,
        torques: str,
        friction: Sequence[FrictionModel],
        shared: Sequence[str] = (),
    ) -> None:
        self._robot = robot
        self._friction = tuple(friction)
        self._friction_known = np.array([not model.terms for model in friction])
        self._armature_sought = np.array(["armature" in model.terms for model in friction])
        self._kinematics = ChainKinematics(robot)
        last = robot.n_joints - 1
        self.rows_of = tuple(range(robot.n_joints)) if torques == "chain" else (last,)
        names = [self._friction[j].parameter_names(robot.joint_names[j]) for j in self.rows_of]
        own = tuple(name for joint in names for name in joint)
        self.names = PARAMETER_NAMES + own + tuple(shared)
        self.joints = tuple(robot.joint_names[j] for j in self.rows_of)
        self.columns = tuple(
            np.array([self.names.index(n) for n in (*PARAMETER_NAMES, *joint, *shared)])
            for joint in names
        )

    @property
    def prior(self) -> Array:
        """The model's own values of all parameters (p,)."""
        values = dict(zip(PARAMETER_NAMES, self._robot.prior.theta))
        for j in self.rows_of:
            joint = self._robot.joint_names[j]
            values[f"coulomb[{joint}]"] = self._robot.friction.coulomb[j]
            values[f"viscous[{joint}]"] = self._robot.friction.viscous[j]
            values[f"armature[{joint}]"] = self._kinematics.armature[j]
        return np.array([float(values.get(name, 0.0)) for name in self.names])

    def rows(
        self, measurement: Measurement, shared: Array | None = None
    ) -> Iterator[tuple[Array, Array]]:
        """Yield (rows (N, k), right-hand side (N,)) per joint of ``joints``.

        Args:
            measurement: N samples with velocities and accelerations.
            shared: (N, n, s) columns of the shared parameters, where there are any.
        """
        if measurement.qd is None or measurement.qdd is None:
            raise InputError(
                "the measurement has no velocities or accelerations; differentiate it first"
            )
        qd, qdd = measurement.qd, measurement.qdd
        motion = self._kinematics.evaluate(measurement.q, qd, qdd)
        known = motion.tau_rest + np.where(
            self._friction_known, self._robot.friction.torque(qd), 0.0
        )
        known -= np.where(self._armature_sought, self._kinematics.armature * qdd, 0.0)
        inertial = joint_regressor(motion, self.rows_of)
        for block, j in zip(inertial, self.rows_of):
            # What the gear carries, by the model: the measured torque has friction in it already.
            load = motion.tau_rest[:, j] + block @ self._robot.prior.theta
            own = self._friction[j].columns(qd[:, j], qdd[:, j], load)
            common = () if shared is None else (shared[:, j],)
            yield np.hstack((block, own, *common)), measurement.tau[:, j] - known[:, j]

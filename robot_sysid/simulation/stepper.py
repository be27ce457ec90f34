"""An arm that moves under joint torques, step by step: what a simulated set of motors drives.

What acts is rigid-body dynamics, armature, springs, and the model's own friction
tau_f = fc sign(qd) + fv qd. Contacts, joint stops and the model's actuators do not act. Joints
outside the chain stay at the reference configuration.

One step is implicit in everything that depends on velocity, so that stiff motor damping, shorted
windings and dry friction are stable with any step: find v with

    M (v - v_before) / h = torque - bias - (damping + fv) v - f,
    f = fc sign(v), or |f| <= fc where v = 0.
"""

from __future__ import annotations

import mujoco
import numpy as np

from robot_sysid.errors import SimulationError
from robot_sysid.records import Array, RobotModel
from robot_sysid.simulation.forward_dynamics import forward_copy

DEFAULT_TIMESTEP = 5e-4


class ArmStepper:
    """The chain of a model, torques in, motion out.

    Args:
        q: (n,) where it starts, at rest; the reference configuration if not given.
        timestep: length of a step [s].

    Attributes:
        q, qd: (n,) positions and velocities [rad, rad/s].
    """

    def __init__(
        self, robot: RobotModel, q: Array | None = None, timestep: float = DEFAULT_TIMESTEP
    ) -> None:
        self._robot, self.n_joints, self.timestep = robot, robot.n_joints, timestep
        self._model = forward_copy(robot)
        self._model.dof_damping[:] = 0.0
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = robot.reference_qpos
        self._coulomb, self._viscous = robot.friction.coulomb, robot.friction.viscous
        self.q: Array = np.array(robot.reference if q is None else q, dtype=float)
        self.qd: Array = np.zeros(robot.n_joints)
        self._units = np.zeros((robot.n_joints, self._model.nv))
        self._units[np.arange(robot.n_joints), robot.dof_index] = 1.0
        self._columns = np.empty_like(self._units)

    def step(self, torque: Array, damping: Array) -> Array:
        """Advance one step under ``torque - damping qd`` and return what acted (n,) [N m].

        Damping (n,) is in N m s/rad.

        Raises:
            SimulationError: the state is not finite any more.
        """
        mobility, bias = self._dynamics()
        h = self.timestep
        matrix = np.eye(self.n_joints) + h * mobility * (damping + self._viscous)
        free = self.qd + h * mobility @ (torque - bias)
        self.qd = self._with_dry_friction(matrix, free, h * mobility)
        self.q = self.q + h * self.qd
        if not np.all(np.isfinite(self.q)):
            raise SimulationError("the simulated arm diverged; lower the gains or the torques")
        return np.asarray(torque - damping * self.qd)

    def tip(self) -> Array:
        """Return where the terminal link's centre of mass is (3,) [m]."""
        self._dynamics()
        return np.array(self._data.xipos[self._robot.body_id])

    def axis(self, joint: int) -> Array:
        """Return the direction (3,) of a chain joint's axis in the world."""
        self._dynamics()
        return np.array(self._data.xaxis[self._model.dof_jntid[self._robot.dof_index[joint]]])

    def moved_inertia(self) -> Array:
        """Return the inertia (n,) that each joint moves, the others being free [kg m^2]."""
        return np.asarray(1.0 / np.diag(self._dynamics()[0]))

    def _dynamics(self) -> tuple[Array, Array]:
        """Return the inverse mass matrix (n, n) and the bias torque (n,) of the chain."""
        data, dofs = self._data, self._robot.dof_index
        data.qpos[self._robot.qpos_index] = self.q
        data.qvel[dofs] = self.qd
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        mujoco.mj_solveM(self._model, data, self._columns, self._units)
        bias = data.qfrc_bias[dofs] - data.qfrc_passive[dofs]
        return self._columns[:, dofs], bias

    def _with_dry_friction(self, matrix: Array, free: Array, impulse: Array) -> Array:
        """Return the velocity v (n,) with matrix v = free - impulse f and f as in the module text.

        A joint slides in the direction it has, or would take without friction; one that would turn
        round against its own friction sticks instead, until that needs more than fc.
        """
        fc, rubs = self._coulomb, self._coulomb > 0.0
        unhindered = np.linalg.solve(matrix, free)
        direction = np.where(self.qd != 0.0, np.sign(self.qd), np.sign(unhindered))
        stuck = np.zeros(len(fc), dtype=bool)
        velocity = np.asarray(unhindered)
        for _ in range(2 * len(fc) + 1):
            # matrix v + impulse f = free; unknown: v of the sliding joints, f of the stuck ones.
            sliding = np.where(stuck, 0.0, fc * direction)
            mixed = np.where(stuck, impulse, matrix)
            unknown = np.linalg.solve(mixed, free - impulse @ sliding)
            velocity = np.where(stuck, 0.0, unknown)
            friction = np.where(stuck, unknown, sliding)
            turned = rubs & ~stuck & (velocity * direction < 0.0)
            broken = stuck & (np.abs(friction) > fc * (1.0 + 1e-9))
            if not np.any(turned | broken):
                break
            direction = np.where(broken, np.sign(friction), direction)
            stuck = (stuck | turned) & ~broken
        return velocity

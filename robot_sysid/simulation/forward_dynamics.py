"""Arms that move: MuJoCo's forward dynamics of the chain, everything else held still.

What acts: rigid-body dynamics, armature, springs, damping and friction. What does not: contacts,
joint stops and equalities (an excitation trajectory touches none of them), the model's actuators
(the torque comes from outside), gravity compensation and drag.

Joints outside the chain (fingers, a second arm, loose objects) get so much armature that nothing
moves them. None of them carries the chain, so the chain feels a rigid load and nothing else.

An arm that motors drive is stepped (``ArmStepper``) with Coulomb's law
tau_f = fc sign(qd) + fv qd, and implicit in damping and dry friction, so that stiff motor damping,
shorted windings and dry friction are stable with any step h: find v and the mean velocity with

    M (v - v_before) / h = torque - bias - (damping + fv) v_mean - f,
    f = fc sign(v), or |f| <= fc where v = 0,

by an L-stable method of second order; M and bias are those in the middle of the step, and positions
move by the mean velocity. So damping adds no apparent armature to the mean torque of a step.
(Implicit Euler, v in place of v_mean, adds h (damping + fv) / 2: 6 % of an OpenArm's rotor.)
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import analysis_copy, posed
from robot_sysid.errors import SimulationError
from robot_sysid.records import Array, RobotModel

HELD_ARMATURE = 1e9
"""Armature that holds joints outside the chain still [kg m^2]."""
DEFAULT_TIMESTEP = 5e-4
"""Step of an arm that motors drive [s]."""


def forward_copy(plant: RobotModel) -> Any:
    """Return a copy of the plant's compiled model set up to be stepped as described above."""
    model = analysis_copy(plant.mj_model)
    flags = int(model.opt.disableflags)
    disable = mujoco.mjtDisableBit
    for name in ("EQUALITY", "LIMIT", "ACTUATION"):
        flags |= int(getattr(disable, f"mjDSBL_{name}"))
    model.opt.disableflags = flags & ~int(disable.mjDSBL_CONSTRAINT)
    model.opt.solver = int(mujoco.mjtSolver.mjSOL_NEWTON)
    model.opt.iterations = 100
    chain = plant.dof_index
    model.dof_damping[chain] = plant.mj_model.dof_damping[chain]
    held = np.setdiff1d(np.arange(model.nv), chain)
    model.dof_armature[held] = HELD_ARMATURE
    model.dof_frictionloss[held] = 0.0
    return model


def placed(plant: RobotModel, model: Any, data: Any, q: Array, qd: Array) -> None:
    """Forget the past and put the chain at positions and velocities (n,), the rest at rest."""
    mujoco.mj_resetData(model, data)
    data.qpos[:] = plant.reference_qpos
    data.qpos[plant.qpos_index] = q
    data.qvel[plant.dof_index] = qd


class ArmStepper:
    """The chain of a model, torques in, motion out.

    Args:
        q: (n,) where it starts, at rest; the reference configuration if not given.
        timestep: length of a step [s].

    Attributes:
        q, qd: (n,) positions and velocities [rad, rad/s].
    """

    def __init__(
        self,
        robot: RobotModel,
        q: Array | None = None,
        timestep: float = DEFAULT_TIMESTEP,
    ) -> None:
        self._robot = robot
        self.n_joints = robot.n_joints
        self.timestep = timestep
        self._model = forward_copy(robot)
        self._model.dof_damping[:] = 0.0
        self._data = posed(self._model, robot.reference_qpos)
        self._viscous = robot.friction.viscous
        shared = robot.friction.shared
        assert shared is not None
        levels = np.max(np.abs(shared), axis=1)
        # Dry friction has these levels (k,), along these directions (k, n) of the joints' speeds.
        self._coulomb = np.concatenate((robot.friction.coulomb, levels))
        self._rubs_along = np.vstack((np.eye(robot.n_joints), shared / levels[:, None]))
        self.q: Array = np.array(robot.reference if q is None else q, dtype=float)
        self.qd: Array = np.zeros(robot.n_joints)
        self._last_change: Array = np.zeros(robot.n_joints)
        self._units = np.zeros((robot.n_joints, self._model.nv))
        self._units[np.arange(robot.n_joints), robot.dof_index] = 1.0
        self._columns = np.empty_like(self._units)

    def step(
        self, torque: Array, damping: Array, duration: float | None = None
    ) -> Array:
        """Advance by ``duration`` [s], a timestep if not given, under ``torque - damping qd``, and
        return the mean torque (n,) that acted [N m]; ``damping`` (n,) is in [N m s/rad].

        Raises:
            SimulationError: the state is not finite any more.
        """
        h = self.timestep if duration is None else duration
        # Half of the last change of velocity stands for that up to the middle of this step.
        mobility, bias = self._dynamics(
            self.q + 0.5 * h * self.qd, self.qd + 0.5 * self._last_change
        )
        resistance = damping + self._viscous
        end_response, mean_response = _velocity_responses(mobility, resistance, h)

        load = torque - bias - resistance * self.qd
        velocity, friction = self._resolve_dry_friction(
            self.qd + end_response @ load, end_response
        )
        mean_velocity = self.qd + mean_response @ (load - friction)
        mean_velocity = np.where(velocity == 0.0, 0.5 * self.qd, mean_velocity)

        self._last_change = velocity - self.qd
        self.q = self.q + h * mean_velocity
        self.qd = velocity
        if not np.all(np.isfinite(self.q)):
            raise SimulationError(
                "the simulated arm diverged; lower the gains or the torques"
            )
        return np.asarray(torque - damping * mean_velocity)

    def tip(self) -> Array:
        """Return where the terminal link's centre of mass is (3,) [m]."""
        self._dynamics(self.q, self.qd)
        return np.array(self._data.xipos[self._robot.body_id])

    def axis(self, joint: int) -> Array:
        """Return the direction (3,) of a chain joint's axis in the world."""
        self._dynamics(self.q, self.qd)
        return np.array(
            self._data.xaxis[self._model.dof_jntid[self._robot.dof_index[joint]]]
        )

    def moved_inertia(self) -> Array:
        """Return the inertia (n,) that each joint moves, the others being free [kg m^2]."""
        return np.asarray(1.0 / np.diag(self.mobility(self.q)))

    def mobility(self, q: Array) -> Array:
        """Return the inverse mass matrix (n, n) at positions (n,) [1 / (kg m^2)]."""
        inverse_mass, _ = self._dynamics(q, np.zeros_like(q))
        return inverse_mass

    def _dynamics(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return the inverse mass matrix (n, n) and the bias torque (n,) of the chain."""
        data = self._data
        dofs = self._robot.dof_index
        data.qpos[self._robot.qpos_index] = q
        data.qvel[dofs] = qd
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        mujoco.mj_solveM(self._model, data, self._columns, self._units)
        return self._columns[:, dofs], data.qfrc_bias[dofs] - data.qfrc_passive[dofs]

    def _resolve_dry_friction(
        self, free: Array, response: Array
    ) -> tuple[Array, Array]:
        """Return (velocities, dry friction torques) (n,) at the end of a step.

        ``free`` (n,) are the velocities without dry friction, which changes them by -response
        (n, n) times its torques.
        """
        # A joint slides in the direction it has, or would take without friction; one that would
        # turn round against its own friction sticks instead, until that needs more than fc. So does
        # a motor that turns several joints.
        fc = self._coulomb
        rubs = self._coulomb > 0.0
        along = self._rubs_along
        of_friction = response @ along.T
        crossed = along @ of_friction
        without = along @ free
        direction = np.where(
            along @ self.qd != 0.0, np.sign(along @ self.qd), np.sign(without)
        )
        stuck = np.zeros(len(fc), dtype=bool)
        for _ in range(2 * len(fc) + 1):
            friction = np.where(stuck, 0.0, fc * direction)
            velocity = without - crossed @ friction
            if np.any(stuck):
                friction[stuck] = self._holding(
                    crossed[np.ix_(stuck, stuck)], velocity[stuck]
                )
                velocity -= crossed[:, stuck] @ friction[stuck]
                velocity[stuck] = 0.0
            turned = rubs & ~stuck & (velocity * direction < 0.0)
            broken = stuck & (np.abs(friction) > fc * (1.0 + 1e-9))
            if not np.any(turned | broken):
                break
            direction = np.where(broken, np.sign(friction), direction)
            stuck = (stuck | turned) & ~broken
        n = self.n_joints
        of_joints = np.where(stuck[:n], 0.0, free - of_friction @ friction)
        return of_joints, along.T @ friction

    def _holding(self, response: Array, velocity: Array) -> Array:
        """Return the dry friction (k,) that stops what sticks, by its response (k, k)."""
        if len(self._coulomb) == self.n_joints:
            return np.asarray(np.linalg.solve(response, velocity))
        # A motor and all joints that it turns may stick together, which is once too often.
        return np.asarray(np.linalg.lstsq(response, velocity, rcond=None)[0])


# Implicit share of each stage that makes the two-stage method below of second order and L-stable.
_STAGE = 1.0 - math.sqrt(0.5)


def _velocity_responses(
    mobility: Array, resistance: Array, h: float
) -> tuple[Array, Array]:
    """Return what a constant torque adds to the velocities at the end of a step of ``h`` [s], and
    to their mean over it, as matrices (n, n), while ``resistance`` (n,) [N m s/rad] damps.
    """
    identity = np.eye(len(resistance))
    stage = np.linalg.solve(identity + _STAGE * h * mobility * resistance, h * mobility)
    second_stage = stage - _STAGE * (stage * resistance) @ stage
    end_response = _STAGE * stage + (1.0 - _STAGE) * second_stage
    mean_response = _STAGE * stage + (0.5 - _STAGE) * second_stage
    return end_response, mean_response

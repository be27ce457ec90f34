"""A plant that moves: MuJoCo's forward dynamics of the chain, everything else held still.

What acts: rigid-body dynamics, armature, springs, damping and MuJoCo's own ``frictionloss``. What
does not: contacts, joint stops and equalities (an excitation trajectory touches none of them), the
model's actuators (the torque comes from outside), gravity compensation and drag.

Joints outside the chain (fingers, a second arm, loose objects) get so much armature that nothing
moves them. None of them carries the chain, so the chain feels a rigid load and nothing else.

The integrator is the explicit Runge-Kutta method of fourth order. MuJoCo's implicit ones add an
apparent armature h (kv + damping) to the torque, and its Euler method evaluates damping half a step
late, an apparent armature of h damping / 2: on a wrist of 5e-4 kg m^2 both spoil the result.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.kinematics import analysis_copy
from robot_sysid.errors import SimulationError
from robot_sysid.records import Array, RobotModel
from robot_sysid.simulation.frictionloss import FrictionRamp

HELD_ARMATURE = 1e9
"""Armature that holds joints outside the chain still [kg m^2]."""
STIFFEST_STEP = 1.0
"""Largest step times fastest decay rate; Runge-Kutta becomes unstable at 2.78."""
SHORTEST_STEP = 2e-6
"""Step below which a plant is refused [s]."""


def forward_copy(plant: RobotModel) -> Any:
    """Return a copy of the plant's compiled model set up to be stepped as described above."""
    model = analysis_copy(plant.mj_model)
    flags, disable = int(model.opt.disableflags), mujoco.mjtDisableBit
    for name in ("EQUALITY", "LIMIT", "ACTUATION"):
        flags |= int(getattr(disable, f"mjDSBL_{name}"))
    model.opt.disableflags = flags & ~int(disable.mjDSBL_CONSTRAINT)
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    model.opt.solver = int(mujoco.mjtSolver.mjSOL_NEWTON)
    model.opt.tolerance, model.opt.iterations = 1e-12, 100
    chain = plant.dof_index
    model.dof_damping[chain] = plant.mj_model.dof_damping[chain]
    held = np.setdiff1d(np.arange(model.nv), chain)
    model.dof_armature[held] = HELD_ARMATURE
    model.dof_frictionloss[held] = 0.0
    return model


class ForwardPlant:
    """The chain as a system with torques in and motion out.

    Args:
        plant: the arm.
        period: time for which a torque is held [s]; cut into shorter integration steps where the
            plant's damping asks for it.
        configurations: (K, n) chain positions it will pass through, to judge that.

    Raises:
        SimulationError: the plant is too stiff or has impossible inertias; names the joint.
    """

    def __init__(self, plant: RobotModel, period: float, configurations: Array) -> None:
        self._plant = plant
        self.model = forward_copy(plant)
        self.data = mujoco.MjData(self.model)
        self._others = np.setdiff1d(np.arange(self.model.nq), plant.qpos_index)
        self._other_dofs = np.setdiff1d(np.arange(self.model.nv), plant.dof_index)
        self.substeps = self._substeps(period, configurations)
        self.model.opt.timestep = period / self.substeps
        self._has_friction = self.model.dof_frictionloss[plant.dof_index] > 0.0
        self._rows = self._friction_rows()
        self.ramp = self._friction_ramp()

    def reset(self, q: Array, qd: Array) -> None:
        """Forget the past and put the chain at positions and velocities (n,)."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._plant.reference_qpos
        self.data.qpos[self._plant.qpos_index] = q
        self.data.qvel[self._plant.dof_index] = qd
        mujoco.mj_forward(self.model, self.data)

    def state(self) -> tuple[Array, Array]:
        """Return copies of the chain's positions and velocities (n,)."""
        q, qd = self.data.qpos[self._plant.qpos_index], self.data.qvel[self._plant.dof_index]
        return np.array(q), np.array(qd)

    def has_diverged(self) -> bool:
        """Tell whether MuJoCo met values it could not go on with."""
        warning = mujoco.mjtWarning
        kinds = (warning.mjWARN_BADQPOS, warning.mjWARN_BADQVEL, warning.mjWARN_BADQACC)
        return any(self.data.warning[int(kind)].number for kind in kinds)

    def times_mass(self, acceleration: Array) -> Array:
        """Return the mass matrix, as of the last step, times accelerations (n,)."""
        wanted, product = np.zeros(self.model.nv), np.empty(self.model.nv)
        wanted[self._plant.dof_index] = acceleration
        mujoco.mj_mulM(self.model, self.data, product, wanted)
        return product[self._plant.dof_index]

    def acceleration(self, tau: Array) -> Array:
        """Return the chain's accelerations (n,) at the present state under torques (n,)."""
        self.data.qfrc_applied[self._plant.dof_index] = tau
        mujoco.mj_forward(self.model, self.data)
        return np.array(self.data.qacc[self._plant.dof_index])

    def step(self, tau: Array) -> None:
        """Advance by one period under constant torques (n,)."""
        self.data.qfrc_applied[self._plant.dof_index] = tau
        mujoco.mj_step(self.model, self.data, self.substeps)
        if len(self._other_dofs):
            self.data.qpos[self._others] = self._plant.reference_qpos[self._others]
            self.data.qvel[self._other_dofs] = 0.0

    def dry_friction(self) -> Array:
        """Return the resisting dry friction torques (n,), as of the last ``acceleration``."""
        torque = np.zeros(self._plant.n_joints)
        torque[self._has_friction] = -self.data.efc_force[self._rows]
        return torque

    def inverse(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torques (N, n) of a motion (N, n), MuJoCo's dry friction included."""
        data, at_v = mujoco.MjData(self.model), self._plant.dof_index
        data.qpos[:] = self._plant.reference_qpos
        tau = np.empty_like(q)
        for k in range(len(q)):
            data.qpos[self._plant.qpos_index] = q[k]
            data.qvel[at_v], data.qacc[at_v] = qd[k], qdd[k]
            mujoco.mj_inverse(self.model, data)
            tau[k] = data.qfrc_inverse[at_v]
        return tau

    def _friction_rows(self) -> NDArray[np.int64]:
        """Return which constraint rows are the chain's dry friction; they never change."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self._plant.reference_qpos
        mujoco.mj_forward(self.model, data)
        kind = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
        row_of = {int(data.efc_id[r]): r for r in np.flatnonzero(data.efc_type == kind)}
        dofs = self._plant.dof_index[self._has_friction]
        return np.array([row_of[int(dof)] for dof in dofs], dtype=np.int64)

    def _friction_ramp(self) -> FrictionRamp:
        """Return the ramps, read off MuJoCo's own constraint at unit velocities."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self._plant.reference_qpos
        data.qvel[self._plant.dof_index] = 1.0
        mujoco.mj_forward(self.model, data)
        inertia, rate = np.zeros(self._plant.n_joints), np.zeros(self._plant.n_joints)
        inertia[self._has_friction] = data.efc_D[self._rows]
        rate[self._has_friction] = -data.efc_aref[self._rows]
        coulomb = self.model.dof_frictionloss[self._plant.dof_index]
        return FrictionRamp(coulomb, inertia, rate)

    def _substeps(self, period: float, configurations: Array) -> int:
        rate, joint = fastest_decay(self._plant, self.model, configurations)
        substeps = max(1, math.ceil(period * rate / STIFFEST_STEP))
        if period / substeps < SHORTEST_STEP:
            raise SimulationError(
                f"joint {self._plant.joint_names[joint]} of the plant is too stiff to be "
                f"simulated: its damping stops it within {1e6 / rate:.2g} microseconds; lower its "
                "damping, give it armature, or use --simulation inverse"
            )
        return substeps


def fastest_decay(plant: RobotModel, model: Any, configurations: Array) -> tuple[float, int]:
    """Return the fastest rate [1/s] at which damping stops the chain, and the joint it stops.

    Args:
        plant: the arm.
        model: its compiled model to be stepped.
        configurations: (K, n) chain positions to look at.

    Returns:
        (rate, joint): largest eigenvalue of M^-1 B over the configurations, M the mass matrix and
        B the damping, and the joint that moves most in its eigenvector.

    Raises:
        SimulationError: M is not positive definite.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = plant.reference_qpos
    damping = _damping(plant, model, data)
    rates = []
    for q in configurations:
        data.qpos[plant.qpos_index] = q
        mujoco.mj_forward(model, data)
        mass = _mass(plant, model, data)
        _require_positive(plant, mass)
        values, vectors = np.linalg.eig(np.linalg.solve(mass, damping))
        fastest = int(np.argmax(values.real))
        joint = int(np.argmax(np.abs(vectors[:, fastest])))
        rates.append((float(values.real[fastest]), joint))
    return max(rates)


def _require_positive(plant: RobotModel, mass: Array) -> None:
    """Raise SimulationError unless every motion of the chain has a positive kinetic energy."""
    values, vectors = np.linalg.eigh(0.5 * (mass + mass.T))
    if not values[0] > 0.0:
        joint = plant.joint_names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise SimulationError(
            f"the plant cannot move: a motion of joint {joint} has no positive kinetic energy, so "
            "a link it carries has an impossible mass or inertia; check the plant model's "
            "<inertial> elements"
        )


def _damping(plant: RobotModel, model: Any, data: Any) -> Array:
    """Return the (n, n) damping at rest, joint damping and that of tendons and actuators."""
    mujoco.mj_forward(model, data)
    at_rest = data.qfrc_passive[plant.dof_index]
    damping = np.empty((plant.n_joints, plant.n_joints))
    for j, dof in enumerate(plant.dof_index):
        data.qvel[dof] = 1.0
        mujoco.mj_forward(model, data)
        damping[:, j] = at_rest - data.qfrc_passive[plant.dof_index]
        data.qvel[dof] = 0.0
    return damping


def _mass(plant: RobotModel, model: Any, data: Any) -> Array:
    """Return the chain's (n, n) mass matrix at the present configuration."""
    mass = np.empty((plant.n_joints, plant.n_joints))
    product, unit = np.empty(model.nv), np.zeros(model.nv)
    for j, dof in enumerate(plant.dof_index):
        unit[dof] = 1.0
        mujoco.mj_mulM(model, data, product, unit)
        unit[dof] = 0.0
        mass[:, j] = product[plant.dof_index]
    return mass

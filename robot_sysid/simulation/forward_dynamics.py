"""Arms that move: MuJoCo's forward dynamics of the chain, everything else held still.

What acts: rigid-body dynamics, armature, springs, damping and MuJoCo's own ``frictionloss``. What
does not: contacts, joint stops and equalities (an excitation trajectory touches none of them), the
model's actuators (the torque comes from outside), gravity compensation and drag.

Joints outside the chain (fingers, a second arm, loose objects) get so much armature that nothing
moves them. None of them carries the chain, so the chain feels a rigid load and nothing else.

A plant's integrator is the explicit Runge-Kutta method of fourth order. MuJoCo's implicit ones add
an apparent armature h (kv + damping) to the torque, and its Euler method evaluates damping half a
step late, an apparent armature of h damping / 2: on a wrist of 5e-4 kg m^2 both spoil the result.

MuJoCo's ``frictionloss`` is not Coulomb's law but a ramp in velocity and acceleration that ends at
the Coulomb level: torque = clip(D (qdd + b qd), -fc, +fc). D and b follow from the constraint
settings and the inertia the joint had when the model was compiled. On a joint without armature the
ramp can be so wide that a slow motion never leaves it; the torque is then viscous friction D b and
inertia D, and no data can give fc. ``RampUse`` counts how often each joint was past its ramp.

What a simulated set of motors drives is stepped otherwise (``ArmStepper``): with Coulomb's law
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
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.kinematics import analysis_copy, inverse_dynamics, posed
from robot_sysid.errors import SimulationError
from robot_sysid.records import Array, RobotModel

HELD_ARMATURE = 1e9
"""Armature that holds joints outside the chain still [kg m^2]."""
STIFFEST_STEP = 1.0
"""Largest step times fastest decay rate; Runge-Kutta becomes unstable at 2.78."""
SHORTEST_STEP = 2e-6
"""Step below which a plant is refused [s]."""
DEFAULT_TIMESTEP = 5e-4
"""Step of an arm that motors drive [s]."""


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


def placed(plant: RobotModel, model: Any, data: Any, q: Array, qd: Array) -> None:
    """Forget the past and put the chain at positions and velocities (n,), the rest at rest."""
    mujoco.mj_resetData(model, data)
    data.qpos[:] = plant.reference_qpos
    data.qpos[plant.qpos_index], data.qvel[plant.dof_index] = q, qd


class ForwardPlant:
    """The chain as a system with torques in and motion out.

    Args:
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
        self._rows, self.ramp = self._read_friction()

    def reset(self, q: Array, qd: Array) -> None:
        """Forget the past and put the chain at positions and velocities (n,)."""
        placed(self._plant, self.model, self.data, q, qd)
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
        data = posed(self.model, self._plant.reference_qpos)
        chain = self._plant.qpos_index, self._plant.dof_index
        return inverse_dynamics(self.model, data, chain, q, qd, qdd)

    def _read_friction(self) -> tuple[NDArray[np.int64], FrictionRamp]:
        """Return which constraint rows are dry friction, they never change, and the ramps."""
        # Read off MuJoCo's own constraint at unit velocities.
        self.reset(self._plant.reference, np.ones(self._plant.n_joints))
        kind = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
        # Nothing outside the chain has any, and MuJoCo goes from the base outwards as the chain.
        rows = np.flatnonzero(self.data.efc_type == kind)
        inertia, rate = np.zeros(self._plant.n_joints), np.zeros(self._plant.n_joints)
        inertia[self._has_friction] = self.data.efc_D[rows]
        rate[self._has_friction] = -self.data.efc_aref[rows]
        coulomb = self.model.dof_frictionloss[self._plant.dof_index]
        return rows, FrictionRamp(coulomb, inertia, rate)

    def _substeps(self, period: float, configurations: Array) -> int:
        rate, joint = self._fastest_decay(configurations)
        substeps = max(1, math.ceil(period * rate / STIFFEST_STEP))
        if period / substeps < SHORTEST_STEP:
            raise SimulationError(
                f"joint {self._plant.joint_names[joint]} of the plant is too stiff to be "
                f"simulated: its damping stops it within {1e6 / rate:.2g} microseconds; lower its "
                "damping, or give it armature"
            )
        return substeps

    def _fastest_decay(self, configurations: Array) -> tuple[float, int]:
        """Return the fastest rate [1/s] at which damping stops the chain, and which joint."""
        # The largest eigenvalue of M^-1 B over the configurations (K, n), M the mass matrix and B
        # the damping, and the joint that moves most in its eigenvector.
        units, passive, rates = np.eye(self._plant.n_joints), [], []
        for qd in (0.0 * units[0], *units):
            self.reset(self._plant.reference, qd)
            passive.append(np.array(self.data.qfrc_passive[self._plant.dof_index]))
        damping = np.column_stack([passive[0] - torque for torque in passive[1:]])
        for q in configurations:
            self.reset(q, np.zeros_like(q))
            mass = np.column_stack([self.times_mass(unit) for unit in units])
            self._require_positive(mass)
            values, vectors = np.linalg.eig(np.linalg.solve(mass, damping))
            fastest = int(np.argmax(values.real))
            joint = int(np.argmax(np.abs(vectors[:, fastest])))
            rates.append((float(values.real[fastest]), joint))
        return max(rates)

    def _require_positive(self, mass: Array) -> None:
        """Raise SimulationError unless every motion of the chain has a positive kinetic energy."""
        values, vectors = np.linalg.eigh(0.5 * (mass + mass.T))
        if not values[0] > 0.0:
            joint = self._plant.joint_names[int(np.argmax(np.abs(vectors[:, 0])))]
            raise SimulationError(
                f"the plant cannot move: a motion of joint {joint} has no positive kinetic energy, "
                "so a link it carries has an impossible mass or inertia; check the plant model's "
                "<inertial> elements"
            )


STANDSTILL = 1e-6
"""Highest speed of a joint that is taken not to move at all [rad/s]."""
# MuJoCo's solver reaches the Coulomb level to about this share.
_FULL = 1e-6


@dataclass(frozen=True)
class FrictionRamp:
    """The ramps of all joints.

    Attributes:
        coulomb: (n,) level at which each ramp ends, fc [N m]; 0 for a joint without dry friction.
        inertia: (n,) slope in acceleration, D [kg m^2].
        rate: (n,) b, so that D b is the slope in velocity [1/s].
    """

    coulomb: Array
    inertia: Array
    rate: Array


class RampUse:
    """Counts, joint by joint (n,), the samples whose dry friction has its full size.

    Attributes:
        ramp_speed: (n,) highest speed at which dry friction was not complete [rad/s]. Leaving out
            all slower samples makes Coulomb's law exact for the rest.
    """

    def __init__(self, joints: tuple[str, ...], ramp: FrictionRamp) -> None:
        self._joints, self._ramp = joints, ramp
        self._was_full = np.zeros(len(joints), dtype=bool)
        self._speed = np.zeros(len(joints))
        self.ramp_speed: Array = np.zeros(len(joints))

    def add(self, qd: Array, dry: Array) -> None:
        """Count a chunk: velocities (N, n) and resisting dry friction torques (N, n) [N m]."""
        full = dry * np.sign(qd) >= (1.0 - _FULL) * self._ramp.coulomb
        speed = np.abs(qd)
        self._was_full |= np.any(full, axis=0)
        self._speed = np.maximum(self._speed, np.max(speed, axis=0))
        self.ramp_speed = np.maximum(self.ramp_speed, np.max(np.where(full, 0.0, speed), axis=0))

    @property
    def never_full(self) -> tuple[str, ...]:
        """Names of the joints whose dry friction never reaches its full size."""
        never = (self._ramp.coulomb > 0.0) & ~self._was_full
        return tuple(self._joints[j] for j in np.flatnonzero(never))

    def sentences(self) -> tuple[str, ...]:
        """Return what the user should know, one sentence each."""
        found, viscous = [], self._ramp.inertia * self._ramp.rate
        for j in np.flatnonzero(self._ramp.coulomb > 0.0).tolist():
            name, coulomb, speed = self._joints[j], self._ramp.coulomb[j], self._speed[j]
            if speed < STANDSTILL:
                found.append(f"{name} does not move, so its friction does not show in the data")
            elif name in self.never_full:
                found.append(
                    f"the frictionloss of {name} ({coulomb:.3g} N m) is never reached: in MuJoCo "
                    "it builds up with speed and is complete only above about "
                    f"{coulomb / viscous[j]:.2g} rad/s, and this motion stays below {speed:.2g} "
                    f"rad/s. It acts as {viscous[j]:.2g} N m s/rad of extra viscous friction, so "
                    "its Coulomb coefficient cannot be identified; give the joint armature in the "
                    "plant model or let it move faster"
                )
        return tuple(found)


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

    def step(self, torque: Array, damping: Array, duration: float | None = None) -> Array:
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
        velocity, friction = self._resolve_dry_friction(self.qd + end_response @ load, end_response)
        mean_velocity = self.qd + mean_response @ (load - friction)
        mean_velocity = np.where(velocity == 0.0, 0.5 * self.qd, mean_velocity)

        self._last_change = velocity - self.qd
        self.q = self.q + h * mean_velocity
        self.qd = velocity
        if not np.all(np.isfinite(self.q)):
            raise SimulationError("the simulated arm diverged; lower the gains or the torques")
        return np.asarray(torque - damping * mean_velocity)

    def tip(self) -> Array:
        """Return where the terminal link's centre of mass is (3,) [m]."""
        self._dynamics(self.q, self.qd)
        return np.array(self._data.xipos[self._robot.body_id])

    def axis(self, joint: int) -> Array:
        """Return the direction (3,) of a chain joint's axis in the world."""
        self._dynamics(self.q, self.qd)
        return np.array(self._data.xaxis[self._model.dof_jntid[self._robot.dof_index[joint]]])

    def moved_inertia(self) -> Array:
        """Return the inertia (n,) that each joint moves, the others being free [kg m^2]."""
        return np.asarray(1.0 / np.diag(self.mobility(self.q)))

    def mobility(self, q: Array) -> Array:
        """Return the inverse mass matrix (n, n) at positions (n,) [1 / (kg m^2)]."""
        inverse_mass, _ = self._dynamics(q, np.zeros_like(q))
        return inverse_mass

    def _dynamics(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return the inverse mass matrix (n, n) and the bias torque (n,) of the chain."""
        data, dofs = self._data, self._robot.dof_index
        data.qpos[self._robot.qpos_index] = q
        data.qvel[dofs] = qd
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        mujoco.mj_solveM(self._model, data, self._columns, self._units)
        return self._columns[:, dofs], data.qfrc_bias[dofs] - data.qfrc_passive[dofs]

    def _resolve_dry_friction(self, free: Array, response: Array) -> tuple[Array, Array]:
        """Return (velocities, dry friction torques) (n,) at the end of a step.

        ``free`` (n,) are the velocities without dry friction, which changes them by -response
        (n, n) times its torques.
        """
        # A joint slides in the direction it has, or would take without friction; one that would
        # turn round against its own friction sticks instead, until that needs more than fc. So does
        # a motor that turns several joints.
        fc, rubs, along = self._coulomb, self._coulomb > 0.0, self._rubs_along
        of_friction = response @ along.T
        crossed = along @ of_friction
        without = along @ free
        direction = np.where(along @ self.qd != 0.0, np.sign(along @ self.qd), np.sign(without))
        stuck = np.zeros(len(fc), dtype=bool)
        for _ in range(2 * len(fc) + 1):
            friction = np.where(stuck, 0.0, fc * direction)
            velocity = without - crossed @ friction
            if np.any(stuck):
                friction[stuck] = self._holding(crossed[np.ix_(stuck, stuck)], velocity[stuck])
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


def _velocity_responses(mobility: Array, resistance: Array, h: float) -> tuple[Array, Array]:
    """Return what a constant torque adds to the velocities at the end of a step of ``h`` [s], and
    to their mean over it, as matrices (n, n), while ``resistance`` (n,) [N m s/rad] damps.
    """
    identity = np.eye(len(resistance))
    stage = np.linalg.solve(identity + _STAGE * h * mobility * resistance, h * mobility)
    second_stage = stage - _STAGE * (stage * resistance) @ stage
    end_response = _STAGE * stage + (1.0 - _STAGE) * second_stage
    mean_response = _STAGE * stage + (0.5 - _STAGE) * second_stage
    return end_response, mean_response

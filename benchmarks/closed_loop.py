"""An arm that a controller drives, in MuJoCo's forward dynamics with MuJoCo's dry friction.

A bench for the estimate that shares nothing with the rows of its equations. Every control period
the drive holds the torque

    tau = tau_ff(t + h/2) + M(q) (w^2 (q_d - q) + 2 w (qd_d - qd)),

tau_ff the plant's own inverse dynamics along the trajectory and M its mass matrix, so that all
joints of any arm get the same critically damped error dynamics of bandwidth w (computed-torque
control with the feed-forward on the desired path: Siciliano, Sciavicco, Villani, Oriolo, "Robotics:
Modelling, Planning and Control", 2009, sec. 8.5.2).

The drive reports the mean of the torques it held just before and just after a sample. The plant
answers a staircase of width h like a smooth torque h/2 later, and the mean is that smooth torque at
the sample's instant: what is reported is the effective torque up to terms of order h^2.

The integrator is the explicit Runge-Kutta method of fourth order. MuJoCo's implicit ones add an
apparent armature h (kv + damping) to the torque, and its Euler method evaluates damping half a step
late, an apparent armature of h damping / 2: on a wrist of 5e-4 kg m^2 both spoil the result.

MuJoCo's ``frictionloss`` is not Coulomb's law but a ramp in velocity and acceleration that ends at
the Coulomb level: torque = clip(D (qdd + b qd), -fc, +fc). D and b follow from the constraint
settings and the inertia the joint had when the model was compiled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.model.compilation import captured_warnings
from robot_sysid.records import Array, Motion, MotionPlan, Recording, RobotModel
from robot_sysid.simulation.plant import forward_model, set_chain_state
from robot_sysid.trajectory import sample_times


class ForwardPlant:
    """The chain as a system with torques in and motion out.

    Args:
        period: time for which a torque is held [s]; cut into shorter integration steps where the
            plant's damping asks for it.
        configurations: (K, n) chain positions it will pass through, to judge that.
    """

    def __init__(self, plant: RobotModel, period: float, configurations: Array) -> None:
        self._plant = plant
        self.model = forward_model(plant)
        self.model.dof_damping[plant.dof_index] = plant.friction.viscous
        self.model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
        self.model.opt.tolerance = 1e-12
        self.data = mujoco.MjData(self.model)
        self._others = np.setdiff1d(np.arange(self.model.nq), plant.qpos_index)
        self._other_dofs = np.setdiff1d(np.arange(self.model.nv), plant.dof_index)
        self.substeps = max(1, math.ceil(period * self._fastest_decay(configurations)))
        self.model.opt.timestep = period / self.substeps
        self._has_friction = self.model.dof_frictionloss[plant.dof_index] > 0.0
        self._rows, self.ramp = self._read_friction()

    def reset(self, q: Array, qd: Array) -> None:
        """Forget the past and put the chain at positions and velocities (n,)."""
        set_chain_state(self._plant, self.model, self.data, q, qd)
        mujoco.mj_forward(self.model, self.data)

    def state(self) -> tuple[Array, Array]:
        """Return copies of the chain's positions and velocities (n,)."""
        q = self.data.qpos[self._plant.qpos_index]
        qd = self.data.qvel[self._plant.dof_index]
        return np.array(q), np.array(qd)

    def times_mass(self, acceleration: Array) -> Array:
        """Return the mass matrix, as of the last step, times accelerations (n,)."""
        full_acceleration = np.zeros(self.model.nv)
        product = np.empty(self.model.nv)
        full_acceleration[self._plant.dof_index] = acceleration
        mujoco.mj_mulM(self.model, self.data, product, full_acceleration)
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
        dynamics = ArmDynamics(self._plant)
        dynamics.model = self.model
        return dynamics.torque(q, qd, qdd)

    def _read_friction(self) -> tuple[NDArray[np.int64], FrictionRamp]:
        """Return which constraint rows are dry friction, they never change, and the ramps."""
        # Read off MuJoCo's own constraint at unit velocities.
        self.reset(self._plant.reference, np.ones(self._plant.n_joints))
        constraint_type = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
        # Nothing outside the chain has any, and MuJoCo goes from the base outwards as the chain.
        rows = np.flatnonzero(self.data.efc_type == constraint_type)
        inertia = np.zeros(self._plant.n_joints)
        rate = np.zeros(self._plant.n_joints)
        inertia[self._has_friction] = self.data.efc_D[rows]
        rate[self._has_friction] = -self.data.efc_aref[rows]
        coulomb = self.model.dof_frictionloss[self._plant.dof_index]
        return rows, FrictionRamp(coulomb, inertia, rate)

    def _fastest_decay(self, configurations: Array) -> float:
        """Return the fastest rate [1/s] at which damping stops the chain.

        It is the largest eigenvalue of M^-1 B over the configurations (K, n), M the mass matrix and
        B the damping. Runge-Kutta becomes unstable at 2.78 times a step.
        """
        units = np.eye(self._plant.n_joints)
        passive = []
        rates = []
        for qd in (0.0 * units[0], *units):
            self.reset(self._plant.reference, qd)
            passive.append(np.array(self.data.qfrc_passive[self._plant.dof_index]))
        damping = np.column_stack([passive[0] - torque for torque in passive[1:]])
        for q in configurations:
            self.reset(q, np.zeros_like(q))
            mass = np.column_stack([self.times_mass(unit) for unit in units])
            rates.append(np.max(np.linalg.eigvals(np.linalg.solve(mass, damping)).real))
        return float(max(rates))


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
    """Highest speed (n,) at which dry friction was not complete, ``ramp_speed`` [rad/s].

    Leaving out all slower samples makes Coulomb's law exact for the rest.
    """

    def __init__(self, ramp: FrictionRamp) -> None:
        self._ramp = ramp
        self.ramp_speed: Array = np.zeros(len(ramp.coulomb))

    def add(self, qd: Array, dry: Array) -> None:
        """Count a chunk: velocities (N, n) and resisting dry friction torques (N, n) [N m]."""
        full = dry * np.sign(qd) >= (1.0 - _FULL) * self._ramp.coulomb
        slow = np.max(np.where(full, 0.0, np.abs(qd)), axis=0)
        self.ramp_speed = np.maximum(self.ramp_speed, slow)


BANDWIDTH = 60.0
"""Bandwidth w of the tracking controller [rad/s]; lower where the control period is long."""
BANDWIDTH_TIMES_PERIOD = 0.1
"""Largest w h: far enough below 1, where the sampled loop would become unstable."""
LOST_TRACKING = 0.2
"""Position error that ends the run [rad or m]."""
_CONFIGURATIONS = 33
"""Places along the motion where the plant's stiffness is judged."""


class ClosedLoop:
    """One arm, one trajectory, one controller.

    Args:
        sample_rate: of the measurements [Hz].

    Attributes:
        period: control period [s], the plant's own time step or the next shorter one of which a
            whole number makes a sample period.
        ramp_use: how much of the plant's dry friction the motion showed.
    """

    def __init__(self, plant: RobotModel, plan: MotionPlan, sample_rate: float) -> None:
        self._plant = plant
        self._plan = plan
        self._sample_rate = sample_rate
        own_step = float(plant.mj_model.opt.timestep)
        self._periods = max(1, math.ceil(1.0 / (sample_rate * own_step) - 1e-9))
        self.period = 1.0 / (sample_rate * self._periods)
        self._bandwidth = min(BANDWIDTH, BANDWIDTH_TIMES_PERIOD / self.period)
        along = np.linspace(0.0, plan.duration, _CONFIGURATIONS)
        with captured_warnings():
            self._arm = ForwardPlant(plant, self.period, plan.evaluate(along).q)
            self._reset()

    def _reset(self) -> None:
        self.ramp_use = RampUse(self._arm.ramp)
        self._held: Array | None = None
        start = self._plan.evaluate(np.zeros(1))
        self._arm.reset(start.q[0], start.qd[0])

    def run(self) -> Iterator[Recording]:
        """Yield exact measurements of the whole motion, accelerations included.

        The accelerations are MuJoCo's at the sample's state under the reported torque. Each call
        starts anew.
        """
        self._reset()
        for time in sample_times(self._plan.duration, self._sample_rate):
            ticks = time[0] + self.period * np.arange(len(time) * self._periods)
            # Half a period later for the feed-forward.
            motion, motion_ahead = (
                self._plan.evaluate(np.minimum(ticks + later, self._plan.duration))
                for later in (0.0, 0.5 * self.period)
            )
            with captured_warnings():
                feed_forward = self._arm.inverse(
                    motion_ahead.q, motion_ahead.qd, motion_ahead.qdd
                )
                measurement = self._chunk(time, motion, feed_forward)
            yield measurement

    def _chunk(self, time: Array, motion: Motion, feed_forward: Array) -> Recording:
        samples = np.empty((5, len(time), self._plant.n_joints))
        for k in range(len(motion.time)):
            tau = self._command(motion, k, feed_forward[k])
            sample, between = divmod(k, self._periods)
            if between == 0:
                reported = tau if self._held is None else 0.5 * (self._held + tau)
                qdd = self._arm.acceleration(reported)
                dry = self._arm.dry_friction()
                samples[:, sample] = (*self._arm.state(), qdd, reported, dry)
            self._arm.step(tau)
            self._held = tau
        q, qd, qdd, measured, dry = samples
        self.ramp_use.add(qd, dry)
        return Recording(time, q, qd, measured, qdd)

    def _command(self, motion: Motion, k: int, feed_forward: Array) -> Array:
        """Return the torque (n,) to hold from tick k on."""
        q, qd = self._arm.state()
        error = motion.q[k] - q
        assert np.all(np.abs(error) < LOST_TRACKING), (
            f"off the trajectory at {motion.time[k]:.3f} s"
        )
        acceleration = self._bandwidth * (
            self._bandwidth * error + 2.0 * (motion.qd[k] - qd)
        )
        return np.asarray(feed_forward + self._arm.times_mass(acceleration))

"""Simulated arms: a plant that follows a motion exactly, and an arm that moves under torques.

A plant is another model of the same arm that plays the real one. Its sensors add noise to the true
torques and round the true positions to encoder steps. With an encoder resolution the
record holds no velocities and accelerations: an arm with encoders alone would have to compute them
from the rounded positions. Torque noise leaves the motion exact.

Arms that move under torques are MuJoCo's forward dynamics of the chain, everything else held still.
The chain is the n joints of the arm, base to terminal.
What acts: rigid-body dynamics, armature, springs, damping, friction, and actuators whose force does
not depend on their control. What does not: contacts and equalities (an excitation trajectory
touches none of them), the model's motors and servos (the torque comes from outside), gravity
compensation and drag.

Joints outside the chain (fingers, a second arm, loose objects) get so much armature that nothing
moves them. None of them carries the chain, so the chain feels a rigid load and nothing else.

An arm that motors drive is stepped (``ArmStepper``) with Coulomb's law
tau_f = fc sign(qd) + fv qd, and implicit in damping and dry friction, so that stiff motor damping,
shorted windings and dry friction are stable with any step h: find v and the mean velocity with

    M (v - v_before) / h = torque - bias - (damping + fv) v_mean - f,
    f = fc sign(v), or |f| <= fc where v = 0,

by an L-stable method of second order; M and bias are those in the middle of the step, and positions
move by the mean velocity. So damping adds no apparent armature to the mean torque of a step.
(Implicit Euler, v in place of v_mean, adds h (damping + fv) / 2, a clear part of a small rotor.)

Its joints have stops at the ends of their ranges, which are rigid and give nothing back: a joint
that would pass one within a step comes to rest there, by whatever torque that takes, as if it stuck
with dry friction; the other joints feel the blow. The stop never pulls. (A spring that is stable
with such steps gives way visibly where a light wrist is pressed against it.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import analysis_copy, data_at_pose
from robot_sysid.errors import InputError, SimulationError
from robot_sysid.model.chain import joints_before
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, MotionPlan, Recording, RobotModel
from robot_sysid.records.option_fields import joint_values
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks
from robot_sysid.wording import option_name

HOLDING_ARMATURE = 1e9
"""Armature that holds a joint still under whatever torque [kg m^2 or kg]."""
TIMESTEP = 5e-4
"""Usual length of a step of ``ArmStepper`` [s]."""


def plant_measurements(
    plant: RobotModel,
    plan: MotionPlan,
    options: SimulatedArmOptions,
    sample_rate: float,
    rng: np.random.Generator,
) -> Iterator[Recording]:
    """Yield, in chunks, what the sensors of a plant read that follows a trajectory exactly.

    Its dry friction is Coulomb's.

    Args:
        plant: the arm that plays the real one, see ``load_plant``.
        plan: the trajectory.
        options: errors of the sensors.
        sample_rate: number of samples per second [Hz].
        rng: source of the sensor noise.

    Raises:
        InputError: options and arm do not have the same number of joints.
        SimulationError: the plant cannot be simulated.
    """
    sigma = joint_values(
        options.noise_torque, plant.n_joints, option_name("noise_torque")
    )
    step = options.encoder_resolution
    noise = np.random.default_rng(rng.integers(2**63, size=4))
    for exact in simulate_inverse(plant, motion_chunks(plan, sample_rate)):
        error = sigma * noise.standard_normal(exact.tau.shape)
        measured = replace(exact, tau=exact.tau + error)
        if step > 0.0:
            q = np.round(exact.q / step) * step
            measured = replace(measured, q=q, qd=None, qdd=None)
        yield measured


def load_plant(
    robot: RobotModel, plant_path: Path, mesh_dir: Path | None = None
) -> RobotModel:
    """Load the model that plays the real arm, matched to the arm to be identified.

    Args:
        robot: the arm to be identified.
        plant_path: MJCF or URDF file with the same joints; masses, friction, armature, fingers and
            everything else may differ.
        mesh_dir: folder of its meshes; default where the file says.

    Returns:
        The plant, held at its own reference configuration apart from the chain.

    Raises:
        InputError: the file cannot be used, or its joints are others than the robot's; says why.
    """
    first = int(robot.mj_model.dof_jntid[robot.dof_index[0]])
    is_carried = bool(joints_before(robot.mj_model, first))
    try:
        plant = load_robot_model(
            plant_path,
            mesh_dir,
            robot.terminal_joint,
            first_joint=robot.joint_names[0] if is_carried else None,
        )
    except InputError as error:
        # Options are about the model: none of them remedies the plant.
        raise InputError(f"the plant {plant_path.name}: {error}") from None
    if plant.lacks_masses:
        raise InputError(
            f"the plant {plant_path.name}: it states no masses, or one number for all links, and "
            "so plays no arm; state masses in kg"
        )
    joints, plant_joints = map(_joints_text, (robot, plant))
    if joints != plant_joints:
        raise InputError(
            f"the plant {plant.path.name} does not have the joints of {robot.path.name}: "
            f"{plant_joints} instead of {joints}. Give a model of the same arm with the same joint "
            "names"
        )
    return plant


def _joints_text(robot: RobotModel) -> str:
    """Return the names of the chain's joints, in order, with a word for slides."""
    return ", ".join(
        f"{name} (slide)" if is_slide else name
        for name, is_slide in zip(robot.joint_names, robot.is_slide)
    )


def forward_model(robot: RobotModel) -> Any:
    """Return a copy of an arm's compiled MuJoCo model in which only the chain moves.

    Contacts, joint stops, equalities, gravity compensation and drag are switched off, actuators
    have no effect but those that act whatever their control is, and joints have no damping; joints
    outside the chain get an armature that holds them still. The copy may be changed.
    """
    # A rollout that diverges must not go on from the start; a chain has no islands to be found.
    disabled = ("CONTACT", "SENSOR", "EQUALITY", "LIMIT", "AUTORESET", "ISLAND")
    model = analysis_copy(robot.mj_model, disabled)
    model.opt.solver = int(mujoco.mjtSolver.mjSOL_NEWTON)
    model.opt.iterations = 100
    # With less, a joint that its friction holds creeps.
    model.opt.tolerance = 1e-14
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    held_dofs = np.setdiff1d(np.arange(model.nv), robot.dof_index)
    model.dof_armature[held_dofs] = HOLDING_ARMATURE
    model.dof_frictionloss[held_dofs] = 0.0
    if not model.ntendon:
        # Nothing needs the pose of a geom: MuJoCo then takes it from its body.
        model.geom_sameframe[:] = 1
    model.actuator_ctrllimited[:] = 0
    if hasattr(model, "actuator_delay"):
        # In releases with delayed actuators; the commands of a rollout are delayed already.
        model.actuator_delay[:] = 0.0
    return model


def set_chain_state(
    robot: RobotModel, model: Any, data: Any, q: Array, qd: Array
) -> None:
    """Reset MuJoCo's ``data`` and put the chain at positions q (n,) with velocities qd (n,).

    All other joints go to the arm's reference configuration, with zero velocity.
    """
    mujoco.mj_resetData(model, data)
    data.qpos[:] = robot.reference_qpos
    data.qpos[robot.qpos_index] = q
    data.qvel[robot.dof_index] = qd


class ArmStepper:
    """Steps the chain of an arm under joint torques, with Coulomb friction and motor damping.

    Each direction of friction is one joint, or a motor that turns several joints at once.

    Args:
        robot: the arm; its compiled model is copied and stays as it is.
        q: (n,) positions at the start [rad or m], where the arm is at rest.
        timestep: length of a step [s].

    Attributes:
        n_joints: number n of joints.
        timestep: as given.
        q: (n,) positions after the last step [rad or m].
        qd: (n,) velocities after the last step [rad/s or m/s].
        viscous: (n,) viscous friction of the joints [N m s/rad]; it may be changed between steps.
        coulomb: (k,) levels of Coulomb friction [N m], of the n joints and then of motors that turn
            several joints; they may be changed between steps.
    """

    def __init__(self, robot: RobotModel, q: Array, timestep: float = TIMESTEP) -> None:
        self._robot = robot
        self.n_joints = robot.n_joints
        self.timestep = timestep
        # Damping and dry friction are stepped here, not by MuJoCo: nothing here calls its
        # constraint solver, in which its frictionloss would act.
        self._model = forward_model(robot)
        self._has_passive_actuators = bool(np.any(self._model.actuator_gear))
        self._data = data_at_pose(self._model, robot.reference_qpos)
        self.viscous = robot.friction.viscous
        # Friction torque (motors, n) of motors that turn several joints; no rows where none does.
        shared = robot.friction.shared
        levels = np.max(np.abs(shared), axis=1)
        # Each level acts along one direction in joint velocities, a row of (k, n).
        self.coulomb = np.concatenate((robot.friction.coulomb, levels))
        self._friction_axes = np.vstack(
            (np.eye(robot.n_joints), shared / levels[:, None])
        )
        self.q: Array = np.array(q, dtype=float)
        # Positions of the joint stops; an arm that begins beyond its range has them there.
        self._stops = robot.limits.with_positions(self.q)
        self.qd: Array = np.zeros(robot.n_joints)
        # Change of velocity in the last step.
        self._last_change: Array = np.zeros(robot.n_joints)
        # A unit torque on each joint (n, nv), and room for the accelerations that these make.
        self._unit_torques = np.eye(self._model.nv)[robot.dof_index]
        self._accelerations = np.empty_like(self._unit_torques)

    @property
    def robot(self) -> RobotModel:
        """The arm, as given."""
        return self._robot

    @property
    def model(self) -> Any:
        """The copy of the arm's compiled model that is stepped; it may be changed between steps."""
        return self._model

    @property
    def data(self) -> Any:
        """MuJoCo's data of that copy, at the last step."""
        return self._data

    def step(
        self, torque: Array, damping: Array, duration: float | None = None
    ) -> Array:
        """Advance by one step under the motor torque ``torque - damping qd``.

        ``q`` and ``qd`` are replaced. Returned is the mean motor torque (n,) in the step [N m].

        Args:
            torque: (n,) constant part of the motor torque [N m].
            damping: (n,) damping by the motors [N m s/rad].
            duration: length of this step [s]; ``timestep`` if not given.

        Raises:
            SimulationError: the state is not finite any more.
        """
        h = self.timestep if duration is None else duration
        # Half of the last change of velocity stands for that up to the middle of this step.
        middle_q = self.q + 0.5 * h * self.qd
        middle_qd = self.qd + 0.5 * self._last_change
        mobility, bias = self._dynamics(middle_q, middle_qd)
        resistance = damping + self.viscous
        end_response, mean_response = _velocity_responses(h * mobility, resistance)

        load = torque - bias - resistance * self.qd
        free_velocity = self.qd + end_response.dot(load)
        free_q = self.q + h * free_velocity
        # Direction of the torque of a stop that a joint would pass without dry friction.
        inwards = (free_q < self._stops.lower) - 1.0 * (free_q > self._stops.upper)
        velocity, friction = self._resolve_dry_friction(
            free_velocity, end_response, inwards
        )
        mean_velocity = self.qd + mean_response.dot(load - friction)
        # A joint that comes to rest loses its velocity evenly.
        mean_velocity = np.where(velocity == 0.0, 0.5 * self.qd, mean_velocity)

        self._last_change = velocity - self.qd
        self.q = self.q + h * mean_velocity
        self.qd = velocity
        if np.count_nonzero(inwards):
            # A blow says nothing of the next step.
            self._last_change = np.zeros(self.n_joints)
            self.q = np.clip(self.q, self._stops.lower, self._stops.upper)
        # What is not finite stays so in a sum.
        if not math.isfinite(self.q.dot(self.q)):
            raise SimulationError(
                "the simulated arm diverged; lower the gains or the torques"
            )
        return torque - damping * mean_velocity

    def mobility(self) -> Array:
        """Return the present inverse mass matrix (n, n) [1 / (kg m^2)]."""
        return self._dynamics(self.q, self.qd)[0]

    def _dynamics(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return the inverse mass matrix (n, n) and the bias torque (n,) of the chain.

        The bias is gravity, Coriolis and centrifugal torque minus that of springs and of actuators
        that act by themselves [N m]. MuJoCo's data is left at positions q (n,) and velocities
        qd (n,).
        """
        model = self._model
        data = self._data
        dofs = self._robot.dof_index
        data.qpos[self._robot.qpos_index] = q
        data.qvel[dofs] = qd
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_solveM(model, data, self._accelerations, self._unit_torques)
        bias = data.qfrc_bias[dofs] - data.qfrc_passive[dofs]
        if self._has_passive_actuators:
            mujoco.mj_fwdActuation(model, data)
            bias -= data.qfrc_actuator[dofs]
        return self._accelerations.take(dofs, axis=1), bias

    def _resolve_dry_friction(
        self, free_velocity: Array, response: Array, inwards: Array
    ) -> tuple[Array, Array]:
        """Return joint velocities (n,) and dry friction torques (n,) at the end of a step.

        A direction of friction that moves slides that way; if friction would turn it round within
        the step it sticks, and so does one at rest, until holding it needs more than its Coulomb
        level. A joint that would pass its stop sticks, until holding it needs a pull.

        Args:
            free_velocity: (n,) joint velocities at the end of the step without dry friction.
            response: (n, n) change of these velocities per constant joint torque; friction torques
                act with the opposite sign.
            inwards: (n,) sign of the torque of each joint's stop; 0 where none acts.
        """
        axes = self._friction_axes
        coulomb = self.coulomb
        stop = np.zeros(len(coulomb))
        stop[: self.n_joints] = inwards
        is_at_stop = stop != 0.0
        can_stick = is_at_stop | (coulomb > 0.0)
        joint_response = response.dot(axes.T)
        axis_response = axes.dot(joint_response)
        free_speed = axes.dot(free_velocity)
        # Sign of the motion along each direction, in which friction takes energy.
        direction = np.sign(axes.dot(self.qd))
        sticks = is_at_stop | (can_stick & (direction == 0.0))
        most_held = coulomb * (1.0 + 1e-9)
        none = np.zeros_like(sticks)
        # Directions stick or slide until the friction of all of them agrees with their motion; the
        # number of rounds is limited in case they never do.
        for _ in range(2 * len(coulomb) + 1):
            friction = np.where(sticks, 0.0, coulomb * direction)
            speed = free_speed - axis_response.dot(friction)
            breaks_loose = none
            if np.count_nonzero(sticks):
                held = axis_response[:, sticks]
                holding = self._hold(held[sticks], speed[sticks])
                friction[sticks] = holding
                speed -= held.dot(holding)
                # One that sticks has no speed that could be reversed.
                speed[sticks] = 0.0
                breaks_loose = sticks & (np.abs(friction) > most_held)
                # Friction has the opposite sign, so that the stop pushes.
                breaks_loose &= stop * friction >= 0.0
            changes = breaks_loose | (can_stick & (speed * direction < 0.0))
            if not np.count_nonzero(changes):
                break
            direction = np.where(breaks_loose, np.sign(friction), direction)
            sticks = sticks ^ changes
        joint_velocity = free_velocity - joint_response.dot(friction)
        joint_sticks = sticks[: self.n_joints]
        return np.where(joint_sticks, 0.0, joint_velocity), friction.dot(axes)

    def _hold(self, response: Array, speed: Array) -> Array:
        """Return the friction (s,) that stops s directions with a ``speed`` (s,).

        ``response`` (s, s) is how much slower their friction makes them.
        """
        friction = np.empty_like(speed)
        if len(self.coulomb) == self.n_joints:
            friction[:] = np.linalg.solve(response, speed)
        else:
            # Singular where a motor and all joints that it turns stick together.
            friction[:] = np.linalg.lstsq(response, speed, rcond=None)[0]
        return friction


# Implicit share of each stage that makes the two-stage method below of second order, L-stable.
_STAGE = 1.0 - math.sqrt(0.5)


@cache
def _identity(n: int) -> Array:
    """Return the unit matrix (n, n), made once: steps are many."""
    return np.eye(n)


def _velocity_responses(undamped: Array, resistance: Array) -> tuple[Array, Array]:
    """Return how a constant torque changes velocities in a damped step.

    Args:
        undamped: (n, n) change of the velocities by an undamped step: the inverse mass matrix times
            the length of the step [rad/s per N m].
        resistance: (n,) damping of the joints [N m s/rad].

    Returns:
        Two matrices (n, n) [rad/s per N m]: the change of the velocities at the end of the step,
        and of their mean over the step.
    """
    implicit = _identity(len(resistance)) + undamped * (_STAGE * resistance)
    stage = np.linalg.solve(implicit, undamped)
    # The second stage is stage - _STAGE damped, and both responses are sums of the two stages.
    damped = (stage * resistance).dot(stage)
    end_response = stage - _STAGE * (1.0 - _STAGE) * damped
    mean_response = 0.5 * stage - _STAGE * (0.5 - _STAGE) * damped
    return end_response, mean_response

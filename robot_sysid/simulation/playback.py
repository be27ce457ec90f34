"""Rollouts: servo commands in, motion out; windows of a log played by a model.

The model is the file's own: links, rotor inertia, springs, damping and MuJoCo's ``frictionloss`` as
written. As in ``plant`` joints outside the chain are held; contacts, stops, equalities and gravity
compensation do not act. The integrator is MuJoCo's implicit one without derivatives of forces
between bodies, stable under any damping, used as a leapfrog (Störmer–Verlet): velocities are those
half a step before the positions, which makes it second order, without a delay of its own, but while
a servo is at its limit. ``mujoco.rollout`` does the steps on all processors where the installed
release has it with several models at a time; older ones step in Python.

Played are the commands of an arm behind position servos, whose torque is

    tau = clip(Kp (command(t - delay) - q) - kv qd, +-limit) - (D - kv) qd - friction.

D is the damping of joint and servo together. The servo's part kv shows in the motion only while the
servo is at its limit. A command holds until the next one comes. A joint whose actuator the model
does not have, or that has dynamics of its own, is pulled by a spring, and has no limit.

Shapes: n joints of the chain, base to terminal; W windows at a time; S steps in each.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from robot_sysid.model.actuators import (
    actuators_on,
    control_rows,
    gear_ratio,
    is_static,
    output_ranges,
    output_rows,
    servo_gains,
)
from robot_sysid.model.compilation import captured_warnings
from robot_sysid.records import Array, RobotModel
from robot_sysid.simulation.plant import forward_model, set_chain_state

STEP = 0.001
"""Time step of the rollouts [s]."""
MAX_WINDOWS = 60
"""Number of windows of one horizon that are played, spread evenly over the pieces of the logs."""
DIVERGED = 1e6
"""Position of a joint, that of a rollout that diverges [rad or m]."""
NO_ACTUATOR = -1
"""Value in place of a MuJoCo actuator id for a joint without an actuator that a rollout can use."""
# MuJoCo's bits for the state from which a rollout starts.
_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
# MuJoCo's bits for the inputs of each step: those of actuators, then forces on the joints.
_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


def interpolate(at: Array | float, time: Array, values: Array) -> Array:
    """Return columns of values, interpolated linearly at new times; outside, the nearest ones.

    Args:
        at: new times (K,), or one time.
        time: (N,) ascending times of the samples.
        values: (N, n) one column per quantity.

    Returns:
        (K, n), or (n,) for one time.
    """
    columns = [np.interp(at, time, column) for column in values.T]
    return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class ServoParameters:
    """Numbers of an arm behind position servos: of its servos and of the joints that they drive.

    Attributes:
        numbers: (4, n) of each joint its gain Kp [N m/rad], its damping D, of joint and servo
            together [N m s/rad], its dry friction [N m] and its rotor inertia [kg m^2].
        delay: time by which all commands act late [s].
        limits: (n,) largest torque of the servos, infinite where there is no limit [N m].
        servo_damping: (n,) part kv of the damping that the servo gives, within its limit
            [N m s/rad].
        firmness: (n,) how firmly dry friction holds a joint, MuJoCo's impedance of it between 0
            and 1: what is missing lets the joint creep.
    """

    numbers: Array
    delay: float
    limits: Array
    servo_damping: Array
    firmness: Array


@dataclass(frozen=True)
class ChainActuators:
    """The model's actuator on each chain joint, reduced to the joint by its gear ratio.

    Attributes:
        index: (n,) MuJoCo ids; ``NO_ACTUATOR`` where there is none that a rollout can use.
        gear: (n,) gear ratios.
        stiffness: (n,) Kp of position actuators [N m/rad]; NaN for others.
        damping: (n,) D of the joints, that of position actuators included [N m s/rad].
        limit: (n,) largest torque, infinite where the model has no limit [N m].
        damping_share: (n,) kv/D, the servo's share of the joint's damping, between 0 and 1.
    """

    index: NDArray[np.int64]
    gear: Array
    stiffness: Array
    damping: Array
    limit: Array
    damping_share: Array


def chain_actuators(robot: RobotModel) -> ChainActuators:
    """Return each chain joint's actuator: the first position actuator on it, or else the first."""
    joints = robot.mj_model.dof_jntid[robot.dof_index].tolist()
    rows = [_joint_actuator(robot.mj_model, joint) for joint in joints]
    index, gear, stiffness, kv = map(np.array, zip(*rows))
    # An index of -1, which stands for no actuator, finds the last value.
    largest = np.max(np.abs(output_ranges(robot.mj_model)), axis=1)
    limit = np.minimum(np.append(largest, np.inf)[index], robot.limits.torque)
    damping = kv + robot.friction.viscous
    share = kv / np.maximum(damping, 1e-300)
    return ChainActuators(index, gear, stiffness, damping, limit, share)


def _joint_actuator(model: Any, joint: int) -> tuple[int, float, float, float]:
    """Return (id, gear, Kp, kv) of the actuator that drives a joint.

    They are as in ``ChainActuators``, kv that of a position actuator; zero for others. Without a
    usable actuator, the gear is 1.

    Args:
        model: compiled MuJoCo model.
        joint: MuJoCo joint id.
    """
    # Behind whether they are position actuators, which come first.
    usable = [(2, NO_ACTUATOR, 1.0, np.nan, 0.0)]
    for actuator in actuators_on(model, joint):
        gear = gear_ratio(model, actuator)
        gains = servo_gains(model, actuator)
        kp, kv = gains or (np.nan, 0.0)
        has_control = len(control_rows(model, actuator)) == 1
        is_plain = has_control and is_static(model, actuator)
        if gear != 0.0 and (gains or is_plain):
            squared = gear**2
            usable.append((gains is None, actuator, gear, squared * kp, squared * kv))
    return min(usable)[1:]


def servos_in_model(robot: RobotModel) -> ServoParameters:
    """Return the servo parameters that the model has: no delay, NaN gains without a servo.

    The damping is that of joint and servo together.
    """
    actuators = chain_actuators(robot)
    resistances = actuators.damping, robot.friction.coulomb, robot.armature
    numbers = np.stack((actuators.stiffness, *resistances))
    kv = actuators.damping_share * actuators.damping
    firmness = robot.mj_model.dof_solimp[robot.dof_index, 0]
    return ServoParameters(numbers, 0.0, actuators.limit, kv, firmness)


@dataclass(frozen=True)
class ServoWindow:
    """Start of a rollout behind servos, and the commands that drive it.

    Attributes:
        start: time at which the rollout begins [s], on the log's clock.
        q: (n,) positions at the start [rad or m].
        qd: (n,) velocities at the start [rad/s or m/s].
        time: (N,) when each command of the log was given [s].
        command: (N, n) commanded positions [rad or m].
    """

    start: float
    q: Array
    qd: Array
    time: Array
    command: Array


def early_by(robot: RobotModel) -> float:
    """Return the time by which MuJoCo, in the steps of the file, acts on a command too early [s].

    Its steps move positions by the velocity at their end: what is commanded at the beginning of a
    step acts as if it came half a step before. Runge-Kutta steps do not.
    """
    options = robot.mj_model.opt
    if options.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        return 0.0
    return 0.5 * float(options.timestep)


def mean_commands(time: Array, command: Array, edges: Array) -> Array:
    """Return the mean commanded position (S, n) between S + 1 times.

    Args:
        time: (N,) when each command was given [s].
        command: (N, n) commanded positions [rad or m].
        edges: (S + 1,) the times [s].
    """
    # A mean command is the difference of the commands' integral over time at the step's ends. The
    # integral is piecewise linear: the last command is taken to hold for 1 s, and the first one to
    # have held at all times before it.
    knots = np.append(time, time[-1] + 1.0)
    steps = command * np.diff(knots)[:, None]
    integral = np.cumsum(np.vstack((0.0 * command[:1], steps)), axis=0)
    values = interpolate(edges, knots, integral)
    values += np.minimum(edges - time[0], 0.0)[:, None] * command[0]
    return np.diff(values, axis=0) / np.diff(edges)[:, None]


class ServoRollouts:
    """Rollouts of an arm behind servos, on one copy of its model, which meshes make large.

    They run on all processors where MuJoCo can play rollouts of several models at a time.

    Args:
        robot: the arm as in the model file.

    Attributes:
        robot: as given.
        model: the copy, see ``forward_model``.
        actuators: those of the chain.
    """

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot
        self.model = forward_model(robot)
        self._pool: Any = None
        threads = 1
        # Older releases play one rollout at a time.
        if hasattr(rollout, "Rollout"):
            threads = os.cpu_count() or 1
            # Zero stands for the calling thread.
            self._pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self.actuators = chain_actuators(robot)

    def play(self, starts: ArrayLike, inputs: Array) -> Array:
        """Return chain positions (W, S + 1, n) in W windows, the start included.

        Positions are NaN from where a rollout diverged.

        Args:
            starts: (W, 2, n) positions, and velocities half a step before [rad, rad/s].
            inputs: (W, S, nu + nv) inputs of the model in each step.
        """
        model = self.model
        data = self._data[0]
        first = np.empty((len(inputs), mujoco.mj_stateSize(model, _STATE)))
        for state, (q, qd) in zip(first, np.asarray(starts)):
            set_chain_state(self.robot, model, data, q, qd)
            mujoco.mj_getState(model, data, state, _STATE)
        with captured_warnings():
            states = self._run(first, inputs)
        # A state is the time, then the positions, then more.
        states = np.concatenate((first[:, None], states), axis=1)
        q = states[:, :, 1 + self.robot.qpos_index]
        # Its clock stands still, or starts again, where a rollout diverges.
        timestep = model.opt.timestep
        late = timestep * np.arange(q.shape[1]) - states[:, :, 0]
        is_well = np.all(np.abs(q) < DIVERGED, axis=2) & (late < 0.5 * timestep)
        q[~np.logical_and.accumulate(is_well, axis=1)] = np.nan
        return q

    def _run(self, starts: Array, inputs: Array) -> Array:
        """Return the states (W, S, s) after each step from starts (W, s).

        Args:
            starts: MuJoCo's states.
            inputs: (W, S, nu + nv) inputs of the model in each step.
        """
        if self._pool is None:
            return self._run_stepwise(starts, inputs)
        models = [self.model] * len(starts)
        states, _ = self._pool.rollout(
            models, self._data, starts, inputs, control_spec=_INPUTS
        )
        return states

    def _inputs(self, command: Array, gain: Array) -> Array:
        """Return the model's inputs (W, S, nu + nv): controls, then forces on the joints.

        Args:
            command: (W, S, n) commanded positions.
            gain: (n,) of the servos; springs stand for those that the model does not have.
        """
        robot = self.robot
        index = self.actuators.index
        driven = index != NO_ACTUATOR
        rows = [control_rows(self.model, actuator)[0] for actuator in index[driven]]
        inputs = np.zeros((*command.shape[:2], self.model.nu + self.model.nv))
        inputs[:, :, rows] = command[:, :, driven]
        spring_rest = robot.mj_model.qpos_spring[robot.qpos_index]
        spring = gain * ~driven * (command - spring_rest)
        inputs[:, :, self.model.nu + robot.dof_index] = spring
        return inputs

    def _run_stepwise(self, starts: Array, inputs: Array) -> Array:
        """Return the states (W, S, s) after each step, from starts (W, s), one after the other.

        This is for releases without ``mujoco.rollout``.
        """
        data = self._data[0]
        states = np.empty((*inputs.shape[:2], starts.shape[1]))
        for start, rows, played in zip(starts, inputs, states):
            mujoco.mj_resetData(self.model, data)
            mujoco.mj_setState(self.model, data, start, _STATE)
            for values, state in zip(rows, played):
                mujoco.mj_setState(self.model, data, values, _INPUTS)
                mujoco.mj_step(self.model, data)
                mujoco.mj_getState(self.model, data, state, _STATE)
        return states

    def positions(
        self, servos: ServoParameters, windows: Sequence[ServoWindow], edges: Array
    ) -> Array:
        """Return chain positions (W, S + 1, n) in W windows, the start included.

        Positions are NaN from where a rollout diverged.

        Args:
            servos: the servo parameters.
            windows: starts and commands of the W windows.
            edges: (S + 1,) ends of the steps of every window, from its start [s], evenly spaced.
        """
        self.model.opt.timestep = edges[1] - edges[0]
        self.set_servos(servos)
        commands = []
        for window in windows:
            # Between the velocities, which are half a step before the positions.
            times = window.start + edges - 0.5 * edges[1] - servos.delay
            commands.append(mean_commands(window.time, window.command, times))
        command = np.stack(commands)
        gain = servos.numbers[0]
        starts = [(window.q, window.qd) for window in windows]
        return self.play(starts, self._inputs(command, gain))

    def set_servos(self, servos: ServoParameters) -> None:
        """Write servo parameters into the model, over those of an earlier call.

        The delay is left out: it shifts the commands. A spring stands for a missing actuator's
        gain.
        """
        model = self.model
        dofs = self.robot.dof_index
        actuators = self.actuators
        stiffness, damping, frictionloss, armature = servos.numbers
        model.dof_armature[dofs] = armature
        model.dof_frictionloss[dofs] = frictionloss
        # Dry friction of a file stays as it is where it is as firm as the file's.
        in_file = self.robot.mj_model.dof_solimp[dofs, :2]
        is_other = servos.firmness != in_file[:, 0]
        firmness = servos.firmness[:, None]
        model.dof_solimp[dofs, :2] = np.where(is_other[:, None], firmness, in_file)
        kv = servos.servo_damping
        model.dof_damping[dofs] = damping - kv
        driven = actuators.index != NO_ACTUATOR
        ids = actuators.index[driven]
        # At the joint: Kp and kv are reduced by the gear ratio already.
        model.actuator_gear[output_rows(model)[ids], 0] = 1.0
        model.actuator_biastype[ids] = int(mujoco.mjtBias.mjBIAS_AFFINE)
        model.actuator_biasprm[ids, 0] = 0.0
        model.actuator_biasprm[ids, 1] = -stiffness[driven]
        model.actuator_biasprm[ids, 2] = -kv[driven]
        # A PID controller takes its gain from the bias.
        plain = ids[[len(control_rows(model, actuator)) == 1 for actuator in ids]]
        model.actuator_gaintype[plain] = int(mujoco.mjtGain.mjGAIN_FIXED)
        model.actuator_gainprm[plain, 0] = -model.actuator_biasprm[plain, 1]
        limit = servos.limits[driven]
        model.actuator_forcelimited[ids] = np.isfinite(limit)
        model.actuator_forcerange[ids] = np.column_stack((-limit, limit))
        springs = model.dof_jntid[dofs][~driven]
        own_stiffness = self.robot.mj_model.jnt_stiffness[springs]
        model.jnt_stiffness[springs] = own_stiffness + stiffness[~driven]
        # As in a compiled file, dry friction is as firm as these rotor inertias make it.
        mujoco.mj_setConst(model, mujoco.MjData(model))
        # An implicit step damps the velocity at its end. Half a step of damping less of rotor
        # inertia makes it the mean of those at both ends.
        less = 0.5 * model.opt.timestep * damping
        model.dof_armature[dofs] = np.maximum(armature - less, 0.0)

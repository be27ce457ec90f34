"""Arms that are not as their models say, stepped by MuJoCo, with friction that no file knows.

Nothing here is shared with the arm that the package simulates: the physics are MuJoCo's own step,
and what a joint's friction is stands below. Links are about 15 % off and one 40 %, rotors are off,
motors and encoders a little; a cable pulls at each joint; motors report position, velocity and
torque of different ages, with noise. Such an arm is sound: nothing of this may stop a run, or make
it say that something is wrong.

Dry friction of a joint is larger at rest and fades with the speed; it grows with the torque in the
gear; and it acts through a stiff spring that slips at its level, so that a joint which stands
neither creeps nor rings. Viscous friction is added to MuJoCo's damping, which is stepped
implicitly, and so is the damping of the motors' own loops.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from rigs.arms.wrong_arms import write_link, wrong_links
from rigs.motors.own_motors import ON, OwnBus
from robot_sysid import spatial

STEP = 1e-3
"""Length of a step of the physics [s]."""
FADING = 0.1
"""Speed with which the friction of rest fades [rad/s]."""
FADED = 10.0 * FADING
GIVE = 1e-3
"""How far the spring of dry friction gives way before it slips, unless drawn [rad]."""
LEAST_GIVE = 5e-4
MOST_GIVE = 5e-3
"""Between which it is drawn [rad]: gears bend by some thousandths before their friction turns."""
CABLE_SHARE = 0.1
"""Most torque of a cable a radian from where it is slack, over what the joint needs in a motion."""
MOST_AGE_CYCLES = 2.0
"""How old what a motor reports may be, in cycles of control."""
OLDEST = 8e-3
"""How old it is at most [s]: two cycles of 250 Hz. A motor that works ten thousand times a second
knows nothing of a computer that sends fifty."""
LONGEST_LAG = 4e-3
"""Longest time constant of the low-pass of reported velocities [s]."""
TORQUE_NOISE = 0.005
"""Most noise of a reported torque (standard deviation), over the motor's peak."""
VELOCITY_NOISE = 2.0
"""Most noise of a reported velocity (standard deviation), in steps in which it is reported."""
VELOCITY_STEPS = 4095.0
STIFFEST = 0.2 / STEP**2
"""Most of the spring's stiffness over the joint's inertia [1/s^2]: far from 4 per step squared,
where it would ring."""
DAMPED = 1.0
"""Damping of that spring over the critical one."""
HELD = 1e9
"""Rotor inertia of joints outside the chain [kg m^2]: nothing moves them."""
GAP_INERTIA = 0.01
"""Inertia of a motor that crosses its backlash [kg m^2]."""
REACH = 0.1
"""Distance of a carried mass from the terminal joint [m]."""
OFF_PARTS = ("CONTACT", "LIMIT", "EQUALITY", "FRICTIONLOSS", "ACTUATION", "SENSOR")
"""What MuJoCo leaves out: the chain touches nothing, and friction is this module's."""


@dataclass(frozen=True)
class JointFriction:
    """Friction of n joints.

    Attributes:
        dry: dry friction in motion [N m].
        at_rest: further dry friction, which fades with the speed [N m].
        load_share: further dry friction per torque of the motor.
        viscous: per speed [N m s/rad].
        give: how far the spring of dry friction gives way before it slips [rad].
    """

    dry: np.ndarray
    at_rest: np.ndarray
    load_share: np.ndarray
    viscous: np.ndarray
    give: float | np.ndarray = GIVE


def draw_friction(typical, rng):
    """Return friction of joints that need the torque ``typical`` (n,) in a motion [N m]."""
    n = len(typical)
    dry = typical * rng.uniform(0.02, 0.1, n)
    return JointFriction(
        dry=dry,
        at_rest=dry * rng.uniform(0.2, 0.6, n),
        load_share=rng.uniform(0.02, 0.06, n),
        viscous=typical * rng.uniform(0.0, 0.1, n),
    )


def model_friction(robot):
    """Return the friction that the model's file states for its chain."""
    model = robot.mj_model
    zero = np.zeros(robot.n_joints)
    return JointFriction(
        dry=model.dof_frictionloss[robot.dof_index].copy(),
        at_rest=zero,
        load_share=zero,
        viscous=model.dof_damping[robot.dof_index].copy(),
    )


class Plant:
    """The true arm: MuJoCo's forward dynamics of the chain, everything else held still.

    Args:
        robot: the arm as its model says.
        q: positions (n,) at the start, at rest [rad].
        friction: of its joints.
        links: true links (n, 10); None for those of the model.
        rotor_change: rotor inertia (n,) beside the model's [kg m^2].
        cable: stiffness (n,) of springs at the joints [N m/rad].
        slack: positions (n,) at which these are slack [rad].

    Attributes:
        time: of the state [s].
        q, qd: positions and velocities as lists of n.
        external: torque (n,) on the joints from outside [N m].
        brake: further dry friction (n,) [N m].
    """

    def __init__(
        self, robot, q, friction, links=None, rotor_change=0.0, cable=0.0, slack=0.0
    ):
        self.robot = robot
        model = copy.copy(robot.mj_model)
        self._model = model
        for name in OFF_PARTS:
            model.opt.disableflags |= int(
                getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
            )
        model.opt.timestep = STEP
        model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
        model.opt.density = 0.0
        model.opt.viscosity = 0.0
        model.body_gravcomp[:] = 0.0
        self._dofs = robot.dof_index
        outside = np.setdiff1d(np.arange(model.nv), self._dofs)
        model.dof_armature[outside] = HELD
        model.dof_armature[self._dofs] += rotor_change
        model.dof_damping[self._dofs] = 0.0
        if hasattr(model, "dof_dampingpoly"):
            model.dof_dampingpoly[:] = 0.0
        if robot.gravity is not None:
            model.opt.gravity[:] = robot.gravity
        self._links = [np.array(theta) for theta in robot.thetas]
        if links is not None:
            self._links = [np.array(theta) for theta in links]
            for number in range(robot.n_joints):
                self._write_link(number)
        self._set_constants()
        self._data = mujoco.MjData(model)
        self._data.qpos[:] = robot.reference_qpos
        self._data.qpos[robot.qpos_index] = q
        # Kinematics and mass matrix, for the springs of friction.
        mujoco.mj_forward(model, self._data)
        self.time = 0.0
        self._begin_friction(friction)
        self._read_state()
        n = robot.n_joints
        self.external = [0.0] * n
        self.brake = [0.0] * n
        self._cable = np.broadcast_to(cable, n).tolist()
        self._slack = np.broadcast_to(slack, n).tolist()

    def set_velocity(self, qd):
        """Let the joints move with velocities qd (n,) [rad/s]."""
        self._data.qvel[self._dofs] = qd
        self._read_state()

    def _begin_friction(self, friction):
        n = self.robot.n_joints
        unit = np.eye(self._model.nv)[self._dofs]
        moved = np.empty_like(unit)
        mujoco.mj_solveM(self._model, self._data, moved, unit)
        # What a joint has against its own spring while the others are free.
        inertia = 1.0 / np.diag(moved[:, self._dofs])
        rows = friction.dry, friction.at_rest, friction.load_share, friction.viscous
        give = np.broadcast_to(friction.give, n)
        self._friction = np.column_stack((*rows, give, inertia)).tolist()
        self._bend = [0.0] * n

    def _write_link(self, number):
        write_link(self._model, self.robot.links[number], self._links[number])

    def _set_constants(self):
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def carry(self, mass):
        """Add a point mass at the terminal link [kg]; a negative one drops it."""
        theta = self._links[-1]
        outwards = theta[1:4] / max(float(np.linalg.norm(theta[1:4])), 1e-9)
        theta += spatial.theta_from_com(mass, REACH * outwards, np.zeros((3, 3)))
        self._write_link(len(self._links) - 1)
        self._set_constants()

    def tilt(self, angle, axis=(1.0, 0.0, 0.0)):
        """Tilt the base by an angle [rad] about an axis, which turns gravity the other way."""
        quaternion = np.zeros(4)
        turned = np.zeros(3)
        mujoco.mju_axisAngle2Quat(quaternion, np.array(axis), -angle)
        mujoco.mju_rotVecQuat(turned, self._model.opt.gravity, quaternion)
        self._model.opt.gravity[:] = turned

    def step(self, torque, damping):
        """Advance by ``STEP`` under the motor torque ``torque - damping qd``, lists of n."""
        forces = []
        resistances = []
        bends = []
        for (
            torque_i,
            damping_i,
            position,
            speed,
            bend,
            external,
            brake,
            cable,
            slack,
            friction,
        ) in zip(
            torque,
            damping,
            self.q,
            self.qd,
            self._bend,
            self.external,
            self.brake,
            self._cable,
            self._slack,
            self._friction,
        ):
            dry, at_rest, load_share, viscous, give, inertia = friction
            force = torque_i + external - cable * (position - slack)
            resistance = damping_i + viscous
            level = dry + brake + load_share * abs(torque_i - damping_i * speed)
            # Beyond that nothing of the friction of rest is left.
            if -FADED < speed < FADED:
                level += at_rest * math.exp(-abs(speed) / FADING)
            if level > 0.0:
                stiffness = min(level / give, STIFFEST * inertia)
                bend += STEP * speed
                spring = stiffness * bend
                if -level < spring < level:
                    resistance += 2.0 * DAMPED * math.sqrt(stiffness * inertia)
                else:
                    spring = math.copysign(level, spring)
                    bend = spring / stiffness
                force -= spring
            forces.append(force)
            resistances.append(resistance)
            bends.append(bend)
        self._bend = bends
        self._data.qfrc_applied[self._dofs] = forces
        self._model.dof_damping[self._dofs] = resistances
        mujoco.mj_step(self._model, self._data)
        self.time += STEP
        self._read_state()

    def _read_state(self):
        self.q = self._data.qpos[self.robot.qpos_index].tolist()
        self.qd = self._data.qvel[self._dofs].tolist()

    def require_finite(self):
        """Raise where MuJoCo has given up."""
        assert not any(warning.number for warning in self._data.warning), "it diverged"


class Arm:
    """A plant whose joints motors drive; it is supported until one is enabled.

    Args:
        plant: the mechanics.
        motors: one per joint, base first.

    Attributes:
        path: positions of all joints after each step, of ``STEP`` each.
        off_at: when no motor was enabled any more [s]; infinite before.
        every_step: functions that are called with the time before each step.
    """

    def __init__(self, plant, motors):
        self.plant = plant
        self.motors = motors
        self.path = [plant.q]
        self.off_at = math.inf
        self.every_step = []
        self.was_enabled = False
        self._events = []

    def at(self, moment, action):
        """Call ``action(arm)`` at a moment [s]."""
        self._events.append((moment, action))
        self._events.sort(key=lambda event: event[0])

    def advance(self, until):
        """Move to the last whole step by ``until`` [s], and tell the motors where they are."""
        plant = self.plant
        while plant.time + STEP <= until + 1e-9:
            self._step()
        # Since the last whole step the joints have moved on.
        ahead = until - plant.time
        for motor, q, qd in zip(self.motors, plant.q, plant.qd):
            motor.link_position = q + ahead * qd
            motor.link_velocity = qd

    def _step(self):
        plant = self.plant
        time = plant.time
        while self._events and self._events[0][0] <= time:
            self._events.pop(0)[1](self)
        for function in self.every_step:
            function(time)
        is_driving = False
        torques = []
        dampings = []
        for motor, q, qd in zip(self.motors, plant.q, plant.qd):
            motor.link_position = q
            motor.link_velocity = qd
            torque = 0.0
            damping = motor.brake
            if motor.status == ON:
                is_driving = True
                motor.expire(time)
                torque, damping = _joint_torque(motor)
            elif time < motor.silent_until:
                # Its power stage is off.
                damping = 0.0
            torques.append(torque)
            dampings.append(damping)
            motor.remember(time, STEP)
            if motor.drift_rate:
                motor.encoder_shift += STEP * motor.drift_rate
        if is_driving:
            self.was_enabled = True
        elif self.was_enabled:
            self.off_at = min(self.off_at, time)
        if self.was_enabled:
            plant.step(torques, dampings)
        else:
            plant.time += STEP
        self.path.append(plant.q)


def _joint_torque(motor):
    """Return constant part and damping of the torque of an enabled motor on its joint."""
    asked = motor.asked_torque()
    if motor.gap > 0.0 and _crosses_gap(motor, asked):
        return 0.0, 0.0
    share = motor.torque_share
    if abs(asked) >= motor.peak_torque:
        return share * asked, 0.0
    # The damping of the law acts on the velocity within the step, too.
    damping = share * motor.gains()[1] * motor.encoder_scale
    return share * asked + damping * motor.link_velocity, damping


def _crosses_gap(motor, asked):
    """Move a motor in its backlash by a step; return whether it still touches neither side."""
    kd = motor.gains()[1]
    half = 0.5 * motor.gap
    speed = motor.gap_velocity + STEP * asked / (GAP_INERTIA + STEP * kd)
    position = motor.gap_position + STEP * speed
    if abs(position) < half:
        motor.gap_velocity = speed
        motor.gap_position = position
        return True
    motor.gap_velocity = 0.0
    motor.gap_position = math.copysign(half, position)
    return False


def drawn_links(robot, seed):
    """Return the true links (n, 10) of the arm of a seed."""
    return wrong_links(robot, np.random.default_rng([seed, 1]))


def sound_plant(robot, q, typical, seed):
    """Return a plant that is as far from its model as real arms are, drawn with a seed."""
    rng = np.random.default_rng([seed, 4])
    n = robot.n_joints
    armature = robot.mj_model.dof_armature[robot.dof_index]
    rotor_change = armature * rng.uniform(-0.3, 0.3, n) + rng.uniform(0.002, 0.02, n)
    friction = draw_friction(typical, rng)
    give = np.exp(rng.uniform(math.log(LEAST_GIVE), math.log(MOST_GIVE), n))
    return Plant(
        robot,
        q,
        replace(friction, give=give),
        drawn_links(robot, seed),
        rotor_change,
        cable=typical * rng.uniform(0.0, CABLE_SHARE, n),
        slack=q + rng.uniform(-1.0, 1.0, n),
    )


def make_sound(motors, seed, period):
    """Let motors and encoders be a little off, as they are, with commands every ``period`` [s]."""
    rng = np.random.default_rng([seed, 2])
    for motor in motors:
        motor.torque_share = 1.0 + 0.03 * rng.standard_normal()
        motor.torque_reading = 1.0 + 0.02 * rng.standard_normal()
        motor.encoder_shift = 2e-3 * rng.standard_normal()
    rng = np.random.default_rng([seed, 5])
    kinds = {}
    for motor in motors:
        kind = motor.limits
        if kind not in kinds:
            kinds[kind] = _draw_ages(period, rng)
        for name, age in kinds[kind].items():
            setattr(motor, name, age)
        motor.torque_noise = rng.uniform(0.0, TORQUE_NOISE) * motor.peak_torque
        step = 2.0 * motor.limits[1] / VELOCITY_STEPS
        motor.velocity_noise = rng.uniform(0.0, VELOCITY_NOISE) * step
        motor.rng = np.random.default_rng([seed, 6, motor.can_id])


def _draw_ages(period, rng):
    """Return how old what a kind of motor reports is [s], by attribute of ``OwnMotor``.

    A third of the motors report all of the same moment but torque of the step of physics before.
    """
    oldest = min(MOST_AGE_CYCLES * period, OLDEST)
    drawn = {
        "torque_age": rng.uniform(0.0, oldest),
        "velocity_age": rng.uniform(0.0, oldest),
        "position_age": rng.uniform(0.0, oldest),
        "velocity_lag": rng.uniform(0.0, LONGEST_LAG),
    }
    return {"torque_age": STEP} if rng.random() < 1.0 / 3.0 else drawn


def bus_of(arm, fd, disturbance=None):
    """Return the bus on which an arm's motors listen."""
    return OwnBus(arm.motors, arm.advance, fd, disturbance=disturbance)

"""A simulated arm behind position servos, with its own stepping and friction.

It shares no code with what is fitted to its logs, or with the rollouts that are tested on them.

    M qdd + bias = clip(stiffness beyond(c - q, dead zone), +-limit) - damping qd - friction
    friction = coulomb + load_share load + (stribeck + load_stribeck load) exp(-(qd / slip)^2)
    load = |motor + bias|
    lag dc/dt = command(t - delay) - c

with the motor's torque behind its limit and damping. Damping stands beside the limit, as back-EMF
does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.records import JointFriction
from robot_sysid.records.arm import RobotModel
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulation.playback import chain_actuators

TICK = 1e-3


@dataclass(frozen=True)
class ServoArm:
    """The true numbers of an arm behind servos.

    Attributes:
        robot: model of its links.
        stiffness, damping, coulomb, armature: (n,) of its servos and joints together.
        servo_damping: (n,) part of the damping that the servo gives within its limit; where it is
            zero, all damping stands beside the limit.
        delay: delay of the commands [s].
        limit: (n,) largest torque of the servos [N m].
        dead_zone: (n,) distance from the command within which a servo gives no torque [rad].
        stribeck: (n,) friction at rest beyond Coulomb's [N m].
        load_share: (n,) share of |motor + links' torque| that is friction.
        load_stribeck: (n,) what this share is more at rest.
        slip_speed: over which friction at rest fades [rad/s].
        lag: time constant with which a servo follows its commands [s].
    """

    robot: RobotModel
    stiffness: np.ndarray
    damping: np.ndarray
    servo_damping: np.ndarray
    coulomb: np.ndarray
    armature: np.ndarray
    delay: float
    limit: np.ndarray
    dead_zone: np.ndarray | float = 0.0
    stribeck: np.ndarray | float = 0.0
    load_share: np.ndarray | float = 0.0
    load_stribeck: np.ndarray | float = 0.0
    slip_speed: float = 0.1
    lag: float = 0.0

    def play(self, time, command):
        """Return positions (N, n) at times (N,) at which commands (N, n) are given, from rest."""
        n = len(self.coulomb)
        friction = JointFriction(self.coulomb, np.zeros(n), np.zeros((0, n)))
        model = self.robot.mj_model.__copy__()
        model.dof_armature[self.robot.dof_index] = self.armature
        arm = ArmStepper(
            replace(self.robot, mj_model=model, friction=friction),
            command[0].copy(),
            TICK / 2,
        )
        dofs = self.robot.dof_index
        # The bias at the start; later it is that of the last step.
        arm.mobility()
        positions = np.empty_like(command)
        ticks = np.round(time / TICK).astype(int)
        late = np.round((time + self.delay) / TICK).astype(int)
        follows = -np.expm1(-TICK / 2 / self.lag) if self.lag else 1.0
        at = -1
        target = command[0]
        led = target
        for tick in range(ticks[-1] + 1):
            sample = np.searchsorted(ticks, tick)
            if ticks[sample] == tick:
                positions[sample] = arm.q
            while at + 1 < len(late) and late[at + 1] <= tick:
                at += 1
                target = command[at]
            for _ in range(2):
                led = led + follows * (target - led)
                distance = led - arm.q
                play = np.clip(distance, -self.dead_zone, self.dead_zone)
                spring = self.stiffness * (distance - play)
                asks = spring - self.servo_damping * arm.qd
                free = np.abs(asks) <= self.limit
                torque = np.where(free, spring, np.clip(asks, -self.limit, self.limit))
                damping = self.damping - np.where(free, 0.0, self.servo_damping)
                load = np.abs(torque - damping * arm.qd + arm.data.qfrc_bias[dofs])
                fades = np.exp(-((arm.qd / self.slip_speed) ** 2))
                sticking = (self.stribeck + self.load_stribeck * load) * fades
                arm.coulomb = self.coulomb + sticking + self.load_share * load
                arm.step(torque, damping)
        return positions


def other_than(
    robot, rng, gain=(0.4, 0.8), friction=(1.5, 3.0), armature=(0.4, 0.8), delay=0.02
):
    """Return an arm whose servos and joints differ from those of its model."""
    n = robot.n_joints
    actuators = chain_actuators(robot)
    return ServoArm(
        robot=robot,
        stiffness=rng.uniform(*gain, n) * np.nan_to_num(actuators.stiffness, nan=50.0),
        damping=rng.uniform(*gain, n) * actuators.damping,
        servo_damping=np.zeros(n),
        coulomb=rng.uniform(*friction, n) * robot.friction.coulomb,
        armature=rng.uniform(*armature, n) * robot.armature,
        delay=delay,
        limit=actuators.limit,
    )


def commands(robot, rng, seconds=40.0, rate=50.0, amplitude=0.5):
    """Return time (N,) [s] and commands (N, n) [rad]: sines and steps within the joints' limits."""
    time = np.arange(round(seconds * rate)) / rate
    lower = np.maximum(robot.limits.lower, -1.5)
    upper = np.minimum(robot.limits.upper, 1.5)
    middle = 0.5 * (lower + upper)
    half = 0.5 * (upper - lower)
    command = np.zeros((len(time), robot.n_joints))
    for joint in range(robot.n_joints):
        for often in rng.uniform(0.1, 0.8, 4):
            size = 0.5 * amplitude * half[joint] * min(1.0, 0.25 / often)
            command[:, joint] += size * np.sin(
                2.0 * np.pi * (often * time + rng.uniform())
            )
        jumps = (rng.uniform(size=len(time)) < 1.0 / rate) * rng.uniform(
            -0.3, 0.3, len(time)
        )
        command[:, joint] += np.clip(np.cumsum(jumps), -0.3, 0.3) * half[joint]
    # Rollouts have no stops at the ends of a joint's range.
    command = np.clip(command, -0.8 * half, 0.8 * half)
    fade = np.clip(np.minimum(time, time[-1] - time) / 1.0, 0.0, 1.0)[:, None]
    return time, middle + fade * fade * (3.0 - 2.0 * fade) * command


def write_log(path, arm, time, command, step):
    """Play commands in steps of an encoder and write what LeRobot would: action and position."""
    sent = step * np.round(command / step)
    measured = step * np.round(arm.play(time, sent) / step)
    names = arm.robot.joint_names
    titles = ["time", *(f"{n}.pos" for n in names), *(f"action_{n}" for n in names)]
    rows = np.column_stack((time, measured, sent))
    np.savetxt(path, rows, "%.9g", ",", header=",".join(titles), comments="")

"""What may happen to motors, their bus, their arm, their set-up and the program that plays.

A cause is called with the simulated run that it happens to (``rigs.motors.damiao_rig.MotorRun``).
"""

from __future__ import annotations

import errno
import signal
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np

from rigs.motors.damiao_rig import delay_cause, fault, mit_command, motor
from robot_sysid.damiao import protocol
from robot_sysid.damiao.protocol import DISABLED, ENABLED, Register

JAMMED = 1e5
"""Damping of a joint that is jammed [N m s/rad]."""
UNDER_VOLTAGE = 0x9
_FOREIGN_PERIOD = 0.01
"""Time between two commands of another program [s]."""


# --- motors ---------------------------------------------------------------------------------------


def lost_motor(joint):
    """Return the fault of a motor without supply: it is silent, and its windings are open."""
    return fault(joint, silent=True, brake=0.0, torque_share=0.0)


def own_position(hit):
    """Return the position of a motor: where it freezes."""
    return hit.position


def fault_of_all(**values):
    """Return the cause of a fault of every motor."""
    return lambda run: [fault(j, **values)(run) for j in range(len(run.motors))]


@dataclass(frozen=True)
class SecondMotor:
    """Another motor with the same id comes alive, elsewhere by an angle [rad].

    It answers before the first one, or after it.
    """

    joint: int
    angle: float = 0.7
    status: int = ENABLED
    is_first: bool = True

    def __call__(self, run):
        twin = motor(run.motors[self.joint].joint)
        twin.status = self.status
        twin.position = run.motors[self.joint].position + self.angle
        # Its watchdog has heard something just now.
        twin.fed_at = run.clock.now()
        run.arm.motors.append(twin)
        if self.is_first:
            answers = run.arm.answers
            run.arm.answers = lambda *frame: answers(*frame)[::-1]


@dataclass(frozen=True)
class SaggingSupply:
    """The supply of all motors sags to 40 % within a second; after two, one reports it."""

    joint: int

    def __call__(self, run):
        for tenth in range(10):
            run.at(0.1 * tenth, partial(self._sag, run))
        delay_cause(2.0, fault(self.joint, status=UNDER_VOLTAGE))(run)

    def _sag(self, run):
        for weak in run.motors:
            weak.peak_torque *= 0.4**0.1


@dataclass(frozen=True)
class PowerDip:
    """The supply of a motor is away for 50 ms, after which the motor is disabled."""

    joint: int

    def __call__(self, run):
        fault(self.joint, silent=True, status=DISABLED)(run)
        delay_cause(0.05, fault(self.joint, silent=False))(run)


# --- the bus --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SecondMaster:
    """Another computer commands one motor to a place an angle [rad] away, 100 times a second."""

    joint: int
    is_seen: bool = True
    angle: float = 0.5

    def __call__(self, run):
        self._send(run, run.arm.mechanism.q[self.joint] + self.angle)

    def _send(self, run, target):
        joint = run.motors[self.joint].joint
        scaling = protocol.Scaling([joint.spec.limits])
        data = protocol.encode_mit(mit_command(target, kp=60.0), scaling)[0].tobytes()
        run.bus.send_foreign(protocol.CanFrame(joint.can_id, data), self.is_seen)
        run.at(_FOREIGN_PERIOD, partial(self._send, run, target))


def delay_answers(seconds):
    """Return the cause of answers that come late by a time [s]."""
    return lambda run: setattr(run.bus, "delay", lambda: seconds)


def slow_adapter(least, most):
    """Return the cause of answers that come late by a time between two [s]."""

    def cause(run):
        random = np.random.default_rng(0)
        run.bus.delay = lambda: random.uniform(least, most)

    return cause


def lose_answers(share):
    """Return the cause of answers of which a share is lost."""
    rng = np.random.default_rng(5)
    return lambda run: setattr(run.bus, "loses", lambda: rng.random() < share)


def switch_bus_off(seconds):
    """Return the cause of a bus that is off for a time [s]."""

    def cause(run):
        run.bus.is_off = True
        run.at(seconds, lambda: setattr(run.bus, "is_off", False))

    return cause


def break_driver(error, seconds):
    """Return the cause of an adapter's driver that raises an error of its own for a time [s]."""

    def cause(run):
        until = run.clock.now() + seconds
        send = run.bus.send
        receive = run.bus.receive

        def failing(call):
            def failing_call(*arguments):
                run.clock.sleep_until(run.clock.now() + 1e-4)
                if run.clock.now() < until:
                    raise error
                return call(*arguments)

            return failing_call

        run.bus.send = failing(send)
        run.bus.receive = failing(receive)

    return cause


# --- the arm and its set-up -----------------------------------------------------------------------


def grip_mass(run):
    """Let the terminal link take up 3 kg."""
    mechanism = run.arm.mechanism
    mechanism.model.body_mass[mechanism.robot.body_id] += 3.0
    mujoco.mj_setConst(mechanism.model, mujoco.MjData(mechanism.model))


def make_link_heavier(factor):
    """Return the cause of a terminal link that is heavier than the model's by a factor."""

    def cause(run):
        mechanism = run.arm.mechanism
        body = mechanism.robot.body_id
        mechanism.model.body_mass[body] *= factor
        mechanism.model.body_inertia[body] *= factor
        mujoco.mj_setConst(mechanism.model, mujoco.MjData(mechanism.model))

    return cause


def push(run):
    """Push the terminal link sideways, with 60 N for 0.3 s."""
    mechanism = run.arm.mechanism
    robot = mechanism.robot
    data = mechanism.data
    torque = np.zeros(mechanism.model.nv)
    force = np.array([0.0, 36.0, -48.0])
    tip = data.xipos[robot.body_id]
    mujoco.mj_applyFT(
        mechanism.model, data, force, np.zeros(3), tip, robot.body_id, torque
    )
    run.arm.push = torque[robot.dof_index]
    run.at(0.3, lambda: setattr(run.arm, "push", 0.0))


def exchange_ids(*joints):
    """Return the cause of two motors that have each other's ids."""

    def cause(run):
        first, second = (run.motors[j].registers for j in joints)
        for number in (Register.ESC_ID, Register.MST_ID):
            first[number], second[number] = second[number], first[number]

    return cause


def mount_otherwise(mountings):
    """Return the cause of motors that are mounted in another way than the map says, by joint."""

    return lambda run: [run.mount(j, **change) for j, change in mountings.items()]


def start_away(angle):
    """Return the cause of an arm that stands an angle [rad] away from its first point."""

    def cause(run):
        run.arm.mechanism.q = run.plan.trajectory.q[0] + angle
        run.during("playing", 0.0, begin)

    def begin(run):
        """The way there is another one: what counts begins here."""
        run.onset = run.clock.now()

    return cause


# --- the program ----------------------------------------------------------------------------------


def raise_error(error):
    """Return what raises an error, whatever it is called with."""

    def fail(*_):
        raise error

    return fail


def hang_up(run):
    """Close the terminal: printing fails from now on, and two signals come."""
    run.console = raise_error(OSError(errno.EIO, "Input/output error"))
    run.stop("stopped by SIGHUP")
    run.at(0.01, lambda: run.stop("stopped by SIGHUP"))


def insist_on_stop(run):
    """Press Ctrl-C, and again while the motors brake."""
    run.stop("stopped by SIGINT")
    run.at(0.02, lambda: run.stop("again", insist=True))


def raise_signal(name):
    """Return the cause of a signal that comes to the program."""
    return lambda run: signal.raise_signal(getattr(signal, name))


def close_terminal(run):
    """Let printing fail from now on."""
    run.terminal_is_closed = True


def stall(seconds):
    """Return the cause of a computer that is busy with something else for a time [s]."""
    return lambda run: run.clock.stall(seconds)


def fill_disk(run):
    """Let the disk take nothing more."""
    run.disk_is_full = True


def ask_for_too_much(run):
    """Let the trajectory that is played ask for a torque that the first motor does not make."""
    run.plan.trajectory.tau[:, 0] = 30.0

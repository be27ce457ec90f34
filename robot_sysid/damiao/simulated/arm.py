"""Simulated motors on a mechanism: torque law, time, and the frames they answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.damiao.protocol.frames import REGISTER_ID, Frame
from robot_sysid.damiao.protocol.joint_space import JointSpace
from robot_sysid.damiao.simulated.faults import Fault
from robot_sysid.damiao.simulated.motor import SimulatedMotor
from robot_sysid.errors import InputError
from robot_sysid.records import Array

if TYPE_CHECKING:
    from robot_sysid.simulation.stepper import ArmStepper

# Damping that holds a blocked joint [N m s/rad].
_JAM = 1e6


class SimulatedArm:
    """An arm whose joints are driven by simulated motors.

    Torque of an enabled motor: kp (p - q) + kd (v - qd) + t, limited to what it can deliver. A
    disabled motor brakes with its shorted windings, so a loaded arm sinks; but until a motor is
    enabled for the first time the arm rests on something.

    Args:
        mechanism: what they move.
        motors: one per joint, base to terminal; more than it has joints are on the bus but
            move nothing.
        faults: what goes wrong, and when.
    """

    def __init__(
        self, mechanism: ArmStepper, motors: Sequence[SimulatedMotor], faults: Sequence[Fault] = ()
    ) -> None:
        if any(not 0 <= fault.joint < len(motors) for fault in faults):
            raise InputError(f"faults name joints 0 to {len(motors) - 1}")
        self.mechanism, self.motors = mechanism, list(motors)
        self._space = JointSpace.of(self.motors[: mechanism.n_joints])
        self.time = 0.0
        self._by_low_id: dict[int, list[SimulatedMotor]] = {}
        for motor in self.motors:
            self._by_low_id.setdefault(motor.can_id & 0xFF, []).append(motor)
        self._enabled_at: float | None = None
        self._faults = sorted(faults, key=lambda fault: fault.after)
        self._changed = True
        self._apply_faults(0.0)

    def advance(self, until: float) -> None:
        """Let physics run up to ``until`` [s]."""
        if self._enabled_at is None:
            self.time = max(self.time, until)
        while self.time + self.mechanism.timestep <= until:
            self.time += self.mechanism.timestep
            self._watch()
            # The position half a step ahead stands for the whole step to second order.
            ahead = self.mechanism.q + 0.5 * self.mechanism.timestep * self.mechanism.qd
            torque, damping = self._law(ahead)
            self.mechanism.step(torque, np.where(self._jammed, _JAM, damping))

    def skip_to(self, time: float) -> None:
        """Set the clock without letting physics run: for a computer that fell behind."""
        self.time = max(self.time, time)

    def handle(self, frame: Frame, time: float) -> list[Frame]:
        """Let all motors take a frame at ``time`` [s]; return their answers."""
        self.advance(time)
        self._read_sensors()
        self._changed = True
        answers = []
        for motor in self._listeners(frame):
            answer = motor.handle(frame, time)
            if answer is not None:
                answers.append(answer)
                answers += self._overheard(answer, motor, time)
        if self._enabled_at is None and any(motor.driving for motor in self.motors):
            self._enabled_at = time
        return answers

    def _overheard(self, answer: Frame, sender: SimulatedMotor, time: float) -> list[Frame]:
        """Let the other motors see an answer: one whose id matches takes it for a command."""
        others = [m for m in self._listeners(answer) if m is not sender]
        answers = [motor.handle(answer, time) for motor in others]
        return [frame for frame in answers if frame is not None]

    def _listeners(self, frame: Frame) -> list[SimulatedMotor]:
        if frame.id == REGISTER_ID:
            return self.motors
        return self._by_low_id.get(frame.id & 0xFF, [])

    def _watch(self) -> None:
        for motor in self.motors:
            self._changed |= motor.tick(self.time)
        if self._faults and self._enabled_at is not None:
            self._apply_faults(self.time - self._enabled_at)

    def _apply_faults(self, elapsed: float) -> None:
        while self._faults and self._faults[0].after <= elapsed:
            fault = self._faults.pop(0)
            fault.apply(self.motors[fault.joint])
            self._changed = True

    def _gather(self) -> None:
        motors = self.motors[: self.mechanism.n_joints]
        table = np.array([(m.p, m.v, m.kp, m.kd, m.t, m.brake, m.peak_torque) for m in motors])
        driving = np.array([m.driving for m in motors])
        *told, brake, peak = table.T
        self._p, v, kp, kd, t = self._space.from_motors(MitCommand(*told))
        self._peak = peak * self._space.ratio
        self._kd = np.where(driving, kd, brake)
        self._offset = np.where(driving, kd * v + t, 0.0)
        self._kp = np.where(driving, kp, 0.0)
        self._limited = driving
        self._jammed = np.array([m.jammed for m in motors])
        self._changed = False

    def _law(self, q: Array) -> tuple[Array, Array]:
        """Return (torque, damping) of the motors at positions q (n,) and present velocities."""
        if self._changed:
            self._gather()
        torque = self._kp * (self._p - q) + self._offset
        total = torque - self._kd * self.mechanism.qd
        saturated = self._limited & (np.abs(total) > self._peak)
        limit = np.clip(total, -self._peak, self._peak)
        return np.where(saturated, limit, torque), np.where(saturated, 0.0, self._kd)

    def _read_sensors(self) -> None:
        q, qd = self.mechanism.q, self.mechanism.qd
        torque, damping = self._law(q)
        positions = self._space.motor_position(q)
        # The motor knows the current it drives, not what its shorted windings do.
        torques = self._space.motor_torque(torque - damping * qd)
        for j, motor in enumerate(self.motors[: self.mechanism.n_joints]):
            motor.position = float(positions[j])
            motor.velocity = float(motor.direction * qd[j])
            motor.torque = float(torques[j]) if motor.driving else 0.0

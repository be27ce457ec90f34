"""Simulated motors on a plant: torque law, time, and the frames they answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.damiao.faults import Fault
from robot_sysid.damiao.frames import Frame
from robot_sysid.damiao.plant_protocol import Plant
from robot_sysid.damiao.simulated_motor import SimulatedMotor
from robot_sysid.errors import InputError

# Damping that holds a blocked joint [N m s/rad].
_JAM = 1e6


class SimulatedArm:
    """An arm whose joints are driven by simulated motors.

    Torque of an enabled motor: kp (p - q) + kd (v - qd) + t, limited to what it can deliver. A
    disabled motor brakes with its shorted windings, so a loaded arm sinks.

    Args:
        plant: the mechanism.
        motors: one per joint, base to terminal; more than the plant has joints are on the bus but
            move nothing.
        faults: what goes wrong, and when.
    """

    def __init__(
        self, plant: Plant, motors: Sequence[SimulatedMotor], faults: Sequence[Fault] = ()
    ) -> None:
        if len(motors) < plant.n_joints:
            raise InputError(f"{plant.n_joints} joints need as many motors, got {len(motors)}")
        if any(not 0 <= fault.joint < len(motors) for fault in faults):
            raise InputError(f"faults name joints 0 to {len(motors) - 1}")
        self.plant, self.motors = plant, list(motors)
        self.time = 0.0
        self._enabled_at: float | None = None
        self._faults = sorted(faults, key=lambda fault: fault.after)
        self._changed = True
        self._apply_faults(0.0)
        self._read_sensors(np.zeros(plant.n_joints))

    def advance(self, until: float) -> None:
        """Let physics run up to ``until`` [s]."""
        while self.time + self.plant.timestep <= until:
            self.time += self.plant.timestep
            self._watch()
            if self._changed:
                self._gather()
            torque, damping = self._law()
            acted = self.plant.step(torque, np.where(self._jammed, _JAM, damping))
            self._read_sensors(np.where(self._jammed, torque, acted))

    def skip_to(self, time: float) -> None:
        """Set the clock without letting physics run: for a computer that fell behind."""
        self.time = max(self.time, time)

    def handle(self, frame: Frame, time: float) -> list[Frame]:
        """Let all motors take a frame at ``time`` [s]; return their answers."""
        self.advance(time)
        self._changed = True
        answers = []
        for motor in self.motors:
            answer = motor.handle(frame, time)
            if answer is not None:
                answers.append(answer)
                answers += self._overheard(answer, motor, time)
        if self._enabled_at is None and any(motor.driving for motor in self.motors):
            self._enabled_at = time
        return answers

    def _overheard(self, answer: Frame, sender: SimulatedMotor, time: float) -> list[Frame]:
        """Let the other motors see an answer: one whose id matches takes it for a command."""
        others = [m.handle(answer, time) for m in self.motors if m is not sender]
        return [frame for frame in others if frame is not None]

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
        motors = self.motors[: self.plant.n_joints]
        table = np.array([(m.p, m.v, m.kp, m.kd, m.t, m.brake, m.peak_torque) for m in motors])
        driving = np.array([m.driving for m in motors])
        self._p, self._v, self._kp, kd, t, brake, self._peak = table.T
        self._kd = np.where(driving, kd, brake)
        self._offset = np.where(driving, kd * self._v + t, 0.0)
        self._kp = np.where(driving, self._kp, 0.0)
        self._limited = driving
        self._jammed = np.array([m.jammed for m in motors])
        self._changed = False

    def _law(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (torque, damping) of this step."""
        torque = self._kp * (self._p - self.plant.q) + self._offset
        total = torque - self._kd * self.plant.qd
        saturated = self._limited & (np.abs(total) > self._peak)
        limit = np.clip(total, -self._peak, self._peak)
        return np.where(saturated, limit, torque), np.where(saturated, 0.0, self._kd)

    def _read_sensors(self, torque: np.ndarray) -> None:
        q, qd = self.plant.q, self.plant.qd
        for j, motor in enumerate(self.motors[: self.plant.n_joints]):
            motor.position, motor.velocity = float(q[j]), float(qd[j])
            # The motor knows the current it drives, not what its shorted windings do.
            motor.torque = float(torque[j]) if motor.driving else 0.0

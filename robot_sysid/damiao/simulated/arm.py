"""Simulated motors on a mechanism: torque law, time, their answers, and what goes wrong on demand.

A motor behaves as the real ones do where that matters: it only speaks when spoken to, matches the
low eight bits of an arbitration id, answers a command with the state before the command acted,
drops the fraction when it packs a value, leaves the enabled state on any fault and when commands
stay away for longer than its watchdog allows, and does not come back by itself.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.damiao.protocol import codec, frames
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.joints import DamiaoJoint, JointSpace
from robot_sysid.errors import InputError
from robot_sysid.records import Array

if TYPE_CHECKING:
    from robot_sysid.simulation.forward_dynamics import ArmStepper


DEFAULT_WATCHDOG = 0.1
_scaling = functools.cache(lambda limits: codec.Scaling([limits]))
_NOTHING = (0.0,) * 5


@dataclass
class SimulatedMotor:
    """State of one motor; registers are number to value, ``command`` holds p, v, kp, kd and t.

    Attributes:
        joint: what it is and how it is mounted.
        peak_torque: what it can deliver [N m].
        brake: damping of the shorted windings while it is disabled [N m s/rad].
        position, velocity, torque: what its sensors read, set by the arm.
        fed_at: when it last got a frame of its own [s].
        jammed: its joint is blocked.
        silent: it hears nothing and says nothing.
        lost_replies: it obeys but its answers do not arrive.
        velocity_factor, torque_factor: factors on the velocity and the torque it reports.
        slip: angle by which the position it reports is off [rad].
        stored: registers that it keeps when the power goes off.
    """

    joint: DamiaoJoint
    registers: dict[int, float]
    peak_torque: float
    brake: float
    status: int = reg.DISABLED
    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0
    temperature_mos: int = 31
    temperature_rotor: int = 29
    command: Sequence[float] = _NOTHING
    fed_at: float = 0.0
    jammed: bool = False
    silent: bool = False
    lost_replies: bool = False
    velocity_factor: float = 1.0
    torque_factor: float = 1.0
    slip: float = 0.0
    stored: dict[int, float] = field(default_factory=dict)

    @property
    def can_id(self) -> int:
        """Id it listens to."""
        return int(self.registers[reg.ESC_ID])

    @property
    def scaling(self) -> codec.Scaling:
        """How it reads and writes frames."""
        return _scaling(tuple(self.registers[number] for number in reg.SCALING))

    @property
    def driving(self) -> bool:
        """Whether it follows commands."""
        return self.status == reg.ENABLED

    def tick(self, time: float) -> bool:
        """Check the watchdog; return whether the motor has just stopped driving."""
        timeout = self.registers[reg.TIMEOUT] * reg.TIMEOUT_UNIT
        if self.driving and 0.0 < timeout < time - self.fed_at:
            self.fail(reg.LOST_COMMUNICATION)
            return True
        return False

    def fail(self, code: int) -> None:
        """Leave the enabled state with a fault."""
        self.status = code
        self.command = _NOTHING

    def handle(self, frame: frames.Frame, time: float) -> frames.Frame | None:
        """Take a frame from the bus and return the answer, if there is one."""
        if self.silent or len(frame.data) < 4 or frame.bus != self.joint.bus:
            return None
        if frame.id == frames.REGISTER_ID:
            data = self._register_answer(frame.data)
        elif frame.id & 0xFF == self.can_id & 0xFF and len(frame.data) == 8:
            data = self._command_answer(frame.data, time)
        else:
            return None
        if data is None or self.lost_replies:
            return None
        fd = self.registers[reg.CAN_BR] > reg.FD_BITRATE_CODES_ABOVE
        return frames.Frame(int(self.registers[reg.MST_ID]), data, fd=fd, bus=self.joint.bus)

    def _command_answer(self, data: bytes, time: float) -> bytes:
        self.fed_at = time
        if frames.is_special(data):
            self._special(data[7])
            return self._feedback()
        # The answer to a command is the state before it acts.
        answer = self._feedback()
        if self.driving and self.registers[reg.CTRL_MODE] == reg.MIT_MODE:
            told = codec.decode_mit(np.frombuffer(data, dtype=np.uint8)[None], self.scaling)
            self.command = [float(value[0]) for value in told]
        return answer

    def _special(self, code: int) -> None:
        if reg.is_fault(self.status) and code != frames.CLEAR_ERROR:
            return
        if code == frames.ENABLE:
            self.status = reg.ENABLED
        elif code == frames.SET_ZERO and not self.driving:
            self.slip -= self.position + self.slip
        elif code in (frames.DISABLE, frames.CLEAR_ERROR):
            self.status, self.command = reg.DISABLED, _NOTHING

    def _register_answer(self, data: bytes) -> bytes | None:
        if data[0] | data[1] << 8 != self.can_id:
            return None
        operation, number = data[2], data[3]
        if operation == frames.REFRESH:
            return self._feedback()
        if operation == frames.STORE and not self.driving:
            self.stored = dict(self.registers)
            return data
        if operation not in (frames.READ, frames.WRITE) or number not in self.registers:
            return None
        if operation == frames.WRITE and number in reg.WRITABLE:
            self.registers[number] = reg.value_from_bytes(number, data[4:8])
        return data[:4] + reg.bytes_from_value(number, self.registers[number])

    def _feedback(self) -> bytes:
        one = np.ones(1)
        state = codec.Feedback(
            np.array([self.can_id]),
            np.array([self.status]),
            one * (self.position + self.slip),
            one * self.velocity * self.velocity_factor,
            one * self.torque * self.torque_factor,
            np.array([self.temperature_mos]),
            np.array([self.temperature_rotor]),
        )
        return codec.encode_feedback(state, self.scaling)[0].tobytes()


def simulated_motor(joint: DamiaoJoint, watchdog: float = DEFAULT_WATCHDOG) -> SimulatedMotor:
    """Return a joint's motor as it leaves the factory, apart from ids and watchdog [s]."""
    peak, gear = joint.spec.strongest, joint.spec.gear_ratio or 1.0
    registers: dict[int, float] = {
        0: 15.0, 1: 0.0, 2: 100.0, 3: 0.8, 11: 1.96e-4, 12: 1.97e-5, 14: 5013.0, 16: 14.0,
        17: 0.84, 19: 5.16e-3, 29: 32.0, 30: 1.0, reg.CAN_BR: 4.0, reg.GR: gear,
        reg.MST_ID: float(joint.master_id), reg.ESC_ID: float(joint.can_id),
        reg.CTRL_MODE: float(reg.MIT_MODE),
        reg.TIMEOUT: float(round(watchdog / reg.TIMEOUT_UNIT)),
    }  # fmt: skip
    registers.update(zip(reg.SCALING, np.array(joint.spec.limits, np.float32).tolist()))
    # Shorted windings brake strongly: a full peak torque sinks at about 2 rad/s.
    return SimulatedMotor(joint, registers, peak, brake=0.5 * peak)


_ATTRIBUTES = (
    *("jammed", "silent", "lost-replies", "temperature-mos", "temperature-rotor"),
    *("velocity-factor", "torque-factor", "slip", "peak-torque"),
)
_REGISTERS = {"tmax": reg.TMAX, "vmax": reg.VMAX, "mode": reg.CTRL_MODE, "watchdog": reg.TIMEOUT}
FAULT_KINDS = ("status", *_ATTRIBUTES, *_REGISTERS)


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Joints are counted from 0. The value is a status code, temperature, new register value, ... or 1
    for "on" and 0 for "off". It happens so many seconds after the arm was first enabled; 0 means
    from the beginning.
    """

    kind: str
    joint: int
    value: float = 1.0
    after: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in FAULT_KINDS:
            raise InputError(f"unknown fault {self.kind!r}; valid: {', '.join(FAULT_KINDS)}")

    def apply(self, motor: SimulatedMotor) -> None:
        """Let it happen."""
        if self.kind == "status":
            motor.fail(int(self.value))
        elif self.kind in _REGISTERS:
            unit = reg.TIMEOUT_UNIT if self.kind == "watchdog" else 1.0
            motor.registers[_REGISTERS[self.kind]] = self.value * (1.0 / unit)
        else:
            name = self.kind.replace("-", "_")
            setattr(motor, name, type(getattr(motor, name))(self.value))


def parse_fault(text: str) -> Fault:
    """Return the fault written as KIND:JOINT[=VALUE][@SECONDS], for instance status:2=13@4.5."""
    rest, _, after = text.partition("@")
    rest, _, value = rest.partition("=")
    kind, _, joint = rest.partition(":")
    try:
        amount, delay = float(value or 1.0), float(after or 0.0)
        if not math.isfinite(amount + delay):
            raise ValueError
        return Fault(kind, int(joint), amount, delay)
    except ValueError:
        raise InputError(
            f"a fault is written KIND:JOINT[=VALUE][@SECONDS], got {text!r}; "
            f"kinds: {', '.join(FAULT_KINDS)}"
        ) from None


# Damping that holds a blocked joint [N m s/rad].
_JAM = 1e6


class SimulatedArm:
    """An arm whose joints are driven by simulated motors.

    Torque of an enabled motor: kp (p - q) + kd (v - qd) + t, limited to what it can deliver. A
    disabled motor brakes with its shorted windings, so a loaded arm sinks; but until a motor is
    enabled for the first time the arm rests on something. There is one motor per joint, base to
    terminal; more are on the bus but move nothing.
    """

    def __init__(
        self, mechanism: ArmStepper, motors: Sequence[SimulatedMotor], faults: Sequence[Fault] = ()
    ) -> None:
        if any(not 0 <= fault.joint < len(motors) for fault in faults):
            raise InputError(f"faults name joints 0 to {len(motors) - 1}")
        self.mechanism, self.motors = mechanism, list(motors)
        self._space = JointSpace.of([m.joint for m in self.motors[: mechanism.n_joints]])
        self.time = 0.0
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
            for motor in self.motors:
                self._changed |= motor.tick(self.time)
            if self._faults and self._enabled_at is not None:
                self._apply_faults(self.time - self._enabled_at)
            # The position half a step ahead stands for the whole step to second order.
            ahead = self.mechanism.q + 0.5 * self.mechanism.timestep * self.mechanism.qd
            torque, damping = self._law(ahead)
            self.mechanism.step(torque, np.where(self._jammed, _JAM, damping))

    def handle(self, frame: frames.Frame, time: float) -> list[frames.Frame]:
        """Let all motors take a frame at ``time`` [s]; return their answers."""
        self.advance(time)
        self._read_sensors()
        self._changed = True
        answers = []
        for motor in self.motors:
            answer = motor.handle(frame, time)
            if answer is not None:
                # Another motor whose id matches that of an answer takes it for a command.
                heard = [each.handle(answer, time) for each in self.motors if each is not motor]
                answers += [answer, *filter(None, heard)]
        if self._enabled_at is None and any(motor.driving for motor in self.motors):
            self._enabled_at = time
        return answers

    def _apply_faults(self, elapsed: float) -> None:
        while self._faults and self._faults[0].after <= elapsed:
            fault = self._faults.pop(0)
            fault.apply(self.motors[fault.joint])
            self._changed = True

    def _gather(self) -> None:
        motors = self.motors[: self.mechanism.n_joints]
        table = np.array([(*m.command, m.brake, m.peak_torque) for m in motors])
        driving = np.array([m.driving for m in motors])
        *told, brake, peak = table.T
        self._p, v, kp, kd, t = self._space.from_motors(codec.MitCommand(*told))
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
            motor.velocity = float(motor.joint.direction * qd[j])
            motor.torque = float(torques[j]) if motor.driving else 0.0

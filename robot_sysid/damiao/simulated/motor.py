"""One simulated motor: what it keeps, what it answers, when it stops driving.

It behaves as the real ones do where that matters: it only speaks when spoken to, matches the low
eight bits of an arbitration id, answers a command with the state before the command acted, drops
the fraction when it packs a value, leaves the enabled state on any fault and when commands stay
away for longer than its watchdog allows, and does not come back by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.codec import Feedback, Scaling, decode_mit, encode_feedback
from robot_sysid.damiao.protocol.motors import MotorSpec

DEFAULT_WATCHDOG = 0.1


@dataclass
class SimulatedMotor:
    """State of one motor.

    Attributes:
        registers: register number to value.
        peak_torque: what it can deliver [N m].
        brake: damping of the shorted windings while it is disabled [N m s/rad].
        status: status code.
        position, velocity, torque: what its sensors read, set by the arm.
        temperature_mos, temperature_rotor: [deg C].
        p, v, kp, kd, t: command in force.
        fed_at: when it last got a frame of its own [s].
        jammed: its joint is blocked.
        silent: it hears nothing and says nothing.
        loses_replies: it obeys but its answers do not arrive.
        velocity_factor, torque_factor: factors on the velocity and the torque it reports.
        slip: angle by which the position it reports is off [rad].
        write_echo: operation byte of its answer to a write.
        stored: registers that it keeps when the power goes off.
        bus: number of the bus it is on.
        direction, offset, torque_ratio: how it is mounted, see ``protocol.joint_space``.
    """

    registers: dict[int, float]
    peak_torque: float
    brake: float
    status: int = reg.DISABLED
    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0
    temperature_mos: int = 31
    temperature_rotor: int = 29
    p: float = 0.0
    v: float = 0.0
    kp: float = 0.0
    kd: float = 0.0
    t: float = 0.0
    fed_at: float = 0.0
    jammed: bool = False
    silent: bool = False
    loses_replies: bool = False
    velocity_factor: float = 1.0
    torque_factor: float = 1.0
    slip: float = 0.0
    write_echo: int = frames.WRITE
    stored: dict[int, float] = field(default_factory=dict)
    bus: int = 0
    direction: int = 1
    offset: float = 0.0
    torque_ratio: float = 1.0
    _scaling: tuple[tuple[float, ...], Scaling] | None = field(default=None, repr=False)

    @property
    def can_id(self) -> int:
        """Id it listens to."""
        return int(self.registers[reg.ESC_ID])

    @property
    def scaling(self) -> Scaling:
        """How it reads and writes frames."""
        limits = tuple(self.registers[number] for number in reg.SCALING)
        if self._scaling is None or self._scaling[0] != limits:
            self._scaling = limits, Scaling(*np.array(limits)[:, None])
        return self._scaling[1]

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
        self._forget_command()

    def handle(self, frame: frames.Frame, time: float) -> frames.Frame | None:
        """Take a frame from the bus and return the answer, if there is one."""
        if self.silent or len(frame.data) < 4 or frame.bus != self.bus:
            return None
        if frame.id == frames.REGISTER_ID:
            data = self._register_answer(frame.data)
        elif frame.id & 0xFF == self.can_id & 0xFF and len(frame.data) == 8:
            data = self._command_answer(frame.data, time)
        else:
            return None
        if data is None or self.loses_replies:
            return None
        fd = self.registers[reg.CAN_BR] > reg.FD_BITRATE_CODES_ABOVE
        return frames.Frame(int(self.registers[reg.MST_ID]), data, fd=fd, bus=self.bus)

    def _command_answer(self, data: bytes, time: float) -> bytes:
        self.fed_at = time
        if frames.is_special(data):
            self._special(data[7])
            return self._feedback()
        # The answer to a command is the state before it acts.
        answer = self._feedback()
        if self.driving and self.registers[reg.CTRL_MODE] == reg.MIT_MODE:
            self._take_command(data)
        return answer

    def _take_command(self, data: bytes) -> None:
        raw = np.frombuffer(data, dtype=np.uint8)[None]
        command = decode_mit(raw, self.scaling)
        self.p, self.v, self.kp, self.kd, self.t = (float(value[0]) for value in command)

    def _special(self, code: int) -> None:
        if reg.is_fault(self.status) and code != frames.CLEAR_ERROR:
            return
        if code == frames.ENABLE:
            self.status = reg.ENABLED
        elif code == frames.SET_ZERO and not self.driving:
            self.slip -= self.position + self.slip
        elif code in (frames.DISABLE, frames.CLEAR_ERROR):
            self.status = reg.DISABLED
            self._forget_command()

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
        echo = self.write_echo if operation == frames.WRITE else frames.READ
        return (
            data[:2] + bytes([echo, number]) + reg.bytes_from_value(number, self.registers[number])
        )

    def _feedback(self) -> bytes:
        one = np.ones(1)
        state = Feedback(
            np.array([self.can_id]),
            np.array([self.status]),
            one * (self.position + self.slip),
            one * self.velocity * self.velocity_factor,
            one * self.torque * self.torque_factor,
            np.array([self.temperature_mos]),
            np.array([self.temperature_rotor]),
        )
        return encode_feedback(state, self.scaling)[0].tobytes()

    def _forget_command(self) -> None:
        self.p = self.v = self.kp = self.kd = self.t = 0.0


def simulated_motor(
    spec: MotorSpec, can_id: int, master_id: int, watchdog: float = DEFAULT_WATCHDOG
) -> SimulatedMotor:
    """Return a motor as it leaves the factory, apart from ids and watchdog [s]."""
    peak, gear = spec.strongest, spec.gear_ratio or 1.0
    registers: dict[int, float] = {
        0: 15.0, 1: 0.0, 2: 100.0, 3: 0.8, 11: 1.96e-4, 12: 1.97e-5, 14: 5013.0, 16: 14.0,
        17: 0.84, 19: 5.16e-3, 29: 32.0, 30: 1.0, reg.CAN_BR: 4.0, reg.GR: gear,
        reg.MST_ID: float(master_id), reg.ESC_ID: float(can_id), reg.CTRL_MODE: float(reg.MIT_MODE),
        reg.TIMEOUT: float(round(watchdog / reg.TIMEOUT_UNIT)),
    }  # fmt: skip
    registers.update(
        zip((reg.PMAX, reg.VMAX, reg.TMAX), np.array(spec.limits, np.float32).tolist())
    )
    # Shorted windings brake strongly: a full peak torque sinks at about 2 rad/s.
    return SimulatedMotor(registers, peak, brake=0.5 * peak)

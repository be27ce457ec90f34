"""Simulated motors, the arm that they drive, and the bus that they are on.

A simulated motor behaves like a real one in these respects: it only sends answers, compares the low
eight bits of an arbitration id, answers a command with the state before the command acted, rounds
down when it packs a value, leaves the enabled state on any fault and when no command comes for
longer than its watchdog allows, and stays disabled until it is enabled again.

The arm is simulated in simulated time, without waiting, or in real time behind a CAN adapter.

What may be wrong with motors, an arm or a bus is simulated by subclasses, which replace public
methods: each says what it may be replaced for.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.bus import SimulatedClock
from robot_sysid.damiao.joints import DamiaoJoint, Mounting
from robot_sysid.damiao.protocol import (
    DISABLE,
    DISABLED,
    ENABLE,
    ENABLED,
    LOST_COMMUNICATION,
    MIT_MODE,
    READ,
    REFRESH,
    REGISTER_ID,
    SCALING,
    TIMEOUT_UNIT,
    BusTiming,
    CanFrame,
    MitCommand,
    Register,
    Scaling,
    bytes_from_value,
    decode_mit,
    encode_feedback,
    is_fault,
    is_special,
)
from robot_sysid.records import Array

if TYPE_CHECKING:
    from robot_sysid.simulation.plant import ArmStepper

# Command without effect: position, velocity, kp, kd and torque are zero.
_NOTHING = (0.0,) * 5
# Time from the last bit of a command to the first one of its answer [s]: a third of a frame,
# assumed.
_TURNAROUND = 50e-6


@dataclass
class SimulatedMotor:
    """One simulated motor and its state.

    A subclass may answer otherwise, by frame (``handle``), by kind of question (``command_answer``,
    ``register_answer``), in its state (``feedback``) or in the bytes of that (``feedback_of``).

    Attributes:
        joint: joint that the motor drives, with its mounting.
        registers: value of each register by its number.
        peak_torque: largest torque that the motor can deliver [N m].
        brake: damping of the shorted windings while the motor is disabled [N m s/rad].
        status: status code, see ``protocol.status_text``.
        position: measured position, set by the arm [rad].
        velocity: measured velocity, set by the arm [rad/s].
        torque: measured torque, set by the arm [N m].
        temperature_mos: temperature of the power stage [deg C].
        temperature_rotor: temperature of the winding [deg C].
        command: position, velocity, kp, kd and torque in force, in the units of ``MitCommand``.
        fed_at: time of the last command to this motor, by which its watchdog is fed [s].
    """

    joint: DamiaoJoint
    registers: dict[int, float]
    peak_torque: float
    brake: float
    status: int = DISABLED
    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0
    temperature_mos: int = 31
    temperature_rotor: int = 29
    command: Sequence[float] = _NOTHING
    fed_at: float = 0.0

    @property
    def can_id(self) -> int:
        """CAN id of the motor, from its register."""
        return int(self.registers[Register.ESC_ID])

    @property
    def drives(self) -> bool:
        """Whether the motor is enabled and follows commands."""
        return self.status == ENABLED

    def tick(self, time: float) -> bool:
        """Stop the motor if its watchdog has expired at ``time`` [s]; return whether it stopped."""
        if not self.drives:
            return False
        timeout = self.registers[Register.TIMEOUT] * TIMEOUT_UNIT
        if 0.0 < timeout < time - self.fed_at:
            self.fail(LOST_COMMUNICATION)
            return True
        return False

    def fail(self, code: int) -> None:
        """Leave the enabled state with a status code, of a fault or DISABLED."""
        self.status = code
        self.command = _NOTHING

    def handle(self, frame: CanFrame, time: float) -> CanFrame | None:
        """Process a frame on the bus at ``time`` [s]; return the motor's answer, None if silent."""
        data = None
        if len(frame.data) < 4:
            return None
        if frame.id == REGISTER_ID:
            data = self.register_answer(frame.data)
        elif frame.id & 0xFF == self.can_id & 0xFF and len(frame.data) == 8:
            data = self.command_answer(frame.data, time)
        if data is None:
            return None
        return CanFrame(int(self.registers[Register.MST_ID]), data)

    def command_answer(self, data: bytes, time: float) -> bytes:
        """Feed the watchdog at ``time`` [s], obey a command's 8 bytes, return the answer's data."""
        self.fed_at = time
        if is_special(data):
            self.obey_special(data[7])
            return self.feedback()
        # The answer to a command is the state before it acts.
        answer = self.feedback()
        if self.drives and self.registers[Register.CTRL_MODE] == MIT_MODE:
            frame = np.frombuffer(data, np.uint8)
            command = decode_mit(frame, self._scaling)
            self.command = np.concatenate(command).tolist()
        return answer

    def obey_special(self, code: int) -> None:
        """Obey the special command with a code: enable or disable; with a fault, neither."""
        if is_fault(self.status):
            return
        if code == ENABLE:
            self.status = ENABLED
        elif code == DISABLE:
            self.fail(DISABLED)

    def register_answer(self, data: bytes) -> bytes | None:
        """Return the data of the answer to a register frame's data, or None if there is none.

        Bytes 0 and 1 hold the CAN id, byte 2 the operation, and byte 3 the register's number.
        """
        if data[0] | data[1] << 8 != self.can_id:
            return None
        operation = data[2]
        number = data[3]
        if operation == REFRESH:
            return self.feedback()
        if operation != READ or number not in self.registers:
            return None
        return data[:4] + bytes_from_value(number, self.registers[number])

    def feedback(self) -> bytes:
        """Return the data of a feedback frame with the present state."""
        return self.feedback_of(self.position, self.velocity, self.torque)

    def feedback_of(self, *measured: float) -> bytes:
        """Return the data of feedback with position [rad], velocity [rad/s], torque [N m]."""
        temperatures = self.temperature_mos, self.temperature_rotor
        fields = np.array([(self.status, self.can_id & 0xF, *measured, *temperatures)])
        return encode_feedback(fields, self._scaling).tobytes()

    @property
    def _scaling(self) -> Scaling:
        """Ranges of the quantities in frames, by the motor's registers."""
        return _scaling_of(*(self.registers[number] for number in SCALING))


@lru_cache
def _scaling_of(*limits: float) -> Scaling:
    """Return the scaling of one motor with PMAX, VMAX and TMAX, made once: frames come fast."""
    return Scaling([limits])


def simulated_motor(joint: DamiaoJoint, watchdog: float) -> SimulatedMotor:
    """Return a simulated motor of a joint, with the factory's registers but for ids and watchdog.

    ``watchdog`` is the time without a command after which the motor stops [s].
    """
    peak = joint.spec.peak_torque
    registers: dict[int, float] = {
        Register.MST_ID: joint.master_id,
        Register.ESC_ID: joint.can_id,
        Register.CTRL_MODE: MIT_MODE,
        Register.TIMEOUT: round(watchdog / TIMEOUT_UNIT),
    }
    registers.update(zip(SCALING, np.array(joint.spec.limits, np.float32).tolist()))
    # Shorted windings brake strongly: a full peak torque sinks at about 2 rad/s.
    return SimulatedMotor(joint, registers, peak, brake=0.5 * peak)


class Drives(NamedTuple):
    """What the n motors of an arm do, in joint space.

    A driving motor makes kp (p - q) - kd qd + offset with offset = kd v + t; for the others kp and
    offset are zero, and kd is the damping of their shorted windings.

    Attributes:
        position: commanded position p (n,) [rad].
        kp: stiffness (n,) [N m/rad].
        kd: damping (n,) [N m s/rad].
        offset: torque (n,) [N m].
        most: largest torque (n,) of a driving motor [N m]; infinite for the others.
        driving: whether each motor drives (n,).
    """

    position: Array
    kp: Array
    kd: Array
    offset: Array
    most: Array
    driving: NDArray[np.bool_]


class SimulatedArm:
    """An arm whose joints are driven by simulated motors.

    An enabled motor makes the torque kp (p - q) + kd (v - qd) + t, limited to its peak torque. A
    disabled motor brakes with its shorted windings, so that a loaded arm sinks; but the arm is
    supported, and does not move, until a motor is enabled for the first time.

    Args:
        mechanism: dynamics of the arm with its n joints.
        motors: one per joint, base to terminal; further motors are on the bus but drive nothing.

    Attributes:
        time: simulated time up to which the arm has been computed [s].
        mechanism: as given.
        motors: as given, as a list.
        mounting: of the motors on their joints.
        was_enabled: whether a motor was ever enabled: until then the arm is supported.
    """

    def __init__(self, mechanism: ArmStepper, motors: Sequence[SimulatedMotor]) -> None:
        self.mechanism = mechanism
        self.motors = list(motors)
        self.time = 0.0
        self.was_enabled = False
        self.mount()

    def mount(self) -> None:
        """Mount the motors as their joints say now."""
        motors = self.motors[: self.mechanism.n_joints]
        self.mounting = Mounting.of([motor.joint for motor in motors])
        # None where commands, states or mounting have changed since they were gathered.
        self._drives: Drives | None = None

    def advance(self, until: float) -> None:
        """Simulate up to the time ``until`` [s]; the last step ends there.

        An arm of which no motor was ever enabled stands still meanwhile.
        """
        if not self.was_enabled:
            self.time = max(self.time, until)
        # Rounding errors of sums are smaller.
        while until - self.time > 1e-9:
            duration = min(self.mechanism.timestep, until - self.time)
            self.time += duration
            for motor in self.motors:
                if motor.tick(self.time):
                    self._drives = None
            # The position half a step ahead stands for the whole step to second order.
            ahead = self.mechanism.q + 0.5 * duration * self.mechanism.qd
            torque, damping = self._motor_torques(ahead)
            self.step(torque, damping, duration)

    def step(self, torque: Array, damping: Array, duration: float) -> None:
        """Advance the mechanism by a time [s] under the motor torque ``torque - damping qd``.

        Of both (n,), a subclass may let other ones arrive at the joints.
        """
        self.mechanism.step(torque, damping, duration)

    def handle(self, frame: CanFrame, time: float) -> list[CanFrame]:
        """Simulate up to ``time`` [s], send a frame to all motors and return their answers."""
        self.advance(time)
        return self.answers(frame, time)

    def answers(self, frame: CanFrame, time: float) -> list[CanFrame]:
        """Send a frame to all motors at ``time`` [s] and return their answers; simulate nothing."""
        self._read_sensors()
        self._drives = None
        answers = [motor.handle(frame, time) for motor in self.motors]
        if not self.was_enabled:
            self.was_enabled = any(motor.drives for motor in self.motors)
        return [answer for answer in answers if answer is not None]

    @property
    def drives(self) -> Drives:
        """What the motors do by their present commands and states."""
        if self._drives is None:
            self._drives = self.gather()
        return self._drives

    def gather(self) -> Drives:
        """Return what the motors do by commands, gains and peak torques, as arrays (n,).

        A subclass may let motors do something else than they are commanded.
        """
        motors = self.motors[: self.mechanism.n_joints]
        rows = [(*m.command, m.brake, m.peak_torque, m.drives) for m in motors]
        *commands, brake, peak, drives = np.array(rows).T
        driving = drives != 0.0
        p, v, kp, kd, t = self.mounting.inverse.command(MitCommand(*commands))
        return Drives(
            position=p,
            kp=np.where(driving, kp, 0.0),
            kd=np.where(driving, kd, brake),
            offset=np.where(driving, kd * v + t, 0.0),
            most=np.where(driving, peak, np.inf),
            driving=driving,
        )

    def encoded(self, q: Array) -> Array:
        """Return the positions (n,) that motors control where the joints are at q (n,) [rad].

        A subclass may let encoders be wrong.
        """
        return q

    def _motor_torques(self, q: Array) -> tuple[Array, Array]:
        """Return the motors' torque (n,) [N m] and damping (n,) [N m s/rad] in joint space.

        The motors make torque - damping qd at positions q (n,) [rad] and the present velocities qd;
        where an enabled motor would exceed its peak torque, torque is the peak and damping zero.
        """
        drives = self.drives
        torque = drives.kp * (drives.position - self.encoded(q)) + drives.offset
        total = torque - drives.kd * self.mechanism.qd
        saturated = np.abs(total) > drives.most
        if not saturated.any():
            return torque, drives.kd
        limit = np.copysign(drives.most, total)
        return np.where(saturated, limit, torque), np.where(saturated, 0.0, drives.kd)

    def _read_sensors(self) -> None:
        """Set each motor's position, velocity and torque from the arm's present state."""
        q = self.mechanism.q
        qd = self.mechanism.qd
        torque, damping = self._motor_torques(q)
        signals = self.mounting.signals(q, qd, torque - damping * qd)
        columns = [signal.tolist() for signal in signals]
        for motor, position, velocity, motor_torque in zip(self.motors, *columns):
            motor.position = position
            motor.velocity = velocity
            # A motor measures the current of its power stage, not that of its shorted windings.
            motor.torque = motor_torque if motor.drives else 0.0


class SimulatedLink:
    """A link to a simulated arm, in simulated time, with the transmission times of frames.

    Frames go over the bus one after the other; waiting for one advances the clock. A burst of
    commands is sent before any reply, because commands have the lower ids. A host without CAN-FD
    does not receive answers in CAN-FD.

    Args:
        clock: clock that is advanced.
        arm: arm that gets the frames and answers.
        timing: frame format and bit rates of the bus.
        echo: whether each sent frame is also received, when it was on the bus, as with SocketCAN.

    Attributes:
        error_frames: number of error frames: this bus has none.
    """

    error_frames = 0

    def __init__(
        self,
        clock: SimulatedClock,
        arm: SimulatedArm,
        timing: BusTiming,
        echo: bool = False,
    ) -> None:
        self.clock = clock
        self.arm = arm
        self._timing = timing
        self._echo = echo
        self._free_at = 0.0
        self._order = itertools.count()
        # Heap of transmitted frames (time, order, frame), and heap of replies that wait for a free
        # bus (time from which they may be sent, id, order, reply): of two, the lower id goes first.
        self._through: list[tuple[float, int, CanFrame]] = []
        self._replies: list[tuple[float, int, int, CanFrame]] = []

    def send(self, frame: CanFrame) -> None:
        """Send a frame as soon as the bus is free; the arm gets it after the last bit."""
        end = self.transmit(frame)
        if self._echo:
            self.deliver(frame._replace(time=end, echo=True))

    def transmit(self, frame: CanFrame) -> float:
        """Put a frame on the bus as soon as it is free, as any program on it may.

        Returned is when the arm gets it, after the last bit [s].
        """
        end = max(self.clock.now(), self._free_at) + self._timing.frame_time
        self._free_at = end
        for reply in self.arm.handle(frame, end):
            self.send_when_free(end + _TURNAROUND, reply)
        return end

    def send_when_free(self, begin: float, frame: CanFrame) -> None:
        """Let a motor send a frame from a moment on [s] at which the bus is free."""
        heapq.heappush(self._replies, (begin, frame.id, next(self._order), frame))

    def receive(self, until: float) -> CanFrame | None:
        """Return the next frame transmitted by ``until`` [s], or None; advance the clock to it."""
        while self._replies:
            begin, _, _, reply = self._replies[0]
            arrival = max(begin, self._free_at) + self._timing.frame_time
            if arrival > until:
                break
            heapq.heappop(self._replies)
            self._free_at = arrival
            if reply.fd <= self._timing.fd:
                self.deliver(reply._replace(time=arrival))
        if not self._through or self._through[0][0] > until:
            self.clock.sleep_until(until)
            return None
        frame = heapq.heappop(self._through)[-1]
        self.clock.sleep_until(frame.time)
        return frame

    def deliver(self, frame: CanFrame) -> None:
        """Store a transmitted frame, which ``receive`` returns at the frame's time.

        A subclass may lose, delay or damage it.
        """
        heapq.heappush(self._through, (frame.time, next(self._order), frame))

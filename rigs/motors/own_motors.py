"""Damiao motors and their bus, written from the maker's manual and not from the package.

A rig that packs and drives with the code that it judges would share its errors. So codec, motor
law, registers and bus are here a second time, in plain Python; of the package only the frame, the
clock and the shape of a link are used. An arm (``rigs.motors.sound_arms``) moves the motors.

Units are those of the output shaft: rad, rad/s, N m, s.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao.bus import SimulatedClock
from robot_sysid.damiao.protocol import CanFrame

SPECIAL_HEAD = b"\xff" * 7
ENABLE = 0xFC
DISABLE = 0xFD
ZERO = 0xFE
CLEAR = 0xFB
REGISTER_ID = 0x7FF
READ = 0x33
REFRESH = 0xCC
MASTER_ID = 7
CAN_ID = 8
TIMEOUT = 9
CONTROL_MODE = 10
FIRST_LIMIT = 21
LAST_LIMIT = 23
MIT_MODE = 1
OFF = 0
ON = 1
WATCHDOG_EXPIRED = 0xD
TIMEOUT_STEP = 50e-6
"""Unit of the watchdog's register [s]."""
KP_RANGE = 500.0
KD_RANGE = 5.0
BRAKE_SHARE = 0.5
"""Damping of shorted windings over the peak torque [s/rad]: a full load sinks at 2 rad/s."""
TURNAROUND = 40e-6
"""Time from a command's last bit to the answer's first [s]."""
CLASSIC_BITS = 111
CLASSIC_STUFF_BITS = 24
FD_BITS = 30
FD_STUFF_BITS = 4
FD_DATA_BITS = 96
FD_DATA_STUFF_BITS = 17
BIT_RATE = 1e6
DATA_BIT_RATE = 5e6


def code_of(value, limit, bits, low=None):
    """Return the integer of a value in [low, limit], rounded down; low is -limit by default."""
    low = -limit if low is None else low
    full = (1 << bits) - 1
    code = int((value - low) * full / (limit - low))
    return min(max(code, 0), full)


def value_of(code, limit, bits, low=None):
    """Return the value of an integer in [low, limit]; low is -limit by default."""
    low = -limit if low is None else low
    return low + code * (limit - low) / ((1 << bits) - 1)


def unpack_command(data, limits):
    """Return position, velocity, kp, kd and torque of the 8 bytes of an MIT command.

    ``limits`` are PMAX, VMAX and TMAX by which the motor reads them.
    """
    word = int.from_bytes(data, "big")
    position_limit, velocity_limit, torque_limit = limits
    return (
        value_of(word >> 48, position_limit, 16),
        value_of(word >> 36 & 0xFFF, velocity_limit, 12),
        value_of(word >> 24 & 0xFFF, KP_RANGE, 12, 0.0),
        value_of(word >> 12 & 0xFFF, KD_RANGE, 12, 0.0),
        value_of(word & 0xFFF, torque_limit, 12),
    )


def pack_command(command, limits):
    """Return the 8 bytes of position, velocity, kp, kd and torque, each rounded down."""
    position, velocity, kp, kd, torque = command
    position_limit, velocity_limit, torque_limit = limits
    word = code_of(position, position_limit, 16) << 48
    word |= code_of(velocity, velocity_limit, 12) << 36
    word |= code_of(kp, KP_RANGE, 12, 0.0) << 24
    word |= code_of(kd, KD_RANGE, 12, 0.0) << 12
    word |= code_of(torque, torque_limit, 12)
    return word.to_bytes(8, "big")


def pack_feedback(status, can_id, measured, temperatures, limits):
    """Return the 8 bytes of an answer; ``measured`` are position, velocity and torque."""
    position, velocity, torque = measured
    position_limit, velocity_limit, torque_limit = limits
    word = (status & 0xF) << 60 | (can_id & 0xF) << 56
    word |= code_of(position, position_limit, 16) << 40
    word |= code_of(velocity, velocity_limit, 12) << 28
    word |= code_of(torque, torque_limit, 12) << 16
    word |= temperatures[0] << 8 | temperatures[1]
    return word.to_bytes(8, "big")


def unpack_feedback(data, limits):
    """Return status, id, position, velocity and torque of the 8 bytes of an answer."""
    word = int.from_bytes(data, "big")
    position_limit, velocity_limit, torque_limit = limits
    return (
        word >> 60,
        word >> 56 & 0xF,
        value_of(word >> 40 & 0xFFFF, position_limit, 16),
        value_of(word >> 28 & 0xFFF, velocity_limit, 12),
        value_of(word >> 16 & 0xFFF, torque_limit, 12),
    )


HISTORY = 0.2
"""How long a motor remembers its state and its commands [s]: more than any answer is old."""


class OwnMotor:
    """A motor at a joint: its registers, its state, its law, and what is wrong with it.

    Args:
        can_id, master_id: of commands and answers.
        limits: PMAX, VMAX and TMAX in its registers.
        peak_torque: what its current loop makes at most.
        watchdog: time without a command after which it stops.

    Attributes:
        link_position, link_velocity: of the joint, set by the arm.
        report_shift: of the position in answers; its own loop does not see it.
        encoder_shift: of the encoder, which its own loop uses too.
        drift_rate: by which ``encoder_shift`` grows [rad/s].
        drift_is_felt: whether the velocity has the drift in it.
        encoder_scale: what the encoder shows over what is true.
        torque_share: real torque over what its law asks for.
        torque_reading: torque in answers over what its law asks for.
        kp_share, kd_share: gains of its law over the commanded ones.
        true_torque_limit: the TMAX by which it really reads and packs; None for the register's.
        odd_status, odd_every: a status that every so many-th answer has while it drives on.
        gap: width of the backlash between motor and link [rad].
        gap_position, gap_velocity: of the motor against the link, from the middle of the gap.
        torque_age, velocity_age, position_age: of what answers report, by its own clock [s].
        velocity_lag: time constant of the low-pass of reported velocities [s]; its own loop does
            without.
        torque_noise, velocity_noise: standard deviations of what is reported [N m, rad/s]; its own
            loop sees none of it.
        rng: draws that noise.
    """

    temperatures = (34, 31)

    def __init__(self, can_id, master_id, limits, peak_torque, watchdog):
        self.can_id = can_id
        self.master_id = master_id
        self.peak_torque = peak_torque
        self.brake = BRAKE_SHARE * peak_torque
        single = [struct.unpack("<f", struct.pack("<f", limit))[0] for limit in limits]
        self.limits = tuple(single)
        self.registers = {
            MASTER_ID: master_id,
            CAN_ID: can_id,
            TIMEOUT: round(watchdog / TIMEOUT_STEP),
            CONTROL_MODE: MIT_MODE,
        }
        self.registers.update(enumerate(single, FIRST_LIMIT))
        self.status = OFF
        self.command = (0.0,) * 5
        self.heard_at = 0.0
        self.silent_until = 0.0
        self.n_answers = 0
        self.link_position = 0.0
        self.link_velocity = 0.0
        self.report_shift = 0.0
        self.encoder_shift = 0.0
        self.drift_rate = 0.0
        self.drift_is_felt = True
        self.encoder_scale = 1.0
        self.torque_share = 1.0
        self.torque_reading = 1.0
        self.kp_share = 1.0
        self.kd_share = 1.0
        self.true_torque_limit = None
        self.odd_status = ON
        self.odd_every = 0
        self.gap = 0.0
        self.gap_position = 0.0
        self.gap_velocity = 0.0
        self.torque_age = 0.0
        self.velocity_age = 0.0
        self.position_age = 0.0
        self.velocity_lag = 0.0
        self.torque_noise = 0.0
        self.velocity_noise = 0.0
        self.rng = np.random.default_rng(can_id)
        # Time, position, velocity and low-passed velocity by the encoder, and (time, command).
        self._states = deque()
        self._commands = deque([(-math.inf, self.command)])

    @property
    def is_driving(self):
        """Whether it follows commands."""
        return self.status == ON

    def leave(self, status):
        """Leave the enabled state with a status."""
        self.status = status
        self.command = (0.0,) * 5
        self._commands = deque([(-math.inf, self.command)])

    def restart(self, time, duration):
        """Start again at ``time``, silent and without torque so long, and then disabled."""
        self.leave(OFF)
        self.silent_until = time + duration

    def expire(self, time):
        """Stop where no command has come for too long."""
        if self.status == ON:
            patience = self.registers[TIMEOUT] * TIMEOUT_STEP
            if 0.0 < patience < time - self.heard_at:
                self.leave(WATCHDOG_EXPIRED)

    def encoder(self):
        """Return position and velocity by its encoder, which its own loop uses."""
        position = self.link_position + self.gap_position
        velocity = self.link_velocity + self.gap_velocity
        shown_velocity = self.encoder_scale * velocity
        if self.drift_is_felt:
            shown_velocity += self.drift_rate
        return self.encoder_scale * position + self.encoder_shift, shown_velocity

    def gains(self):
        """Return stiffness and damping of its law."""
        return self.kp_share * self.command[2], self.kd_share * self.command[3]

    def asked_torque(self):
        """Return what its law asks for, limited to the peak; 0 where it is not enabled."""
        if self.status != ON:
            return 0.0
        return self._law(self.command, *self.encoder())

    def _law(self, command, position, velocity):
        target, target_velocity, kp, kd, torque = command
        kp *= self.kp_share
        kd *= self.kd_share
        torque += kp * (target - position) + kd * (target_velocity - velocity)
        return min(max(torque, -self.peak_torque), self.peak_torque)

    def remember(self, time, step):
        """Store the state at ``time``, which comes again every ``step`` [s]."""
        if not (
            self.torque_age
            or self.velocity_age
            or self.position_age
            or self.velocity_lag
        ):
            return
        position, velocity = self.encoder()
        states = self._states
        smooth = velocity
        if states and self.velocity_lag:
            share = -math.expm1(-step / self.velocity_lag)
            smooth = states[-1][3] + share * (velocity - states[-1][3])
        states.append((time, position, velocity, smooth))
        if time - states[0][0] > HISTORY:
            states.popleft()

    def _state_at(self, moment):
        """Return position, velocity and low-passed velocity at a moment, or the oldest ones."""
        newer = (state for state in reversed(self._states) if state[0] <= moment)
        time, position, velocity, smooth = next(newer, self._states[0])
        ahead = max(moment - time, 0.0)
        return position + ahead * velocity, velocity, smooth

    def _command_at(self, moment):
        for begin, command in reversed(self._commands):
            if begin <= moment:
                return command
        return self._commands[0][1]

    def _measured(self, time):
        """Return position, velocity and torque as it would report them at ``time``."""
        if not self._states:
            position, velocity = self.encoder()
            torque = self.asked_torque()
        else:
            position = self._state_at(time - self.position_age)[0]
            velocity = self._state_at(time - self.velocity_age)[2]
            moment = time - self.torque_age
            command = self._command_at(moment)
            torque = self._law(command, *self._state_at(moment)[:2])
            torque = torque if self.status == ON else 0.0
        torque *= self.torque_reading
        if self.torque_noise:
            torque += self.torque_noise * self.rng.standard_normal()
        if self.velocity_noise:
            velocity += self.velocity_noise * self.rng.standard_normal()
        return position + self.report_shift, velocity, torque

    def answer(self, frame_id, data, time):
        """Return the 8 bytes with which it answers a frame, or None."""
        if time < self.silent_until or len(data) < 4:
            return None
        if frame_id == REGISTER_ID:
            return self._register_answer(data, time)
        if frame_id & 0xFF != self.can_id & 0xFF or len(data) != 8:
            return None
        self.heard_at = time
        if data[:7] == SPECIAL_HEAD:
            self._obey_special(data[7])
            return self._feedback(time)
        # The answer is the state before the command acts.
        answer = self._feedback(time)
        if self.status == ON and self.registers[CONTROL_MODE] == MIT_MODE:
            self.command = unpack_command(data, self._frame_limits())
            self._commands.append((time, self.command))
            if time - self._commands[0][0] > HISTORY:
                self._commands.popleft()
        return answer

    def _frame_limits(self):
        if self.true_torque_limit is None:
            return self.limits
        return (*self.limits[:2], self.true_torque_limit)

    def _obey_special(self, code):
        if code == CLEAR:
            self.leave(OFF)
        elif code == ENABLE and self.status == OFF:
            self.status = ON
        elif code == DISABLE and self.status == ON:
            self.leave(OFF)
        elif code == ZERO:
            self.encoder_shift -= self.encoder()[0]

    def _register_answer(self, data, time):
        if data[0] | data[1] << 8 != self.can_id:
            return None
        operation = data[2]
        number = data[3]
        if operation == REFRESH:
            return self._feedback(time)
        if operation != READ or number not in self.registers:
            return None
        value = self.registers[number]
        is_float = FIRST_LIMIT <= number <= LAST_LIMIT
        return data[:4] + struct.pack("<f" if is_float else "<I", value)

    def _feedback(self, time):
        status = self.status
        self.n_answers += 1
        if self.odd_every and status == ON and self.n_answers % self.odd_every == 0:
            status = self.odd_status
        limits = self._frame_limits()
        measured = self._measured(time)
        return pack_feedback(status, self.can_id, measured, self.temperatures, limits)


@dataclass(frozen=True)
class Disturbance:
    """What a sound bus with its adapter does to frames of a run now and then.

    Attributes:
        lost: share of commands, and of answers, that never arrive.
        late: share of answers that the adapter hands over later, by ``delay`` [s].
        doubled: share of answers that come twice.
        delay: of late answers [s].
        seed: draws which ones.
    """

    lost: float = 0.0
    late: float = 0.0
    doubled: float = 0.0
    delay: float = 0.0
    seed: int = 0


class OwnBus:
    """A CAN bus on which frames take time, one after the other, in simulated time.

    Commands have the lower ids, so that a burst of them is sent before any answer. It has the
    methods of a link that the package sends and receives by.

    Args:
        motors: that listen.
        advance: moves the arm and the motors to a moment [s].
        fd: whether frames are those of CAN-FD.
        has_echo: whether sent frames come back when they were on the bus, as with SocketCAN.
        disturbance: what happens to commands of enabled motors, and to their answers.
    """

    def __init__(self, motors, advance, fd=False, has_echo=True, disturbance=None):
        self.clock = SimulatedClock()
        self.error_frames = 0
        # Motors compare the low eight bits of an id only.
        self._listeners = {}
        for motor in motors:
            self._listeners.setdefault(motor.can_id & 0xFF, []).append(motor)
        self._advance = advance
        self._fd = fd
        self._has_echo = has_echo
        self._disturbance = disturbance or Disturbance()
        self._rng = np.random.default_rng([self._disturbance.seed, 7])
        self._free_at = 0.0
        # Answers that wait for a free bus, as they came: (moment from which on, id, data).
        self._waiting = []
        # Frames that were on the bus and are not read yet, in the order of time.
        self._inbox = deque()
        # Answers that the adapter hands over late.
        self._held = deque()

    def frame_time(self, data):
        """Return how long a frame occupies the bus [s]; stuff bits depend on its data."""
        # A share from 0 to 1 that is spread over all data.
        stuffing = (sum(data) % 17) / 16.0
        if self._fd:
            head = (FD_BITS + stuffing * FD_STUFF_BITS) / BIT_RATE
            return head + (FD_DATA_BITS + stuffing * FD_DATA_STUFF_BITS) / DATA_BIT_RATE
        return (CLASSIC_BITS + stuffing * CLASSIC_STUFF_BITS) / BIT_RATE

    def send(self, frame):
        """Send a frame behind what is on the bus already."""
        now = self.clock.now()
        self._let_answer(now)
        end = max(now, self._free_at) + self.frame_time(frame.data)
        self._free_at = end
        if self._has_echo:
            self._inbox.append(frame._replace(time=end, echo=True))
        self._advance(end)
        number = frame.data[0] if frame.id == REGISTER_ID else frame.id & 0xFF
        for motor in self._listeners.get(number, ()):
            if motor.is_driving and self._happens(self._disturbance.lost):
                continue
            data = motor.answer(frame.id, frame.data, end)
            if data is not None:
                self._waiting.append((end + TURNAROUND, motor.master_id, data))

    def receive(self, until):
        """Return the next frame that was on the bus by ``until`` [s], or None."""
        if not self._inbox:
            self._let_answer(until)
        frames = self._inbox
        if self._held and (not frames or self._held[0].time < frames[0].time):
            frames = self._held
        if not frames or frames[0].time > until:
            self.clock.sleep_until(until)
            return None
        frame = frames.popleft()
        self.clock.sleep_until(frame.time)
        return frame

    def close(self):
        """There is no adapter to be closed."""

    def _let_answer(self, until):
        """Put answers onto the bus that begin before a moment [s]; the lowest id goes first."""
        waiting = self._waiting
        while waiting:
            begin = max(self._free_at, waiting[0][0])
            if begin >= until:
                return
            first = waiting[0]
            for answer in waiting:
                if answer[0] <= begin and answer[1] < first[1]:
                    first = answer
            waiting.remove(first)
            _, master_id, data = first
            self._free_at = begin + self.frame_time(data)
            self._hand_over(CanFrame(master_id, data, self._free_at, self._fd))

    def _happens(self, share):
        return share > 0.0 and self._rng.random() < share

    def _hand_over(self, frame):
        """Put an answer into the inbox, late or twice, unless it is lost."""
        disturbance = self._disturbance
        # Of a motor that is not enabled nothing is lost: the runs begin with all motors there.
        if frame.data[0] >> 4 != ON:
            self._inbox.append(frame)
            return
        if self._happens(disturbance.lost):
            return
        if self._happens(disturbance.late):
            frame = frame._replace(time=frame.time + disturbance.delay)
            self._held.append(frame)
            return
        self._inbox.append(frame)
        if self._happens(disturbance.doubled):
            end = self._free_at + self.frame_time(frame.data)
            self._free_at = end
            self._inbox.append(frame._replace(time=end))

"""Simulated motors on a simulated bus in simulated time, what may be wrong with them, and a run."""

from __future__ import annotations

import builtins
import errno
import gc
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from rigs.motors.clocks import ScriptedClock
from rigs.motors.links import RememberingLink
from rigs.motors.recordings import read_recording
from robot_sysid.damiao import execution, protocol
from robot_sysid.damiao.bus import GuardedLink, LinkError, inspect_bus
from robot_sysid.damiao.checks.preflight import bus_checks
from robot_sysid.damiao.joints import DamiaoJoint, damiao_joints
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import BusTiming, Feedback, MitCommand, Register
from robot_sysid.damiao.safety.holding import file_holding
from robot_sysid.damiao.safety.plausibility import NO_STATUS, Replies
from robot_sysid.damiao.session import MotorSession
from robot_sysid.damiao.settings import Plan, PlaySettings, RecordingOptions
from robot_sysid.damiao.simulated import (
    SimulatedArm,
    SimulatedLink,
    SimulatedMotor,
    simulated_motor,
)
from robot_sysid.damiao.trajectory import (
    DamiaoTrajectory,
    export_damiao_trajectory,
    read_damiao_trajectory,
)
from robot_sysid.records import Limits
from robot_sysid.records.file_access import atomic_file

INERTIA = 0.1
GRAVITY = 2.0
# Register of the code of the bit rate: above 4 a motor answers in CAN-FD.
BIT_RATE = 35
COARSE_STEP = 4e-3
"""Step of simulated arms of models [s]; a step of the usual size takes as long."""


# --- motions and files ----------------------------------------------------------------------------


def rest_to_rest(amplitude, turns, duration=2.0, rate=250.0):
    """Return (time, q, qd, qdd) of joints that swing from zero to an amplitude and back.

    They do so ``turns`` times. Amplitudes [rad] and turns are (n,); of further axes in front of it,
    with one in between, each is a motion.
    """
    time = np.arange(round(duration * rate) + 1) / rate
    w = 2 * np.pi / duration * turns
    phase = w * time[:, None]
    q = 0.5 * amplitude * (1 - np.cos(phase))
    qd = 0.5 * amplitude * w * np.sin(phase)
    return time, q, qd, 0.5 * amplitude * w**2 * np.cos(phase)


def swing(n_joints=3, duration=2.0, rate=250.0, amplitude=0.4, gravity=GRAVITY):
    """Joint motion from rest to rest with its exact torque: (time, q, qd, tau)."""
    turns = 1 + np.arange(n_joints) % 2
    time, q, qd, qdd = rest_to_rest(amplitude, turns, duration, rate)
    return time, q, qd, INERTIA * qdd + gravity * np.sin(q)


def lifted_swing(angle, gravity=GRAVITY, **options):
    """The swing of two joints about an angle [rad], with the torque of gravity there [N m]."""
    time, q, qd, tau = swing(2, gravity=gravity, **options)
    lifted = q + angle
    return time, lifted, qd, tau + gravity * (np.sin(lifted) - np.sin(q))


def map_line(name, can_id, master_id, *mounted):
    """A line of a joint map."""
    return DamiaoJoint("", can_id, master_id, name, *mounted)


def export(chunks, types, path):
    """Write a motion for motors of these types, and return what was clamped."""
    joints = damiao_joints(types, len(types))
    with atomic_file(path) as file:
        return export_damiao_trajectory(chunks, joints, file)


def trajectory_of(motion, *types, **options):
    """A motion as a trajectory of no file, for motors of these types, else of one."""
    types = types or ["DM4340"] * motion[1].shape[1]
    joints = damiao_joints(types, len(types), **options)
    return DamiaoTrajectory(Path("swing.csv"), joints, *motion)


def trajectory_file(folder, motion, *types):
    """A motion as a trajectory file for motors of these types, else of one, read back."""
    path = folder / "damiao_trajectory.csv"
    export([motion], types or ["DM4340"] * motion[1].shape[1], path)
    return read_damiao_trajectory(path)


# --- motors, arms and buses, and what may be wrong with them --------------------------------------


@dataclass
class FaultyMotor(SimulatedMotor):
    """A motor in which something may be wrong.

    Attributes:
        silent: it hears nothing and says nothing.
        lost_replies: it obeys but its answers do not arrive.
        is_stale: it repeats its last answer, bit by bit.
        velocity_factor, torque_factor: factors on the velocity and the torque it reports.
        shift: angle added to the position it reports, as since a zero was set [rad].
        frozen_position: position that it reports, at no speed [rad]; NaN while it reports its own.
        frozen_encoder: the same, and it also controls this position.
        encoder_error: encoder minus joint position [rad].
        slip_rate: how fast that grows [rad/s].
        slip_is_felt: whether the encoder's speed includes the slip.
        torque_share: torque that it makes per torque that it is to make.
        stiffness_share: stiffness that it has per stiffness that it is to have.
        jam_damping: damping of what holds its joint [N m s/rad].
        false_status: status code that some of its answers have although it drives; None for none.
        false_every: every so many answers have it.
        stored: registers in flash.
        writable: registers that it lets be written.
        next_answers: data of its next states, in place of its own.
        counts_commands: whether the temperature of its winding says how many it has had.
        n_commands: number of commands that it has had.
    """

    silent: bool = False
    lost_replies: bool = False
    is_stale: bool = False
    velocity_factor: float = 1.0
    torque_factor: float = 1.0
    shift: float = 0.0
    frozen_position: float = np.nan
    frozen_encoder: float = np.nan
    encoder_error: float = 0.0
    slip_rate: float = 0.0
    slip_is_felt: bool = True
    torque_share: float = 1.0
    stiffness_share: float = 1.0
    jam_damping: float = 0.0
    false_status: int | None = None
    false_every: int = 10
    stored: dict = field(default_factory=dict)
    writable: tuple[int, ...] = tuple(Register)
    next_answers: list[bytes] = field(default_factory=list)
    counts_commands: bool = False
    n_commands: int = 0
    last_answer: bytes = b""
    ticked_at: float = 0.0
    n_answers: int = 0

    @property
    def felt_slip(self):
        """How much faster the encoder turns than the joint [rad/s]."""
        return self.slip_rate * self.slip_is_felt

    def tick(self, time):
        self.encoder_error += self.slip_rate * (time - self.ticked_at)
        self.ticked_at = time
        return super().tick(time) or self.slip_rate != 0.0

    def handle(self, frame, time):
        answer = None if self.silent else super().handle(frame, time)
        if answer is None or self.lost_replies:
            return None
        return answer._replace(fd=self.registers.get(BIT_RATE, 0.0) > 4.0)

    def command_answer(self, data, time):
        self.n_commands += 1
        if self.counts_commands:
            self.temperature_rotor = self.n_commands % 60
        return super().command_answer(data, time)

    def feedback(self):
        if self.next_answers:
            return self.next_answers.pop(0)
        if self.is_stale and self.last_answer:
            return self.last_answer
        position = self.position + self.encoder_error + self.shift
        velocity = (self.velocity + self.felt_slip) * self.velocity_factor
        for frozen in (self.frozen_position, self.frozen_encoder):
            if not np.isnan(frozen):
                position = frozen
                velocity = 0.0
        torque = self.torque * self.torque_factor
        self.last_answer = self.feedback_of(position, velocity, torque)
        return self.last_answer

    def feedback_of(self, *measured):
        data = super().feedback_of(*measured)
        self.n_answers += 1
        if self.false_status is None or self.n_answers % self.false_every:
            return data
        return bytes([self.false_status << 4 | data[0] & 0xF]) + data[1:]

    def obey_special(self, code):
        if code == protocol.CLEAR_ERROR:
            self.fail(protocol.DISABLED)
        super().obey_special(code)

    def register_answer(self, data):
        number = data[3]
        if data[0] != self.can_id or data[2] not in (protocol.WRITE, protocol.STORE):
            return super().register_answer(data)
        if data[2] == protocol.STORE:
            self.stored = dict(self.registers)
            return data
        if number in self.writable:
            self.registers[number] = protocol.value_from_bytes(number, data[4:8])
        return data[:4] + protocol.bytes_from_value(number, self.registers[number])


def motor(joint, watchdog=0.1):
    """A joint's motor, in which nothing is wrong yet."""
    sound = simulated_motor(joint, watchdog)
    sound.registers[BIT_RATE] = 4.0
    return FaultyMotor(**vars(sound))


class Pendulums:
    """Independent pendulums: INERTIA qdd + gravity sin(q) = torque."""

    timestep = 4e-3

    def __init__(self, n_joints, q=None, gravity=GRAVITY):
        self.n_joints = n_joints
        self.gravity = gravity
        self.q = np.zeros(n_joints) if q is None else np.array(q, dtype=float)
        self.qd = np.zeros(n_joints)

    def step(self, torque, damping, h):
        force = torque - self.gravity * np.sin(self.q)
        self.qd = (self.qd + h * force / INERTIA) / (1.0 + h * damping / INERTIA)
        self.q = self.q + h * self.qd


class FaultyArm(SimulatedArm):
    """An arm of faulty motors, which are mounted straight where their encoders are frozen.

    Attributes:
        truth: time [s], positions and velocities (n,) of its joints, as they really were, per step.
        push: (n,) torque on the joints from outside [N m].
        off_at: when no motor was enabled any more [s]; infinite before.
        takes_whole_steps: whether steps are never cut short at the time of a frame: this is fast.
    """

    def __init__(self, mechanism, motors):
        super().__init__(mechanism, motors)
        self.truth = [(0.0, mechanism.q.copy(), mechanism.qd.copy())]
        self.push = np.zeros(mechanism.n_joints)
        self.off_at = np.inf
        self.takes_whole_steps = False

    def advance(self, until):
        if self.takes_whole_steps and self.was_enabled:
            step = self.mechanism.timestep
            until = self.time + np.floor((until - self.time) / step + 1e-6) * step
        super().advance(until)

    def step(self, torque, damping, duration):
        # The windings of a motor that does not drive brake whatever its torque was.
        share = np.where(self.drives.driving, self._share, 1.0)
        torque = share * torque + self.push
        super().step(torque, share * damping + self._jam, duration)
        if not np.any(self.drives.driving):
            self.off_at = min(self.off_at, self.time)
        state = self.mechanism.q.copy(), self.mechanism.qd.copy()
        self.truth.append((self.time, *state))

    def gather(self):
        drives = super().gather()
        motors = self.motors[: self.mechanism.n_joints]
        rows = [
            (
                m.torque_share,
                m.stiffness_share,
                m.jam_damping,
                m.encoder_error,
                m.frozen_encoder,
                m.felt_slip,
            )
            for m in motors
        ]
        self._share, stiff, self._jam, self._error, self._frozen, slip = np.transpose(
            rows
        )
        # Of motors that turn the other way than their joints, too.
        self._error, slip = self.mounting.direction * [self._error, slip]
        is_frozen = drives.driving & np.isfinite(self._frozen)
        return drives._replace(
            kp=stiff * drives.kp,
            offset=drives.offset - np.where(drives.driving, drives.kd * slip, 0.0),
            kd=np.where(is_frozen, 0.0, drives.kd),
        )

    def encoded(self, q):
        return np.where(np.isnan(self._frozen), q + self._error, self._frozen)


# Characters of the line of text of a feedback frame that carry a field.
_SPANS = {
    "arbitration id": (1, 4),
    "status": (5, 6),
    "id nibble": (6, 7),
    "position": (7, 11),
    "velocity": (11, 14),
    "torque": (14, 17),
}


@dataclass(frozen=True)
class Damage:
    """What happens to the next feedback frame of a joint, where nothing protects it.

    An adapter that speaks slcan sends a frame as a line of text: ``t``, the id in three hexadecimal
    digits, the number of bytes in one, the bytes in two each. No check sum protects it.

    ``field`` is one of the frame's, or "text"; ``size`` is an angle [rad] for the position, a bit
    for velocity and torque, the number of a flipped bit of the whole line for "text", and else the
    code that stands there instead.
    """

    field: str
    size: float
    joint: int

    def __call__(self, run):
        run.bus.damage = self

    def apply(self, frame, position_limit):
        """Return a motor's frame as it comes, by its PMAX [rad]; ValueError where it is none."""
        line = f"t{frame.id:03X}8{frame.data.hex().upper()}"
        if self.field == "text":
            index = self.size // 8 % len(line)
            character = chr(ord(line[index]) ^ (1 << self.size % 7))
            line = line[:index] + character + line[index + 1 :]
        else:
            begin, end = _SPANS[self.field]
            code = self._code(int(line[begin:end], 16), position_limit)
            line = f"{line[:begin]}{code:0{end - begin}X}{line[end:]}"
        text = line[5 : 5 + 2 * int(line[4], 16)]
        if line[0] != "t" or len(text) != 2 * int(line[4], 16):
            raise ValueError("not a frame")
        return frame._replace(id=int(line[1:4], 16), data=bytes.fromhex(text))

    def _code(self, code, position_limit):
        if self.field == "position":
            change = round(self.size * 0xFFFF / (2.0 * position_limit))
            return code + change if 0 <= code + change <= 0xFFFF else code - change
        if self.field in ("velocity", "torque"):
            return code ^ (1 << self.size)
        return self.size


class FaultyBus(SimulatedLink):
    """A bus on which frames come late or damaged, or not at all, or others talk.

    Attributes:
        delay: returns by how much the next answer is late [s]; none overtakes another.
        loses: returns whether the next answer is lost.
        route: returns what becomes of a frame: itself, another one, or None where it is lost.
        damage: what happens to the next answer of its joint; None once it has happened.
        is_off: whether it takes no frames, because the adapter has switched itself off.
    """

    delay = None
    loses = None
    route = None
    damage = None
    is_off = False
    _last_arrival = 0.0

    def send_foreign(self, frame, is_seen):
        """Let another program send a frame, which this computer's adapter sees or does not."""
        self._require_on()
        end = self.transmit(frame)
        if is_seen:
            self.deliver(frame._replace(time=end))

    def send(self, frame):
        self._require_on()
        super().send(frame)

    def _require_on(self):
        if self.is_off:
            raise LinkError("the CAN bus takes no more frames")

    def receive(self, until):
        if not self.is_off:
            return super().receive(until)
        self.clock.sleep_until(until)
        return None

    def deliver(self, frame):
        if self.route is not None:
            frame = self.route(frame)
            if frame is None:
                return
        if self.loses is not None and not frame.echo and self.loses():
            return
        if self.delay is not None and not frame.echo:
            self._last_arrival = max(self._last_arrival, frame.time + self.delay())
            frame = frame._replace(time=self._last_arrival)
        damage = self.damage
        if damage is not None and self._is_feedback(frame, damage.joint):
            self.damage = None
            limit = self.arm.motors[damage.joint].joint.spec.limits[0]
            try:
                frame = damage.apply(frame, limit)
            except ValueError:
                # As ``BusLink`` does, pass over a line that is no frame.
                return
        super().deliver(frame)

    def _is_feedback(self, frame, j):
        joint = self.arm.motors[j].joint
        is_answer = frame.id == joint.master_id and not frame.echo
        # Answers to questions about registers repeat the id in their first two bytes.
        is_state = frame.data[0] & 0xF == joint.can_id & 0xF and frame.data[0] >> 4
        return is_answer and len(frame.data) == 8 and bool(is_state)


@dataclass(frozen=True)
class Fault:
    """Something goes wrong with a motor: attributes or registers get other values.

    A value may be a function of the motor; a ``status`` takes the motor out of the enabled state.
    """

    joint: int
    values: dict[str, Any]

    def __call__(self, rig):
        hit = rig.motors[self.joint]
        for name, value in self.values.items():
            if name == "status":
                hit.fail(value)
            elif name.isupper():
                hit.registers[Register[name]] = float(value)
            else:
                assert hasattr(hit, name), name
                setattr(hit, name, value(hit) if callable(value) else value)


def fault(joint, **values):
    """Return the fault that gives a joint's motor these values."""
    return Fault(joint, values)


def restart_motor(joint, seconds, shift=0.0):
    """Return the cause that lets a motor start again, silent for so long [s].

    Its position is then another one by ``shift`` [rad], which may be a function of the motor.
    """
    off = fault(joint, status=protocol.DISABLED, silent=True, shift=shift)
    return combine_causes(off, delay_cause(seconds, fault(joint, silent=False)))


def delay_cause(seconds, cause):
    """Return the cause that lets another one happen so many seconds later."""
    return lambda rig: rig.at(seconds, lambda: cause(rig))


def combine_causes(*causes):
    """Return the cause of several ones at once."""
    return lambda rig: [cause(rig) for cause in causes]


# --- programs on the bus --------------------------------------------------------------------------


def only_asks(sent):
    """Whether none of these frames can move a motor or change what it holds."""
    asking = protocol.READ, protocol.REFRESH
    return all(f.id == protocol.REGISTER_ID and f.data[2] in asking for f in sent)


@cache
def freeze_heap():
    """Let later garbage collections, of which each run begins with two, skip what is loaded now."""
    gc.collect()
    gc.freeze()


def mit_command(position=0.0, velocity=0.0, kp=0.0, kd=1.0, torque=0.0):
    """A command of one joint, or of as many as the longest of these has."""
    fields = map(np.atleast_1d, (position, velocity, kp, kd, torque))
    return MitCommand(*(field.astype(float) for field in np.broadcast_arrays(*fields)))


def state(position=0.0, velocity=0.0, torque=0.0, status=1, mos=30, rotor=30):
    """What one joint reports, or as many as the longest of these has."""
    fields = map(np.atleast_1d, (status, position, velocity, torque, mos, rotor))
    return Feedback(*np.broadcast_arrays(*fields))


def undoubted_replies(answered, time, feedback, requested, command=None):
    """Replies in a cycle in which nothing was doubted, surplus or foreign."""
    no_count = np.zeros(len(answered), int)
    none = no_count != 0
    counts = none, none, 0.0 * no_count, no_count, no_count
    reported = np.where(answered, feedback.status, NO_STATUS)
    return Replies(
        answered,
        time,
        feedback,
        requested,
        command,
        *counts,
        late=np.zeros(len(answered), int),
        reported=reported,
    )


class MotorBus:
    """Motors on a bus in simulated time.

    Attributes:
        motors: those of the joints, base first.
        wire: what the program sends and receives.
        link: what it plays by.
    """

    def __init__(
        self,
        joints=None,
        mechanism=None,
        extra_motors=(),
        timing=None,
        watchdog=0.1,
        echo=False,
    ):
        freeze_heap()
        joints = joints or damiao_joints(["DM4340"] * 2, 2)
        timing = timing or BusTiming()
        self.motors = [motor(joint, watchdog) for joint in joints]
        mechanism = mechanism or Pendulums(len(joints))
        self.arm = FaultyArm(mechanism, [*self.motors, *extra_motors])
        self.clock = ScriptedClock()
        self.bus = FaultyBus(self.clock, self.arm, timing, echo)
        self.wire = RememberingLink(self.bus, self.clock)
        self.link = GuardedLink(self.wire, self.clock, timing.fd)

    def states(self):
        """The status code of each motor."""
        return [motor.status for motor in self.arm.motors]

    def mount(self, j, **mounting):
        """Mount a joint's motor in another way; no program knows it."""
        self.motors[j].joint = replace(self.motors[j].joint, **mounting)
        self.arm.mount()

    def at(self, delay, action):
        """Do something some time [s] from now."""
        self.clock.at(self.clock.now() + delay, action)

    @property
    def equipment(self):
        """The equipment of runs that find this bus in place of a real one, with its clock."""
        return execution.Equipment(self.clock, lambda *_: self.wire, COARSE_STEP)

    def open_session(self, limits=None):
        """Return a session of all motors."""
        joints = [motor.joint for motor in self.motors]
        scaling = protocol.Scaling(joint.spec.limits for joint in joints)
        return MotorSession(self.link, joints, scaling, limits or Limits())


class MotorRun(MotorBus):
    """A plan that is played on motors, and what happens.

    Attributes:
        phases: what the run said that it was doing: (time [s], sentence).
        error, report: what came of it.
    """

    def __init__(self, plan, mechanism, **options):
        super().__init__(
            plan.trajectory.joints, mechanism, timing=plan.timing, **options
        )
        self.plan = plan
        self.holding = file_holding(plan.trajectory)
        self.stop = StopRequest()
        self.phases = []
        self.console = lambda sentence: None
        self.error = self.report = None
        self._hooks = []

    def during(self, phase, delay, action: Callable[[MotorRun], Any]):
        """Call ``action(run)`` some seconds after a phase has begun."""
        self._hooks.append((phase, delay, action))
        return self

    def note_phase(self, sentence):
        """Keep when a phase began, and let happen what is to happen during it."""
        self.phases.append((self.clock.now(), sentence))
        for phase, delay, action in self._hooks:
            if sentence.startswith(phase):
                self.at(delay, partial(action, self))
        self.console(sentence)

    def run(self, settle=0.5):
        """Inspect, play, record; keep error or report; then let the arm be for a while."""
        inspection = inspect_bus(self.link)
        try:
            self.checks = [*bus_checks(self.plan, inspection)]
            self.plan.recording.require_free()
            others = self.stop, self.note_phase, self.holding
            self.report = execution.run(self.link, self.plan, inspection, *others)
        except Exception as error:
            self.error = error
        self.arm.advance(self.clock.now() + settle)
        return self


class RecordingFile:
    """A file that takes nothing more once its disk is full; ``is_full`` tells whether it is."""

    def __init__(self, file, is_full):
        self._file = file
        self._is_full = is_full

    def write(self, text):
        if self._is_full():
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(text)

    def close(self):
        self._file.close()


class Rig(MotorRun):
    """Plays a swing on pendulums and records it; ``faults`` are there from the beginning.

    Attributes:
        disk_is_full: whether the disk of the recording takes nothing more.
    """

    def __init__(
        self,
        folder,
        n_joints=2,
        faults=(),
        start=None,
        motion=None,
        name="measured",
        extra_motors=(),
        gravity=GRAVITY,
        **settings,
    ):
        self.disk_is_full = False
        trajectory = trajectory_file(folder, motion or swing(n_joints, duration=1.0))
        self.record_path = folder / f"{name}.csv"
        quick = {
            "ramp_time": 0.1,
            "approach_time": 0.1,
            "rest_time": 0.1,
            "rate": 125.0,
        }
        plan = Plan(
            trajectory,
            PlaySettings(**{**quick, **settings}),
            recording=RecordingOptions(self.record_path),
        )
        pendulums = Pendulums(trajectory.n_joints, start, gravity)
        super().__init__(plan, pendulums, extra_motors=extra_motors)
        for cause in faults:
            cause(self)
        self.states_before = self.states()

    def run(self, settle=0.5):
        """Play on a disk that may become full, see ``MotorRun.run``."""
        with mock.patch.object(builtins, "open", partial(self._open, open)):
            return super().run(settle)

    def _open(self, open_file, path, *arguments, **options):
        file = open_file(path, *arguments, **options)
        if path != self.record_path:
            return file
        return RecordingFile(file, lambda: self.disk_is_full)

    def span(self, phase):
        """Return from when to when a phase went on [s]; both are infinite where it never began."""
        names = [sentence[: len(phase)] for _, sentence in self.phases]
        times = [time for time, _ in self.phases] + [np.inf, np.inf]
        number = [*names, phase].index(phase)
        return times[number], times[number + 1]

    def has_begun(self, phase):
        """Whether a phase whose name begins so has begun."""
        return self.span(phase)[0] < np.inf

    @property
    def play_frames(self):
        """What arrived while the trajectory itself was played."""
        begin, end = self.span("playing")
        received = [frame for frame, sent in self.wire.frames if not sent]
        return [frame for frame in received if begin < frame.time <= end]

    @property
    def recording(self):
        return read_recording(self.record_path)

    def assert_never_moved(self):
        """No motor was ever enabled, commanded or written to."""
        assert self.states() == self.states_before
        assert only_asks(self.wire.sent)

    def assert_stopped(self, cause, states=None, is_recorded=True):
        """The run ended with this cause, all motors in these states, nothing harmful was sent.

        If ``is_recorded``, every answer that came is in the recording.
        """
        assert self.error is not None and cause in str(self.error), self.error
        assert "\n" not in str(self.error) and self.error.exit_code == 3
        expected = [protocol.DISABLED] * len(self.arm.motors)
        for joint, code in (states or {}).items():
            expected[joint] = code
        assert self.states() == expected
        self.assert_harmless()
        if is_recorded:
            self.assert_nothing_lost()

    def assert_played(self):
        """The run was played to its end, all motors are disabled; return the recording."""
        assert self.error is None, self.error
        assert self.states() == [protocol.DISABLED] * len(self.arm.motors)
        return self.assert_nothing_lost()

    def assert_harmless(self):
        """Nothing was sent that stores something in a motor or clears an error."""
        special = [
            frame.data[7] for frame in self.wire.sent if protocol.is_special(frame.data)
        ]
        assert set(special) <= {protocol.ENABLE, protocol.DISABLE}

    def assert_nothing_lost(self):
        """Every reply that arrived while the trajectory played is in the recording."""
        recording = self.recording
        positions = recording.joint_values("pos")
        for j, joint in enumerate(self.plan.trajectory.joints):
            arrived = [f for f in self.play_frames if f.id == joint.master_id]
            n_recorded = np.count_nonzero(np.isfinite(positions[:, j]))
            n_doubted = np.nansum(recording.joint_values("doubted")[:, j])
            assert n_recorded + n_doubted == len(arrived)
        return recording

"""A simulated arm on a simulated bus in simulated time, with everything a run needs around it."""

from __future__ import annotations

import gc
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from rigs.clocks import ScriptedClock
from rigs.links import RememberingLink, SlowAdapter
from rigs.recordings import read_recording
from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import GuardedLink, inspect_bus
from robot_sysid.damiao.execution import run
from robot_sysid.damiao.joints import DamiaoJoint, damiao_joints
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.preflight import bus_checks
from robot_sysid.damiao.protocol import Register
from robot_sysid.damiao.references import file_holding
from robot_sysid.damiao.settings import (
    Permissions,
    Plan,
    PlaySettings,
    RecordingOptions,
)
from robot_sysid.damiao.simulated import (
    SimulatedArm,
    SimulatedLink,
    SimulatedMotor,
    simulated_motor,
)
from robot_sysid.damiao.trajectory import (
    export_damiao_trajectory,
    read_damiao_trajectory,
)
from robot_sysid.records.file_access import atomic_file
from robot_sysid.simulation import plant
from robot_sysid.simulation.plant import ArmStepper

INERTIA = 0.1
GRAVITY = 2.0
CLASSIC = protocol.BusTiming()
# Register of the code of the bit rate: above 4 a motor answers in CAN-FD.
BIT_RATE = 35


class Pendulums:
    """Independent pendulums: INERTIA qdd + GRAVITY sin(q) = torque; those jammed stand."""

    timestep = 4e-3

    def __init__(self, n_joints, q=None):
        self.n_joints = n_joints
        self.q = np.zeros(n_joints) if q is None else np.array(q, dtype=float)
        self.qd = np.zeros(n_joints)
        self.jammed = np.zeros(n_joints, bool)

    def step(self, torque, damping, h):
        damping = np.where(self.jammed, 1e6, damping)
        force = torque - GRAVITY * np.sin(self.q)
        self.qd = (self.qd + h * force / INERTIA) / (1.0 + h * damping / INERTIA)
        self.q = self.q + h * self.qd


@dataclass
class FaultyMotor(SimulatedMotor):
    """A motor in which something may be wrong.

    Attributes:
        silent: it hears nothing and says nothing.
        lost_replies: it obeys but its answers do not arrive.
        velocity_factor, torque_factor: factors on the velocity and the torque it reports.
        shift: angle added to the position it reports, as since a zero was set [rad].
        stored: registers in flash.
        is_stale: it repeats its last answer, bit by bit.
        answers_first: it answers before another motor with its id.
        frozen_position: position that it reports, at no speed [rad]; NaN while it reports its own.
    """

    silent: bool = False
    lost_replies: bool = False
    velocity_factor: float = 1.0
    torque_factor: float = 1.0
    shift: float = 0.0
    stored: dict = field(default_factory=dict)
    is_stale: bool = False
    answers_first: bool = False
    frozen_position: float = np.nan
    last_answer: bytes = b""

    def handle(self, frame, time):
        answer = None if self.silent else super().handle(frame, time)
        if answer is None or self.lost_replies:
            return None
        return answer._replace(fd=self.registers.get(BIT_RATE, 0.0) > 4.0)

    def _feedback(self):
        if self.is_stale and self.last_answer:
            return self.last_answer
        position = self.position + self.shift
        velocity = self.velocity * self.velocity_factor
        if not np.isnan(self.frozen_position):
            position = self.frozen_position
            velocity = 0.0
        torque = self.torque * self.torque_factor
        self.last_answer = self._pack(position, velocity, torque)
        return self.last_answer

    def _special(self, code):
        if code == protocol.CLEAR_ERROR:
            self.fail(protocol.DISABLED)
        super()._special(code)

    def _register_answer(self, data):
        number = data[3]
        if data[0] != self.can_id or data[2] not in (protocol.WRITE, protocol.STORE):
            return super()._register_answer(data)
        if data[2] == protocol.STORE:
            self.stored = dict(self.registers)
            return data
        if number in WRITABLE:
            self.registers[number] = protocol.value_from_bytes(number, data[4:8])
        return data[:4] + protocol.bytes_from_value(number, self.registers[number])


# Registers that the motors write.
WRITABLE = tuple(protocol.Register)


def motor(joint, watchdog=0.1):
    """A joint's motor, in which nothing is wrong yet."""
    sound = simulated_motor(joint, watchdog)
    sound.registers[BIT_RATE] = 4.0
    return FaultyMotor(**vars(sound))


REGISTERS = {"tmax": Register.TMAX, "vmax": Register.VMAX, "mode": Register.CTRL_MODE}


def fault(name, joint, value=1):
    """Function: let something go wrong with a motor of a rig, or of the motors in a list."""

    def cause(rig):
        hit = (rig if isinstance(rig, list) else rig.motors)[joint]
        if name == "status":
            hit.fail(int(value))
        elif name == "watchdog":
            hit.registers[Register.TIMEOUT] = round(value / protocol.TIMEOUT_UNIT)
        elif name in REGISTERS:
            hit.registers[REGISTERS[name]] = float(value)
        elif name == "jammed":
            rig.arm.mechanism.jammed[joint] = True
        else:
            setattr(hit, name, value)

    return cause


def swing(n_joints=3, duration=2.0, rate=250.0, amplitude=0.4):
    """Joint motion from rest to rest with its exact torque: (time, q, qd, tau)."""
    time = np.arange(round(duration * rate) + 1) / rate
    w = 2 * np.pi / duration * (1 + np.arange(n_joints) % 2)
    phase = w * time[:, None]
    q = 0.5 * amplitude * (1 - np.cos(phase))
    qd = 0.5 * amplitude * w * np.sin(phase)
    qdd = 0.5 * amplitude * w**2 * np.cos(phase)
    return time, q, qd, INERTIA * qdd + GRAVITY * np.sin(q)


def lifted_swing(angle, **options):
    """The swing of two joints about an angle [rad], with the torque of gravity there [N m]."""
    time, q, qd, tau = swing(2, **options)
    lifted = q + angle
    return time, lifted, qd, tau + GRAVITY * (np.sin(lifted) - np.sin(q))


def map_line(name, can_id, master_id, *mounted):
    """A line of a joint map."""
    return DamiaoJoint("", can_id, master_id, name, *mounted)


@cache
def freeze_heap():
    """Let later garbage collections, of which each run begins with two, skip what is loaded now."""
    gc.collect()
    gc.freeze()


def two_motor_arm(watchdog=0.1):
    """Two pendulums with their motors."""
    freeze_heap()
    joints = damiao_joints(["DM4340"] * 2, 2)
    return SimulatedArm(Pendulums(2), [motor(joint, watchdog) for joint in joints])


def export(chunks, types, path, **ids):
    """Write a motion for motors of these types, and return the report."""
    joints = damiao_joints(types, len(types), **ids)
    with atomic_file(path) as file:
        return export_damiao_trajectory(chunks, joints, file)


def trajectory_file(folder, motion, *types):
    """A motion as a trajectory file for motors of these types, else of one, read back."""
    path = folder / "damiao_trajectory.csv"
    export([motion], types or ["DM4340"] * motion[1].shape[1], path)
    return read_damiao_trajectory(path)


def with_coarse_physics(monkeypatch):
    """Let simulated arms of models take steps of 4 ms; a step of the usual size takes as long."""
    monkeypatch.setattr(plant, "ArmStepper", partial(ArmStepper, timestep=4e-3))


def only_asks(sent):
    """Whether none of these frames can move a motor or change what it holds."""
    asking = protocol.READ, protocol.REFRESH
    return all(f.id == protocol.REGISTER_ID and f.data[2] in asking for f in sent)


class Rig:
    """Builds an arm, plays a swing on it, and keeps what happened.

    ``faults`` are there from the beginning.
    """

    def __init__(
        self,
        folder,
        n_joints=2,
        faults=(),
        timing=CLASSIC,
        extra_motors=(),
        start=None,
        permissions=None,
        watchdog=0.1,
        motion=None,
        name="measured",
        adapter=None,
        console=lambda sentence: None,
        **settings,
    ):
        freeze_heap()
        trajectory = trajectory_file(folder, motion or swing(n_joints, duration=1.0))
        self.motors = [motor(joint, watchdog) for joint in trajectory.joints]
        self.arm = SimulatedArm(
            Pendulums(n_joints, start), [*self.motors, *extra_motors]
        )
        for cause in faults:
            cause(self)
        self.states_before = self.states()
        self.clock = ScriptedClock()
        self.bus = SimulatedLink(self.clock, self.arm, timing)
        self.adapter = SlowAdapter(self.bus, self.clock, adapter)
        self.console = console
        self.wire = RememberingLink(self.adapter, self.clock)
        self.link = GuardedLink(self.wire, self.clock, timing.fd)
        self.record_path = folder / f"{name}.csv"
        quick = {"ramp_time": 0.3, "approach_time": 0.3, "rest_time": 0.1}
        self.plan = Plan(
            trajectory,
            PlaySettings(**{**quick, **settings}),
            timing,
            permissions or Permissions(),
            RecordingOptions(self.record_path),
        )
        self.stop = StopRequest()
        self.hooks = {}
        self.phase_times = []
        self.first_played = None
        self.last_played = None
        self.error = self.report = None

    def mount(self, j, **mounting):
        """Mount a motor in another way, and let the plan know it."""
        joints = list(self.plan.trajectory.joints)
        self.motors[j].joint = joints[j] = replace(joints[j], **mounting)
        trajectory = replace(self.plan.trajectory, joints=tuple(joints))
        self.plan = replace(self.plan, trajectory=trajectory)
        self.bus.arm = self.arm = SimulatedArm(self.arm.mechanism, self.arm.motors)

    @property
    def phases(self):
        """What the run said that it was doing."""
        return [sentence for sentence, _ in self.phase_times]

    @property
    def play_frames(self):
        """What arrived while the trajectory itself was played."""
        if self.first_played is None:
            return []
        frames = self.wire.frames[self.first_played : self.last_played]
        return [frame for frame, sent in frames if not sent]

    def _phase(self, sentence):
        if sentence.startswith("playing"):
            self.first_played = len(self.wire.frames)
        elif self.first_played is not None and self.last_played is None:
            self.last_played = len(self.wire.frames)
        self.phase_times.append((sentence, self.clock.now()))
        for beginning, hook in self.hooks.items():
            if sentence.startswith(beginning):
                hook(self)
        self.console(sentence)

    def during(self, phase, delay, action):
        """Call action(rig) some seconds after a phase has begun."""

        def hang(rig):
            rig.clock.at(rig.clock.now() + delay, lambda: action(rig))

        self.hooks[phase] = hang
        return self

    def run(self, settle=0.5):
        """Inspect, play, record; keep error or report; then let the arm be for a while."""
        inspection = inspect_bus(self.link)
        others = self._phase, file_holding(self.plan.trajectory)
        try:
            self.checks = [*bus_checks(self.plan, inspection)]
            self.plan.recording.require_free()
            self.report = run(self.link, self.plan, inspection, self.stop, *others)
        except Exception as error:
            self.error = error
        self.arm.advance(self.clock.now() + settle)
        return self

    @property
    def recording(self):
        return read_recording(self.record_path)

    def states(self):
        return [motor.status for motor in self.arm.motors]

    def assert_never_moved(self):
        """No motor was ever enabled, commanded or written to."""
        assert self.states() == self.states_before
        assert only_asks(self.wire.sent)

    def assert_stopped(self, cause, states=None):
        """The run ended with this cause, all motors in these states, nothing harmful was sent."""
        assert self.error is not None and cause in str(self.error), self.error
        assert "\n" not in str(self.error) and self.error.exit_code == 3
        expected = [protocol.DISABLED] * len(self.arm.motors)
        for joint, code in (states or {}).items():
            expected[joint] = code
        assert self.states() == expected
        self.assert_harmless()
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
            assert n_recorded + np.nansum(
                recording.joint_values("doubted")[:, j]
            ) == len(arrived)
        return recording

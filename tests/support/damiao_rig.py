"""A simulated arm on a simulated bus in simulated time, with everything a run needs around it."""

from __future__ import annotations

import numpy as np

from robot_sysid.damiao.bus.clock import SimulatedClock
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.play.player import StopRequest
from robot_sysid.damiao.play.preflight import Permissions
from robot_sysid.damiao.play.recorder import read_recording
from robot_sysid.damiao.play.run import (
    Audience,
    RecordingChoice,
    look,
    make_plan,
    perform,
)
from robot_sysid.damiao.play.settings import PlaySettings, default_gains
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.protocol.registers import DISABLED
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.damiao.simulated.simulated_link import SimulatedLink
from robot_sysid.damiao.trajectory.csv_file import export_damiao_trajectory, read_damiao_trajectory

INERTIA, GRAVITY = 0.1, 2.0


class Pendulums:
    """Independent pendulums: INERTIA qdd + GRAVITY sin(q) = torque."""

    timestep = 1e-3

    def __init__(self, n_joints, q=None):
        self.n_joints = n_joints
        self.q = np.zeros(n_joints) if q is None else np.array(q, dtype=float)
        self.qd = np.zeros(n_joints)

    def step(self, torque, damping):
        h = self.timestep
        force = torque - GRAVITY * np.sin(self.q)
        self.qd = (self.qd + h * force / INERTIA) / (1.0 + h * damping / INERTIA)
        self.q = self.q + h * self.qd
        return torque - damping * self.qd


def swing(n_joints=3, duration=2.0, rate=250.0, amplitude=0.4):
    """Joint motion from rest to rest with its exact torque: (time, q, qd, tau)."""
    time = np.arange(round(duration * rate) + 1) / rate
    w = 2 * np.pi / duration * (1 + np.arange(n_joints) % 2)
    phase = w * time[:, None]
    q = 0.5 * amplitude * (1 - np.cos(phase))
    qd = 0.5 * amplitude * w * np.sin(phase)
    qdd = 0.5 * amplitude * w**2 * np.cos(phase)
    return time, q, qd, INERTIA * qdd + GRAVITY * np.sin(q)


class Rig:
    """Builds an arm, plays a swing on it, and keeps what happened."""

    def __init__(
        self,
        folder,
        n_joints=3,
        motor_type="DM4340",
        faults=(),
        timing=None,
        echo=False,
        extra_motors=(),
        start=None,
        allowed=None,
        watchdog=0.1,
        half_step=True,
        motion=None,
        **settings,
    ):
        self.folder, self.half_step = folder, half_step
        types = [motor_type] * n_joints
        joints = damiao_joints(types, n_joints)
        path = folder / "damiao_trajectory.csv"
        export_damiao_trajectory([motion or swing(n_joints)], types, path)
        self.motors = [simulated_motor(j.spec, j.can_id, j.master_id, watchdog) for j in joints]
        plant = Pendulums(n_joints, start)
        self.arm = SimulatedArm(plant, [*self.motors, *extra_motors], faults)
        self.clock = SimulatedClock()
        self.bus = SimulatedLink(self.clock, self.arm, timing, echo)
        fd = bool(timing and timing.fd)
        self.link = GuardedLink(self.bus, self.clock.now, fd, self._observe)
        kp, kd = default_gains([j.spec for j in joints])
        kp, kd = settings.pop("kp", kp), settings.pop("kd", kd)
        self.settings = PlaySettings(
            kp, kd, **{"ramp_time": 0.3, "approach_time": 0.3, "rest_time": 0.1, **settings}
        )
        self.plan = make_plan(
            read_damiao_trajectory(path), self.settings, timing or BusTiming(),
            allowed or Permissions(), half_step,
        )  # fmt: skip
        self.stop = StopRequest()
        self.hooks = {}
        self.phases, self.phase_times, self.playing = [], [], False
        self.frames, self.play_frames = [], []
        self.error = self.report = None

    @property
    def record_path(self):
        return self.folder / "measured.csv"

    def _observe(self, frame, sent):
        self.frames.append((frame, sent))
        if self.playing and not sent:
            self.play_frames.append(frame)

    def _phase(self, sentence):
        self.phases.append(sentence)
        self.phase_times.append((sentence, self.clock.now()))
        self.playing = sentence.startswith("playing")
        for words, hook in self.hooks.items():
            if sentence.startswith(words):
                hook(self)

    def during(self, phase, after, action):
        """Call action(rig) some seconds after a phase has begun."""

        def hang(rig):
            rig.clock.at(rig.clock.now() + after, lambda: action(rig))

        self.hooks[phase] = hang
        return self

    def look(self):
        return look(self.link, self.clock, self.plan)

    def run(self, settle=0.5):
        """Look, play, record; keep error or report; then let the arm be for a while."""
        inspection, self.findings = self.look()
        try:
            self.report = perform(
                self.link, self.clock, self.plan, inspection, self.stop,
                RecordingChoice(self.record_path), Audience(self._phase),
            )  # fmt: skip
        except Exception as error:
            self.error = error
        self.playing = False
        self.disabled_at = self.clock.now()
        self.arm.advance(self.clock.now() + settle)
        return self

    @property
    def recording(self):
        return read_recording(self.record_path)

    def states(self):
        return [motor.status for motor in self.arm.motors]

    def assert_never_moved(self):
        """No motor was ever enabled or commanded, and none was written to."""
        assert self.states() == self.states_before
        assert all(motor.commands_seen == 0 for motor in self.arm.motors)

    def assert_stopped(self, cause, states=None):
        """The run ended with this cause, all motors in these states, nothing harmful was sent."""
        assert self.error is not None and cause in str(self.error), self.error
        assert "\n" not in str(self.error)
        expected = [DISABLED] * len(self.arm.motors)
        for joint, code in (states or {}).items():
            expected[joint] = code
        assert self.states() == expected
        assert not any(m.was_zeroed or m.was_stored for m in self.arm.motors)

    def assert_nothing_lost(self):
        """Every reply that arrived while the trajectory played is in the recording."""
        recording = self.recording
        positions = recording.joint_values("pos")
        for j, joint in enumerate(self.plan.trajectory.joints):
            arrived = [f for f in self.play_frames if f.id == joint.master_id and not f.error]
            assert np.count_nonzero(np.isfinite(positions[:, j])) == len(arrived)
        return recording

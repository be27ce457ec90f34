"""Whole runs of arms' models on simulated motors, in simulated time, with a fault in them.

Each run is compared with an undisturbed one of the same set-up: ``departure`` says how far a joint
got from the path that it would have taken.
"""

from __future__ import annotations

import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from rigs.clocks import ScriptedClock
from rigs.damaged_links import FaultyLink
from rigs.damiao_rig import BIT_RATE, motor, trajectory_file
from rigs.faulty_arm import FaultyArm
from rigs.places import GUESS, TRUTH
from rigs.wrong_arms import resting_torque
from robot_sysid.damiao.bus import GuardedLink, inspect_bus
from robot_sysid.damiao.execution import run as play_plan
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.model_check import gravity_check
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.references import file_holding
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.damiao.simulated import SimulatedLink
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.simulation.plant import ArmStepper

PHYSICS_STEP = 1e-3
DURATION = 5.0
FILE_RATE = 250.0
OBSERVED = 1.0
"""How long after a stop begins it is observed [s]; the motors may be disabled before."""
LATER = 0.1
"""From when on after a stop begins joints have lost the speed that they had then [s]."""
WINDOW_BEFORE = 0.1
WINDOW_AFTER = 0.5
"""Which part of the undisturbed path a joint may be on: around the stop [s]."""
FASTEST_CLASSIC = 250.0
"""Highest rate at which seven motors fit onto a classic CAN bus [Hz]."""
CLEAN_MARGIN = 1.0
"""How long after the last case can end the undisturbed run goes on [s]."""
MOTOR_TYPES = ["DM8009", "DM10010L", "DM8009", "DM8009", "DM4340", "DM4340", "DM4340"]
"""Types of the motors of the Kinova arm, base to terminal."""
SHOULDER_LOAD = 20.0, 33.0
"""Least and most gravity on the most loaded joint in poses that count as loaded [N m]."""


@dataclass(frozen=True)
class SetUp:
    """What the Kinova arm plays, and what the player knows about it.

    Attributes:
        belief: "truth" or "guess": the model whose torques are in the file.
        model_is_given: whether the player has that model too.
        park: where the arm is left; None where it ends.
        kp: stiffness of all joints [N m/rad]; None: by motor type.
        pose: number of the loaded pose around which it moves.
        stands: whether the trajectory stands still in that pose.
    """

    belief: str = "guess"
    model_is_given: bool = True
    park: str | None = None
    rate: float = 250.0
    kp: float | None = None
    pose: int = 0
    stands: bool = False
    duration: float = DURATION

    @property
    def timing(self):
        """Bit rates of the bus: CAN-FD where classic CAN would be full."""
        return BusTiming(fd=self.rate > FASTEST_CLASSIC)

    @property
    def watchdog(self):
        """What the motors' watchdogs are set to [s]: ten cycles at least."""
        return max(0.1, 10.0 / self.rate)

    def __str__(self):
        model = self.belief if self.model_is_given else f"none ({self.belief} fed)"
        park = f", park {self.park}" if self.park else ""
        stiffness = f", kp {self.kp:g}" if self.kp else ""
        pose = f", pose {self.pose}" if self.pose else ""
        return f"model {model}, {self.rate:g} Hz{park}{stiffness}{pose}"


@cache
def robot_of(belief):
    """Return the model of the arm as it really is ("truth"), or as its user has it ("guess")."""
    return load_robot_model(TRUTH if belief == "truth" else GUESS)


@cache
def loaded_poses(count=5):
    """Return poses (count, n) in which gravity loads the arm's shoulder [rad]."""
    robot = robot_of("truth")
    least, greatest = SHOULDER_LOAD
    lower = np.maximum(robot.limits.lower, -1.8) + 0.6
    upper = np.minimum(robot.limits.upper, 1.8) - 0.6
    q = np.random.default_rng(7).uniform(lower, upper, (4000, robot.n_joints))
    load = np.max(np.abs(resting_torque(robot, q, robot.thetas)), axis=1)
    return q[(load > least) & (load < greatest)][:count]


def loaded_joint(setup):
    """Return the joint on which gravity pulls most in a set-up's pose."""
    robot = robot_of("truth")
    pose = loaded_poses()[setup.pose][None]
    return int(np.argmax(np.abs(resting_torque(robot, pose, robot.thetas))))


def multi_sine(pose, seed, duration, rate=FILE_RATE):
    """Return a smooth motion from rest to rest around a pose: time, q, qd, qdd."""
    random = np.random.default_rng(seed)
    t = np.arange(round(duration * rate) + 1)[:, None] / rate
    fade, fade_rate, fade_acceleration = _fade(t, duration)
    n = len(pose)
    s = np.zeros((3, len(t), n))
    for frequency in (0.25, 0.45):
        omega = 2.0 * np.pi * frequency * random.uniform(0.9, 1.1, n)
        phase = random.uniform(0.0, 2.0 * np.pi, n)
        s[0] += np.sin(omega * t + phase)
        s[1] += omega * np.cos(omega * t + phase)
        s[2] -= omega**2 * np.sin(omega * t + phase)
    q = fade * s[0]
    qd = fade_rate * s[0] + fade * s[1]
    qdd = fade_acceleration * s[0] + 2.0 * fade_rate * s[1] + fade * s[2]
    amplitude = random.uniform(0.3, 0.6, n)
    scale = np.minimum(amplitude / np.abs(q).max(axis=0), 1.0 / np.abs(qd).max(axis=0))
    return t[:, 0], pose + scale * q, scale * qd, scale * qdd


def _fade(t, duration, length=1.0):
    """Return a quintic fade in and out (N, 1), its rate and its acceleration."""
    left = np.minimum(t, duration - t) / length
    sign = np.where(t < 0.5 * duration, 1.0, -1.0)
    s = np.clip(left, 0.0, 1.0)
    fade = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    rate = sign * 30.0 * s**2 * (1.0 - s) ** 2 / length
    acceleration = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / length**2
    return fade, rate, acceleration


@cache
def exported_trajectory(setup):
    """Return a set-up's trajectory as the player reads it from the exported file."""
    pose = loaded_poses()[setup.pose]
    time_, q, qd, qdd = multi_sine(pose, seed=3, duration=setup.duration)
    if setup.stands:
        q = np.tile(pose, (len(time_), 1))
        qd = np.zeros_like(q)
        qdd = np.zeros_like(q)
    robot = robot_of(setup.belief)
    tau = np.asarray(ArmDynamics(robot)(Motion(time_, q, qd, qdd)))
    with tempfile.TemporaryDirectory() as folder:
        return trajectory_file(Path(folder), (time_, q, qd, tau), *MOTOR_TYPES)


@cache
def plan_of(setup):
    """Return the plan of a set-up, with the inertias of the model if there is one."""
    trajectory = exported_trajectory(setup)
    robot = robot_of(setup.belief)
    names = robot.joint_names
    mobility = None
    if setup.model_is_given:
        joints = damiao_joints(MOTOR_TYPES, robot.n_joints, names=names)
        trajectory = replace(trajectory, joints=joints)
        mobility = ArmStepper(robot, trajectory.q[0]).mobility()
    stiffness = {} if setup.kp is None else {"kp": (setup.kp,)}
    settings = PlaySettings(rate=setup.rate, park=setup.park, **stiffness)
    return Plan(trajectory, settings, setup.timing, mobility=mobility)


@dataclass
class RunRecord:
    """What a run did from its onset on.

    Times are in the run's clock [s]; ``stop_at`` and ``disabled_at`` are None where there was none.
    ``energy`` has a row of time and mechanical energy [s, J] for every 20th step.
    """

    onset: float
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    energy: np.ndarray
    commands: list[np.ndarray]
    phases: list[tuple[float, str]]
    stop_at: float | None
    disabled_at: float | None
    error: str
    was_ended: bool


@dataclass(frozen=True)
class Case:
    """A fault in a run.

    Attributes:
        cause: what lets it happen; is called with the run.
        phase: the phase in which it does; "" at the very beginning.
        after: when, after the phase has begun [s].
        patience: how long after that a run that nothing stops is ended [s]; None plays on.
        joint: the joint at fault, where it is one's.
    """

    name: str
    setup: SetUp
    cause: Callable[[BenchRun], None]
    phase: str = "playing"
    after: float = 1.5
    patience: float | None = None
    joint: int | None = None


class BenchRun:
    """One run of a set-up; causes reach motors, arm, link and clock through it.

    Each case goes on in a process of its own from where its fault begins, so that what comes before
    is computed once; the run itself stays undisturbed.
    """

    def __init__(self, setup, cases=(), folder=None, jobs=2):
        self.setup = setup
        self.plan = plan_of(setup)
        self.clock = ScriptedClock()
        joints = self.plan.trajectory.joints
        self.motors = [motor(joint, setup.watchdog) for joint in joints]
        first = self.plan.trajectory.q[0]
        toward_start = np.where(np.arange(len(first)) % 2, 0.1, -0.1)
        start = first if setup.stands else first + toward_start
        mechanism = ArmStepper(robot_of("truth"), start, PHYSICS_STEP)
        self.arm = FaultyArm(mechanism, self.motors)
        for played in self.motors:
            played.registers[BIT_RATE] = 9.0 if setup.timing.fd else 4.0
        wire = SimulatedLink(self.clock, self.arm, setup.timing, echo=True)
        self.link = FaultyLink(wire, self.clock, joints)
        self.stop = StopRequest()
        self.phases = []
        self.stop_at = None
        self.was_ended = False
        self._cases = dict(enumerate(cases))
        patience = [
            np.inf if case.patience is None else case.patience for case in cases
        ]
        self._patience = max(patience, default=np.inf)
        self._folder = folder
        self._jobs = jobs
        self._children = set()
        self._case_number = None
        self._onset = 0.0

    def at(self, delay, action):
        """Do something some time [s] from now."""
        self.clock.at(self.clock.now() + delay, action)

    def play(self):
        """Play the plan; return the undisturbed record and those of the cases, by their number."""
        self._branch_in("")
        record = self._record(self._played())
        if self._case_number is not None:
            (self._folder / f"{self._case_number}.pickle").write_bytes(
                pickle.dumps(record)
            )
            os._exit(0)
        while self._children:
            self._wait_for_one()
        return record, self._case_records()

    def _case_records(self):
        paths = [] if self._folder is None else self._folder.glob("*.pickle")
        return {int(path.stem): pickle.loads(path.read_bytes()) for path in paths}

    def _branch_in(self, phase):
        """Let the cases of a phase that has just begun, or of the very beginning, branch off."""
        for number, case in self._cases.items():
            begins = phase.startswith(case.phase) if case.phase else not phase
            if begins:
                self.at(case.after, partial(self._branch, number, case))

    def _branch(self, number, case):
        """Go on undisturbed here, and with a case's fault in a new process."""
        if self._case_number is not None:
            return
        while len(self._children) >= self._jobs:
            self._wait_for_one()
        sys.stdout.flush()
        child = os.fork()
        if child:
            self._children.add(child)
            del self._cases[number]
            if not self._cases:
                self.at(self._patience + CLEAN_MARGIN, self._end)
            return
        self._case_number = number
        self._onset = self.clock.now()
        case.cause(self)
        if case.patience is not None:
            self.at(case.patience, self._end)

    def _wait_for_one(self):
        child, _ = os.wait()
        self._children.discard(child)

    def _record(self, error):
        if self.link.damage is not None:
            error = "Error: no frame was damaged"
        self.arm.advance(self.clock.now() + 0.05)
        times, q, qd = map(np.array, zip(*self.arm.truth))
        since = np.searchsorted(times, self._onset - 0.01)
        energy = self.arm.energy(q[since::20], qd[since::20])
        return RunRecord(
            self._onset,
            times[since:],
            q[since:],
            qd[since:],
            np.column_stack([times[since::20], energy]),
            self.link.command_paths(),
            self.phases,
            self.stop_at,
            self.link.disabled_at,
            error,
            self.was_ended,
        )

    def _played(self):
        guarded = GuardedLink(self.link, self.clock, self.setup.timing.fd)
        holding = file_holding(self.plan.trajectory)
        if self.setup.model_is_given:
            robot = robot_of(self.setup.belief)
            holding = gravity_check(robot, self.plan.trajectory.joints)
        try:
            inspection = inspect_bus(guarded)
            play_plan(
                guarded, self.plan, inspection, self.stop, self._note_phase, holding
            )
        except SysidError as error:
            return str(error)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        return ""

    def _note_phase(self, name):
        now = self.clock.now()
        self.phases.append((now, name))
        if name.startswith("stopping") and self.stop_at is None and not self.was_ended:
            self.stop_at = now
            # Lowering an arm takes up to 20 s, of which nothing is measured.
            self.clock.at(now + OBSERVED + 0.2, self._insist)
        if self._case_number is None:
            self._branch_in(name)

    def _end(self):
        if self.stop_at is None:
            self.was_ended = True
            self.stop("ended by the bench", insist=True)

    def _insist(self):
        self.stop("ended by the bench", insist=True)


def outcomes_of(cases, jobs=2):
    """Yield the outcomes of cases, set-up by set-up."""
    setups = dict.fromkeys(case.setup for case in cases)
    for setup in setups:
        setup_cases = [case for case in cases if case.setup == setup]
        with tempfile.TemporaryDirectory() as folder:
            clean, records = BenchRun(setup, setup_cases, Path(folder), jobs).play()
        for number, case in enumerate(setup_cases):
            if number in records:
                yield judged_outcome(case, records[number], clean)
            else:
                print(
                    f"{case.name}: phase {case.phase!r} never began, or the run crashed"
                )


def _path_hull(clean, begin, end):
    """Return the least and the greatest position (n,) of a clean run between two moments [s].

    Both the true and the commanded positions count: a joint sags below its command.
    """
    inside = (clean.time >= begin) & (clean.time <= end)
    q = clean.q[inside] if np.any(inside) else clean.q[-1:]
    lower = q.min(axis=0)
    upper = q.max(axis=0)
    for joint_index, (times, positions) in enumerate(clean.commands):
        commanded = positions[(times >= begin) & (times <= end)]
        if len(commanded):
            lower[joint_index] = min(lower[joint_index], commanded.min())
            upper[joint_index] = max(upper[joint_index], commanded.max())
    return lower, upper


def _beyond(q, lower, upper):
    """Return how far positions (..., n) are outside of an interval [rad]."""
    return np.maximum(np.maximum(lower - q, q - upper), 0.0)


@dataclass(frozen=True)
class Outcome:
    """What came of a fault.

    Attributes:
        departure: farthest that a joint was from the undisturbed run's path, from the onset until
            a second after the stop began, while motors were enabled [rad].
        others_departure: the same of the joints that are not at fault: where a motor has lost its
            supply, no software keeps its own joint.
        fall: farthest of the joint at fault, if one is named, else of all, after the stop began
            from where it was then [rad]; ``others_fall`` of the other joints.
        others_speed: greatest speed of the other joints after the stop began [rad/s];
            ``others_later_speed`` later than ``LATER`` after that.
        energy_gain: most that the mechanical energy rose after the stop began [J].
        stop_delay: from the onset to the beginning of the stop [s]; None without a stop.
        ending: "stopped", "completed", "refused" (before anything moved) or "ended" by the bench.
    """

    name: str
    setup: SetUp
    phase: str
    departure: float
    others_departure: float
    fall: float
    others_fall: float
    others_speed: float
    others_later_speed: float
    energy_gain: float
    stop_delay: float | None
    ending: str
    words: str

    def line(self):
        """Return a line for people."""
        delay = "   -  " if self.stop_delay is None else f"{self.stop_delay:6.3f}"
        return (
            f"{self.name:34.34s} {self.phase[:10]:10s} {self.departure:6.3f} rad {delay} s "
            f"{self.ending:9s} {self.words[:90]}  [{self.setup}]"
        )


def _phase_at(record, moment):
    names = [name for begin, name in record.phases if begin <= moment]
    return names[-1] if names else "before"


def _clean_span(record, clean, begin, end):
    """Return from when to when the clean run was where it would be between two moments [s].

    A fault may make earlier phases longer, so time counts from the beginning of a phase; where the
    phase itself has another length, all of it counts.
    """
    begun = [(moment, name) for moment, name in record.phases if moment <= begin]
    phases = [
        (moment, name) for moment, name in begun if not name.startswith("stopping")
    ]
    if not phases:
        return begin, end
    phase_begin, phase_text = phases[-1]
    name = phase_text.split(" (")[0]
    moments = [moment for moment, _ in clean.phases] + [clean.time[-1]]
    for number, (moment, text) in enumerate(clean.phases):
        if text == phase_text:
            return begin - phase_begin + moment, end - phase_begin + moment
        if text.startswith(name):
            return moment, moments[number + 1]
    return begin, end


def _departures(record, clean, onset, until):
    """Return the departure (n,) of each joint between the onset and a moment [rad]."""
    stop_at = np.inf if record.stop_at is None else record.stop_at
    departure = np.zeros(record.q.shape[1])
    step = 0.02
    for begin in np.arange(onset, min(stop_at, until), step):
        inside = (record.time >= begin) & (
            record.time < min(begin + step, stop_at, until)
        )
        if np.any(inside):
            clean_begin, clean_end = _clean_span(record, clean, begin, begin + step)
            hull = _path_hull(
                clean, clean_begin - WINDOW_BEFORE, clean_end + WINDOW_BEFORE
            )
            departure = np.maximum(
                departure, _beyond(record.q[inside], *hull).max(axis=0)
            )
    inside = (record.time >= stop_at) & (record.time <= until)
    if np.any(inside):
        clean_begin, clean_end = _clean_span(record, clean, stop_at, stop_at)
        hull = _path_hull(clean, clean_begin - WINDOW_BEFORE, clean_end + WINDOW_AFTER)
        departure = np.maximum(departure, _beyond(record.q[inside], *hull).max(axis=0))
    return departure


def _ending(record):
    if record.was_ended:
        return "ended"
    if record.stop_at is not None:
        return "stopped"
    return "refused" if record.error else "completed"


def judged_outcome(case, record, clean):
    """Return what came of a case, by its record and that of the undisturbed run."""
    # The player stops at errors of the bench, too.
    assert "Error: " not in record.error, record.error
    onset = record.onset
    stop_at = record.stop_at
    last = record.time[-1] if record.disabled_at is None else record.disabled_at
    until = last if stop_at is None else min(last, stop_at + OBSERVED)
    departure = _departures(record, clean, onset, until)
    distance, speed, later_speed, gain = _motion_after_stop(record, until)
    is_other = np.arange(len(distance)) != case.joint
    return Outcome(
        name=case.name,
        setup=case.setup,
        phase=_phase_at(record, onset),
        departure=float(departure.max()),
        others_departure=float(departure[is_other].max()),
        fall=float(distance.max() if case.joint is None else distance[case.joint]),
        others_fall=float(distance[is_other].max()),
        others_speed=float(speed[is_other].max()),
        others_later_speed=float(later_speed[is_other].max()),
        energy_gain=gain,
        stop_delay=None if stop_at is None else stop_at - onset,
        ending=_ending(record),
        words=record.error,
    )


def _motion_after_stop(record, until):
    """Return how far, how fast, and later how fast joints got after the stop, each (n,), and the
    energy gained.
    """
    n = record.q.shape[1]
    stop_at = np.inf if record.stop_at is None else record.stop_at
    inside = (record.time >= stop_at) & (record.time <= until)
    if not np.any(inside):
        return np.zeros(n), np.zeros(n), np.zeros(n), 0.0
    q = record.q[inside]
    distance = np.abs(q - q[0]).max(axis=0)
    speed = np.abs(record.qd[inside])
    later_speed = speed[record.time[inside] >= stop_at + LATER].max(axis=0, initial=0.0)
    times, energy = record.energy.T
    total = energy[(times >= stop_at - 0.02) & (times <= until)]
    return distance, speed.max(axis=0), later_speed, float(np.max(total) - total[0])

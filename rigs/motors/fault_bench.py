"""Whole runs of an arm's model on simulated motors, in simulated time, with a fault in them.

Each run is compared with an undisturbed one of the same set-up: ``departure`` says how far a joint
got from the path that it would have taken. The table of incidents (``rigs.motors.incidents``) says
how far joints may get, and what has to be said; benchmarks/motors/motor_faults.md shows what
``benchmarks/motors/motor_faults.py`` makes of it.
"""

from __future__ import annotations

import itertools
import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import mujoco
import numpy as np

from rigs.arms.wrong_arms import resting_torque
from rigs.files.places import GUESS, TRUTH
from rigs.motors.damiao_rig import Damage, MotorRun, fault, trajectory_of
from rigs.motors.motor_causes import JAMMED, lost_motor
from robot_sysid.damiao import protocol
from robot_sysid.damiao.checks.model import with_weight_of
from robot_sysid.damiao.joints import motor_spec
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.safety.holding import gravity_holding
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.trajectory import SineTrajectory

PHYSICS_STEP = 1e-3
DURATION = 5.0
FILE_RATE = 250.0
OBSERVED = 1.0
"""How long after a stop begins it is observed [s]; the motors may be disabled before."""
LATER = 0.1
"""From when on after a stop begins joints have lost the speed that they had then [s]."""
AT_END = 5e-3
"""How near a joint is to its stop in a step in which it rebounds from that [rad]: it goes so far in
a step at 5 rad/s."""
STEP = 0.02
WINDOW_BEFORE = 0.1
WINDOW_AFTER = 0.5
"""Which part of the undisturbed path a joint may be on: around each step, and the stop [s]."""
FASTEST_CLASSIC = 250.0
"""Highest rate at which seven motors fit onto a classic CAN bus [Hz]."""
CLEAN_MARGIN = 1.0
"""How long after the last case can end the undisturbed run goes on [s]."""
MOTOR_TYPES = ["DM8009", "DM10010L", "DM8009", "DM8009", "DM4340", "DM4340", "DM4340"]
"""Types of the motors of the Kinova arm, base to terminal."""
SHOULDERS = {"DM10010L": (20.0, 33.0), "DM8009": (20.0, 33.0), "DM4340": (12.4, 12.8)}
"""Motors of the shoulder: least and most gravity on it in poses that count as loaded [N m]."""
SHOULDER = 1


@dataclass(frozen=True)
class SetUp:
    """What the Kinova arm plays, and what the player knows about it.

    Attributes:
        belief: "truth" or "guess": the model whose torques are in the file.
        model_is_given: whether the player has that model too.
        park: where the arm is left; None where it ends.
        kp: stiffness of all joints [N m/rad]; None: by motor type.
        shoulder: type of the motor of the loaded joint.
        pose: number of the loaded pose around which it moves.
        stands: whether the trajectory stands still in that pose.
    """

    belief: str = "guess"
    model_is_given: bool = True
    park: str | None = None
    rate: float = 250.0
    kp: float | None = None
    shoulder: str = MOTOR_TYPES[SHOULDER]
    pose: int = 0
    stands: bool = False
    duration: float = DURATION

    @property
    def motor_types(self):
        """Types of the motors, base to terminal."""
        return [*MOTOR_TYPES[:SHOULDER], self.shoulder, *MOTOR_TYPES[SHOULDER + 1 :]]

    @property
    def watchdog(self):
        """What the motors' watchdogs are set to [s]: ten cycles at least."""
        return max(0.1, 10.0 / self.rate)

    @property
    def robot(self):
        """The model of the arm that the player has, if any."""
        return robot_of(self.belief)

    def plan(self):
        """Return the plan of the run."""
        return plan_of(self)

    def mechanism(self, q):
        """Return the arm as it is, at rest at q (n,) [rad]."""
        return ArmStepper(robot_of("truth"), q, PHYSICS_STEP)

    def prepare(self, run):
        """Make motors as they are before a run, which are sound here."""


@cache
def robot_of(belief):
    """Return the model of the arm as it really is ("truth"), or as its user has it ("guess")."""
    return load_robot_model(TRUTH if belief == "truth" else GUESS)


@cache
def loaded_poses(shoulder, count=5):
    """Return poses (count, n) [rad] that load the arm's shoulder as its motor's type can hold."""
    robot = robot_of("truth")
    least, greatest = SHOULDERS[shoulder]
    lower = np.maximum(robot.limits.lower, -1.8) + 0.6
    upper = np.minimum(robot.limits.upper, 1.8) - 0.6
    q = np.random.default_rng(7).uniform(lower, upper, (4000, robot.n_joints))
    gravity = np.abs(resting_torque(robot, q, robot.thetas))
    weight = gravity[:, SHOULDER]
    is_most_loaded = np.argmax(gravity, axis=1) == SHOULDER
    return q[is_most_loaded & (least < weight) & (weight < greatest)][:count]


def load_of(setup):
    """Return gravity's torque on the shoulder in a set-up's pose [N m]."""
    robot = robot_of("truth")
    pose = loaded_poses(setup.shoulder)[setup.pose][None]
    return abs(resting_torque(robot, pose, robot.thetas)[0, SHOULDER])


def multi_sine(pose, duration, stands=False):
    """Return a smooth motion from rest to rest around a pose, or one that stands there."""
    random = np.random.default_rng(3)
    share, turn = random.uniform(size=(2, 2, len(pose))).transpose(1, 2, 0)
    frequency = np.array([0.25, 0.45]) * (0.9 + 0.2 * share)
    shape = pose, np.ones_like(turn), frequency, 2.0 * np.pi * turn
    waves = SineTrajectory(*shape, duration, fade=min(1.25, 0.5 * duration))
    time = np.arange(round(duration * FILE_RATE) + 1) / FILE_RATE
    motion = waves.evaluate(time)
    amplitude = random.uniform(0.3, 0.6, len(pose)) * (not stands)
    speed = np.abs(motion.qd).max(axis=0)
    size = np.minimum(amplitude / np.abs(motion.q - pose).max(axis=0), 1.0 / speed)
    return waves.scale_amplitudes(size).evaluate(time)


@cache
def plan_of(setup):
    """Return the plan of a set-up, with the inertias of the model if there is one."""
    robot = robot_of(setup.belief)
    pose = loaded_poses(setup.shoulder)[setup.pose]
    motion = multi_sine(pose, setup.duration, setup.stands)
    tau = np.asarray(ArmDynamics(robot)(motion))
    return plan_with(setup, robot, motion, tau, setup.motor_types)


def plan_with(setup, robot, motion, tau, types):
    """Return the plan of a set-up for a motion, its torque (N, n) [N m] and the motors' types."""
    names = robot.joint_names if setup.model_is_given else ()
    signals = motion.time, motion.q, motion.qd, tau
    trajectory = with_weight_of(robot, trajectory_of(signals, *types, names=names))
    if not setup.model_is_given:
        # As the file beside a planned trajectory has it.
        trajectory = replace(trajectory, weight_error=None)
    stiffness = () if setup.kp is None else (setup.kp,)
    settings = PlaySettings(rate=setup.rate, park=setup.park, kp=stiffness)
    timing = BusTiming(fd=setup.rate > FASTEST_CLASSIC)
    mobility = None
    if setup.model_is_given:
        mobility = ArmStepper(robot, trajectory.q[0]).mobility()
    return Plan(trajectory, settings, timing, mobility=mobility)


@dataclass
class RunRecord:
    """What a run did from its onset on.

    Times are in the run's clock [s]; where there was none, ``stop_at`` is None and ``disabled_at``
    infinite.
    ``energy`` has a row of time and mechanical energy [s, J] for every 20th step.
    """

    onset: float
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    energy: np.ndarray
    phases: list[tuple[float, str]]
    stop_at: float | None
    disabled_at: float
    error: str
    was_ended: bool


@dataclass(frozen=True)
class Case:
    """A fault in a run, the greatest departure that it may cause [rad], and what has to be said.

    Attributes:
        cause: what lets it happen; is called with the run.
        words: of the message.
        bound: on ``quantity``, a figure of ``Outcome``: where a motor does not drive any more, that
            of the other joints.
        phase: the phase in which it happens; "" at the very beginning.
        after: when, after the phase has begun [s].
        patience: how long after that a run that nothing stops is ended [s]; None plays on. It is
            the same for all cases of a set-up.
        endings: ways in which its run may end, see ``Outcome``.
    """

    name: str
    cause: Callable[[BenchRun], object]
    words: str = ""
    bound: float = 0.15
    quantity: str = "departure"
    setup: SetUp = SetUp()
    phase: str = "playing"
    after: float = 1.5
    patience: float | None = None
    endings: tuple[str, ...] = ("stopped",)

    @property
    def joint(self):
        """The joint at fault, where it is one's."""
        return getattr(self.cause, "joint", None)


def energy_of(mechanism, q, qd):
    """Return the mechanical energy (N,) [J] of an arm at positions and velocities (N, n)."""
    robot = mechanism.robot
    model = mechanism.model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.reference_qpos
    energy = []
    for position, velocity in zip(q, qd):
        data.qpos[robot.qpos_index] = position
        data.qvel[robot.dof_index] = velocity
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        energy.append(data.energy.sum())
    return np.array(energy)


class BenchRun(MotorRun):
    """One run of a set-up; causes reach motors, arm, bus and clock through it.

    Each case goes on in a process of its own from where its fault begins, so that what comes before
    is computed once; the run itself stays undisturbed.

    Attributes:
        onset: when what counts begins [s]; before a case's fault, 0.
    """

    def __init__(self, setup, cases=(), folder=None, jobs=2):
        plan = setup.plan()
        first = plan.trajectory.q[0]
        toward_start = np.where(np.arange(len(first)) % 2, 0.1, -0.1)
        start = first if setup.stands else first + toward_start
        mechanism = setup.mechanism(start)
        super().__init__(plan, mechanism, watchdog=setup.watchdog, echo=True)
        self.arm.takes_whole_steps = True
        setup.prepare(self)
        if setup.model_is_given:
            self.holding = gravity_holding(setup.robot, plan.trajectory.joints)
        self.stop_at = None
        self.was_ended = False
        self._cases = dict(enumerate(cases))
        self._folder = folder
        self._jobs = jobs
        self._children = set()
        self._case_number = None
        self.onset = 0.0

    def play(self):
        """Play the plan; return the undisturbed record and those of the cases, by their number."""
        for number, case in self._cases.items():
            branch = partial(self._branch, number, case)
            if case.phase:
                self.during(case.phase, case.after, branch)
            else:
                self.at(case.after, partial(branch, self))
        self.run(settle=0.05)
        record = self._record()
        if self._case_number is not None:
            self._path_of(self._case_number).write_bytes(pickle.dumps(record))
            os._exit(0)
        while self._children:
            self._wait_for_one()
        return record

    def _path_of(self, number):
        return self._folder / f"{number}.pickle"

    def record_of(self, number):
        """Return the record of a case."""
        return pickle.loads(self._path_of(number).read_bytes())

    def _branch(self, number, case, run):
        """Go on undisturbed here, and with a case's fault in a new process."""
        if self._case_number is not None:
            return
        while len(self._children) >= self._jobs:
            self._wait_for_one()
        sys.stdout.flush()
        child = os.fork()
        if child:
            self._children.add(child)
            self._cases.pop(number)
            if not self._cases and case.patience is not None:
                self.at(case.patience + CLEAN_MARGIN, self._end)
            return
        self._case_number = number
        self.onset = self.clock.now()
        case.cause(self)
        if case.patience is not None:
            self.at(case.patience, self._end)

    def _wait_for_one(self):
        child, _ = os.wait()
        self._children.discard(child)

    def _record(self):
        error = str(self.error or "")
        if self.bus.damage is not None:
            error = "Error: no frame was damaged"
        times, q, qd = map(np.array, zip(*self.arm.truth))
        since = np.searchsorted(times, self.onset - 0.01)
        energy = energy_of(self.arm.mechanism, q[since::20], qd[since::20])
        disable = protocol.special_frame(protocol.DISABLE, 0).data
        disabled = [frame.time for frame in self.wire.sent if frame.data == disable]
        return RunRecord(
            self.onset,
            times[since:],
            q[since:],
            qd[since:],
            np.column_stack([times[since::20], energy]),
            self.phases,
            self.stop_at,
            min([*disabled, self.arm.off_at]),
            error,
            self.was_ended,
        )

    def note_phase(self, sentence):
        super().note_phase(sentence)
        if (
            sentence.startswith("stopping")
            and self.stop_at is None
            and not self.was_ended
        ):
            self.stop_at = self.clock.now()
            # Lowering an arm takes up to 20 s, of which nothing is measured.
            self.at(OBSERVED + 0.2, self._insist)

    def _end(self):
        if self.stop_at is None:
            self.was_ended = True
            self._insist()

    def _insist(self):
        self.stop("ended by the bench", insist=True)


def outcomes_of(cases, jobs=2):
    """Yield the outcomes of cases, set-up by set-up."""
    for setup in dict.fromkeys(case.setup for case in cases):
        setup_cases = [case for case in cases if case.setup == setup]
        with tempfile.TemporaryDirectory() as folder:
            run = BenchRun(setup, setup_cases, Path(folder), jobs)
            clean = run.play()
            for number, case in enumerate(setup_cases):
                yield judge_outcome(case, run.record_of(number), clean)


@dataclass(frozen=True)
class Outcome:
    """What came of a fault.

    Attributes:
        figures: those of ``_other_ends``, and greatest values of all joints; "own ..." is that of
            the joint at fault, if one is named, and "others ..." that of the other ones: where a
            motor has lost its supply, no software keeps its own joint. "departure" is the distance
            from the undisturbed run's path, from the onset until a second after the stop began,
            while motors were enabled [rad]; "fall" that after the stop began from where it was then
            [rad]; "speed" that after the stop began, "later speed" later than ``LATER`` after that
            [rad/s].
        energy_gain: most that the mechanical energy rose after the stop began [J].
        stop_delay: from the onset to the beginning of the stop [s]; None without a stop.
        ending: "stopped", "completed", "refused" (before anything moved) or "ended" by the bench.
    """

    name: str
    setup: SetUp
    phase: str
    figures: dict[str, float]
    energy_gain: float
    stop_delay: float | None
    ending: str
    words: str


def _clean_span(record, clean, begin, end):
    """Return from when to when the clean run was where it would be between two moments [s].

    A fault may make earlier phases longer, so time counts from the beginning of a phase; where the
    phase itself has another length, all of it counts.
    """
    phases = [
        (since, text)
        for since, text in record.phases
        if since <= end and not text.startswith("stopping")
    ]
    if not phases:
        return begin, end
    since, text = phases[-1]
    clean_ends = [moment for moment, _ in clean.phases[1:]] + [clean.time[-1]]
    for (clean_since, clean_text), clean_end in zip(clean.phases, clean_ends):
        if clean_text == text:
            return begin - since + clean_since, end - since + clean_since
        if clean_text.startswith(text.split(" (")[0]):
            return clean_since, clean_end
    return begin, end


def departures(record, clean, until):
    """Return the departure (n,) of each joint between the onset and a moment [rad]."""
    stop_at = until if record.stop_at is None else record.stop_at
    steps = np.arange(record.onset, min(stop_at, until), STEP)
    windows = [(begin, begin + STEP, begin + STEP + WINDOW_BEFORE) for begin in steps]
    windows.append((stop_at, until + PHYSICS_STEP, stop_at + WINDOW_AFTER))
    departure = np.zeros(record.q.shape[1])
    for begin, end, ahead in windows:
        q = record.q[(record.time >= begin) & (record.time < end)]
        span = _clean_span(record, clean, begin - WINDOW_BEFORE, ahead)
        since, to = np.searchsorted(clean.time, span)
        path = clean.q[min(since, len(clean.q) - 1) : to + 1]
        beyond = np.maximum(path.min(axis=0) - q, q - path.max(axis=0))
        departure = np.maximum(departure, beyond.max(axis=0, initial=0.0))
    return departure


def _other_ends(case, record):
    """Return how far and how fast a weak motor's joint would get in two other stops.

    In the first its motor gives its most at once, while nothing else moves: how far it then gets
    until it stands, no stop by this motor can do better than [rad]. In the second all motors are
    disabled at once, and their windings brake [rad, rad/s]. Both last as long as what is observed.
    """
    share = getattr(case.cause, "values", {}).get("torque_share", 0.0)
    types = [motor_spec(name) for name in case.setup.motor_types]
    peak = np.array([spec.peak_torque for spec in types])
    joint = np.arange(len(peak)) == case.joint
    brake = np.where(joint, share, 1.0) * 0.5 * peak
    at_stop = np.searchsorted(record.time, record.stop_at)
    most = -np.sign(record.qd[at_stop]) * share * peak * joint
    ends = {}
    for name, torque, damping in (
        ("least", most, np.where(joint, 0.0, JAMMED)),
        ("disabled", 0.0 * peak, brake),
    ):
        arm = ArmStepper(robot_of("truth"), record.q[at_stop], PHYSICS_STEP)
        arm.qd = record.qd[at_stop].copy()
        speeds = []
        while len(speeds) * PHYSICS_STEP < OBSERVED:
            arm.step(torque, damping)
            speeds.append(np.abs(arm.qd[joint]).max(initial=0.0))
            if name == "least" and np.all(arm.qd * most >= 0.0):
                break
        fall = np.abs(arm.q - record.q[at_stop])[joint].max(initial=0.0)
        ends |= {f"{name} fall": float(fall), f"{name} speed": max(speeds)}
    return ends


def _hit_at(case, record):
    """Return until when a joint without a motor has not hit its stop, which throws others [s]."""
    limits = case.setup.robot.limits
    is_at_end = (record.q <= limits.lower + AT_END) | (
        record.q >= limits.upper - AT_END
    )
    is_hit = np.any(is_at_end, axis=1) & (
        getattr(case.cause, "values", {}).get("silent", False)
    )
    return min(record.time[is_hit] - 2.0 * PHYSICS_STEP, default=np.inf)


def _ending(record):
    if record.was_ended:
        return "ended"
    if record.stop_at is not None:
        return "stopped"
    return "refused" if record.error else "completed"


def judge_outcome(case, record, clean):
    """Return what came of a case, by its record and that of the undisturbed run."""
    # The player stops at errors of the bench, too.
    assert "Error: " not in record.error, record.error
    stop_at = np.inf if record.stop_at is None else record.stop_at
    ends = (
        record.disabled_at,
        record.time[-1],
        stop_at + OBSERVED,
        _hit_at(case, record),
    )
    until = min(ends)
    inside = (record.time >= stop_at) & (record.time <= until)
    is_later = inside & (record.time >= stop_at + LATER)
    q = record.q[inside]
    values = {
        "departure": departures(record, clean, until),
        "fall": np.abs(q - q[:1]).max(axis=0, initial=0.0),
        "speed": np.abs(record.qd[inside]).max(axis=0, initial=0.0),
        "later speed": np.abs(record.qd[is_later]).max(axis=0, initial=0.0),
    }
    is_other = np.arange(record.q.shape[1]) != case.joint
    is_hold = case.setup.stands and record.stop_at
    figures = _other_ends(case, record) if is_hold else {}
    for name, joint_values in values.items():
        figures[name] = float(joint_values.max())
        figures[f"others {name}"] = float(joint_values[is_other].max())
        figures[f"own {name}"] = float(joint_values[~is_other].max(initial=0.0))
    times, energy = record.energy.T
    energy = energy[(times >= stop_at - 0.02) & (times <= until)]
    phases = [text for begin, text in record.phases if begin <= record.onset]
    return Outcome(
        name=case.name,
        setup=case.setup,
        phase=["before", *phases][-1],
        figures=figures,
        energy_gain=float(np.max(energy - energy[:1], initial=0.0)),
        stop_delay=record.stop_at and record.stop_at - record.onset,
        ending=_ending(record),
        words=record.error,
    )


# --- damaged frames, and an arm that is held ------------------------------------------------------

DAMAGES = [
    *(("position", angle) for angle in (0.2, 0.78, 3.9)),
    *((name, bit) for name in ("velocity", "torque") for bit in (5, 8, 11)),
    *(("status", code) for code in (0x0, 0x9, 0xA, 0xD)),
    ("id nibble", "other"),
    ("id nibble", 0xF),
    ("arbitration id", "other"),
    ("arbitration id", 0x7A),
    ("text", "any"),
]
"""Fields of a feedback frame, and what happens to them; see ``Damage``."""
MOMENTS = {
    "enabling": (0.0, 0.0, 0.05),
    "raising": (0.0, 0.75, 0.15),
    "moving": (0.0, 1.45, 0.2),
    "playing": (0.0, 4.95, 0.4),
    "coming": (0.0, 0.45, 0.1),
    "lowering": (0.0, 2.0, 0.1),
}
"""Phases: the earliest and the latest onset after their beginning [s], and their share of runs."""
DAMAGE_BOUND = 0.05
"""Largest departure of a joint after a damaged frame [rad]."""


def damage_cases(runs, seed):
    """Return cases of one damaged frame each, spread over fields, sizes, phases and joints."""
    random = np.random.default_rng(seed)
    shares = [share for *_, share in MOMENTS.values()]
    cases = []
    for number in range(runs):
        name, size = DAMAGES[number % len(DAMAGES)]
        phase = str(random.choice(list(MOMENTS), p=shares))
        park = "rest" if phase == "lowering" or random.random() < 0.5 else None
        setup = SetUp(model_is_given=bool(random.random() < 0.5), park=park)
        joint = int(random.integers(len(MOTOR_TYPES)))
        cause = Damage(name, _size(name, size, joint, random), joint)
        begin, end, _ = MOMENTS[phase]
        onset = phase, random.uniform(begin, end), 1.0
        cases.append(
            Case(f"{name}, {size}", cause, "", DAMAGE_BOUND, "departure", setup, *onset)
        )
    return cases


def _size(name, size, joint, random):
    """Return the size of a damage of the feedback frame of a joint (from 0)."""
    n = len(MOTOR_TYPES)
    other = 1 + (joint + int(random.integers(1, n))) % n
    if name == "position":
        return float(size * random.choice([-1.0, 1.0]))
    if size == "other":
        return other + 0x10 * (name == "arbitration id")
    return int(random.integers(21 * 8)) if size == "any" else size


def hold_cases():
    """Return a case for each fault of a motor that holds the arm still, pose and stiffness."""
    causes = {
        f"weak motor, {share}": fault(SHOULDER, torque_share=share)
        for share in (0.5, 0.6, 0.7, 0.8)
    }
    causes["motor lost"] = lost_motor(SHOULDER)
    cases = []
    grid = itertools.product(SHOULDERS, (60.0, 180.0), range(5))
    for type_name, kp, pose in grid:
        options = {"kp": kp, "shoulder": type_name, "pose": pose}
        setup = SetUp("truth", stands=True, duration=2.5, **options)
        for name, cause in causes.items():
            cases.append(Case(name, cause, setup=setup, after=1.0))
    return cases


def held_torque(outcome):
    """Return what the motor of a case of ``hold_cases`` can hold [N m]."""
    share = outcome.name.partition("weak motor, ")[2]
    return float(share or 0.0) * motor_spec(outcome.setup.shoulder).peak_torque

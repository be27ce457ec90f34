"""Planned motions that are played on arms which are not as their models say, and what comes of it.

A motion is planned and exported by the command ``plan``, and played by the command ``motors
play``, but for the bus, which is the rig's own, and for the model, which is loaded once. A run with
a fault is compared with a twin: the same run without the fault, in simulated time, so that both are
alike to the last bit until the fault begins.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from rigs.arms.walk import run_here
from rigs.arms.wrong_arms import resting_torque, typical_torque
from rigs.files.places import GUESS, MODELS
from rigs.motors.own_motors import Disturbance, OwnMotor
from rigs.motors.sound_arms import (
    STEP,
    Arm,
    Plant,
    bus_of,
    drawn_links,
    make_sound,
    model_friction,
    sound_plant,
)
from rigs.motors.worn_arms import motor_types
from robot_sysid.commands.motors import play
from robot_sysid.commands.motors.session import PlayChoices, Session
from robot_sysid.damiao import execution
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import SysidError
from robot_sysid.motion.trajectories import load_trajectory
from robot_sysid.parser import load_robot_model
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import record_from

FASTEST_CLASSIC = 250.0
"""Highest rate at which seven motors fit onto a classic CAN bus [Hz]."""
WATCHDOG_CYCLES = 12.0
WATCHDOG = 0.1
"""Least time of the motors' watchdogs [s]; slow cycles need so many of their own."""
AFTERWARDS = 0.5
"""How long an arm is watched after the run [s]."""
WINDOW_BEFORE = 0.1
WINDOW_AFTER = 0.5
"""Which part of the twin's path a joint may be on in a stop: around the moment it began [s]."""
LEAST_RATE = 50.0
MOST_RATE = 500.0
LEAST_STIFFNESS = 20.0
MOST_STIFFNESS = 100.0
"""Between which rates [Hz] and stiffnesses [N m/rad] runs are drawn."""
MOST_SAG = 0.1
"""How far an arm may sag by the error of its weight [rad]; friction, and the sag of other joints,
add to it, and a run is stopped at 0.2, as it should be."""
LEAST_OVER_GRAVITY = 1.5
"""Least stiffness over the slope of the weight, below which an arm topples like a pencil on end."""
NEAR = 0.01
"""Angle over which that slope is taken [rad]."""
SAMPLE_RATE = 250.0
"""Rate at which a motion's torque is looked at, to choose motors [Hz]."""
LATE_SHARE = 0.5
"""Share of answers that are late, or doubled, over that of frames that are lost."""
COMPLETED = "completed"
STOPPED = "stopped"
REFUSED = "refused"
PLAYING = "playing"
STOPPING = "stopping"


@dataclass(frozen=True)
class PublicArm:
    """A model, its terminal joint if the model has several, and its motors.

    Attributes:
        model: its file.
        joint: its terminal joint; "" where it has one only.
        motors: types of its motors, base first; by default the weakest that are strong enough.
        excitation: how ``plan`` finds its motion.
        wrist_damping: of the model's motors DM4310 in place of the file's [N m s/rad].
    """

    model: Path
    joint: str = ""
    motors: tuple[str, ...] = ()
    excitation: str = "sines"
    wrist_damping: float | None = None

    @property
    def is_at_hand(self):
        """Whether the model's file is there."""
        return self.model.exists()


_KINOVA_MOTORS = (
    "DM8009",
    "DM10010L",
    "DM8009",
    "DM8009",
    "DM4340",
    "DM4340",
    "DM4340",
)
_OPENARM_MOTORS = ("DM8009",) * 2 + ("DM4340",) * 2 + ("DM4310",) * 2 + ("DM3507",)
_OPENARM = PublicArm(
    MODELS / "openarm_v2" / "openarm_bimanual.xml",
    "openarm_left_joint7",
    _OPENARM_MOTORS,
    # Random sines that touch nothing are so small here that its damping is not felt.
    "optimal --excitation-time-budget 20",
)
SOUND_ARMS = {
    "kinova": PublicArm(GUESS, motors=_KINOVA_MOTORS),
    "openarm": _OPENARM,
    "openarm_light": replace(_OPENARM, wrist_damping=0.05),
    "ur5e": PublicArm(MODELS / "universal_robots_ur5e" / "ur5e.xml"),
    # The weakest motors of these two that are strong enough have wrists of DM4310.
    "iiwa14": PublicArm(MODELS / "kuka_iiwa_14" / "iiwa14.xml"),
    "fr3": PublicArm(MODELS / "franka_fr3" / "FrankaFR3_7DoF.urdf"),
    "xarm7": PublicArm(MODELS / "ufactory_xarm7" / "xarm7_nohand.xml"),
}
"""Arms on Damiao motors, none of whose runs may be stopped while they are sound."""


def arm_named(name):
    """Return one of ``SOUND_ARMS``, or the arm of ``FILE`` or of ``FILE:TERMINAL_JOINT``."""
    if name in SOUND_ARMS:
        return SOUND_ARMS[name]
    file, _, joint = name.partition(":")
    return PublicArm(Path(file), joint)


@dataclass(frozen=True)
class PlannedMotion:
    """What ``plan --export-damiao`` has written for an arm.

    Attributes:
        arm: what it was planned for.
        model: the model's file, which may be a changed copy of the arm's.
        path: the exported trajectory.
        robot: the model as the player has it.
        motors: types of the motors, base first.
        typical: torque (n,) that joints need in it [N m].
        q: its positions (N, n) [rad].
    """

    arm: PublicArm
    model: Path
    path: Path
    robot: object
    motors: tuple[str, ...]
    typical: np.ndarray
    q: np.ndarray

    def least_stiffness(self, seed):
        """Return with which stiffness the arm of a seed stands and sags little [N m/rad].

        It sags because its links are heavier or lighter than the model's, which are fed, and it
        topples where its weight grows faster with the angle than its stiffness.
        """
        thetas = drawn_links(self.robot, seed)
        true = resting_torque(self.robot, self.q, thetas)
        fed = resting_torque(self.robot, self.q, self.robot.thetas)
        sagging = np.abs(true - fed).max(axis=0) / MOST_SAG
        slopes = []
        for j, turn in enumerate(NEAR * np.eye(self.robot.n_joints)):
            ahead = resting_torque(self.robot, self.q + turn, thetas)
            slopes.append(float(np.abs(ahead - true)[:, j].max()) / NEAR)
        # An arm that sinks takes up more of its weight.
        least = np.maximum(sagging + slopes, LEAST_OVER_GRAVITY * np.array(slopes))
        return float(least.max())

    def telling_joints(self):
        """Return the numbers of the joints that carry most and second most, and of a wrist's."""
        most, second = np.argsort(-self.typical)[:2].tolist()
        return most, second, max(set(range(len(self.typical) - 1)) - {most, second})

    @property
    def joint_option(self):
        """The option that names the terminal joint, as a value of options."""
        return {"joint": self.arm.joint} if self.arm.joint else {}


@cache
def planned_motion(name, folder, duration=6.0, seed=0):
    """Return the motion of an arm, which is planned into a folder unless it is there already."""
    arm = arm_named(name)
    target = Path(folder) / f"{Path(name).stem}_{duration:g}_{seed}"
    target.mkdir(exist_ok=True)
    model = _model_file(arm, target)
    joint = f"--joint {arm.joint}" if arm.joint else ""
    exported = target / "damiao_trajectory.csv"
    coefficients = target / "plan.json"
    if not coefficients.exists():
        _command(
            f"plan {model} {joint} --for arm --excitation {arm.excitation} --duration {duration:g} "
            f"--seed {seed} --output-dir {target} --save-trajectory {coefficients}"
        )
    robot = load_robot_model(model, max_velocity=math.inf, joint=arm.joint or None)
    plan = load_trajectory(coefficients).plan
    time = np.arange(round(plan.duration * SAMPLE_RATE) + 1) / SAMPLE_RATE
    motion = plan.evaluate(time)
    dynamics = ArmDynamics(robot)
    types = arm.motors
    if not types:
        fastest = np.abs(motion.qd).max(axis=0)
        types = tuple(motor_types(np.asarray(dynamics(motion)), fastest))
    if not exported.exists():
        motors = " ".join(f"--motor-type {motor}" for motor in types)
        _command(
            f"plan {model} {joint} --for arm --trajectory {coefficients} {motors} "
            f"--export-damiao --output-dir {target}"
        )
    weight, inertia = dynamics.weight_and_inertia(motion)
    typical = typical_torque(weight + inertia)
    return PlannedMotion(arm, model, exported, robot, types, typical, motion.q)


def _command(line):
    code, output = run_here(f"robot-sysid {line}")
    if code not in (0, 1):
        raise SystemExit(f"{line}\n{output}")


def _model_file(arm, folder):
    """Return the arm's model file, or a copy of it with another damping of the wrist's motors."""
    if arm.wrist_damping is None:
        return arm.model
    text = arm.model.read_text(encoding="utf-8")
    text = text.replace('meshdir="assets"', f'meshdir="{arm.model.parent / "assets"}"')
    stated = 'frictionloss="0.04" damping="0.9" armature="0.0100"'
    assert stated in text
    path = folder / arm.model.name
    path.write_text(
        text.replace(stated, stated.replace("0.9", f"{arm.wrist_damping:g}")),
        encoding="utf-8",
    )
    return path


@dataclass(frozen=True)
class ArmFault:
    """Something that goes wrong with an arm.

    Attributes:
        name: in tables.
        act: is called with the arm when it happens.
        after: when, after the motion has begun [s]; None: it is so from the very beginning.
        joint: the joint at fault; None where it is no single one.
        carried: mass at the terminal link from the beginning, in the twin's run, too [kg].
    """

    name: str
    act: Callable[[Arm], object]
    after: float | None = 1.5
    joint: int | None = None
    carried: float = 0.0


@dataclass(frozen=True)
class RunOptions:
    """How a motion is played on an arm.

    Attributes:
        arm: name of one of ``SOUND_ARMS``, or a model file, see ``arm_named``.
        seed: draws what is wrong with the arm; None: nothing, and the model's own friction.
        speed, rate, kp: as the options of ``motors play``; None for the command's default.
        has_model: whether the player has the model.
        duration: of the planned motion at full speed [s].
        records: whether the run is recorded.
        lost: share of commands, and of answers, that never arrive; half as many answers come a
            cycle late, and as many twice.
    """

    arm: str
    seed: int | None = 0
    speed: float = 1.0
    rate: float | None = None
    kp: float | None = None
    has_model: bool = True
    duration: float = 6.0
    records: bool = False
    lost: float = 0.0

    @property
    def is_fd(self):
        """Whether it needs CAN-FD."""
        return (self.rate or 0.0) > FASTEST_CLASSIC

    @property
    def period(self):
        """Length of a cycle of control [s]."""
        return 1.0 / (self.rate or SAMPLE_RATE)

    @property
    def disturbance(self):
        """What the bus does to frames."""
        return Disturbance(
            self.lost,
            late=LATE_SHARE * self.lost,
            doubled=LATE_SHARE * self.lost,
            delay=self.period,
            seed=self.seed or 0,
        )


def draw_options(name, folder, seed, speed, has_model, duration=6.0, lost=0.0):
    """Return how the arm of a seed is played, with a rate and a stiffness that are drawn, too.

    A stiffness with which it would sag out of its tolerance is raised.
    """
    rng = np.random.default_rng([seed, 3, *Path(name).stem.encode()])
    rate = math.exp(rng.uniform(math.log(LEAST_RATE), math.log(MOST_RATE)))
    stiffness = rng.uniform(LEAST_STIFFNESS, MOST_STIFFNESS)
    planned = planned_motion(name, folder, duration)
    least = planned.least_stiffness(seed)
    return RunOptions(
        arm=name,
        seed=seed,
        speed=speed,
        rate=round(rate),
        kp=round(max(stiffness, least)),
        has_model=has_model,
        duration=duration,
        lost=lost,
    )


class Listener(Progress):
    """A console that keeps what is printed, and notes when phases begin.

    Attributes:
        lines: all that was printed.
        begun: when a phase began, by its name [s].
    """

    json = False

    def __init__(self, clock):
        self._clock = clock
        self.lines = []
        self.begun = {}
        self.on_playing = []

    def stage(self, *messages):
        for message in messages:
            self.lines.append(str(message))
            phase = str(message).split(" ")[0]
            if phase in (PLAYING, STOPPING):
                self.begun.setdefault(phase, self._clock.now())
            if phase == PLAYING:
                for function in self.on_playing:
                    function(self._clock.now())
                self.on_playing = []

    def advance(self, label, done, total, text):
        """Show no progress."""

    def close(self):
        """There is no progress bar to be closed."""


class OwnSession(Session):
    """A run of ``motors play`` on the rig's own bus, with a model that is loaded once."""

    def __init__(self, values, console, bus, robot):
        choices = record_from(PlayChoices, values)
        equipment = execution.Equipment(bus.clock, lambda *_: bus)
        options = execution.RunOptions.of(values)
        super().__init__(options, console, choices, equipment)
        self._loaded = robot

    @property
    def robot(self):
        return self._loaded if self.options.files.model else None

    @property
    def problem(self):
        return _problem_of(self._loaded, self.options.limits)


@cache
def _geometry(robot_id, limits):
    from robot_sysid.motion.problem import build_problem

    return build_problem(_ROBOTS[robot_id], limits)


# By identity, as a robot's arrays cannot be hashed.
_ROBOTS = {}


def _problem_of(robot, limits):
    _ROBOTS[id(robot)] = robot
    return _geometry(id(robot), limits)


@dataclass(frozen=True, eq=False)
class Run:
    """What an arm did.

    Attributes:
        exit: ``COMPLETED``, ``STOPPED`` or ``REFUSED``.
        code: exit code of the command.
        message: of the error, or the verdict.
        lines: all that was printed.
        path: true positions (steps, n) every ``STEP`` from the beginning [rad].
        begun_at: when the motion began [s]; NaN where it did not.
        fault_at: when the fault happened [s]; NaN where it did not.
        stop_at: when a stop began [s]; infinite without one.
        off_at: when no motor made torque any more [s].
    """

    exit: str
    code: int
    message: str
    lines: list[str]
    path: np.ndarray
    begun_at: float
    fault_at: float
    stop_at: float
    off_at: float


@cache
def twin_of(options, folder, carried=0.0):
    """Return the undisturbed run of an arm that may carry a mass [kg]."""
    if not carried:
        return run_arm(options, folder)
    nothing = ArmFault("nothing", lambda arm: None, after=None, carried=carried)
    return run_arm(options, folder, nothing)


def disturbed_run(options, folder, fault):
    """Return the run with a fault, and what the fault did."""
    run = run_arm(options, folder, fault)
    return run, effect_of(run, twin_of(options, folder, fault.carried))


def run_arm(options, folder, fault=None):
    """Play a planned motion on an arm, with a fault or without; return the run."""
    planned = planned_motion(options.arm, folder, options.duration)
    motors = [
        OwnMotor(
            joint.can_id,
            joint.master_id,
            joint.spec.limits,
            joint.spec.peak_torque,
            watchdog=max(WATCHDOG, WATCHDOG_CYCLES / (options.rate or SAMPLE_RATE)),
        )
        for joint in damiao_joints(planned.motors, len(planned.motors))
    ]
    plant = _plant(planned, options)
    if options.seed is not None:
        make_sound(motors, options.seed, options.period)
    arm = Arm(plant, motors)
    bus = bus_of(arm, options.is_fd, options.disturbance)
    console = Listener(bus.clock)
    happened = []
    if fault is not None:
        if fault.carried:
            plant.carry(fault.carried)
        _prepare_fault(fault, arm, console, happened)
    values = {
        "trajectory": planned.path,
        "channel": "own",
        "speed": options.speed,
        "accept_directions": True,
        "yes": True,
    }
    if options.rate is not None:
        values["rate"] = options.rate
    if options.is_fd:
        values["fd"] = True
    if options.kp is not None:
        values["kp"] = (options.kp,)
    if options.has_model:
        values |= {"model": planned.model, **planned.joint_option}
    if options.records:
        record = planned.path.with_name(f"measured_{os.getpid()}.csv")
        values |= {"record": record, "overwrite": True}
    session = OwnSession(values, console, bus, planned.robot)
    code = 0
    try:
        code = play(session)
        message = session.verdict[0]
        console.stage(message)
        ending = COMPLETED
    except SysidError as error:
        code = error.exit_code
        message = str(error)
        ending = STOPPED if arm.was_enabled else REFUSED
    arm.advance(bus.clock.now() + AFTERWARDS)
    plant.require_finite()
    return Run(
        ending,
        code,
        message,
        console.lines,
        np.array(arm.path),
        console.begun.get(PLAYING, math.nan),
        happened[0] if happened else math.nan,
        console.begun.get(STOPPING, math.inf),
        arm.off_at,
    )


def _plant(planned, options):
    if options.seed is None:
        return Plant(planned.robot, planned.q[0], model_friction(planned.robot))
    return sound_plant(planned.robot, planned.q[0], planned.typical, options.seed)


def _prepare_fault(fault, arm, console, happened):
    """Let a fault happen when its time comes, and note when."""

    def happen(arm):
        happened.append(arm.plant.time)
        fault.act(arm)

    if fault.after is None:
        happen(arm)
    else:
        console.on_playing.append(lambda now: arm.at(now + fault.after, happen))


@dataclass(frozen=True)
class Effect:
    """What a fault did.

    Attributes:
        departure: largest distance of a joint from the twin's path, from the fault until no motor
            makes torque any more [rad].
        departure_in_stop: that since the stop began; 0 without one.
        seconds: from the fault until no motor makes torque any more [s].
        joint: number of the joint with the largest departure.
    """

    departure: float
    departure_in_stop: float
    seconds: float
    joint: int


def effect_of(run, twin):
    """Return what a fault did, by its run and that of its twin.

    Until a stop begins, joints are compared at the same moment. A stop may end anywhere on the path
    around its beginning, and the arm may sink once the motors are off.
    """
    if math.isnan(run.fault_at):
        return Effect(0.0, 0.0, math.nan, -1)
    n_steps = min(len(run.path), len(twin.path))
    begin = round(run.fault_at / STEP)
    off = _step_of(run.off_at, n_steps)
    stop = min(_step_of(run.stop_at, n_steps), off)
    before = np.abs(run.path[begin:stop] - twin.path[begin:stop])
    # The twin may have ended earlier than a run that goes on.
    since = max(stop - round(WINDOW_BEFORE / STEP), 0)
    nearby = twin.path[since : stop + round(WINDOW_AFTER / STEP)]
    stopping = run.path[stop:off]
    low = nearby.min(axis=0) if len(nearby) else -math.inf
    high = nearby.max(axis=0) if len(nearby) else math.inf
    beyond = np.maximum(np.maximum(low - stopping, stopping - high), 0.0)
    in_stop = beyond.max(axis=0, initial=0.0)
    departure = np.maximum(before.max(axis=0, initial=0.0), in_stop)
    return Effect(
        float(departure.max()),
        float(in_stop.max()),
        run.off_at - run.fault_at,
        int(np.argmax(departure)),
    )


def _step_of(moment, n_steps):
    return n_steps if math.isinf(moment) else min(round(moment / STEP), n_steps)

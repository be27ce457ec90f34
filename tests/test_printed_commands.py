"""Every command that the program prints is run, as it is printed, and leads on.

A situation is what somebody has and types. It is refused, or it ends with a next step; either way
commands are printed. Each of them has to end better than what came before: a refusal's with a
result, if need be over further commands that it prints, and a next step's without a fault. Where
nothing more can be got, that is said.

What prints a command is found in the package's source: an option that an error offers, and a state
of ``STEPS``. Each has a situation here. A command with a blank is a form: it is filled in with what
the person knows, which the words above it ask for, and run.
"""

from __future__ import annotations

import ast
import contextlib
import json
import re
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.walk import Step, TrueArm, Walk, run_here
from rigs.arms.wrong_arms import resting_torque, truth_of
from rigs.files import urdf
from rigs.logs import recorded, servo_logs
from rigs.logs.log_files import write, write_signals
from rigs.motors.damiao_rig import MotorBus
from rigs.motors.person import Person
from robot_sysid.commands import motors
from robot_sysid.logs.ros_messages import STATE
from robot_sysid.logs.suggestion import FILLINGS
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.motion.goals import load_goals
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.next_steps import STEPS
from robot_sysid.records import Motion, Recording
from tests.faults.conftest import FOUR_AXES, JOINT
from tests.test_architecture import nodes_of, package_sources

OPTION = re.compile(r"--[a-z][a-z-]*[a-z]")
FORWARDING = {
    "robot_sysid.commands.remedies",
    "robot_sysid.pipeline.next_steps",
    "robot_sysid.wording",
}
"""Modules that print the commands of others."""
MOST_COMMANDS = 4
"""Commands one after the other within which a refusal has to lead to a result."""


def offered_options(source: str) -> Iterator[str]:
    """Yield the options that a module's tuples of words state, such as ("--units", "ms")."""
    for node in nodes_of(source):
        if not isinstance(node, ast.Tuple) or isinstance(node.ctx, ast.Store):
            continue
        texts = [each.value for each in node.elts if isinstance(each, ast.Constant)]
        flags = [text for text in texts if OPTION.fullmatch(str(text))]
        # Names of several options are no words of a command, nor is one beside what it writes.
        are_words = len(flags) < len(node.elts) or len(node.elts) == 1
        if flags and are_words and flags[0] != "--output-dir":
            yield flags[0]


def sources() -> set[str]:
    """Return what prints commands: options by module, whole commands by module, and steps."""
    found = {f"step: {state}" for state in STEPS}
    for name, source in package_sources().items():
        # Most modules have neither word, and are not parsed.
        if name in FORWARDING or not re.search('"--|command_lines', source):
            continue
        short = name.partition(".")[2]
        found |= {f"{short} {flag}" for flag in offered_options(source)}
        names = {n.id for n in nodes_of(source) if isinstance(n, ast.Name)}
        keywords = {n.arg for n in nodes_of(source) if isinstance(n, ast.keyword)}
        if "command_lines" in (names | keywords) and short not in ("errors", "cli"):
            found.add(f"{short} command")
    return found


@dataclass(frozen=True)
class Situation:
    """What somebody has and types.

    Attributes:
        sources: of the commands that are printed on the way.
        words: that are typed.
        prepare: writes the files into the working folder, and returns the arm of later recordings.
        ends: what is said where nothing more can be got; "" where each command leads on.
        is_fast: whether it takes less than a second.
        knows: what the person puts into the blanks of a printed command, by the key of each.
        has_motors: whether two motors answer on a bus.
        folders: of the results before and after, of which the second is to be better elsewhere.
    """

    sources: tuple[str, ...]
    words: str
    prepare: Callable[[], TrueArm | servo_logs.WeighedServos | None]
    ends: str = ""
    is_fast: bool = False
    knows: Mapping[str, str] = field(default_factory=dict)
    has_motors: bool = False
    folders: tuple[str, str] = ("", "")


def written_arm(text: str = "", name: str = "arm.xml") -> Path:
    """Write a model and return its path."""
    path = Path(name)
    path.write_text(text or small_arms.serial_arm(FOUR_AXES, joint=JOINT))
    return path


def log_with(
    change: Callable[[Recording], Recording], name: str = "log.csv"
) -> Callable[[], None]:
    """Return what writes an arm and a log of it in which something is changed."""

    def prepare() -> None:
        robot = load_robot_model(written_arm())
        log = change(truth_of(robot, seed=4).log)
        write_measurement_csv(Path(name), robot.joint_names, [log])

    return prepare


def log_titled(**signals: str) -> Callable[[], None]:
    """Return what writes an arm and a log of it under other titles, see ``signals_of``."""

    def prepare() -> None:
        robot = load_robot_model(written_arm())
        titles = {title.replace("N", "{}"): name for title, name in signals.items()}
        write_signals(Path("log.csv"), truth_of(robot, seed=4).log, titles)

    return prepare


def true_arm(carries: bool = True, is_short: bool = False) -> Callable[[], TrueArm]:
    """Return what writes an arm of three joints and its first log, and returns the arm."""

    def prepare() -> TrueArm:
        text = small_arms.serial_arm(joint='range="-2 2" armature=".02"')
        arm = TrueArm(load_robot_model(written_arm(text)), 1, 1.0, carries)
        plan = arm.first_plan
        if is_short:
            plan = replace(plan, duration=4.0, fade=1.0).scale_amplitudes(0.4)
        arm.record(Path("log.csv"), plan, arm.tool_mass if carries else 0.0)
        arm.tool_mass *= carries
        return arm

    return prepare


def arm_with_currents() -> TrueArm:
    """Its log has currents below the titles of torques."""
    constants = np.array([8.0, 12.0, 10.0, 5.0])
    arm = TrueArm(load_robot_model(written_arm()), 1, constants)
    arm.record(Path("log.csv"), arm.first_plan, 0.0)
    return arm


def noisy_arm() -> TrueArm:
    """Noise as large as half of the torque: more of the motion helps, and no other one."""
    arm = TrueArm(load_robot_model(written_arm()), 1, carries=False)
    arm.noise *= 50.0
    arm.record(Path("log.csv"), replace(arm.first_plan, duration=15.0), 0.0)
    arm.tool_mass = 0.0
    return arm


def a_link_too_heavy() -> None:
    """The third of six links has four times its mass and inertia in the model."""
    text = small_arms.serial_arm((*FOUR_AXES, small_arms.Y, small_arms.X), joint=JOINT)
    robot = load_robot_model(written_arm(text))
    log = truth_of(robot, seed=4).log
    write_measurement_csv(Path("log.csv"), robot.joint_names, [log])
    link = [*re.finditer("<inertial.*?>", text)][2]
    number = r"(?<=mass=\").*?(?=\")|(?<=inertia=\").*?(?=\")"

    def times_four(numbers: re.Match[str]) -> str:
        return " ".join(str(4.0 * float(word)) for word in numbers[0].split())

    heavy = re.sub(number, times_four, link[0])
    written_arm(text[: link.start()] + heavy + text[link.end() :])


def topics_of_two_arms() -> None:
    """A ROS bag."""
    robot = load_robot_model(written_arm())
    log = truth_of(robot, seed=4).log
    states = recorded.shuffled_states(log, robot.joint_names)
    topics = [(f"/{side}/joint_states", STATE, states) for side in ("left", "right")]
    recorded.write_bag(Path("log"), topics)


def torques_in_other_topics() -> None:
    """A ROS bag with positions in one topic, and torques in two others."""
    robot = load_robot_model(written_arm())
    log = truth_of(robot, seed=4).log
    names = robot.joint_names

    def states(is_torque: bool) -> Callable[[Any], Iterator[Any]]:
        def messages(types: Any) -> Iterator[Any]:
            for time, q, tau in zip(log.time, log.q, log.tau):
                values = (None, None, tau) if is_torque else (q, None, None)
                yield time, recorded.joint_state(types, time, names, *values)

        return messages

    topics = {"/joint_states": False, "/motor_torques": True, "/raw": True}
    rows = [(name, STATE, states(of_torque)) for name, of_torque in topics.items()]
    recorded.write_bag(Path("log"), rows)


def topics_of_json() -> None:
    """An MCAP file."""
    robot = load_robot_model(written_arm())
    log = truth_of(robot, seed=4).log
    samples = [*zip(log.time.tolist(), log.q.tolist(), log.tau.tolist())]
    messages = [
        (topic, round(1e9 * time), {"t": time, "q": q, "tau": tau})
        for topic in ("/left", "/right")
        for time, q, tau in samples
    ]
    recorded.write_json_mcap(Path("log.mcap"), messages)


def log_of_some(
    position: Collection[int], torque: Collection[int], stands: int
) -> Callable[[], None]:
    """Return what writes a log with columns of some joints, of which one stands still."""

    def prepare() -> None:
        robot = load_robot_model(written_arm())
        truth = truth_of(robot, seed=4)
        moves = np.arange(4) != stands
        place = np.where(moves, 0.0, 0.7)
        motion = truth.motion
        motion = Motion(
            motion.time, place + moves * motion.q, moves * motion.qd, moves * motion.qdd
        )
        noise = 0.01 * np.random.default_rng(1).normal(size=motion.q.shape)
        log = truth.arm.log(motion, noise)
        names = robot.joint_names
        titles = ["time", *(f"{names[k]} position" for k in position)]
        titles += [f"{names[k]} effort" for k in torque]
        rows = np.column_stack((log.time, log.q[:, position], log.tau[:, torque]))
        write(Path("log.csv"), rows, titles)

    return prepare


def registers_with_a_sign_bit() -> None:
    """Thousandths of a newton metre, as servos have them: the sign in bit 15."""
    robot = load_robot_model(written_arm())
    log = truth_of(robot, seed=4).log
    counts = np.round(1000.0 * log.tau)
    load = np.where(counts < 0.0, 2.0**15 - counts, counts)
    titles = ["time", *(f"q{k}" for k in range(4))]
    titles += [f"Present_Load_{k}" for k in range(4)]
    write(Path("log.csv"), np.column_stack((log.time, log.q, load)), titles)


def rows_twice_with_strange_titles() -> None:
    """A tenth of the rows, which hides that the time increases steadily."""
    robot = load_robot_model(written_arm())
    log = truth_of(robot, seed=4).log
    rows = np.column_stack((log.time, log.q, log.tau))
    rows = rows[np.sort([*range(len(rows)), *range(0, len(rows), 10)])]
    titles = ["Takt", *(f"w{k}_pos_x" for k in range(4))]
    titles += [f"m{k}_torque_x" for k in range(4)]
    write(Path("log.csv"), rows, titles)


def publishers_of_one_topic() -> None:
    """A simulator's messages, without torques, between those of the driver."""
    robot = load_robot_model(written_arm())
    log = truth_of(robot, seed=4).log

    def messages(types: Any) -> Iterator[Any]:
        for k, (time, q, qd, tau) in enumerate(zip(log.time, log.q, log.qd, log.tau)):
            for late, torque, frame in ((0.0, tau, "base"), (1e-3, 0.0 * tau, "sim")):
                if frame == "base" or k % 2:
                    at = time + late
                    state = (robot.joint_names, q, qd, torque, frame)
                    yield at, recorded.joint_state(types, at, *state)

    recorded.write_bag(Path("log"), [("/joint_states", STATE, messages)])


MOTORS = "--motor-type DM4340 --motor-type DM4340"


def arm_with_motors() -> None:
    """An arm of the two motors on the bus, and another one, which is heavier."""
    axes = (small_arms.Y, small_arms.Y)
    text = small_arms.serial_arm(axes, joint='range="-2 2" armature=".02"')
    written_arm(text)
    heavier = re.sub('mass="(.*?)"', lambda m: f'mass="{1.2 * float(m[1])}"', text)
    written_arm(heavier, "heavier.xml")


def motion_for_motors() -> None:
    arm_with_motors()
    line = f"robot-sysid plan arm.xml {MOTORS} --output-dir planned"
    code, output = run_here(line, is_hasty=True)
    assert code == 0, output


def small_motion_in_degrees() -> None:
    """Small and slow enough to be one in radians."""
    robot = load_robot_model(written_arm())
    plan = truth_of(robot, seed=4).plan.scale_amplitudes(0.15)
    log = truth_of(robot, seed=4, played=plan).log
    log = replace(log, q=np.degrees(log.q), qd=None)
    write_measurement_csv(Path("log.csv"), robot.joint_names, [log])


def servos() -> None:
    """Positions and goals of servos, without torque."""
    robot = load_robot_model(written_arm(servo_logs.XML))
    time, goals = servo_logs.sines_and_steps()
    positions = servo_logs.positions(robot, time, goals)
    servo_logs.write(Path("log.csv"), time, positions, goals)


def servos_titled(position: str, goal: str) -> Callable[[], None]:
    """Return what writes the same in degrees, under titles with "{}" for a joint's name."""

    def prepare() -> None:
        servos()
        rows = np.loadtxt("log.csv", delimiter=",", skiprows=1)
        rows[:, 1:] = np.degrees(rows[:, 1:])
        names = load_robot_model("arm.xml").joint_names
        titles = ["time", *map(position.format, names), *map(goal.format, names)]
        np.savetxt("log.csv", rows, "%.9g", ",", header=",".join(titles), comments="")

    return prepare


def servos_with_a_gripper() -> None:
    """The same under numbers, with a gripper's behind them."""
    servos()
    rows = np.loadtxt("log.csv", delimiter=",", skiprows=1)
    rows = rows[:, [0, 1, 2, 1, 3, 4, 3]]
    numbers = [
        f"{name}[{k}]" for name in ("observation.state", "action") for k in range(3)
    ]
    header = ",".join(["time", *numbers])
    np.savetxt("log.csv", rows, "%.9g", ",", header=header, comments="")


class ServoArm:
    """An arm of servos, which plays the goals beside the log that it writes."""

    tool_mass = 0.0
    first_plan = None

    def __init__(self) -> None:
        self.robot = load_robot_model(written_arm(servo_logs.XML))

    def record(self, path: Path, *_: object) -> None:
        goals = load_goals(path.with_name("goals.csv"))
        time = np.arange(round(servo_logs.RATE * goals.time[-1])) / servo_logs.RATE
        command = [np.interp(time, goals.time, column) for column in goals.q.T]
        commands = np.transpose(command)
        positions = servo_logs.positions(self.robot, time, commands)
        servo_logs.write(path, time, positions, commands)


def arm_with_servos() -> ServoArm:
    return ServoArm()


def light_servos() -> servo_logs.WeighedServos:
    """A log of servos without a weight, of an arm that is recorded with one later."""
    arm = servo_logs.WeighedServos(load_robot_model(written_arm(servo_logs.LIGHT)))
    arm.record(Path("log.csv"), None, 0.0)
    return arm


def two_arms() -> None:
    written_arm(small_arms.TWO_ARMS)


def two_arms_and_a_log_of_one() -> None:
    two_arms()
    robot = load_robot_model("arm.xml", joint="right_joint3")
    log = truth_of(robot, seed=4).log
    write_measurement_csv(Path("log.csv"), robot.joint_names, [log])


def arm_on_a_free_base() -> None:
    bodies = small_arms.serial_bodies(FOUR_AXES, joint=JOINT)
    base = small_arms.link('<freejoint name="root"/>', bodies, "base")
    written_arm(small_arms.world(base))


def arm_on_a_floating_root() -> None:
    """Its first link has the name of MuJoCo's own world, and is carried by another one."""
    links = {f"l{k}": urdf.inertial(4.0 - k) for k in range(1, 4)}
    arm = urdf.serial(links).replace('"base"', '"world"')
    root = urdf.joint("odom", "world", "floating")
    written_arm(urdf.robot(urdf.link("odom"), root, arm), "arm.urdf")


def arm_in_tonnes() -> None:
    masses = {"l1": 3e-3, "l2": 2e-3, "l3": 1e-3}
    links = {
        name: urdf.inertial(mass, inertia="1e-5 2e-5 2.5e-5")
        for name, mass in masses.items()
    }
    written_arm(urdf.robot(urdf.serial(links)), "arm.urdf")


def arm_on_a_wall() -> None:
    """The base is turned by a quarter, and the model does not say so."""
    robot = load_robot_model(written_arm())
    truth = truth_of(robot, seed=4)
    thetas = truth.arm.thetas
    level, turned = (
        resting_torque(robot, truth.motion.q, thetas, np.array(gravity))
        for gravity in ([0.0, 0.0, -9.81], [9.81, 0.0, 0.0])
    )
    log = replace(truth.log, tau=truth.log.tau + turned - level)
    write_measurement_csv(Path("log.csv"), robot.joint_names, [log])


def earlier_log() -> None:
    """A log in degrees, and one of today."""
    log_with(lambda log: replace(log, q=np.degrees(log.q), qd=None), "earlier.csv")()
    log_with(lambda log: log)()


def in_time(factor: float) -> Callable[[], None]:
    return log_with(lambda log: replace(log, time=factor * log.time))


def form(titles: Mapping[str, str], **knows: str) -> Situation:
    """Return a log whose titles do not say all, and what the person says."""
    prepare = log_titled(**titles)
    sources = ("logs.reader --columns",)
    return Situation(sources, "log log.csv arm.xml", prepare, is_fast=True, knows=knows)


SIMULATED = "motors simulate planned/damiao_trajectory.csv --model arm.xml --record rehearsed.csv"

SITUATIONS = {
    "two arms": Situation(
        ("errors --joint",), "arm.xml --duration 1", two_arms, is_fast=True
    ),
    "two arms, one of them logged": Situation(
        ("pipeline.named_arm --joint",),
        "log log.csv arm.xml",
        two_arms_and_a_log_of_one,
    ),
    "free base": Situation(
        ("mjcf.urdf --fix-base",),
        "arm.xml --duration 1",
        arm_on_a_free_base,
        is_fast=True,
    ),
    "free base in the world's place": Situation(
        ("mjcf.urdf --fix-base",),
        "arm.urdf --duration 1",
        arm_on_a_floating_root,
        is_fast=True,
    ),
    "tonnes": Situation(
        ("model.units --mass-scale",),
        "arm.urdf --duration 1",
        arm_in_tonnes,
        is_fast=True,
    ),
    "self-test": Situation(
        ("step: self-test passed",), "arm.xml --duration 1", true_arm()
    ),
    "light load": Situation(
        ("step: load not seen",),
        "plan arm.xml --for payload --payload-reserve 0.005 --output-dir planned",
        true_arm(),
        ends="weigh a lighter one on scales",
    ),
    "planned": Situation(
        ("step: motion planned",), "plan arm.xml --output-dir planned", true_arm()
    ),
    "planned for servos": Situation(
        ("step: motion planned for servos",),
        "plan arm.xml --for servos --output-dir planned",
        arm_with_servos,
    ),
    "planned for a payload": Situation(
        ("step: motion planned for payload",),
        "plan arm.xml --for payload --output-dir planned",
        true_arm(),
    ),
    "only empty logs": Situation(
        ("config command",), "payload arm.xml --empty log.csv", true_arm()
    ),
    "right log": Situation(
        (f"step: {'log is fine'}",), "log log.csv arm.xml", true_arm()
    ),
    "tool": Situation(
        ("step: part bolted on",), "identify arm.xml log.csv", true_arm()
    ),
    "short log": Situation(
        (
            "step: further motion",
            "step: further motion recorded",
            "step: part not seen",
        ),
        "identify arm.xml log.csv",
        true_arm(False, is_short=True),
        folders=("sysid_output", "sysid_output/both"),
    ),
    "milliseconds": Situation(
        ("logs.checks --units",), "log log.csv arm.xml", in_time(1e3)
    ),
    "degrees": Situation(
        ("logs.checks --units",),
        "log log.csv arm.xml",
        log_with(lambda log: replace(log, q=np.degrees(log.q), qd=None)),
    ),
    "small degrees": Situation(
        ("faults.readings --units",), "log log.csv arm.xml", small_motion_in_degrees
    ),
    "strange titles": Situation(
        ("logs.reader --columns",),
        "log log.csv arm.xml",
        log_titled(time="t", wN_pos_x="deg", mN_torque_x="tau"),
    ),
    "strange currents": Situation(
        ("logs.reader --columns", "logs.suggestion --torque-constants"),
        "log log.csv arm.xml",
        log_titled(time="t", wN_pos_x="q", xN_current="tau"),
    ),
    "goals in degrees": Situation(
        ("logs.column_map --torque-from", "logs.suggestion --units"),
        "log log.csv arm.xml",
        servos_titled("observation.{}.pos", "action.{}.pos"),
    ),
    "goals under other titles": Situation(
        ("logs.reader --columns", "logs.suggestion --torque-from"),
        "log log.csv arm.xml",
        servos_titled("{} Winkel", "{} Sollwert"),
    ),
    "goals with a gripper's": Situation(
        ("logs.reader --columns", "logs.suggestion --torque-from"),
        "log log.csv arm.xml",
        servos_with_a_gripper,
        knows={"position": "#2..#3", "command": "#5..#6"},
    ),
    "goals": Situation(
        ("logs.column_map --torque-from",), "log log.csv arm.xml", servos
    ),
    "light links": Situation(
        ("step: servo sizes unknown",),
        "identify arm.xml log.csv --torque-from position-error",
        light_servos,
    ),
    "torque sign": Situation(
        ("faults.refusal --columns",),
        "log log.csv arm.xml",
        log_with(lambda log: replace(log, tau=log.tau * [1.0, 1.0, -1.0, 1.0])),
    ),
    "torques of another size": Situation(
        ("faults.scales --torque-scale", "faults.scales --mass-scale"),
        "log log.csv arm.xml",
        log_with(lambda log: replace(log, tau=0.5 * log.tau)),
    ),
    "currents as torques": Situation(
        ("faults.scales --torque-scale", "step: torque scales unknown"),
        "log log.csv arm.xml",
        arm_with_currents,
    ),
    "on a wall": Situation(
        ("faults.reading_search --gravity",), "log log.csv arm.xml", arm_on_a_wall
    ),
    "noisy log": Situation(
        ("expected.other_motions --duration",),
        "identify arm.xml log.csv",
        noisy_arm,
        folders=("sysid_output", "sysid_output/both"),
    ),
    "weight bolted on": Situation(
        ("step: torque scales known",),
        "payload arm.xml --empty log.csv --loaded weight.csv --known-mass 1 --save-torque-scale "
        "scales.json --output-dir scales",
        arm_with_currents,
    ),
    "heavy link": Situation(
        ("faults.misfits --accept", "faults.scales --mass-scale"),
        "log log.csv arm.xml",
        a_link_too_heavy,
    ),
    "topics of two arms": Situation(
        ("logs.ros_bag --topic",), "log log arm.xml", topics_of_two_arms
    ),
    "torques in other topics": Situation(
        ("logs.ros_bag --topic",), "log log arm.xml", torques_in_other_topics
    ),
    "topics of JSON": Situation(
        ("logs.documents --topic",), "log log.mcap arm.xml", topics_of_json
    ),
    "planned for motors": Situation(
        ("step: motion planned for motors",),
        f"plan arm.xml {MOTORS} --export-damiao --output-dir planned",
        arm_with_motors,
        has_motors=True,
    ),
    "rehearsed": Situation(
        ("step: motion recorded",), SIMULATED, motion_for_motors, has_motors=True
    ),
    "rehearsed on another model": Situation(
        ("commands.motors.following --accept",),
        f"{SIMULATED} --plant-model heavier.xml",
        motion_for_motors,
        has_motors=True,
    ),
    "motor changed": Situation(
        ("commands.motors.setup --motor",),
        "motors setup --channel can0 --motor 1 --watchdog 0.2",
        lambda: None,
        has_motors=True,
        is_fast=True,
    ),
    "two angles": form(
        {"time": "t", "a_pos_xN": "q", "b_pos_xN": "heat", "tauN": "tau"},
        position="a_pos_x*",
    ),
    "counts": Situation(
        ("logs.reader --columns",),
        "log log.csv arm.xml",
        log_titled(**{"time": "t", "servo[N].ticks": "ticks", "tauN": "tau"}),
        knows={"units": "4096/rev"},
    ),
    "two clocks": form(
        {"clock_x": "t", "clock_y": "ms", "qN": "q", "tauN": "tau"}, time="clock_x"
    ),
    "rows that count": form(
        {"Takt": "row", "Ist-Position_AN": "deg", "Ist-Moment_AN": "tau"}, rate="250"
    ),
    "neither positions nor torques": form(
        {"t": "t", "aN": "q", "bN": "tau"}, position="a*", torque="b*"
    ),
    "joint that stands": Situation(
        ("logs.reader --columns",),
        "log log.csv arm.xml",
        log_of_some([0, 1, 3], [0, 1, 3], stands=2),
        is_fast=True,
        knows={"position.joint2": "0.7"},
    ),
    "registers with a sign bit": Situation(
        ("logs.reader --columns", "faults.scales --torque-scale"),
        "log log.csv arm.xml",
        registers_with_a_sign_bit,
    ),
    "rows twice": Situation(
        ("logs.reader --columns",),
        "log log.csv arm.xml",
        rows_twice_with_strange_titles,
    ),
    "publishers of one topic": Situation(
        ("step: log is fine",), "log log arm.xml", publishers_of_one_topic
    ),
    "joint without torque": Situation(
        ("logs.reader --columns",),
        "log log.csv arm.xml",
        log_of_some([0, 1, 2, 3], [0, 1, 3], stands=2),
        is_fast=True,
    ),
    "joint that stands, without torque": Situation(
        ("logs.reader --columns",),
        "log log.csv arm.xml --columns 'position.joint2 = 0.7'",
        log_of_some([0, 1, 3], [0, 1, 3], stands=2),
        is_fast=True,
    ),
    "last joint without torque": Situation(
        ("logs.column_map --columns",),
        "log log.csv arm.xml",
        log_of_some([0, 1, 2, 3], [0, 1, 2], stands=3),
    ),
    "earlier log in degrees": Situation(
        ("pipeline.comparison command",),
        "check arm.xml log.csv --since earlier.csv",
        earlier_log,
    ),
}
"""Name to situation."""


def test_everything_that_prints_a_command_has_a_situation():
    covered = {source for each in SITUATIONS.values() for source in each.sources}
    assert sources() == covered


def test_each_blank_of_a_form_has_a_situation():
    known = {key for each in SITUATIONS.values() for key in each.knows}
    assert known >= {*FILLINGS}


def printed_lines(output: str, knows: Mapping[str, str]) -> list[str]:
    """Return the commands of an output, their blanks filled in with what a person knows."""
    lines = []
    for line in re.findall("^  (robot-sysid .+)$", output, re.MULTILINE):
        for key in re.findall(r"([\w.]+) = \?", line):
            # What is asked for is said above the command.
            _, is_of_joint, joint = key.partition(".")
            asked = f"if {joint} stood still" if is_of_joint else FILLINGS[key]
            assert asked in output, output
            line = line.replace(f"{key} = ?", f"{key} = {knows[key]}")
        assert "?" not in line
        lines.append(line)
    return lines


def shows(source: str, outputs: str) -> bool:
    """Return whether a source has printed one of its commands."""
    _, _, state = source.partition("step: ")
    if state:
        sentence = STEPS[state].sentence
        words = STEPS[state].command.split("{")[0]
        return (
            sentence.partition("{")[0] in outputs or f"  robot-sysid {words}" in outputs
        )
    words = source.split()[1]
    lines = "\n".join(re.findall("^  robot-sysid .+$", outputs, re.MULTILINE))
    return ("robot-sysid " if words == "command" else words) in lines


def error_elsewhere(folder: str) -> float:
    """Return the torque error to expect of a result on other motions, over the torque."""
    content = json.loads((Path(folder) / "params.json").read_text())
    return float(content["file"]["elsewhere"]["after"]["relative_error"])


class Follower:
    """Runs printed commands until they lead to a result; keeps all that was printed."""

    def __init__(self, situation: Situation, arm: Any) -> None:
        self._ends = situation.ends
        self._knows = situation.knows
        self._bus = MotorBus(watchdog=0.5, echo=True)
        equipment = self._bus.equipment
        self._commands = motors.commands_with(equipment) if situation.has_motors else ()
        self._walk = None if arm is None else Walk(arm)
        self._tried: set[str] = set()
        self.outputs = ""

    def run(self, line: str) -> Step:
        """Run a command, with the recordings that it names and that do not exist yet."""
        self._tried.add(line)
        if self._walk is not None:
            self._walk.record_missing(line)
        with self._person():
            step = Step(line, *run_here(line, self._commands, is_hasty=True))
        self.outputs += step.output
        return step

    def _person(self) -> contextlib.AbstractContextManager[None]:
        """Return the person beside the arm on the bus, where there is one."""
        if not (self._commands and Path("arm.xml").exists()):
            return contextlib.nullcontext()
        return Person(self._bus, load_robot_model("arm.xml")).at_terminal()

    def lines_in(self, output: str) -> list[str]:
        """Return the commands of an output, as the person runs them."""
        return printed_lines(output, self._knows)

    def leads_on(self, line: str, is_step: bool, depth: int = 1) -> bool:
        """Return whether a command ends well, of a refusal if need be over others that it prints.

        Args:
            line: the command.
            is_step: whether it is a next step, which is refused by nothing.
            depth: how many commands it is away from the first one.
        """
        step = self.run(line)
        if step.code == 0:
            return True
        if self._ends and self._ends in step.output:
            return True
        further = [
            each for each in self.lines_in(step.output) if each not in self._tried
        ]
        if is_step or depth == MOST_COMMANDS:
            return False
        return any(self.leads_on(each, is_step, depth + 1) for each in further)


def cases(situations):
    """The names of situations; most of them are slow."""
    return [
        pytest.param(name, marks=() if each.is_fast else pytest.mark.slow)
        for name, each in situations.items()
    ]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", cases(SITUATIONS))
def test_every_printed_command_leads_on(name, tmp_path, monkeypatch):
    folder = tmp_path / "my arm"
    folder.mkdir()
    monkeypatch.chdir(folder)
    situation = SITUATIONS[name]
    follower = Follower(situation, situation.prepare())
    first = follower.run(f"robot-sysid {situation.words}")
    lines = follower.lines_in(first.output)
    assert lines, first.output
    for line in lines:
        assert follower.leads_on(line, first.code == 0), (line, follower.outputs)
    for source in situation.sources:
        assert shows(source, follower.outputs), (source, follower.outputs)
    before, after = situation.folders
    if after:
        assert error_elsewhere(after) < error_elsewhere(before)


READING = {name: each for name, each in SITUATIONS.items() if each.words[:4] == "log "}
"""Situations in which a log is read."""


def without_command(line: str) -> str:
    """Return a printed command without its name, and model and log in one order."""
    name, first, second, *options = shlex.split(line)[1:]
    names = sorted((first, second)) if name in ("log", "identify") else [name]
    return shlex.join([*names, *options])


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", cases(READING))
def test_log_and_identify_say_the_same_of_a_log(name, tmp_path, monkeypatch):
    """What stops one stops the other, in the same words and with the same remedies."""
    monkeypatch.chdir(tmp_path)
    READING[name].prepare()
    log = READING[name].words
    command, path, model, *options = shlex.split(log)
    identify = shlex.join(["identify", model, path, *options])
    codes = []
    errors = []
    remedies = []
    for words in (log, identify):
        code, output = run_here(f"robot-sysid {words}", is_hasty=True)
        codes.append(code)
        # A finding that is in the error is not printed before it, too.
        for finding in re.findall("^doubts: (.*)", output, re.MULTILINE):
            assert output.count(finding) == 1, output
        errors.append(re.findall("^robot-sysid: error: .*", output, re.MULTILINE))
        lines = re.findall("^  (robot-sysid .+)$", output, re.MULTILINE)
        remedies.append(sorted(map(without_command, lines)) if code else [])
    assert codes[0] == codes[1]
    assert errors[0] == errors[1]
    assert remedies[0] == remedies[1]

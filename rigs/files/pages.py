"""The commands and Python blocks of the pages, and a folder with the files that they name."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from string import Template
from types import MappingProxyType

import numpy as np

from rigs.arms import small_arms
from rigs.files.places import ROOT
from rigs.logs import recorded, servo_logs
from rigs.logs.log_files import read_measurements
from robot_sysid.cli import main
from robot_sysid.config import SelfTestConfig
from robot_sysid.damiao.joints import write_joint_map
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.motions import design_motion
from robot_sysid.records import join_recordings
from robot_sysid.records.messages import Progress
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulation.plant import load_plant, plant_measurements
from robot_sysid.trajectory import TrajectoryOptions

PAGES = sorted(
    [ROOT / "README.md", *ROOT.glob("docs/*.md"), ROOT / "examples/kinova/README.md"]
)
OTHERS = ["pip", "git", "cd", "conda", "sudo", "ros2", "pytest", "ruff", "python"]
OTHERS += ["mkdocs", "nc", "python3", "."]
"""Beginnings of lines that are not this tool's commands; scripts have tests of their own."""
AXES = (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X)
ARM = {
    "joint": 'range="-2.5 2.5" frictionloss=".4" damping=".2"',
    "tip_inertial": '<inertial pos=".03 .05 .1" mass="4" diaginertia=".03 .04 .02"/>',
}
"""Most of it is the terminal link, so that one log tells its mass without knowing the others."""
MODEL = {
    "joint": 'range="-2.5 2.5" frictionloss=".2" damping=".1"',
    "tip_inertial": '<inertial pos=".02 .04 .1" mass="3.5" diaginertia=".02 .03 .02"/>',
}
"""What the arm's model says instead."""
HOME = '<keyframe><key name="home" qpos="0 0 0 0"/></keyframe>'
"""Keyframe of the model, the pose in which all its joints are at zero."""
WEIGHT = "2.000"
"""Mass of the payload [kg], the one that docs/payload.md calls known."""
_BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_TABLE_COMMAND = re.compile(r"^\|.*\| `(robot-sysid [^`]+)` \|", re.MULTILINE)
_PRINTED = re.compile(
    r"^<!-- printed -->\n```text\n(.*?)^```$", re.DOTALL | re.MULTILINE
)
_VARIABLE = re.compile(r'^([A-Z]+)="(.*?)".*$', re.MULTILINE)
_EXIT_CODE = re.compile(r"# exit code (\d)")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.]*\w)")


def blocks(
    page: Path, variables: Mapping[str, str] = MappingProxyType({})
) -> list[tuple[str, str]]:
    """Return (language, text) of a page's blocks that can be run, then of its tables' commands.

    A variable of the shell, which the page sets at the beginning of a line, is replaced by its
    value, of those that ``variables`` has by the value there.
    """
    return blocks_of(page.read_text(encoding="utf-8"), variables)


def blocks_of(text: str, variables: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the blocks of a page's text, or of a part of it, see ``blocks``."""
    in_tables = [("bash", command) for command in _TABLE_COMMAND.findall(text)]
    found = _BLOCK.findall(text) + in_tables
    values = {
        name: value
        for language, block in found
        if language == "bash"
        for name, value in _VARIABLE.findall(block)
    }
    values.update(variables)
    plain = []
    for language, block in found:
        if language == "bash":
            block = Template(_VARIABLE.sub("", block)).safe_substitute(values)
        plain.append((language, block))
    return plain


def command_lines(block: str) -> list[list[str]]:
    """Return the words of each command of a block, continued lines joined, comments gone."""
    return [words for words, _ in commands(block)]


def commands(block: str) -> Iterator[tuple[list[str], int]]:
    """Yield the words of each command of a block, and the exit code that its comment states."""
    for line in block.replace("\\\n", " ").replace(" && ", "\n").splitlines():
        stated = _EXIT_CODE.search(line)
        words = shlex.split(line, comments=True)
        if words:
            yield words, int(stated[1]) if stated else 0


def printed(page: Path) -> list[str]:
    """Return the lines that a page says its commands print."""
    return "".join(_PRINTED.findall(page.read_text(encoding="utf-8"))).splitlines()


def is_said(line: str, page: str) -> bool:
    """Tell whether a text has a line with the same words and, up to a few per cent, numbers."""
    line_words, numbers = _parts(line)
    for words, other_numbers in map(_parts, page.splitlines()):
        if words == line_words and np.allclose(other_numbers, numbers, rtol=0.03):
            return True
    return False


def _parts(line: str) -> tuple[list[str], list[float]]:
    """Return the words of a line with # in place of each number, and the numbers."""
    numbers = list(map(float, _NUMBER.findall(line)))
    return _NUMBER.sub("#", line).split(), numbers


def make_workshop(folder: Path) -> None:
    """Write the models and logs that the pages speak of to a folder, the working one."""
    (folder / "examples").symlink_to(ROOT / "examples")
    make_models(folder)
    for number, log in enumerate(
        ("a", "d", "log1", "log2", "log3", "log", "e", "today")
    ):
        record(folder, "truth.xml", f"{log}.csv", number)
    for number, log in enumerate(("b", "c", "f")):
        record(folder, "loaded.xml", f"{log}.csv", 10 + number)
    record_servos(folder)
    motors = "--export-damiao" + 4 * " --motor-type DM8009"
    run(f"my_arm.xml --duration 12 --sample-rate 200 --output-dir made {motors}")
    for path in (folder / "made").glob("damiao*.csv"):
        path.rename(folder / path.name)
    joints = read_damiao_trajectory(folder / "damiao_trajectory.csv").joints
    named = []
    for k, joint in enumerate(joints):
        named.append(replace(joint, name=f"joint{k}", verified="hand"))
    write_joint_map(folder / "joint_map.csv", named)


def add_recordings(folder: Path) -> None:
    """Write log.csv again as the ROS bag that a page speaks of."""
    titles = [f"joint{k}" for k in range(len(AXES))]
    log = read_measurements(folder / "log.csv", titles)
    data = replace(log, qd=np.zeros_like(log.q))
    messages = recorded.shuffled_states(data, titles)
    topics = [("/joint_states", recorded.STATE, messages)]
    recorded.write_bag(folder / "run1.mcap", topics, "MCAP")


def make_models(folder: Path) -> None:
    """Write the true arm, alone and with a weight, under the names of the pages."""
    load = f'<body pos="0 0 .1"><inertial pos="0 .02 .03" mass="{WEIGHT}" '
    load += 'diaginertia=".004 .005 .003"/></body>'
    truth = small_arms.serial_arm(AXES, **ARM)
    loaded = small_arms.serial_arm(AXES, tip=load, **ARM)
    model = small_arms.serial_arm(AXES, extra=HOME, **MODEL)
    tool = small_arms.serial_arm(AXES, tip=load, **MODEL)
    texts = {"truth.xml": truth, "loaded.xml": loaded, "arm_with_tool.xml": tool}
    names = ("my_arm.xml", "arm.xml", "guess.xml", "MODEL.xml")
    texts.update(dict.fromkeys(names, model))
    texts["humanoid.xml"] = humanoid()
    texts["no_masses.urdf"] = no_masses()
    five = "[0.1, 0.1, 0.1, 0.1, 0.2]"
    texts["yam.yml"] = f"gravity_comp_factor: {five}\ncoulomb_friction: {five}\n"
    texts["follower.yaml"] = f"FollowerArmParam:\n  Fc: {five}\n  Fv: {five}\n"
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def record_servos(folder: Path) -> None:
    """Write the model of a small arm behind servos, and a log of it without torques."""
    path = folder / "servo_arm.xml"
    path.write_text(servo_logs.XML, encoding="utf-8")
    time, command = servo_logs.sines_and_steps()
    q = servo_logs.positions(load_robot_model(path), time, command)
    servo_logs.write(folder / "servo_log.csv", time, q, command)


def humanoid() -> str:
    """Return the model of an arm on a torso that turns, on a base that flies."""
    arm = small_arms.serial_bodies(AXES, **MODEL)
    torso = small_arms.link(small_arms.hinge("waist", small_arms.Z), arm, "torso")
    return small_arms.world(small_arms.link("<freejoint/>", torso, "pelvis"))


def no_masses() -> str:
    """Return the URDF of the arm that states no masses."""
    text = '<link name="base"/>'
    parent = "base"
    for number, axis in enumerate(AXES):
        name = f"link{number}"
        text += (
            f'<link name="{name}"/><joint name="joint{number}" type="revolute"><parent '
            f'link="{parent}"/><child link="{name}"/><origin xyz="0 .02 .25"/><axis xyz="{axis}"/>'
            '<limit lower="-2.5" upper="2.5" effort="100" velocity="2"/></joint>'
        )
        parent = name
    return f'<robot name="arm">{text}</robot>'


def record(
    folder: Path, plant: str, log: str, seed: int = 1, duration: float = 12.0
) -> None:
    """Write what the sensors of an arm in the folder report along a motion for my_arm.xml [s]."""
    robot = load_robot_model(folder / "my_arm.xml")
    settings = SelfTestConfig(trajectory=TrajectoryOptions(duration, 200.0, seed=seed))
    plan = design_motion(settings, robot, Progress()).plan
    sensors = SimulatedArmOptions(noise_torque=0.05, encoder_resolution=1e-5)
    truth = load_plant(robot, folder / plant)
    rng = np.random.default_rng([seed, 1])
    samples = join_recordings(plant_measurements(truth, plan, sensors, 200.0, rng))
    write_measurement_csv(folder / log, robot.joint_names, [samples])


def run(line: str) -> None:
    """Run a command line of robot-sysid in the working folder; its result need not be trusted."""
    assert main(line.split()) in (0, 1), line

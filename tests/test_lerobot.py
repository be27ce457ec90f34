"""The plan as a teleoperator of LeRobot: beside a stand-in of it, and beside LeRobot itself."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.small_arms import Y, Z, serial_arm
from rigs.files.places import ROOT
from rigs.logs.log_files import open_log
from robot_sysid.cli import main
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.motion.goals import LONGEST_STEP, load_goals
from robot_sysid.parser import load_robot_model

PLUGIN = "lerobot_teleoperator_robot_sysid"
ROBOT = "lerobot_robot_simulated_servos"
FOLDERS = {PLUGIN: ROOT / "plugins" / "lerobot", ROBOT: ROOT / "rigs" / "lerobot"}
GOALS = """time,pan goal position [rad],lift goal position [rad],slide goal position [m]
0,0.1,-0.2,0.01
1,0.5,0.2,0.02
2,0.1,-0.2,0.01
"""
SERVOS = "".join(
    f'<position name="joint{i}" joint="joint{i}" kp="300" forcerange="-30 30"/>'
    for i in (0, 1)
)
XML = serial_arm(
    (Z, Y),
    joint='range="-2.5 2.5" armature=".05" damping="1" frictionloss=".2"',
    extra=f"<actuator>{SERVOS}</actuator>",
)


class Teleoperator:
    """Stands for LeRobot's base class."""

    def __init__(self, config):
        self.id = config.id


@dataclass
class TeleoperatorConfig:
    """Stands for LeRobot's base class of options, which registers its kinds by name."""

    kinds = {}

    @classmethod
    def register_subclass(cls, name):
        return lambda config_class: cls.kinds.setdefault(name, config_class)

    id = None


@pytest.fixture
def plugin(monkeypatch):
    """The plug-in, imported beside a stand-in of LeRobot."""
    package = ModuleType("lerobot")
    stand_in = ModuleType("lerobot.teleoperators")
    stand_in.Teleoperator = Teleoperator
    stand_in.TeleoperatorConfig = TeleoperatorConfig
    monkeypatch.setitem(sys.modules, "lerobot", package)
    monkeypatch.setitem(sys.modules, "lerobot.teleoperators", stand_in)
    path = FOLDERS[PLUGIN] / f"{PLUGIN}.py"
    spec = importlib.util.spec_from_file_location(PLUGIN, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, PLUGIN, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def goals_file(tmp_path):
    path = tmp_path / "goals.csv"
    path.write_text(GOALS, encoding="utf-8")
    return path


class Clock:
    """A clock that goes on by 0.05 s a call."""

    now = 3.0

    def __call__(self):
        self.now += 0.05
        return self.now


def test_lerobot_finds_its_classes_by_name(plugin):
    """It makes the class that is called like the options without "Config"."""
    assert TeleoperatorConfig.kinds["robot_sysid"] is plugin.RobotSysidConfig
    assert plugin.RobotSysidConfig.__name__ == plugin.RobotSysid.__name__ + "Config"
    text = (FOLDERS[PLUGIN] / "pyproject.toml").read_text(encoding="utf-8")
    # LeRobot looks for distributions of this beginning, and imports a module of the whole name.
    assert f'name = "{PLUGIN}"' in text and PLUGIN.startswith("lerobot_teleoperator_")
    assert plugin.RobotSysid.name == "robot_sysid"


def test_goals_are_played_in_degrees_from_the_start_and_back_to_it(plugin, goals_file):
    start = {"pan": 20.0, "lift": -30.0, "slide": 0.01, "jaw": 7.0}
    config = plugin.RobotSysidConfig(goals_file, start)
    device = plugin.RobotSysid(config, Clock())
    with pytest.raises(ConnectionError):
        device.get_action()
    device.connect()
    assert device.is_connected and device.is_calibrated
    actions = [device.get_action() for _ in range(200)]
    assert all(set(action) == set(device.action_features) for action in actions)
    columns = {name: np.array([a[name] for a in actions]) for name in actions[0]}
    assert set(columns) == {f"{name}.pos" for name in start}
    assert np.all(columns["jaw.pos"] == 7.0)
    for name in ("pan", "lift", "slide"):
        column = columns[f"{name}.pos"]
        assert_allclose(column[[0, -1]], start[name], atol=1e-9)
    # Of an angle in degrees, of a slide in metres; half of a step of the clock is 2 % of them.
    assert_allclose(np.max(columns["pan.pos"]), np.degrees(0.5), rtol=0.021)
    assert_allclose(np.max(columns["slide.pos"]), 0.02, rtol=0.021)
    device.disconnect()
    assert not device.is_connected


def test_radians_are_for_robots_that_take_them(plugin, goals_file):
    config = plugin.RobotSysidConfig(
        goals_file, {"pan": 0.1, "lift": -0.2, "slide": 0.01}, unit="radians"
    )
    device = plugin.RobotSysid(config, Clock())
    device.connect()
    assert device.get_action() == {"pan.pos": 0.1, "lift.pos": -0.2, "slide.pos": 0.01}
    with pytest.raises(ValueError, match="use_degrees=true"):
        plugin.RobotSysidConfig(goals_file, unit="per cent")


def test_a_person_brings_the_arm_to_where_nobody_said_that_it_stands(
    plugin, goals_file, monkeypatch
):
    asked = []
    monkeypatch.setattr("builtins.input", asked.append)
    device = plugin.RobotSysid(
        plugin.RobotSysidConfig(goals_file, {"jaw": 7.0, "lift": 0.0}), Clock()
    )
    device.connect()
    assert len(asked) == 1 and "(degrees): pan 5.7, slide 0.0." in asked[0]
    first = device.get_action()
    assert_allclose(
        [first["pan.pos"], first["lift.pos"], first["jaw.pos"]],
        [np.degrees(0.1), 0.0, 7.0],
        atol=1e-9,
    )

    def nobody(_):
        raise EOFError

    monkeypatch.setattr("builtins.input", nobody)
    lonely = plugin.RobotSysid(plugin.RobotSysidConfig(goals_file))
    with pytest.raises(ConnectionError, match="--teleop.start='{pan: 0, lift: 0, "):
        lonely.connect()
    assert not lonely.is_connected


def test_files_and_speeds_that_cannot_be_played_are_refused(plugin, goals_file):
    with pytest.raises(InputError, match="factor above 0 and at most 1"):
        plugin.RobotSysid(plugin.RobotSysidConfig(goals_file, speed=2.0))
    goals_file.write_text("time,q\n0,1\n", encoding="utf-8")
    with pytest.raises(InputError, match="goals.csv, which robot-sysid plan"):
        plugin.RobotSysid(plugin.RobotSysidConfig(goals_file))


@pytest.fixture
def lerobot_environment(tmp_path):
    """Variables of a process in which LeRobot finds both plug-ins, as if they were installed."""
    if importlib.util.find_spec("lerobot") is None:
        pytest.skip("LeRobot is not installed")
    site = tmp_path / "site"
    for name in FOLDERS:
        metadata = site / f"{name}-1.0.dist-info" / "METADATA"
        metadata.parent.mkdir(parents=True)
        text = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
        metadata.write_text(text, encoding="utf-8")
    paths = [site, *FOLDERS.values(), ROOT]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "HF_HOME": str(tmp_path / "hugging_face"),
        "HF_HUB_OFFLINE": "1",
    }


@pytest.mark.slow
def test_lerobot_records_the_plan_and_the_servos_are_identified(
    lerobot_environment, arm_file, tmp_path, monkeypatch
):
    """LeRobot itself, on a simulated arm that speaks its interface."""
    monkeypatch.chdir(tmp_path)
    path = arm_file(XML)
    planned = "--for servos --excitation-time-budget 0.05 --seed 1 --duration 6"
    assert main(["plan", str(path), *planned.split(), "--output-dir", "plan"]) == 0
    start = "{joint0: 10, joint1: -20}"
    words = [
        *("--robot.type=simulated_servos", f"--robot.model={path}", "--robot.kp=30"),
        *(f"--robot.start={start}", f"--teleop.start={start}"),
        *("--teleop.type=robot_sysid", "--teleop.plan=plan/goals.csv"),
        *("--dataset.repo_id=me/set", "--dataset.root=set", "--dataset.fps=50"),
        *("--dataset.single_task=identify", "--dataset.num_episodes=1"),
        *("--dataset.episode_time_s=20", "--dataset.push_to_hub=false"),
        *("--dataset.video=false", "--play_sounds=false"),
    ]
    run = subprocess.run(
        [sys.executable, "-m", "lerobot.scripts.lerobot_record", *words],
        env=lerobot_environment,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert run.returncode == 0, run.stderr
    assert "the last pose is held" in run.stderr

    robot = load_robot_model(path)
    recording = open_log(robot, Path("set"), LogOptions(commanded=True))
    goals = load_goals(Path("plan/goals.csv"))
    assert_allclose(recording.command[0], np.radians([10.0, -20.0]), atol=1e-6)
    assert_allclose(recording.command[-1], np.radians([10.0, -20.0]), atol=1e-6)
    path_points = np.vstack((goals.q, recording.command[:1]))
    for extreme in (np.min, np.max):
        recorded = extreme(recording.command, axis=0)
        assert_allclose(recorded, extreme(path_points, axis=0), atol=0.02)
    # No step is longer than the fastest joint's way in the longest time that may pass.
    steps = np.max(np.abs(np.diff(recording.command, axis=0)))
    assert steps <= 2.0 * LONGEST_STEP

    # The gains of the model are ten times those of the robot, which a late loop does not hide.
    words = "identify arm.xml set --torque-from position-error --output-dir found"
    assert main(words.split()) == 0

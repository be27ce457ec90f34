"""An arm that is mounted otherwise than its model says: the printed command makes it right."""

from __future__ import annotations

import re
import shlex

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.wrong_arms import resting_torque, truth_of
from rigs.files import urdf
from rigs.files.command_line import CommandLine
from robot_sysid.dynamics.inverse_dynamics import with_gravity
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.mjcf.inertial import urdf_inertial_about_com
from robot_sysid.parser import load_robot_model

AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0")
MASSES = (3.0, 2.5, 2.0, 1.5)
LINKS = {
    f"l{k}": urdf_inertial_about_com(
        mass, np.array([0.02, 0.0, 0.1]), mass * np.diag([4e-3, 5e-3, (1 + k) * 1e-3])
    )
    for k, mass in enumerate(MASSES)
}
TURN = iter(AXES)
MODELS = {
    "arm.xml": small_arms.serial_arm(AXES, joint='range="-2.5 2.5"'),
    "arm.urdf": re.sub(
        '<axis xyz="0 0 1"/><origin xyz="0 0 0.2" rpy="0.1 0 0"/>',
        lambda _: f'<axis xyz="{next(TURN)}"/><origin xyz="0 0 0.2"/>',
        urdf.robot(urdf.serial(LINKS)).replace(
            '="-1" upper="1"', '="-2.5" upper="2.5"'
        ),
    ),
}
WALL = (9.81, 0.0, 0.0)
CEILING = (0.0, 0.0, 9.81)
POSES = np.random.default_rng(0).uniform(-1.0, 1.0, (20, len(AXES)))


def holding_torque(path):
    """Return the torque (20, 4) that holds the arm of a file in the poses."""
    robot = load_robot_model(path)
    return resting_torque(robot, POSES, robot.thetas)


def turned_base(text, origin):
    """Return a URDF without MuJoCo's settings, its base turned by an <origin>."""
    joint = '<joint name="mount" type="fixed"><parent link="ground"/>'
    joint += f'<child link="base"/>{origin}</joint>'
    text = re.sub(r"(?s)<mujoco>.*?</mujoco>", "", text)
    return text.replace("</robot>", f'<link name="ground"/>{joint}</robot>')


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MODELS))
@pytest.mark.parametrize(("gravity", "words"), [(WALL, "1 0 0"), (CEILING, "0 0 1")])
def test_the_printed_command_is_right(
    tmp_path, monkeypatch, capsys, name, gravity, words
):
    monkeypatch.chdir(tmp_path)
    command = CommandLine(tmp_path, capsys)
    path = tmp_path / name
    path.write_text(MODELS[name])
    robot = load_robot_model(path)
    truth = truth_of(with_gravity(robot, np.array(gravity)), seed=3)
    write_measurement_csv(tmp_path / "log.csv", robot.joint_names, [truth.log])
    refused = command.run(f"identify {name} log.csv --output-dir out", code=2).err
    line = refused.splitlines()[-1]
    assert (
        line
        == f"  robot-sysid identify {name} log.csv --output-dir out --gravity {words}"
    )
    done = command.run(*shlex.split(line)[1:])
    assert "Usable: " in done.out
    expected = resting_torque(truth.arm.robot, POSES, truth.arm.thetas)
    path = (tmp_path / "out" / "updated_model.xml").with_suffix(path.suffix)
    tolerance = 0.03 * np.max(np.abs(expected))
    assert_allclose(holding_torque(path), expected, atol=tolerance)
    if name == "arm.urdf":
        origin = re.search("<origin rpy=.*?/>", done.err)[0]
        path.write_text(turned_base(path.read_text(), origin))
        assert_allclose(holding_torque(path), expected, atol=tolerance)

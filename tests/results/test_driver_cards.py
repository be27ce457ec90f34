"""Cards for arms' own software: read back as that software reads them."""

from __future__ import annotations

import ast
import json
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.small_arms import random_theta
from rigs.files.model_files import write_files
from rigs.files.notes import NoteRecorder
from robot_sysid.config import IdentifyConfig
from robot_sysid.export import save
from robot_sysid.parser import load_robot_model
from robot_sysid.records.controllers import ALL, DRIVERS
from robot_sysid.records.file_access import ARM_CARD_NAMES
from robot_sysid.results.cards import FRICTION_SHARE
from tests.results.test_written_model import checkpoints, file_of, result_of

NAMES = {"joint0": "left_s1_0", "joint1": "left_s2_0", "joint2": "left_s3_0"}
JOINTS = {
    name: {"armature": 0.1, "damping": damping, "frictionloss": friction}
    for name, damping, friction in zip(
        NAMES.values(), (0.5, 0.25, 0.0), (1.25, 0.0, 0.125)
    )
}
SCALES = (1.0, 1.3, 1.1)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """An arm with the Axol's names, whose last link is two bodies."""
    joint = 'armature=".1" damping=".2" frictionloss=".3" range="-2 2"'
    text = small_arms.serial_arm(small_arms.SEVEN_AXES[:3], joint=joint)
    for name, other in NAMES.items():
        text = text.replace(f'name="{name}"', f'name="{other}"')
    path = write_files(tmp_path_factory.mktemp("in"), {"arm.xml": text})
    return load_robot_model(path)


@pytest.fixture(scope="module")
def result(robot):
    rng = np.random.default_rng(3)
    thetas = robot.thetas
    for k in range(robot.n_joints):
        thetas[k] += random_theta(rng, 0.3)
    identified = result_of(robot, thetas[-1], **file_of(JOINTS))
    return replace(identified, thetas=thetas, checkpoints=checkpoints(robot))


def card_of(result, robot, folder, software, **options):
    """The text of the card of one software."""
    config = IdentifyConfig.of(
        robot.path,
        measurements=("log.csv",),
        output_dir=folder,
        cards=software,
        **options,
    )
    save(result, config, NoteRecorder())
    return (folder / ARM_CARD_NAMES[software]).read_text()


def yaml_lists(text):
    """Key of a YAML of lists of numbers to the list, below the key of its table, if any."""
    values = {}
    table = ""
    for line in text.splitlines():
        if not line or line.startswith("#"):
            continue
        key, _, content = line.partition(":")
        if not content:
            table = f"{key}."
            continue
        assert line.startswith("  ") == bool(table)
        values[table + key.strip()] = ast.literal_eval(content.strip())
    return values


def friction(name, scales=SCALES):
    """Friction per joint, as a driver compensates it."""
    found = np.array([numbers[name] for numbers in JOINTS.values()])
    return FRICTION_SHARE * np.array(scales) * found


def test_i2rt_gets_factors_and_coulomb_friction_of_its_names(result, robot, tmp_path):
    text = card_of(result, robot, tmp_path, "i2rt", torque_scale=SCALES)
    card = yaml_lists(text)
    assert [*card] == ["gravity_comp_factor", "coulomb_friction"]
    assert card["gravity_comp_factor"] == [*SCALES]
    assert_allclose(card["coulomb_friction"], friction("frictionloss"), 5e-3)
    assert f"#   breakaway: {card['coulomb_friction']}" in text
    assert "ONLY WITH THE MODEL" in text


def test_openarm_gets_eight_numbers_so_that_its_program_finds_the_grippers(
    result, robot, tmp_path
):
    text = card_of(result, robot, tmp_path, "openarm")
    card = yaml_lists(text)
    assert "torque scales" not in text
    for node in ("LeaderArmParam", "FollowerArmParam"):
        for key, name in (("Fc", "frictionloss"), ("Fv", "damping")):
            *joints, gripper = card[f"{node}.{key}"]
            assert gripper == 0.0
            assert_allclose(joints, friction(name, (1.0, 1.0, 1.0)), 5e-3)
    assert len(card) == 4


def test_where_a_driver_has_no_place_for_scales_its_card_says_so(
    result, robot, tmp_path
):
    for software in ("openarm", "axol"):
        text = card_of(result, robot, tmp_path, software, torque_scale=SCALES)
        assert "no place for torque scales" in text and "1.0, 1.3, 1.1" in text


@pytest.fixture
def axol_sdk(tmp_path, monkeypatch):
    """A stand-in for the two functions of the SDK, by their names and arguments."""
    path = tmp_path / "calibration.json"
    path.write_text(
        json.dumps(
            {"left": {"shoulder_2": {"kp": 50.0, "friction": {"k": 7.0, "fo": 0.2}}}}
        )
    )

    def load_calibration():
        return {"left": {}, "right": {}, **json.loads(path.read_text())}

    def update_joint_calibration(side, joint, *, friction=None, com=None, mass=None):
        assert friction is not None and {*friction} == {"fc", "k", "fv", "fo"}
        content = load_calibration()
        entry = content[side].setdefault(joint, {})
        entry.update(friction=friction, com=com, mass=mass)
        path.write_text(json.dumps(content))
        return path

    module = types.ModuleType("almond_axol.robot.calibration")
    module.load_calibration = load_calibration
    module.update_joint_calibration = update_joint_calibration
    for name in ("almond_axol", "almond_axol.robot"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return load_calibration


def run_card(text):
    values = {"__name__": "__main__"}
    exec(compile(text, "axol_card.py", "exec"), values)


def test_the_axols_calibration_gets_links_and_friction_and_keeps_the_rest(
    result, robot, tmp_path, axol_sdk
):
    run_card(card_of(result, robot, tmp_path / "out", "axol"))
    found = axol_sdk()["left"]
    assert [*found] == ["shoulder_2", "shoulder_1", "shoulder_3"]
    assert found["shoulder_2"]["kp"] == 50.0
    kept = {name: entry["friction"]["k"] for name, entry in found.items()}
    assert kept == {"shoulder_2": 7.0, "shoulder_1": 100.0, "shoulder_3": 100.0}
    assert found["shoulder_2"]["friction"]["fo"] == 0.2
    names = ("shoulder_1", "shoulder_2", "shoulder_3")
    for index, name in enumerate(names):
        entry = found[name]
        theta = result.thetas[index]
        assert entry["mass"] == pytest.approx(theta[0], rel=1e-9)
        assert_allclose(np.array(entry["com"]) * theta[0], theta[1:4], 1e-8, 1e-12)
        numbers = [entry["friction"][key] for key in ("fc", "fv")]
        expected = [
            friction(key, (1.0,) * 3)[index] for key in ("frictionloss", "damping")
        ]
        assert_allclose(numbers, expected, 5e-3)


def test_another_arm_leaves_the_axols_calibration_alone(
    result, robot, tmp_path, axol_sdk
):
    before = axol_sdk()
    text = card_of(result, robot, tmp_path / "out", "axol")
    with pytest.raises(SystemExit, match="'left_q9' is no joint of axol.urdf"):
        run_card(text.replace("left_s3_0", "left_q9"))
    assert axol_sdk() == before


def test_all_means_all_simulators_and_a_card_of_another_choice_goes(
    result, robot, tmp_path
):
    for software in DRIVERS:
        card_of(result, robot, tmp_path, software)
        (left,) = (name for key, name in ARM_CARD_NAMES.items() if key == software)
        cards = {path.name for path in tmp_path.iterdir()} & {*ARM_CARD_NAMES.values()}
        assert cards == {left}
    card_of(result, robot, tmp_path, "drake")
    config = IdentifyConfig.of(
        robot.path, measurements=("log.csv",), output_dir=tmp_path, cards=ALL
    )
    written = save(result, config, NoteRecorder()).files
    names = {path.name for path in written}
    assert not names & {name for _, name in DRIVERS.values()}

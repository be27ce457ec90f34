"""``robot-sysid payload MODEL``: from logs without and with it to a model with the payload."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.files import schemas
from rigs.files.command_line import OUT
from rigs.files.params import rows
from rigs.logs.measured_logs import log_of
from rigs.logs.payload_logs import PAYLOAD
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import load_robot_model
from robot_sysid.trajectory import generate_excitation_trajectory

JOINT = 'range="-2.5 2.5" frictionloss=".3" damping=".2" armature=".02"'
AXES = (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X)
TOOL = (
    '<body name="tool"><inertial pos=".03 -.02 .08" mass="1.2" '
    'fullinertia=".006 .007 .004 .001 .0005 -.0004"/></body>'
)


@pytest.fixture
def models(arm_file):
    """An arm without and with a tool."""
    empty = arm_file(small_arms.serial_arm(AXES, joint=JOINT), "empty.xml")
    loaded = arm_file(small_arms.serial_arm(AXES, joint=JOINT, tip=TOOL), "loaded.xml")
    return empty, loaded


def record_logs(models, swapped=False):
    """The words that ask for the payload in logs of both arms, recorded in the order ABBA."""
    empty, loaded = map(load_robot_model, models[::-1] if swapped else models)
    plan = generate_excitation_trajectory(empty, np.random.default_rng(1), 15.0)
    paths = []
    for number, plant in enumerate((empty, loaded, loaded, empty)):
        log = log_of(plant, plan, [1, number], 100.0, noise_torque=0.02)
        paths.append(models[0].with_name(f"log{number}.csv"))
        write_measurement_csv(paths[-1], plant.joint_names, [log])
    logs = ("--empty", paths[0], paths[3], "--loaded", paths[1], paths[2])
    return (models[0], *logs, "--order ABBA")


@pytest.mark.slow
def test_a_payload_is_found_and_written_into_the_model_as_a_body(command, models):
    printed = command.run("payload", *record_logs(models), "--as-body gripper")
    content = schemas.check(OUT / "params.json")
    numbers = rows(content)
    mass = numbers["payload", "mass"]
    assert content["status"] == "OK" and content["valid"]["trustworthy"]
    assert mass["value"] == pytest.approx(PAYLOAD[0], abs=0.02)
    com = [numbers["payload", f"com_{axis}"]["value"] for axis in "xyz"]
    off = np.subtract(com, PAYLOAD[1:4] / PAYLOAD[0])
    assert np.max(np.abs(off)) < 0.005
    assert mass["reason"] == "the torque scales"
    row = re.search(r"^  mass +([\d.]+) +([\d.]+) +kg$", printed.out, re.MULTILINE)
    assert row is not None
    assert float(row[1]) == pytest.approx(mass["value"], abs=0.5 * float(row[2]))
    card = (OUT / "payload_card.txt").read_text()
    assert f"Payload of {row[1]} ± {row[2]} kg" in card
    written = compile_model(OUT / "updated_model.xml").mj_model
    assert written.body("gripper").mass[0] == pytest.approx(mass["value"], rel=1e-9)
    theta = small_arms.composite_theta(written, written.qpos0, written.body("link3").id)
    whole = numbers["link3 with payload", "mass"]["value"]
    assert theta[0] == pytest.approx(whole, rel=1e-9)
    assert whole == pytest.approx(numbers["link3", "mass"]["value"] + mass["value"])


@pytest.mark.slow
def test_swapped_recordings_are_refused_and_nothing_is_written_as_if_it_were_good(
    command, models
):
    printed = command.run("payload", *record_logs(models, swapped=True), code=1)
    assert "look swapped" in printed.err
    left = sorted(path.name for path in OUT.glob("[!.]*"))
    assert left == ["params.json", "report_data.npz", "run.toml"]
    content = schemas.check(OUT / "params.json")
    assert content["status"] == "SWAPPED" and not content["valid"]["trustworthy"]
    assert content["payload"]["card"] is None


@pytest.mark.slow
def test_a_known_mass_gives_a_file_of_torque_scales(command, models):
    options = ("--known-mass 1.2 --save-torque-scale scale.json",)
    printed = command.run("payload", *record_logs(models), *options)
    scales = json.loads((models[0].parent / "scale.json").read_text())["torque_scale"]
    assert list(scales) == ["joint0", "joint1", "joint2", "joint3"]
    # The third joint lifts the weight all the time.
    assert scales["joint1"]["value"] == pytest.approx(1.0, abs=0.01)
    assert "Torque scales by the known mass of 1.2 kg" in printed.out
    assert not (OUT / "updated_model.xml").exists()

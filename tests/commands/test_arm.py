"""``robot-sysid arm MODEL LOG...``: every link from logs, to the files and the exit code."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.commands import arm as module
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.identify.judgement.rollout.compare import compare
from robot_sysid.logs.reader import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.records.options import options_of
from tests.support import arms, option_samples
from tests.support.measured_logs import JOINT, log_of, plan_of, true_arm

XML = arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT)
SMOOTH = XML.replace(JOINT, JOINT.replace("frictionloss", "margin"))
QUICK = ("--cutoff", "8", "--friction-model", "coulomb-viscous-offset-armature")


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def logs(plant, tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / name for name in ("a.csv", "b.csv")]
    for seed, path in enumerate(paths):
        log = log_of(plant, plan_of(plant, seed), noise_torque=0.05)
        write_measurement_csv(path, plant.joint_names, [log])
    return paths


def test_every_option_of_the_estimation_is_one_of_the_command():
    taken = option_samples.keys_of(module.build_parser())
    assert {each.key for each in options_of(ArmOptions).values()} <= taken
    assert {"columns", "units", "validation_measurements", "output_dir", "joint"} <= taken


def test_a_run_writes_every_link_and_prints_it(command, arm_file, logs, plant):
    first, second = logs
    words = (arm_file(XML), first, "--validation-measurements", second, *QUICK)
    out = command.run("arm", *words).out
    content = json.loads((arm_file(XML).parent / "sysid_output" / "arm.json").read_text())
    assert content["status"] == "OK" and content["reasons"] == []
    assert [link["body"] for link in content["links"]] == ["link0", "link1", "link2"]
    for link, true in zip(content["links"], plant.links):
        assert set(link["standard_errors"]) == set(PARAMETER_NAMES)
        assert link["identified"]["mass"] == pytest.approx(true.theta[0], rel=0.05)
    assert set(content["joints"]) == set(plant.joint_names)
    coulomb = content["joints"]["joint2"]["coulomb"]
    assert coulomb["value"] == pytest.approx(0.3, abs=5.0 * coulomb["standard_error"] + 1e-3)
    assert len(content["base_parameters"]) == content["structural_rank"] == 15
    (test,) = content["validation"]
    assert test["relative_error"] < 0.05
    written = arms.robot_of(
        (arm_file(XML).parent / "sysid_output" / "updated_model.xml").read_text()
    )
    for mine, link in zip(written.links, content["links"]):
        assert mine.theta[0] == pytest.approx(link["identified"]["mass"], rel=1e-6)
    assert written.friction.coulomb == pytest.approx(0.3, abs=0.02)
    for said in ("link1 mass  ", "joint0: coulomb ", "15 of 15", "Validation on"):
        assert said in out


def test_what_is_said_about_the_model_is_said_of_the_file(command, arm_file, logs):
    message = command.refused("arm", arm_file(XML), logs[0], "--coupling", "none.json")
    assert "none.json" in message
    assert "LOG" in command.refused("arm", arm_file(XML))
    assert "--model-weight" in command.refused("arm", arm_file(XML), logs[0], "--model-weight", "0")


def test_a_file_that_is_read_is_not_written_over(command, arm_file, logs):
    path = arm_file(XML, "updated_model.xml")
    said = command.refused("arm", path, logs[0], "--output-dir", ".")
    assert "would overwrite a file that is read" in said


def test_torques_of_another_arm_give_no_model(command, arm_file, logs, tmp_path):
    """Torques that have nothing to do with the motion predict nothing."""
    rows = logs[0].read_text().splitlines()
    rng = np.random.default_rng(0)
    table = np.array([[float(v) for v in row.split(",")] for row in rows[1:]])
    columns = [k for k, title in enumerate(rows[0].split(",")) if "torque" in title]
    table[:, columns] = 5.0 * rng.normal(size=(len(table), len(columns)))
    path = tmp_path / "noise.csv"
    body = "\n".join(",".join(f"{v:.9g}" for v in row) for row in table)
    path.write_text(f"{rows[0]}\n{body}\n")
    printed = command.run("arm", arm_file(XML), path, *QUICK, code=1)
    assert "no model was written" in printed.err
    assert not list(tmp_path.rglob("updated_model*"))
    content = json.loads((tmp_path / "sysid_output" / "arm.json").read_text())
    assert content["status"] != "OK" and content["reasons"]


@pytest.mark.slow
def test_a_model_is_played_on_what_was_not_fitted_before_it_is_written(command, arm_file, logs):
    folder = arm_file(SMOOTH).parent / "sysid_output"
    out = command.run("arm", arm_file(SMOOTH), logs[0], "--verify-rollout", *QUICK).out
    entry = json.loads((folder / "arm.json").read_text())["rollout"]
    assert entry["is_better"] and entry["score"] < 0.7
    assert "the last fifth of every log" in entry["held_out"] and entry["held_out"] in out
    assert {(e["loop"], e["horizon"]) for e in entry["errors"]} >= {
        ("open loop", 0.1), ("closed loop", 1.0)
    }  # fmt: skip
    assert (folder / "updated_model.xml").exists()


@pytest.mark.slow
def test_a_model_that_moves_no_better_is_not_written(command, arm_file, logs, monkeypatch):
    def swapped(before, after, *rest):
        return compare(after, before, *rest)

    monkeypatch.setattr("robot_sysid.identify.arm.played.compare", swapped)
    words = ("arm", arm_file(SMOOTH), logs[0], "--validation-measurements", logs[1])
    words = (*words, "--verify-rollout", *QUICK)
    folder = arm_file(SMOOTH).parent / "sysid_output"
    refused = command.run(*words, code=1).err
    assert "not better than the old one" in refused and "--accept rollout" in refused
    assert (folder / "arm.json").exists() and not (folder / "updated_model.xml").exists()
    command.run(*words, "--accept", "rollout")
    assert (folder / "updated_model.xml").exists()


@pytest.mark.slow
def test_an_offset_goes_into_the_model_where_it_is_wanted(command, arm_file, plant, tmp_path):
    log = log_of(plant, plan_of(plant, 0), noise_torque=0.05)
    log = replace(log, tau=log.tau + [-0.1, 0.0, 0.15])
    write_measurement_csv(tmp_path / "log.csv", plant.joint_names, [log])
    words = ("arm", arm_file(XML), tmp_path / "log.csv", *QUICK)
    folder = arm_file(XML).parent / "sysid_output"
    for more in ((), ("--write-offset",)):
        command.run(*words, *more)
        joint = json.loads((folder / "arm.json").read_text())["joints"]["joint2"]
        assert ("offset_or_asymmetry" in joint["not_in_the_model"]) == (not more)
        model = load_robot_model(folder / "updated_model.xml").mj_model
        offset = -model.jnt_stiffness * model.qpos_spring
        expected = [-0.1, 0.0, 0.15] if more else 3 * [0.0]
        np.testing.assert_allclose(offset, expected, atol=0.03)
    assert "leave --keep-friction off" in command.refused(*words, *more, "--keep-friction")

"""``robot-sysid identify MODEL LOG...``: from logs, and nothing else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import robot_sysid as rs
from robot_sysid.api.results import one_thread
from robot_sysid.commands import identify as module
from robot_sysid.config import config_from
from robot_sysid.logs.reader import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.results.rollout import compare
from tests.support import arms, option_samples, schemas
from tests.support.command_line import files_in
from tests.support.measured_logs import JOINT, log_of, plan_of, true_arm

TAKEN = option_samples.keys_of(module.build_parser())
SAMPLES = [sample for sample in option_samples.samples() if sample.option.key in TAKEN]
LOGS = (Path("a.csv"), Path("b.csv"))
AXES = (arms.Z, arms.Y, arms.X)
XML = arms.serial_arm(AXES, joint=JOINT)
SMOOTH = XML.replace(JOINT, JOINT.replace("frictionloss", "margin"))
HEAVY = arms.serial_arm(AXES, joint=JOINT, tip_inertial=arms.TIP.replace('mass=".8"', 'mass="1.6"'))
QUICK = ("--cutoff", "8", "--friction-model", "coulomb-viscous-offset-armature")


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def logs(plant, tmp_path_factory):
    """Two logs of an arm like XML."""
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / name for name in ("a.csv", "b.csv")]
    for seed, path in enumerate(paths):
        log = log_of(plant, plan_of(plant, seed), noise_torque=0.05)
        write_measurement_csv(path, plant.joint_names, [log])
    return paths


def result_in(folder):
    """The content of the params.json there, which is what its schema says."""
    schemas.check(folder / "params.json")
    return json.loads((folder / "params.json").read_text())


def test_it_takes_what_logs_need_and_nothing_of_a_motion():
    assert {sample.option.key for sample in SAMPLES} == TAKEN
    assert {sample.option.needs for sample in SAMPLES} == {
        "",
        "log",
        "servos",
        "measured",
        "friction",
        "estimate",
        "prior",
    }


def test_the_logs_stand_after_the_model(asked):
    for logs in (LOGS[:1], LOGS):
        assert asked("arm.xml", *logs) == config_from("arm.xml", measurements=logs)


@pytest.mark.parametrize("sample", SAMPLES, ids=str)
def test_every_option_reaches_its_record(sample, asked):
    met = {"prior": ["--prior", "entropic"], "servos": ["--torque-from", "position-error"]}
    config = asked("arm.xml", "a.csv", *met.get(sample.option.needs, ()), *sample.words)
    assert getattr(getattr(config, sample.record), sample.field) == sample.value
    assert config.log.measurements == LOGS[:1]


def test_without_a_log_it_says_so(command, arm_file):
    message = command.refused("identify", arm_file(arms.THREE))
    assert "the following arguments are required: LOG" in message


def test_the_same_log_asked_in_every_way_gives_the_same_numbers(command, arm_file, logs):
    """To the last digit, printed and in every file."""
    path = arm_file(HEAVY)
    place = path.parent / "out"
    ways = {
        "identify": ("identify", path, logs[0]),
        "links": ("identify", path, logs[0], "--links"),
        "root": (path, "--measurements", logs[0]),
    }
    with one_thread():
        printed, files = {}, {}
        for name, words in ways.items():
            printed[name] = command.run(*words, "--output-dir", "out")
            files[name] = files_in(place)
    assert files["root"] == files["links"] == files["identify"]
    assert printed["root"] == printed["identify"]
    assert printed["links"].err == printed["identify"].err
    found = rs.identify(path, logs[0])
    assert found.to_dict() == result_in(place)
    found.save(path.parent / "saved")
    for name in ("params.json", "updated_model.xml"):
        assert (path.parent / "saved" / name).read_bytes() == files["root"][name]


def test_every_link_is_written_and_printed(command, arm_file, logs, plant):
    first, second = logs
    words = (arm_file(HEAVY), first, "--links", "--validation-measurements", second, *QUICK)
    out = command.run("identify", *words).out
    folder = arm_file(HEAVY).parent / "sysid_output"
    content = result_in(folder)
    assert content["status"] == "BETTER" and content["reasons"] == []
    assert [link["name"] for link in content["links"]] == ["link0", "link1", "link2"]
    for link, true in zip(content["links"], plant.links):
        error = link["standard_errors"]["m"]
        assert link["mass"] == pytest.approx(true.theta[0], rel=0.05, abs=2.0 * error)
    assert set(content["joints"]) == set(plant.joint_names)
    coulomb = content["joints"]["joint2"]["terms"]["coulomb"]
    assert coulomb["value"] == pytest.approx(0.3, abs=5.0 * coulomb["standard_error"])
    assert len(content["base_parameters"]) == content["structural_rank"] == 15
    written = load_robot_model(folder / "updated_model.xml")
    for mine, link in zip(written.links, content["links"]):
        assert mine.theta[0] == pytest.approx(link["in_the_file"]["mass"], rel=1e-6)
    assert written.friction.coulomb == pytest.approx(0.3, abs=0.02)
    (pair,) = content["file"]["others"]
    assert pair["after"]["relative_error"] < 0.05 < 0.2 < pair["before"]["relative_error"]
    assert f"Torque error of the model on {second}: " in out
    for said in ("link1 mass  ", "joint0: coulomb ", "Torque error of the model on held-out data"):
        assert said in out


def test_a_file_that_is_read_is_not_written_over(command, arm_file, logs):
    path = arm_file(XML, "updated_model.xml")
    said = command.refused("identify", path, logs[0], "--output-dir", ".")
    assert "would overwrite a file that is read" in said


def test_torques_that_do_not_follow_from_the_motion_change_nothing(
    command, arm_file, logs, tmp_path
):
    titles, *rows = logs[0].read_text().splitlines()
    table = np.array([[float(v) for v in row.split(",")] for row in rows])
    columns = [k for k, title in enumerate(titles.split(",")) if "torque" in title]
    table[:, columns] = 5.0 * np.random.default_rng(0).normal(size=(len(table), len(columns)))
    path = tmp_path / "noise.csv"
    np.savetxt(path, table, "%.9g", ",", header=titles, comments="")
    command.run("identify", arm_file(HEAVY), logs[0], *QUICK)
    message = command.refused("identify", arm_file(HEAVY), path, *QUICK, "--accept", "model")
    assert "98 % of the torque unexplained" in message


def test_logs_of_an_earlier_run_count_again(command, arm_file, logs):
    """As if all had been given at once."""
    path = arm_file(HEAVY)
    command.run("identify", path, logs[0], *QUICK)
    earlier = ("--append", "sysid_output/params.json", "--output-dir", "both")
    command.run("identify", path, logs[1], *QUICK, *earlier)
    command.run("identify", path, *logs, *QUICK, "--output-dir", "together")
    both, together = (result_in(path.parent / name) for name in ("both", "together"))
    assert both == together and both["logs"] == [str(log) for log in logs]


@pytest.mark.slow
def test_a_model_is_played_on_what_was_not_fitted_before_it_is_written(
    command, arm_file, logs, monkeypatch
):
    def swapped(robot, written, *rest):
        return compare(written, robot, *rest)

    words = ("identify", arm_file(SMOOTH), logs[0], "--verify-rollout", *QUICK)
    folder = arm_file(SMOOTH).parent / "sysid_output"
    out = command.run(*words).out
    entry = result_in(folder)["rollout"]
    assert entry["is_better"] and entry["score"] < 0.7
    assert "the last fifth of every log" in entry["held_out"] and entry["held_out"] in out
    assert {(e["loop"], e["horizon"]) for e in entry["errors"]} >= {
        ("open loop", 0.1), ("closed loop", 1.0)
    }  # fmt: skip
    assert (folder / "updated_model.xml").exists()
    monkeypatch.setattr("robot_sysid.results.rollout.compare", swapped)
    refused = command.run(*words, "--validation-measurements", logs[1], code=1).err
    assert "not better than the old one" in refused and "--accept rollout" in refused
    assert (folder / "params.json").exists() and not (folder / "updated_model.xml").exists()
    command.run(*words, "--validation-measurements", logs[1], "--accept", "rollout")
    assert (folder / "updated_model.xml").exists()


@pytest.mark.slow
def test_an_offset_goes_into_the_model_where_it_is_wanted(command, arm_file, plant, tmp_path):
    log = log_of(plant, plan_of(plant, 0), noise_torque=0.05)
    log = replace(log, tau=log.tau + [-0.1, 0.0, 0.15])
    write_measurement_csv(tmp_path / "log.csv", plant.joint_names, [log])
    words = ("identify", arm_file(HEAVY), tmp_path / "log.csv", *QUICK)
    folder = tmp_path / "sysid_output"
    for more in ((), ("--write-offset",)):
        command.run(*words, *more)
        held = {name: j["in_the_file"] for name, j in result_in(folder)["joints"].items()}
        model = load_robot_model(folder / "updated_model.xml").mj_model
        offset = dict(zip(held, -model.jnt_stiffness * model.qpos_spring))
        for joint, true in zip(held, (-0.1, 0.0, 0.15)):
            found = held[joint].get("offset", {"value": 0.0, "standard_error": 0.0})
            assert ("offset" in held[joint]) == bool(more and true)
            assert offset[joint] == pytest.approx(found["value"], rel=1e-4)
            assert not more or abs(offset[joint] - true) <= 4.0 * found["standard_error"]
    assert "leave --keep-friction off" in command.refused(*words, *more, "--keep-friction")


@pytest.mark.parametrize(
    ("part", "same"),
    [
        ("friction", ("dof_frictionloss", "dof_damping")),
        ("rotors", ("dof_armature",)),
        ("links", ("body_mass", "body_ipos", "body_inertia")),
    ],
)
def test_a_part_that_is_kept_stays_as_it_was(part, same, command, arm_file, logs):
    path = arm_file(HEAVY.replace('armature=".05"', 'armature=".04" ').replace('".3"', '".2"'))
    command.run("identify", path, logs[0], f"--keep-{part}", *QUICK)
    folder = path.parent / "sysid_output"
    assert result_in(folder)["file"]["kept"] == [part]
    written, own = (load_robot_model(p).mj_model for p in (folder / "updated_model.xml", path))
    for name in same:
        before, after = getattr(own, name), getattr(written, name)
        others = slice(0, -1) if part == "links" else slice(None)
        np.testing.assert_array_equal(after[others], before[others])
    moved = {"dof_frictionloss", "dof_armature", "body_mass"} - {*same} | {"body_inertia"}
    assert all(not np.array_equal(getattr(written, n), getattr(own, n)) for n in moved)

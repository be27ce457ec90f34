"""``robot-sysid identify MODEL LOG...``: from logs, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.files import params, schemas
from rigs.files.command_line import OUT, words_of
from rigs.logs import servo_logs
from rigs.logs.measured_logs import JOINT, log_of, plan_of, true_arm
from robot_sysid.api.results import one_thread
from robot_sysid.cli import main
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.records import InertialParameters
from robot_sysid.results.table import ORIGIN

HEAVY = small_arms.serial_arm(
    joint=JOINT, tip_inertial=small_arms.TIP.replace('mass=".8"', 'mass="1.6"')
)
TERMS = "coulomb-viscous-offset-armature"
QUICK = ("--friction-model", TERMS)


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def logs(plant, tmp_path_factory):
    """Two logs of the arm."""
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / name for name in ("a.csv", "b.csv")]
    for seed, path in enumerate(paths):
        log = log_of(plant, plan_of(plant, seed), noise_torque=0.05)
        write_measurement_csv(path, plant.joint_names, [log])
    return paths


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    """The model of an arm whose last link weighs twice as much."""
    path = tmp_path_factory.mktemp("model") / "arm.xml"
    path.write_text(HEAVY)
    return path


@pytest.fixture(scope="module")
def first(heavy, logs):
    """The folder of a run on the first log."""
    folder = heavy.with_name("first")
    options = ("identify", heavy, logs[0], *QUICK, "--output-dir", folder)
    with one_thread():
        assert main(words_of(options)) == 0
    return folder


def without_paths(content):
    """What params.json says, but for the lines that name the folder of the results."""
    return {k: v for k, v in content.items() if k not in ("verdict", "next_step")}


def test_a_program_gets_the_same_files(command, heavy, logs, first):
    """To the last bit."""
    result = rs.identify(heavy, logs[0], friction_model=TERMS)
    expected = without_paths(schemas.check(first / "params.json"))
    assert without_paths(result.to_dict()) == expected
    result.save("saved")
    model = (first / "updated_model.xml").read_bytes()
    assert without_paths(schemas.check(Path("saved/params.json"))) == expected
    assert Path("saved", "updated_model.xml").read_bytes() == model


@pytest.mark.slow
def test_every_link_is_written_and_printed(command, arm_file, logs, plant):
    first, second = logs
    options = (first, "--links --validation-measurements", second, *QUICK)
    out = command.run("identify", arm_file(HEAVY), *options).out
    content = schemas.check(OUT / "params.json")
    assert content["status"] == "BETTER" and content["failure"] is None
    numbers = params.rows(content)
    for name, true in zip(("link0", "link1", "link2"), plant.links):
        row = numbers[name, "mass"]
        bound = 2.0 * row["error"]
        assert row["value"] == pytest.approx(true.theta[0], rel=0.05, abs=bound)
    coulomb = numbers["joint2", "coulomb"]
    assert coulomb["value"] == pytest.approx(0.3, abs=5.0 * coulomb["error"])
    written = load_robot_model(OUT / "updated_model.xml")
    for link in written.links:
        printed = [numbers[link.body_name, name]["value"] for name in ORIGIN]
        off = np.abs(link.theta - printed) / InertialParameters(link.theta).scale
        assert np.max(off) < 1e-6
    assert written.friction.coulomb == pytest.approx(0.3, abs=0.02)
    (pair,) = content["file"]["others"]
    assert (
        pair["after"]["relative_error"] < 0.05 < 0.2 < pair["before"]["relative_error"]
    )
    assert f"Torque error of the model on {second}: " in out
    assert out.count("Before -> after") == 1
    for title in ("link0 mass", "link2 mass", "joint0 Coulomb friction"):
        assert out.count(f"  {title} ") == 1
    assert re.search(
        "\nUsable: sysid_output/updated_model.xml; torque error .* -> .* here.*, "
        ".* -> .* expected on other motions up to 2 rad/s\n",
        out,
    )


@pytest.mark.slow
def test_torques_that_do_not_follow_from_the_motion_change_nothing(
    command, arm_file, logs, tmp_path
):
    titles, *rows = logs[0].read_text().splitlines()
    table = np.loadtxt(rows[: len(rows) // 2], delimiter=",")
    columns = [k for k, title in enumerate(titles.split(",")) if "torque" in title]
    shape = (len(table), len(columns))
    table[:, columns] = 5.0 * np.random.default_rng(0).normal(size=shape)
    path = tmp_path / "noise.csv"
    np.savetxt(path, table, "%.9g", ",", header=titles, comments="")
    options = ("identify", arm_file(HEAVY), path, *QUICK)
    message = command.refused(*options, code=1)
    assert "the torques do not fit this model: " in message
    accepted = command.run(*options, "--accept unexplained --output-dir out", code=1)
    assert "no model was written" in accepted.err
    assert not Path("out", "updated_model.xml").exists()


@pytest.mark.slow
def test_what_is_kept_stays_as_it_was(command, arm_file, logs):
    path = arm_file(
        HEAVY.replace('armature=".05"', 'armature=".04" ').replace('".3"', '".2"')
    )
    keep = "--keep friction --keep rotors --keep links"
    command.run("identify", path, logs[0], keep, *QUICK)
    content = schemas.check(OUT / "params.json")
    assert content["file"]["kept"] == ["friction", "links", "rotors"]
    original = mujoco.MjModel.from_xml_path(str(path))
    written = mujoco.MjModel.from_xml_path("sysid_output/updated_model.xml")
    for name in ("dof_frictionloss", "dof_damping", "dof_armature"):
        assert_array_equal(getattr(written, name), getattr(original, name))
    for name in ("body_mass", "body_ipos", "body_inertia"):
        is_same = np.equal(getattr(written, name), getattr(original, name))
        assert np.all(is_same[:-1]) and not np.all(is_same[-1])


# --- where no torque was measured ----------------------------------------------------------------

JOINTS = ("joint0", "joint1")
SERVOS = ("--torque-from position-error",)


@pytest.fixture(scope="module")
def log_with_commands():
    """(time, positions, commands) of the true arm."""
    time, command = servo_logs.sines_and_steps()
    return (
        time,
        servo_logs.positions(small_arms.robot_of(servo_logs.XML), time, command),
        command,
    )


@pytest.fixture
def servo_log(log_with_commands, tmp_path):
    return servo_logs.write(tmp_path / "log.csv", *log_with_commands)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # half a minute of processor time; the machine may be busy
def test_servos_friction_and_rotor_inertia_are_found_and_written(
    command, arm_file, servo_log
):
    path = arm_file(servo_logs.XML)
    out = command.run("identify", path, servo_log, *SERVOS, "--verbose").out
    content = schemas.check(OUT / "servo.json")
    assert "No torque was measured" in content["torque"] and content["torque"] in out
    found, in_file = (
        {
            (row["of"], row["name"]): row
            for row in content["quantities"]
            if row["source"] in sources
        }
        for sources in (("data", "model"), ("file",))
    )
    for k, joint in enumerate(JOINTS):
        terms = ("gain", "damping", "frictionloss", "armature")
        for term, true in zip(terms, servo_logs.TRUTH.numbers[:, k]):
            number = found[joint, term]
            assert abs(number["value"] - true) < 4.0 * number["error"]
    rollout = content["rollout"]
    assert 3.0 * max(rollout["after"]) < max(rollout["before"])
    written = mujoco.MjModel.from_xml_path(str(OUT / "updated_model.xml"))
    for field, name in {
        "actuator_gainprm": "gain",
        "dof_damping": "damping",
        "dof_frictionloss": "frictionloss",
        "dof_armature": "armature",
    }.items():
        numbers = [in_file[joint, name]["value"] for joint in JOINTS]
        if name == "damping":  # What the servo commands within its limit is its kv.
            shares = [in_file[joint, "limited_damping"]["value"] for joint in JOINTS]
            numbers = np.multiply(numbers, np.subtract(1.0, shares))
        values = getattr(written, field).reshape(2, -1)[:, 0]
        assert_allclose(values, numbers, rtol=1e-6)
    text = (OUT / "updated_model.xml").read_text()
    assert text.count("<inertial") == servo_logs.XML.count("<inertial")


def test_what_cannot_be_used_is_said_in_one_line(
    command, arm_file, log_with_commands, tmp_path
):
    path = arm_file(servo_logs.XML)
    time, q, commands = log_with_commands
    still_log = servo_logs.write(tmp_path / "still.csv", time, 0.0 * q, commands)
    assert "at rest" in command.refused("identify", path, still_log, *SERVOS)
    one = servo_logs.write(tmp_path / "one.csv", time, q, commands)
    one.write_text(one.read_text().replace("action_joint1", "remark"))
    assert "the '?' filled in" in command.refused("identify", path, one, *SERVOS)

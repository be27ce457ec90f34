"""``robot-sysid check MODEL LOG --since EARLIER``: what it says, and what it refuses."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.files.command_line import CommandLine
from robot_sysid import spatial
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model

ARM = small_arms.serial_arm(small_arms.SEVEN_AXES[:4], joint='range="-2.5 2.5"')
OTHER = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y, small_arms.X, small_arms.Y), joint='range="-2.5 2.5"'
)
LOAD = spatial.theta_from_com(0.8, np.array([0.0, 0.02, 0.1]), 2e-3 * np.eye(3))
TURNED = np.radians(2.0) * np.eye(4)[1]
FRICTION_ALONE = np.array([1.0, 1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, an earlier log of an arm, and later ones of another motion."""
    folder = tmp_path_factory.mktemp("check")
    (folder / "arm.xml").write_text(ARM)
    robot = small_arms.robot_of(ARM)
    first = truth_of(robot, 2)
    motion = truth_of(robot, 3).motion
    noise = 0.02 * np.random.default_rng(1).standard_normal(motion.q.shape)
    same = first.arm.log(motion, noise)
    logs = {
        "earlier": first.log,
        "same": same,
        "turned": replace(same, q=same.q + TURNED),
        "sign": replace(same, tau=same.tau * FRICTION_ALONE),
        "carrying": first.arm.log(motion, noise, LOAD),
        "carrying_again": first.arm.log(first.motion, noise, LOAD),
        "still": replace(same, q=np.tile(same.q[:1], (len(same), 1))),
        "other": truth_of(small_arms.robot_of(OTHER), 3).log,
    }
    for name, log in logs.items():
        write_measurement_csv(folder / f"{name}.csv", robot.joint_names, [log])
    return folder


@pytest.fixture
def command(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    return CommandLine(folder, capsys)


def test_an_arm_is_what_it_was(command):
    printed = command.run("check arm.xml same.csv --since earlier.csv --json")
    content = json.loads(printed.out)
    assert not content["has_changed"] and content["since"] == ["earlier.csv"]
    assert content["verdict"][0].startswith("Unchanged: no difference beyond the err")
    rows = {(row["name"], row["of"]): row for row in content["changes"]}
    assert 0.0 < rows["m", "link3"]["least"] < 0.5
    assert rows["zero", "joint0"]["reason"] == "not shown"


@pytest.mark.slow
def test_a_zero_that_moved_is_named_with_its_size_and_what_to_do(command):
    printed = command.run("check arm.xml turned.csv --since earlier.csv", code=1)
    verdict = printed.out.splitlines()[-2:]
    size = re.match(
        r"Changed: the position of joint1 reads (\S+) ± (\S+) deg.* more$", verdict[0]
    )
    assert abs(float(size[1]) - 2.0) < 2.0 * float(size[2]) < 0.5
    assert verdict[1] == "What to do: set the joint's zero anew"


@pytest.mark.parametrize(
    ("log", "since", "texts"),
    [
        ("earlier", "earlier.csv", ("has the samples of", "give each log once")),
        ("still", "earlier.csv", ("still.csv: the arm is at rest",)),
        ("same", "still.csv", ("--since takes an earlier log, or the fol", "at rest")),
        ("same", "absent", ("cannot read the log absent",)),
        ("same", ".", ("--since takes", ". is a folder of no known form")),
    ],
)
def test_a_log_that_shows_nothing_or_is_none_is_refused(command, log, since, texts):
    printed = command.run(f"check arm.xml {log}.csv --since {since}", code=2)
    assert all(text in printed.err for text in texts)


def test_the_file_of_a_run_may_be_the_model_that_a_log_is_compared_with(
    folder, command
):
    """It lies where identify would write, which check does not."""
    result = folder / "sysid_output" / "updated_model.xml"
    result.parent.mkdir()
    result.write_text(ARM)
    command.run(f"check {result.relative_to(folder)} same.csv --since earlier.csv")
    assert list(result.parent.iterdir()) == [result]
    result.unlink()
    result.parent.rmdir()


def in_tonnes(text):
    """Return a model whose links weigh 1, 2, 1.5 and 0.7 kg, stated in tonnes."""
    masses = iter((1e-3, 2e-3, 1.5e-3, 0.7e-3))

    def inertial(stated):
        mass = next(masses)
        moments = " ".join(
            f"{mass * float(number):g}" for number in stated["moments"].split()
        )
        return f'mass="{mass:g}" fullinertia="{moments}"'

    return re.sub('mass=".*?" fullinertia="(?P<moments>.*?)"', inertial, text)


@pytest.mark.slow
def test_a_model_in_tonnes_goes_from_a_log_over_the_report_to_the_check(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    command = CommandLine(tmp_path, capsys)
    (tmp_path / "arm.xml").write_text(in_tonnes(ARM))
    robot = load_robot_model("arm.xml", mass_scale=1e3)
    truth = truth_of(robot, 2)
    motion = truth_of(robot, 3).motion
    noise = 0.02 * np.random.default_rng(1).standard_normal(motion.q.shape)
    later = truth.arm.log(motion, noise)
    for name, log in (("log.csv", truth.log), ("later.csv", later)):
        write_measurement_csv(tmp_path / name, robot.joint_names, [log])
    assert "--mass-scale 1000" in command.run("log log.csv arm.xml", code=2).err
    command.run("log log.csv arm.xml --mass-scale 1000")
    command.run("identify arm.xml log.csv --mass-scale 1000 --output-dir run")
    rows = json.loads((tmp_path / "run" / "params.json").read_text())["quantities"]
    (mass,) = [row for row in rows if (row["name"], row["of"]) == ("mass", "link3")]
    assert mass["model"] == pytest.approx(0.7)
    assert abs(mass["value"] - truth.theta[0]) < 2.0 * mass["error"]
    command.run("report run")
    page = (tmp_path / "run" / "report.html").read_text()
    assert "0.70" in page and f"{mass['value']:.2f}" in page
    line = "check arm.xml later.csv --since run"
    assert f"robot-sysid {line} --mass-scale 1000" in command.run(line, code=2).err
    assert "Unchanged" in command.run(f"{line} --mass-scale 1000").out
    # The file has its masses in kg.
    line = "check run/updated_model.xml later.csv --since log.csv"
    assert "Unchanged" in command.run(line).out


def test_a_doubt_about_the_earlier_log_is_said_to_be_its(folder, command):
    """Its clock jumps."""
    titles, *rows = (folder / "earlier.csv").read_text().splitlines()
    jumping = [titles]
    for number, row in enumerate(rows):
        time, comma, others = row.partition(",")
        jumping.append(f"{float(time) + 0.05 * (number // 700)}{comma}{others}")
    (folder / "jumping.csv").write_text("\n".join(jumping))
    printed = command.run("check arm.xml same.csv --since jumping.csv", code=1)
    assert "--since takes an earlier log" in printed.err
    assert "jumping.csv: the clock jumps" in printed.err


@pytest.mark.slow
@pytest.mark.parametrize("way", ["on", "off"])
def test_a_load_is_weighed_as_by_payload(folder, command, way):
    """Whichever side carries it, and although gears lose a part of it."""
    robot = small_arms.robot_of(ARM)
    arm = replace(truth_of(robot, 2).arm, loss=np.full(4, 0.1))
    weight = spatial.theta_from_com(0.5, np.array([0.0, 0.02, 0.1]), 1e-3 * np.eye(3))
    rng = np.random.default_rng(2)
    for name, seed, load in (("light", 2, 0.0), ("heavy", 3, 1.0)):
        motion = truth_of(robot, seed).motion
        noise = 0.02 * rng.standard_normal(motion.q.shape)
        log = arm.log(motion, noise, load * weight)
        write_measurement_csv(folder / f"{name}.csv", robot.joint_names, [log])
    pair = ("heavy.csv", "light.csv")
    log, since = pair if way == "on" else pair[::-1]
    line = f"check arm.xml {log} --since {since} --json"
    content = json.loads(command.run(line, code=1).out)
    assert f"kg came {way} at link3" in content["verdict"][0]
    row = content["changes"][0]
    weighed = rs.payload("arm.xml", "light.csv", "heavy.csv").payload
    assert abs(row["value"]) == pytest.approx(weighed.mass, abs=0.1 * row["error"])
    assert row["error"] >= 0.9 * weighed.errors[0]
    assert abs(abs(row["value"]) - 0.5) < 2.0 * row["error"] < 0.2


@pytest.mark.slow
def test_a_torque_of_the_other_sign_is_no_drift(command):
    printed = command.run("check arm.xml sign.csv --since earlier.csv", code=2)
    assert "torque of joint joint3 has the opposite sign" in printed.err
    # Columns put right are those of the log, not of the earlier one.
    command.run("check arm.xml sign.csv --since earlier.csv --columns sign_columns.txt")


@pytest.mark.slow
def test_a_log_of_another_arm_is_no_change(command):
    printed = command.run("check arm.xml other.csv --since earlier.csv", code=1)
    assert "error: other.csv: the torques do not fit this model" in printed.err


@pytest.mark.slow
def test_since_takes_the_folder_of_a_run_from_anywhere(command, folder, tmp_path):
    command.run("identify arm.xml earlier.csv --output-dir run")
    printed = command.run("check arm.xml same.csv --since run")
    assert "Unchanged" in printed.out
    result = rs.check("arm.xml", "same.csv", since="run")
    assert not result.has_changed and [*result.verdict] == printed.out.splitlines()[-2:]
    (folder / "earlier.csv").rename(folder / "moved.csv")
    printed = command.run("check arm.xml same.csv --since run", code=2)
    assert "--since takes" in printed.err and "earlier.csv: No such" in printed.err
    (folder / "moved.csv").rename(folder / "earlier.csv")


@pytest.mark.slow
def test_since_takes_the_folder_of_a_weighing_for_its_empty_logs(command):
    weigh = (
        "payload arm.xml --empty earlier.csv --loaded carrying.csv --output-dir weighed"
    )
    command.run(weigh)
    printed = command.run("check arm.xml same.csv --since weighed")
    assert "Unchanged" in printed.out
    assert (
        "those without the payload (/" in printed.err and "earlier.csv)" in printed.err
    )
    printed = command.run("check arm.xml carrying_again.csv --since weighed", code=1)
    assert re.search(r"Changed: 0\.[78]\d+ ± [\d.]+ kg came on", printed.out)

"""``robot-sysid log LOG MODEL``: what is in a log, and what is wrong with it."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.files import schemas
from rigs.files.command_line import OUT, CommandLine
from rigs.logs import recorded
from rigs.logs.payload_logs import TrueArm, wide_motion
from robot_sysid.commands.remedies import remedies
from robot_sysid.errors import InputError
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records import Recording
from robot_sysid.records.option_fields import write_torque_scale
from robot_sysid.spatial import theta_from_com

ARM = small_arms.serial_arm(small_arms.SEVEN_AXES[:4], joint='range="-2.5 2.5"')

ONE_KG = theta_from_com(1.0, np.array([0.05, 0.03, 0.1]), 2e-3 * np.eye(3))
PER_NM = np.array([0.08, 0.08, 0.1, 0.13])
"""Motor current per torque at each joint [A/(N m)]."""


@pytest.fixture(scope="module")
def truth():
    return truth_of(small_arms.robot_of(ARM), 2)


def late(log):
    """A channel that holds its value for 0.4 s, eight times."""
    tau = log.tau.copy()
    for start in range(200, 2600, 300):
        tau[start : start + 100, 1] = tau[start, 1]
    return replace(log, tau=tau)


def write_halves(folder, name):
    """Write positions of a log as q_NAME.csv and its torques as tau_NAME.csv."""
    rows = [
        line.split(",") for line in (folder / f"{name}.csv").read_text().splitlines()
    ]
    for half, word in (("q", "position"), ("tau", "torque")):
        kept = [
            k for k, title in enumerate(rows[0]) if "time" in title or word in title
        ]
        lines = [",".join(row[k] for k in kept) for row in rows]
        (folder / f"{half}_{name}.csv").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def folder(truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    log = truth.log
    (folder / "arm.xml").write_text(ARM)
    turned = replace(log, tau=log.tau * np.array([1.0, -1.0, 1.0, 1.0]))
    logs = {"log": log, "wrong": replace(log, tau=1e3 * log.tau), "late": late(log)}
    logs["turned"] = turned
    logs["strong"] = replace(log, tau=log.tau * np.array([1.0, 1.4, 1.0, 1.0]))
    logs["degrees"] = replace(log, q=np.degrees(log.q))
    for name, finding in logs.items():
        write_measurement_csv(
            folder / f"{name}.csv", truth.robot.joint_names, [finding]
        )
    text = (folder / "log.csv").read_text()
    for name in ("log", "turned"):
        write_halves(folder, name)
    (folder / "odd.csv").write_text(
        text.replace("joint0_torque", "joint0_torque\x1b[2J")
    )
    return folder


@pytest.fixture
def command(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    return CommandLine(folder, capsys)


def test_a_wrong_log_is_refused_and_right_with_the_scale_that_was_named(command):
    refused = command.run("log wrong.csv arm.xml", code=2).err
    assert "as in mN·m" in refused
    assert refused.endswith(
        "\n  robot-sysid log wrong.csv arm.xml --torque-scale 1000\n"
    )
    scaled = command.run("log wrong.csv arm.xml --torque-scale 1000")
    assert "nothing that stops an identification was found" in scaled.out


def test_remedies_keep_the_units_and_columns_that_were_given():
    error = InputError("", [("--units", "deg"), ("--columns", "rate = 5, time = t")])
    words = ["log.csv", "arm.xml", "--units", "ms", "--columns", "rate = 5"]
    values = {"units": "ms", "columns": "rate = 5"}
    assert [*remedies(error, "log", words, values)] == [
        "robot-sysid log log.csv arm.xml --columns 'rate = 5' --units ms,deg",
        "robot-sysid log log.csv arm.xml --units ms --columns 'rate = 5, time = t'",
    ]


def test_units_replace_those_of_their_kind():
    error = InputError("", [("--units", "us")])
    values = {"units": "ms,deg"}
    (line,) = remedies(
        error, "log", ["log.csv", "arm.xml", "--units", "ms,deg"], values
    )
    assert line == "robot-sysid log log.csv arm.xml --units deg,us"


@pytest.mark.slow
def test_degrees_end_with_the_command_that_declares_the_unit(command):
    """No arm is as fast as these are in radians."""
    lines = command.run("log degrees.csv arm.xml", code=2).err.splitlines()
    assert lines[1:] == ["  robot-sysid log degrees.csv arm.xml --units deg"]
    right = command.run("log degrees.csv arm.xml --units deg")
    assert "nothing that stops an identification was found" in right.out


@pytest.mark.slow
def test_a_turned_sign_is_put_right_with_the_command_that_is_named(folder, command):
    refused = command.run("log turned.csv arm.xml", code=2).err
    message, line = refused.splitlines()
    assert message.endswith(
        "turned_columns.txt has the columns put right: read it, and go on with it:"
    )
    words = "--columns turned_columns.txt"
    assert line == f"  robot-sysid identify arm.xml turned.csv {words}"
    lines = (folder / "turned_columns.txt").read_text().splitlines()
    assert lines[1:] == ["torque.joint1 = -joint1_torque"]
    right = command.run(f"log turned.csv arm.xml {words}")
    assert "nothing that stops an identification was found" in right.out


@pytest.mark.slow
def test_positions_and_torques_in_two_files_are_one_log(command):
    """The commands that are printed name both files."""
    printed = command.run("log q_log.csv tau_log.csv arm.xml").out
    assert "nothing that stops an identification was found" in printed
    last = printed.splitlines()[-1]
    assert last == "  robot-sysid identify arm.xml q_log.csv tau_log.csv"
    refused = command.run("log q_turned.csv tau_turned.csv arm.xml", code=2).err
    words = "--columns q_turned_columns.txt"
    last = refused.splitlines()[-1]
    assert last == f"  robot-sysid identify arm.xml q_turned.csv tau_turned.csv {words}"


def test_half_a_log_and_two_logs_are_refused(command):
    text = command.run("log q_log.csv arm.xml", code=2).err
    assert "if positions and torques are in two files, give both" in text
    text = command.run("log log.csv turned.csv arm.xml", code=2).err
    assert "log.csv, turned.csv are logs of their own: check them one by one" in text


def test_the_order_of_a_payload_has_a_letter_for_each_log_not_for_each_file(command):
    empty = "--empty q_log.csv tau_log.csv"
    loaded = "--loaded q_turned.csv tau_turned.csv"
    text = command.run(f"payload arm.xml {empty} {loaded} --order AABB", code=2).err
    assert "--order AABB: needs 1 times A (the empty logs) and 1 times B" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("relative_error", "found"), [(0.2, []), (0.005, [("torque-scale", "says")])]
)
def test_a_file_of_scales_says_how_sure_they_are(
    folder, command, truth, relative_error, found
):
    """A scale within what its file says is no finding; one beyond is, as without a file."""
    scales = dict.fromkeys(truth.robot.joint_names, (1.0, relative_error))
    write_torque_scale(folder / "scale.json", scales)

    def findings(scale):
        line = f"log strong.csv arm.xml --torque-scale {scale} --accept torque-scale"
        answer = json.loads(command.run(f"{line} --json").out)
        return [(each["about"], each["level"]) for each in answer["findings"]]

    assert findings("scale.json") == found
    assert findings("1") == [("torque-scale", "says")]


@pytest.mark.slow
def test_a_warning_stops_unless_it_is_accepted(command):
    printed = command.run("log late.csv arm.xml --json", code=1)
    answer = json.loads(printed.out)
    levels = {finding["about"]: finding["level"] for finding in answer["findings"]}
    assert levels.pop("held") == "doubts" and {*levels.values()} <= {"says"}
    assert answer["samples"] == 3000
    message = command.refused("log late.csv arm.xml", code=1)
    assert "8 times in all, too much" in message and "--accept held" in message
    printed = command.run("log late.csv arm.xml --accept held")
    assert "doubts: a sensor failed from 0.80 s to 1.20 s (joint1)" in printed.out


@pytest.mark.slow
def test_a_result_in_spite_of_a_doubt_is_not_called_usable_without_that_word(command):
    command.refused("identify arm.xml late.csv", code=1)
    assert not Path(OUT, "updated_model.xml").exists()
    printed = command.run("identify arm.xml late.csv --accept held")
    use = "\nUsable only if the accepted doubts do no harm: "
    assert f"{use}sysid_output/updated_model.xml; torque error" in printed.out
    content = schemas.check(OUT / "params.json")
    assert content["status"] == "ACCEPTED" and not content["valid"]["trustworthy"]
    (remark,) = (each for each in content["remarks"] if each["level"] == "doubts")
    assert remark["text"].startswith("accepted in spite of doubts: held")
    assert Path(OUT, "updated_model.xml").exists()


def test_titles_cannot_steer_the_terminal(command):
    assert "\x1b" not in command.run("log odd.csv arm.xml", code=2).err


def test_a_data_set_without_torque_ends_with_the_command_that_needs_none(
    command, folder, truth
):
    positions = [f"{name}.pos" for name in truth.robot.joint_names], truth.log.q
    features = {"observation.state": positions, "action": positions}
    recorded.write_data_set(folder / "set", "v3.0", 200, features)
    message = command.run("log set arm.xml --episode 0", code=2).err
    assert message.splitlines()[-1] == (
        "  robot-sysid identify arm.xml set --episode 0 --torque-from position-error"
    )


@pytest.mark.slow
def test_motor_currents_end_with_the_command_that_weighs_their_constants(
    command, folder
):
    """It runs as printed when the log with the weight is there, and its file is the truth's."""
    arm = TrueArm(small_arms.robot_of(ARM), 1, model_error=0.05, payload=ONE_KG)
    for seed, name in enumerate(("ampere", "weight")):
        motion = wide_motion(seed, joints=4, duration=15.0, rate=250.0)
        torque = arm.recording(motion, name == "weight").tau
        torque += np.random.default_rng(seed).normal(0.0, 0.02, torque.shape)
        log = Recording(motion.time, motion.q, motion.qd, PER_NM * torque)
        write_measurement_csv(folder / f"{name}.csv", arm.robot.joint_names, [log])
    payload = "payload arm.xml --empty ampere.csv --loaded"
    runs = (
        "log ampere.csv arm.xml",
        "identify arm.xml ampere.csv",
        f"{payload} weight.csv",
    )
    remedies = set()
    scales = []
    for words in runs:
        message, remedy = command.run(words, code=2).err.splitlines()[-2:]
        assert "motor currents" in message
        before, scale, after = re.split(r"(?<=--torque-scale )(\S+)", remedy)
        remedies.add((before, after))
        scales.append(float(scale))
    # A payload's scale is that of both of its logs.
    assert len(remedies) == 1
    assert scales == pytest.approx(scales[:1] * 3, rel=0.05)
    known = f"{payload} weight.csv --known-mass 1"
    remedy_of_known = command.run(known, code=2).err.splitlines()[-1]
    assert remedy_of_known.startswith(f"  robot-sysid {known} --torque-scale ")
    words = shlex.split(remedy)
    assert words[:4] == ["robot-sysid", "payload", "arm.xml", "--empty"]
    command.run(" ".join(words[1:]))
    content = json.loads((folder / "torque_scale" / "torque_scale.json").read_text())[
        "torque_scale"
    ]
    scales = [entry["value"] for entry in content.values()]
    np.testing.assert_allclose(scales, PER_NM, rtol=0.05)

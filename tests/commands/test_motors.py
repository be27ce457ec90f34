"""The command robot-sysid motors: check, play, simulate."""

from __future__ import annotations

import io
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.files.command_line import MotorsCommandLine, files_in, words_of
from rigs.motors.damiao_rig import (
    COARSE_STEP,
    fault,
    map_line,
    only_asks,
    swing,
    trajectory_file,
)
from rigs.motors.realtime_arm import NEEDS_TERMINALS, arm_process
from rigs.motors.recordings import read_recording
from robot_sysid.damiao.bus import SystemClock
from robot_sysid.damiao.execution import Equipment
from robot_sysid.damiao.joints import write_joint_map
from robot_sysid.damiao.protocol import DISABLED
from robot_sysid.parser import load_robot_model

CAN0 = "--channel can0"
AT_50 = "--rate 50"


@pytest.fixture
def trajectory(tmp_path):
    return write_trajectory(tmp_path, swing(2, duration=0.5, amplitude=0.05))


def write_trajectory(folder, motion):
    return trajectory_file(folder, motion).path


def refuse_real_time(*_):
    raise AssertionError("asked for real time")


class RefusedClock(SystemClock):
    """A clock that nobody may ask."""

    now = sleep_until = refuse_real_time


def times_opened(path, monkeypatch):
    """Return the list to which the path is added whenever it is opened."""
    opened = []
    really_open = io.open

    def note_and_open(file, *arguments, **options):
        if not isinstance(file, int) and Path(file) == path:
            opened.append(path)
        return really_open(file, *arguments, **options)

    monkeypatch.setattr("io.open", note_and_open)
    monkeypatch.setattr("builtins.open", note_and_open)
    return opened


# --- check --------------------------------------------------------------------------------------


def test_check_prints_a_table_and_enables_nothing(motors, bus, trajectory):
    fault(1, TIMEOUT=1e5)(bus)
    out = motors.succeed("check", trajectory, CAN0)
    assert "ready to play" in out
    assert re.search(
        r"2 +0x12 +MIT +12.5 +10 +28 +DM4340 +5000 ms .* 31/29 +status 0", out
    )
    assert only_asks(bus.wire.sent)
    assert bus.states() == [DISABLED] * 2


def test_what_is_said_is_the_result_as_json(motors, bus, trajectory):
    limits = "--max-velocity 9 --max-torque 20,27"
    check = ("motors check", trajectory, CAN0, "--json", limits)
    code, out, err = motors.run_program(words_of(check))
    assert code == 0
    answer = json.loads(out)
    assert (answer["command"], answer["exit_code"]) == ("check", 0)
    assert (
        answer["lines"] == err.splitlines()
        and answer["lines"][-3:] == answer["verdict"]
    )
    record = trajectory.with_name("slow.csv")
    options = (CAN0, "--speed 0.3 --record", record, limits)
    following = words_of(("robot-sysid motors play", trajectory, *options))
    assert answer["verdict"][0] == "Usable: ready to play"
    assert shlex.split(answer["verdict"][2]) == following
    assert answer["next_step"]["command"] == following
    fault(0, CTRL_MODE=2)(bus)
    play = words_of(("motors play", trajectory, CAN0, "--yes --json"))
    code, out, _ = motors.run_program(play)
    assert code == 3
    answer = json.loads(out)
    assert answer["verdict"][0].startswith(
        "Not usable: not played: motor 1 is in mode 2"
    )


def test_check_says_what_has_to_change_in_the_names_of_a_map(
    motors, bus, trajectory, tmp_path
):
    table = tmp_path / "map.csv"
    write_joint_map(table, [map_line("hip", 1, 0x11), map_line("knee", 2, 0x12)])
    fault(0, CTRL_MODE=2)(bus)
    fault(1, TMAX=40, TIMEOUT=0)(bus)
    code, out, _ = motors.run("check", trajectory, CAN0, "--joint-map", table)
    assert code == 1 and "not DM4340!" in out and "3 to change before playing" in out
    mode = "motor 1 (joint hip) is in mode 2 (POS_VEL); set it to MIT with motors"
    assert f"[STOP] {mode}" in out
    assert "[STOP] motor 2 (joint knee)'s watchdog of 0 ms" in out
    findings = [line for line in out.splitlines() if line.startswith("[")]
    assert all("motor 1 (joint hip)" in line for line in findings if "motor 1" in line)


def test_what_has_to_change_is_changed_by_the_words_that_are_printed(
    motors, bus, trajectory
):
    fault(0, CTRL_MODE=2, TIMEOUT=0)(bus)
    fault(1, MST_ID=0x15)(bus)
    _, out, _ = motors.run("check", trajectory, CAN0)
    words = re.findall(r"with motors (setup .*? --store)", out)
    assert len(words) == 3
    for setup in words:
        motors.succeed(setup, CAN0)
    # The answer to the last one is still on this bus.
    motors.succeed("setup", CAN0)
    assert "ready to play" in motors.succeed("check", trajectory, CAN0)


def test_check_without_a_bus_checks_the_file(motors, bus, trajectory):
    motors.succeed("check", trajectory)
    code, out, _ = motors.run("check", trajectory, "--rate 2000")
    assert code == 1 and "limit 70 %; use --rate 250" in out
    assert bus.wire.frames == []


# --- play ---------------------------------------------------------------------------------------


def test_playing_needs_a_confirmation(motors, bus, trajectory, monkeypatch):
    err = motors.fail(2, "play", trajectory, CAN0)
    assert "give --yes" in err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda prompt: "no")
    err = motors.fail(2, "play", trajectory, CAN0)
    assert "not confirmed" in err
    assert only_asks(bus.wire.sent)
    monkeypatch.setattr("builtins.input", lambda prompt: " Yes ")
    motors.succeed("play", trajectory, CAN0, AT_50)


def test_play_records_but_over_no_file_and_nobody_is_asked_first(
    motors, bus, trajectory, tmp_path, person
):
    existing = tmp_path / "measured.csv"
    record = "--record", existing
    existing.write_text("precious")
    played = trajectory.read_bytes()
    err = motors.fail(2, "play", trajectory, CAN0, *record)
    assert f"{existing.name} exists" in err and "--overwrite" in err
    same = tmp_path / ".." / tmp_path.name / trajectory.name
    over_itself = "--record", same, "--overwrite"
    err = motors.fail(2, "play", trajectory, CAN0, *over_itself)
    assert "would overwrite a file that is read" in err
    nowhere = "--record", tmp_path / "missing" / "measured.csv"
    err = motors.fail(2, "play", trajectory, CAN0, *nowhere)
    assert "its folder is missing" in err
    assert existing.read_text() == "precious" and trajectory.read_bytes() == played
    assert {*files_in(tmp_path)} == {trajectory.name, existing.name}
    options = CAN0, *record, AT_50, "--yes --kd 2 --overwrite"
    out = motors.succeed("play", trajectory, *options)
    assert "all motors are disabled" in out and bus.states() == [DISABLED] * 2
    recording = read_recording(existing)
    assert recording.ending == "completed" and "kd=2 2" in recording.head
    assert len(recording.columns["time"]) == 26 and person[1] == []


FAST = "--rate 125 --yes"


@pytest.mark.slow
def test_a_run_without_missing_answers_says_so_in_a_line(motors, bus, trajectory):
    out = motors.succeed("play", trajectory, CAN0, FAST)
    assert "every command was answered" in out and "lost" not in out
    lines = [line.split() for line in out.splitlines()]
    assert ["motor", "1", "20", "20"] in [line[:4] for line in lines]
    assert lines.count(["error", "frames", "on", "the", "bus:", "0"]) == 1


def test_a_fault_that_a_motor_reports_while_it_drives_is_the_verdict(
    motors, bus, trajectory
):
    bus.at(1.0, lambda: fault(1, false_status=3)(bus))
    code, out, _ = motors.run("play", trajectory, CAN0, FAST)
    assert code == 1 and bus.states() == [DISABLED] * 2
    *_, verdict, remedy = out.splitlines()
    pattern = "Not usable: motor 2 reported status 3: .* in (\\d+) answers; played to"
    (count,) = re.findall(pattern, verdict)
    assert remedy.startswith("Find the cause")
    row = rf"motor 2 +\d+ +0 +0.0 +0 +{count} +status 3: .* \({count} times\)"
    assert re.search(row, out) and re.search(
        r"motor 1 +\d+ +0 +0.0 +0 +0 +-$", out, re.M
    )
    assert "error frames on the bus: 0" in out.split("largest distance")[1]


def test_a_run_that_is_stopped_says_how_the_motors_answered(motors, bus, trajectory):
    bus.at(3.0, lambda: fault(1, lost_replies=True)(bus))
    code, out, _ = motors.run("play", trajectory, CAN0, FAST)
    assert code == 3
    assert re.search(r"motor 2 +\d+ +[1-9]\d* +[\d.]+ +0 +0 +-$", out, re.M)


def test_interrupting_before_anything_moves(motors, bus, trajectory, person):
    def interrupt():
        raise KeyboardInterrupt

    person[0].append(interrupt)
    err = motors.fail(130, "play", trajectory, CAN0)
    assert "no motor is enabled" in err
    assert only_asks(bus.wire.sent)


# --- usage --------------------------------------------------------------------------------------


BAD_USAGE = {
    "fly": "unknown command 'fly'; valid: simulate, check, play, hold, move, setup",
    "check": "the following arguments are required: TRAJECTORY",
    "play T": "this command needs --channel",
    "play --channel can0": "the following arguments are required: TRAJECTORY",
    "play missing.csv --channel can0": "cannot read missing.csv",
    "check T --interface udp_multicast": "invalid choice: 'udp_multicast'",
    "simulate T": "the following arguments are required: --model",
}


def test_bad_usage_is_one_line_and_exit_code_2(motors, trajectory):
    for line, message in BAD_USAGE.items():
        assert message in motors.fail(2, line.replace("T", str(trajectory))), line


# --- a model of the arm -------------------------------------------------------------------------

NARROW = 'range="-.3 .3"'


def test_a_trajectory_beyond_the_joint_ranges_is_refused_by_all(
    motors, bus, tmp_path, arm_file
):
    """Play and simulate refuse what check has to say."""
    trajectory = write_trajectory(tmp_path, swing(2, amplitude=0.98))
    model = (
        "--model",
        arm_file(small_arms.serial_arm((small_arms.Z, small_arms.Y), joint=NARROW)),
    )
    record = "--record", tmp_path / "measured.csv"
    files = set(tmp_path.iterdir())
    messages = set()
    for command, *options in (
        ("play", CAN0, "--yes", *record),
        ("simulate", *record),
        ("simulate", CAN0),
    ):
        err = motors.fail(3, command, trajectory, *model, *options)
        messages.add(re.search("not (played|rehearsed): (.*)", err)[2])
    (message,) = messages
    for channel in ((CAN0,), ()):
        code, out, _ = motors.run("check", trajectory, *model, *channel)
        stops = re.findall(r"\[STOP\] +(.*)", out)
        assert code == 1 and stops[0] == message
        for number, stop in enumerate(stops[:2]):
            name = f"motor {number + 1} (joint joint{number})"
            beyond = "position 0.98 rad is beyond the model's limit, 0.3, at "
            assert stop.startswith(f"{name}: {beyond}")
    assert set(tmp_path.iterdir()) == files and only_asks(bus.wire.sent)


def test_limits_hold_for_what_is_played(motors, bus, trajectory, arm_file):
    """At 0.31 rad/s; planes only with a model, and models of as many joints."""
    three = arm_file(small_arms.THREE)
    for code, options, message in (
        (2, "--keep-out 0 0 1 0", "--keep-out is about a model; add --model"),
        (2, f"--model {three}", f"has 2 joints but the chain of {three} has 3"),
        (3, "--max-velocity 0.3", "rad/s is beyond your limit, 0.3"),
    ):
        assert bus.wire.frames == []
        assert message in motors.fail(code, "play", trajectory, CAN0, "--yes", options)
    assert only_asks(bus.wire.sent)


# --- simulate -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_rehearsal_takes_no_real_time_and_reads_its_model_once(
    capsys, trajectory, model, tmp_path, monkeypatch
):
    """Its recording is too short to be judged as ``check`` does, which would read it again."""
    opened = times_opened(model, monkeypatch)
    load_robot_model(model)
    once = len(opened)
    opened.clear()
    monkeypatch.setattr("time.sleep", refuse_real_time)
    equipment = Equipment(RefusedClock(), refuse_real_time, COARSE_STEP)
    motors = MotorsCommandLine(capsys, equipment)
    record = tmp_path / "measured.csv"
    arguments = ("--model", model, "-v --fd --rate 50 --overwrite --record", record)
    out = motors.succeed("simulate", trajectory, *arguments)
    assert (
        "played 26 cycles, 0 skipped; started late by 0.00 ms" in out
        and len(opened) == once > 0
    )
    # The command that is printed records nothing.
    assert "Next, with the arm connected, find out" in out and "--overwrite" not in out
    assert "friction of which the model knows nothing" in out
    assert "identify" in out and "--accept computed" not in out
    recording = read_recording(record)
    assert recording.ending == "completed"
    assert np.all(np.isfinite(recording.joint_values("pos")))
    first = record.read_bytes()
    # Of an arm that is exactly the model's, which has no friction, nothing is to be found.
    out = motors.succeed("simulate", trajectory, *arguments, "--plant-model", model)
    assert "identify" not in out and "knows nothing" not in out
    assert record.read_bytes() != first
    out = motors.succeed("simulate", trajectory, *arguments, "--speed 0.9")
    assert "Next, with the arm connected, find out" in out and "identify" not in out


def test_every_rate_that_is_proposed_passes(motors, bus, trajectory):
    """Of a bus that is too full, on which answers come too late."""
    check = "check", trajectory, CAN0, "--rate"
    code, out, _ = motors.run(*check, "2000")
    rates = re.findall(r"use --rate (\S+)", out)
    assert code == 1 and len(rates) == 2
    for rate in rates:
        motors.succeed(*check, rate)


@pytest.mark.slow
@pytest.mark.parametrize("friction", ["", 'frictionloss=".3" damping=".4"'])
def test_the_command_behind_a_rehearsal_identifies_the_simulated_arm(
    command, arm_file, friction
):
    """From a motion planned for the arm, with friction and without."""
    joint = f'armature=".05" {friction}'
    model = arm_file(small_arms.serial_arm((small_arms.Z, small_arms.Y), joint=joint))
    plan = "--for arm --excitation sines --duration 10 --seed 0 --export-damiao"
    motors = "--motor-type DM4340 --motor-type DM4340"
    command.run("plan", model, plan, motors, "--output-dir plan")
    played = "plan/damiao_trajectory.csv --model", model, "--record rehearsed.csv"
    out = command.run("motors simulate", *played).out
    identify = re.search("identify the simulated arm .*\n  robot-sysid (.*)", out)[1]
    words = shlex.split(identify)
    assert words[:2] == ["identify", str(model)]
    out = command.run(*words).out
    assert re.search("Usable.*: rehearsed/updated_model.xml; ", out)


# --- real time ----------------------------------------------------------------------------------


@pytest.mark.realtime
@NEEDS_TERMINALS
def test_two_processes_over_a_pseudo_terminal(trajectory, model, tmp_path):
    """Slowly enough for most computers; ``test_incidents.py`` has what may happen meanwhile."""
    record = tmp_path / "measured.csv"
    with arm_process([trajectory, "--model", model, "--watchdog", "5"]) as (device, _):
        options = (
            f"--interface slcan --channel {device} --rate 25 --yes --record {record}"
        )
        play = [sys.executable, "-m", "robot_sysid", "motors", "play", trajectory]
        done = subprocess.run(
            [*play, *options.split()], capture_output=True, text=True, timeout=60
        )
    assert done.returncode == 0, done.stderr
    assert read_recording(record).ending == "completed"

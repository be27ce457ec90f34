"""The command robot-sysid-damiao."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.damiao.bus.can_bus import open_bus
from robot_sysid.damiao.bus.clock import SystemClock
from robot_sysid.damiao.options import play_settings
from robot_sysid.damiao.play.recorder import read_recording
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.protocol.registers import DISABLED
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.damiao.simulated.faults import FAULT_KINDS, Fault, parse_fault
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.damiao.simulated.server import served_in_background
from robot_sysid.damiao.trajectory.csv_file import export_damiao_trajectory
from robot_sysid.damiao_cli import main
from robot_sysid.errors import InputError
from tests.support import arms
from tests.support.damiao_rig import Pendulums, swing

# Wide enough for a busy computer: these tests run in real time.
SLOWLY = [
    "--rate",
    "25",
    "--max-lateness-ms",
    "2000",
    "--max-missed",
    "100",
    "--max-tracking-error",
    "1",
]


@pytest.fixture
def trajectory(tmp_path):
    path = tmp_path / "damiao_trajectory.csv"
    motion = swing(2, duration=0.5, amplitude=0.05)
    export_damiao_trajectory([motion], ["DM4340"] * 2, path)
    return path


@pytest.fixture
def arm():
    """A simulated arm on the virtual bus called after the test's process."""
    motors = [simulated_motor(MOTORS["DM4340"], i, i + 16, watchdog=5.0) for i in (1, 2)]
    simulated = SimulatedArm(Pendulums(2), motors)
    clock = SystemClock()
    with served_in_background(simulated, open_bus("virtual", "cli", BusTiming(), clock), clock):
        yield simulated


@pytest.fixture
def quick(monkeypatch):
    """Shorten the pauses of a run."""

    def shortened(*arguments):
        return replace(play_settings(*arguments), ramp_time=0.2, approach_time=0.2, rest_time=0.05)

    monkeypatch.setattr("robot_sysid.damiao_cli.play_settings", shortened)


BUS = ["--interface", "virtual", "--channel", "cli"]


def run(capsys, *arguments):
    """Run the command; return exit code, output and the one error line."""
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert len(err.splitlines()) <= 1, err
    return code, out, err


def test_check_prints_a_table_and_enables_nothing(capsys, arm, trajectory):
    code, out, err = run(capsys, "check", trajectory, *BUS)
    assert (code, err) == (0, "")
    assert "ready to play" in out and "load classic CAN to 14 %" in out
    assert re.search(r"2 +0x12 +MIT +12.5 +10 +28 +DM4340 +5000 ms +40 +31/29 +status 0", out)
    assert [m.commands_seen for m in arm.motors] == [0, 0]
    assert [m.status for m in arm.motors] == [DISABLED] * 2


def test_check_works_without_a_trajectory(capsys, arm):
    code, out, _ = run(capsys, "check", *BUS)
    assert code == 0 and "DM4340 " in out


def test_check_says_what_has_to_change(capsys, arm, trajectory):
    Fault("mode", 0, 2.0).apply(arm.motors[0])
    Fault("tmax", 1, 40.0).apply(arm.motors[1])
    code, out, _ = run(capsys, "check", trajectory, *BUS)
    assert code == 1
    assert "[STOP] motor 1 is in mode 2 (POS_VEL); set CTRL_MODE to 1 (MIT)" in out
    assert "not DM4340!" in out and "2 to change before playing" in out


def test_check_of_an_empty_bus(capsys):
    code, out, _ = run(capsys, "check", "--interface", "virtual", "--channel", "empty")
    assert code == 1 and "no motor answers" in out


def test_play_records_and_disables(capsys, quick, arm, trajectory, tmp_path):
    record = tmp_path / "measured.csv"
    code, out, err = run(
        capsys, "play", trajectory, *BUS, *SLOWLY, "--yes", "--record", record, "--kd", "2"
    )
    assert (code, err) == (0, ""), err
    assert "all motors are disabled" in out
    assert [m.status for m in arm.motors] == [DISABLED] * 2
    recording = read_recording(record)
    assert recording.ending == "completed"
    assert np.nanmax(np.abs(recording.joint_values("pos"))) < 1.0
    assert (tmp_path / "measured.log").read_text().count(" T\n") > 20


def test_dry_run_enables_nothing(capsys, arm, trajectory):
    code, out, _ = run(capsys, "play", trajectory, *BUS, "--dry-run")
    assert code == 0 and "nothing speaks against playing" in out
    assert [m.commands_seen for m in arm.motors] == [0, 0]


def test_dry_run_without_a_bus_judges_the_file(capsys, trajectory):
    code, out, _ = run(capsys, "play", trajectory, "--dry-run")
    assert code == 0 and "[ok  ] ids are unique: 1, 2" in out
    code, out, err = run(capsys, "play", trajectory, "--dry-run", "--rate", "2000")
    assert code == 3 and "limit 70 %; use --rate 1000" in err


def test_a_motor_with_another_scaling_is_refused(capsys, arm, trajectory):
    Fault("tmax", 0, 20.0).apply(arm.motors[0])
    code, _, err = run(capsys, "play", trajectory, *BUS, *SLOWLY, "--yes")
    assert code == 3 and "--accept-register-limits" in err
    assert [m.commands_seen for m in arm.motors] == [0, 0]


def test_playing_needs_a_confirmation(capsys, arm, trajectory, monkeypatch):
    code, _, err = run(capsys, "play", trajectory, *BUS)
    assert code == 2 and "give --yes" in err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda prompt: "no")
    code, _, err = run(capsys, "play", trajectory, *BUS)
    assert code == 2 and "not confirmed" in err
    assert [m.commands_seen for m in arm.motors] == [0, 0]


def test_an_existing_recording_is_kept(capsys, arm, trajectory, tmp_path):
    (tmp_path / "measured.csv").write_text("precious")
    record = tmp_path / "measured.csv"
    code, _, err = run(capsys, "play", trajectory, *BUS, "--yes", "--record", record)
    assert code == 2 and "exists" in err
    assert record.read_text() == "precious"


def test_interrupting_before_anything_moves(capsys, arm, trajectory, monkeypatch):
    def interrupt(prompt):
        raise KeyboardInterrupt

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", interrupt)
    code, _, err = run(capsys, "play", trajectory, *BUS)
    assert code == 130 and "nothing was moved" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["play", "T"], "play needs --channel"),
        (["play", "T", "--channel", "c", "--kd", "0"], "--kd must be above 0"),
        (["play", "T", "--channel", "c", "--kd", "6"], "--kd must be above 0 and at most 5"),
        (["play", "T", "--channel", "c", "--kp", "501"], "--kp must be at most 500"),
        (["play", "T", "--channel", "c", "--kp", "1", "2", "3"], "--kp was given 3 values"),
        (["play", "T", "--channel", "c", "--speed", "1.5"], "--speed must be above 0"),
        (["play", "T", "--channel", "c", "--speed", "0"], "--speed must be above 0"),
        (["play", "T", "--channel", "c", "--rate", "0"], "--rate"),
        (["play", "T", "--channel", "c", "--rate", "nan"], "--rate must be a positive number"),
        (["play", "T", "--channel", "c", "--set-watchdog", "0"], "--set-watchdog must be"),
        (["play", "T", "--channel", "c", "--bitrate", "0"], "--bitrate and --data-bitrate"),
        (["play", "missing.csv", "--channel", "c"], "cannot read missing.csv"),
        (["check", "--channel", "c", "--interface", "udp_multicast"], "invalid choice"),
        (["simulate", "T", "--model", "missing.xml"], "missing.xml"),
    ],
)  # fmt: skip
def test_bad_usage_is_one_line_and_exit_code_2(capsys, trajectory, arguments, words):
    arguments = [trajectory if a == "T" else a for a in arguments]
    code, _, err = run(capsys, *arguments)
    assert code == 2 and words in err, err


def test_debug_shows_a_traceback(capsys):
    assert main(["play", "missing.csv", "--channel", "c", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("command", [[], ["check"], ["play"], ["simulate"]])
def test_help_is_there(capsys, command):
    with pytest.raises(SystemExit) as caught:
        main([*command, "--help"])
    assert caught.value.code == 0
    assert "usage: robot-sysid-damiao" in capsys.readouterr().out


# --- simulate ----------------------------------------------------------------------------------


@pytest.fixture
def model(arm_file):
    return arm_file(arms.serial_arm((arms.Z, arms.Y)))


def test_a_rehearsal_in_one_process(capsys, quick, trajectory, model, tmp_path):
    code, out, err = run(
        capsys, "simulate", trajectory, "--model", model, "--play", *SLOWLY, "--watchdog", "5",
        "--record", tmp_path / "measured.csv",
    )  # fmt: skip
    assert code == 0, err
    assert read_recording(tmp_path / "measured.csv").ending == "completed"


def test_a_rehearsal_with_a_fault(capsys, quick, trajectory, model):
    code, _, err = run(
        capsys, "simulate", trajectory, "--model", model, "--play", *SLOWLY, "--watchdog", "5",
        "--fault", "status:1=10@0.2",
    )  # fmt: skip
    assert code == 3 and "motor 2 (joint 1) reports status A: over-current" in err


def test_a_model_with_other_joints_is_refused(capsys, trajectory, arm_file):
    path = arm_file(arms.THREE)
    code, _, err = run(capsys, "simulate", trajectory, "--model", path)
    assert code == 2 and "has 2 joints but the chain" in err and "has 3" in err


@pytest.mark.parametrize("text", ["status", "status:x", "status:1=hot", "flood:1", "status:1@soon"])
def test_faults_that_cannot_be_read_are_refused(text):
    with pytest.raises(InputError, match="status, jammed, silent"):
        parse_fault(text)


def test_faults_are_read():
    assert parse_fault("status:2=13@4.5") == Fault("status", 2, 13.0, 4.5)
    assert parse_fault("silent:0") == Fault("silent", 0, 1.0, 0.0)
    assert all(parse_fault(f"{kind}:0").kind == kind for kind in FAULT_KINDS)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
def test_two_processes_over_a_pseudo_terminal(trajectory, model, tmp_path):
    """What the user does: simulate in one terminal, play and stop it in the other."""
    command = [sys.executable, "-m", "robot_sysid.damiao_cli"]
    server = subprocess.Popen(
        [*command, "simulate", trajectory, "--model", model, "--watchdog", "5"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        device = None
        while device is None:
            match = re.search(r"--channel (\S+)", server.stdout.readline())
            device = match and match.group(1)
        play = [
            *command, "play", trajectory, "--interface", "slcan", "--channel", device, *SLOWLY,
            "--yes", "--record", tmp_path / "measured.csv",
        ]  # fmt: skip
        done = subprocess.run(play, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        assert read_recording(tmp_path / "measured.csv").ending == "completed"
    finally:
        server.send_signal(signal.SIGINT)
        time.sleep(0.1)
        assert server.wait(timeout=20) == 0
        server.stdout.close()
        server.stderr.close()

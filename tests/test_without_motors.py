"""The package works with the folders for motors taken out, and says what they are needed for."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from rigs.arms import small_arms
from rigs.files.places import ROOT

DAMIAO = "robot_sysid.damiao"
COMMANDS = "robot_sysid.commands.motors"
# Runs one command per argument and prints its exit code, then the face for Python programs.
PROGRAM = """
import sys
import robot_sysid as rs
from robot_sysid.cli import main
for words in sys.argv[1:]:
    try:
        code = main(words.split())
    except SystemExit as ending:
        code = ending.code
    print("exit code", code, flush=True)
assert not hasattr(rs, "motors")
try:
    rs.PlayReport
except rs.InputError as error:
    print(error)
print(rs.__file__)
"""


@pytest.fixture(params=[(DAMIAO,), (DAMIAO, COMMANDS)], ids=["damiao", "both"])
def missing(request):
    """Names of the packages that are taken out."""
    return request.param


@pytest.fixture
def run(missing, tmp_path):
    """Return a function that runs commands of a copy without motors: exit codes and output."""
    shutil.copytree(
        ROOT / "robot_sysid",
        tmp_path / "robot_sysid",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    for name in missing:
        shutil.rmtree(tmp_path.joinpath(*name.split(".")))

    def run_commands(*commands):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, *commands],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert done.returncode == 0, done.stdout
        *lines, message, module = done.stdout.splitlines()
        assert module == str(tmp_path / "robot_sysid" / "__init__.py")
        assert message.startswith(
            f"Damiao motors need {DAMIAO}, which is not installed"
        )
        codes = [int(line.split()[-1]) for line in lines if line.startswith("exit")]
        return codes, done.stdout

    return run_commands


def test_what_is_for_motors_says_what_is_missing_and_all_else_starts(run, missing):
    codes, output = run("--version", "--help", "motors", "motors check x.csv", "log -h")
    assert codes == [0, 0, 2, 2, 0]
    assert output.count(f"error: Damiao motors need {missing[-1]}, which is not") == 2


@pytest.mark.slow
def test_an_arm_is_identified_without_motors(run, tmp_path):
    arm = small_arms.serial_arm(
        (small_arms.Z, small_arms.Y), joint='frictionloss="0.4" damping="0.2"'
    )
    (tmp_path / "arm.xml").write_text(arm)
    motors = "--export-damiao --motor-type DM4340 --motor-type DM4340"
    codes, output = run(
        "arm.xml --plant-model arm.xml --noise-torque 0.05 --save-measurements log.csv --seed 1",
        "identify arm.xml log.csv",
        "plan arm.xml --excitation sines --duration 4 --seed 1",
        f"plan arm.xml --excitation sines --duration 4 {motors}",
        f"arm.xml {motors}",
        "arm.xml --export-damiao",
    )
    assert codes == [0, 0, 0, 2, 2, 2], output
    assert output.count(f"error: Damiao motors need {DAMIAO}, which is not") == 2
    assert "--export-damiao requires at least one --motor-type" in output

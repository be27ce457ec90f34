"""An arm that is heavier than its model says: what is refused, and how it is moved all the same."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from robot_sysid.damiao.trajectory import read_damiao_trajectory

KINOVA = Path(__file__).resolve().parents[2] / "examples" / "kinova" / "model"
GUESS = KINOVA / "kinova_fullinertia_guess.xml"
TRUTH = KINOVA / "kinova_fullinertia.xml"
MOTORS = ["--motor-type", "DM4340"] * 7
PEAK = 27.0
TRUE_MASS = 1.51714643


def last_command(text):
    """Return the words of the last command that a text holds, alone on its line."""
    commands = re.findall(r"^  robot-sysid (.*)$", text, re.MULTILINE)
    assert commands, text
    return shlex.split(commands[-1])


def play(command, folder, code=0):
    """Play a folder's trajectory on the true arm, simulated, and return what was printed."""
    log = ("--record", folder / "log.csv")
    file = folder / "damiao_trajectory.csv"
    arm = ("--model", TRUTH, "--plant-model", TRUTH)
    return command.run("motors simulate", file, *arm, *log, code=code)


def identify(command, folder, model):
    """Identify the arm from the recording in a folder and return what was printed."""
    return command.run("identify", model, folder / "log.csv", "--output-dir", folder)


@pytest.mark.slow
@pytest.mark.timeout(900)  # three designs and two runs; the machine may be busy
def test_a_motion_that_is_refused_is_played_after_a_smaller_one(command):
    export = ("--export-damiao", *MOTORS, "--seed 1")
    first = ("--output-dir first --duration 8", *export)
    printed = command.run("plan", GUESS, *first)
    assert "Usable: play it on the arm" in printed.out
    refused = play(command, Path("first"), code=3)
    assert "joint1): torque " in refused.err

    assert "a smaller motion first (see --for weight of plan)" in refused.err
    weighing = ("--for weight --output-dir first/weighing", *export)
    printed = command.run("plan", GUESS, *weighing)
    rehearsal = last_command(printed.out)
    file = "first/weighing/damiao_trajectory.csv"
    record = "first/weighing/rehearsed.csv"
    words = ["motors", "simulate", file, "--model", str(GUESS), "--record", record]
    assert rehearsal == words
    printed = command.run(*rehearsal)
    words = ["motors", "map", "--channel", "can0", "--model", str(GUESS)]
    assert last_command(printed.out) == words
    slow = read_damiao_trajectory("first/weighing/damiao_trajectory.csv")
    assert np.max(np.abs(slow.tau)) < 0.5 * PEAK and np.max(np.abs(slow.qd)) <= 0.6

    play(command, Path("first/weighing"))
    printed = identify(command, Path("first/weighing"), GUESS)
    assert "Usable: " in printed.out

    model = Path("first/weighing/updated_model.xml")
    planned = ("--output-dir first/weighing/planned", *export)
    printed = command.run("plan", model, *planned)
    assert "Usable: play it on the arm" in printed.out
    planned = Path("first/weighing/planned")
    play(command, planned)
    identify(command, planned, model)
    written = Path("first/weighing/planned/updated_model.xml").read_text()
    masses = re.findall(r'<body name="link6".*?mass="([0-9.]+)"', written, re.DOTALL)
    assert float(masses[0]) == pytest.approx(TRUE_MASS, abs=0.15)

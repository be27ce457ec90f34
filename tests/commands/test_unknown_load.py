"""An arm that is heavier than its model says: each step is printed by the one before."""

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


def words_after(text, mark):
    """Return the command that follows a mark on its line, up to the end of the line."""
    command = re.search(rf"{re.escape(mark)}robot-sysid (.*)$", text, re.MULTILINE)
    assert command is not None, text
    return shlex.split(command[1])


def play(command, folder, code=0):
    """Play a folder's trajectory on the true arm, simulated, and return what was printed."""
    log = ("--play --record", folder / "log.csv")
    file = folder / "damiao_trajectory.csv"
    return command.run("motors simulate", file, "--model", TRUTH, *log, code=code)


@pytest.mark.slow
@pytest.mark.timeout(900)  # three designs and two runs; the machine may be busy
def test_the_way_from_a_refused_motion_to_one_that_is_played_is_printed_step_by_step(
    command, tmp_path
):
    begin = ("--export-damiao", *MOTORS, "--output-dir first --seed 1 --duration 8")
    printed = command.run("plan", GUESS, *begin)
    assert "Usable: play it on the arm" in printed.out
    refused = play(command, Path("first"), code=3)
    assert "joint1): the motion needs " in refused.err

    weigh = words_after(refused.err, "with a smaller motion first: ")
    printed = command.run(*weigh, "--seed 1")
    assert words_after(printed.out, "Next: ")[:3] == [
        "motors",
        "check",
        "first/weighing/damiao_trajectory.csv",
    ]
    slow = read_damiao_trajectory("first/weighing/damiao_trajectory.csv")
    assert np.max(np.abs(slow.tau)) < 0.5 * PEAK and np.max(np.abs(slow.qd)) <= 0.6

    played = play(command, Path("first/weighing"))
    identify = words_after(played.out, "Next: ")
    assert identify[:2] == ["identify", str(GUESS)]
    printed = command.run(*identify)
    assert "Usable: " in printed.out

    plan = words_after(printed.out, "Next: ")
    assert plan[:2] == ["plan", "first/weighing/updated_model.xml"]
    printed = command.run(*plan, "--seed 1")
    assert "Usable: play it on the arm" in printed.out
    played = play(command, Path("first/weighing/planned"))

    command.run(*words_after(played.out, "Next: "))
    written = Path("first/weighing/planned/updated_model.xml").read_text()
    masses = re.findall(r'<body name="link6".*?mass="([0-9.]+)"', written, re.DOTALL)
    assert float(masses[0]) == pytest.approx(TRUE_MASS, abs=0.15)

"""What a command counts, on whatever machine: solves, passes over rows, searches, imports.

Each command runs once, in a process of its own, under Python's profiler. A bound is what it counts
today and a little more: lower it with each change that lets it.
"""

from __future__ import annotations

import functools
import json
import os
import pstats
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass

import pytest

from rigs.files.places import DATA, GUESS, ROOT, TRUTH
from robot_sysid.cli import main
from robot_sysid.commands.example import RECORDING
from robot_sysid.config import SelfTestConfig
from robot_sysid.pipeline import stages

COUNTED = {
    "solve_question": "whole solves",
    "sums": "passes over all rows",
    "consistent_least_squares": "searches for possible bodies",
    "_products": "products of readings",
}
"""Names of functions, whichever module they are in, to what their calls are."""
MODULES = "imported modules"
BOUNDS = {
    "log": (1, 5, 0, 80, 450),
    "identify": (1, 8, 24, 80, 620),
    "payload": (1, 9, 29, 80, 640),
    "kuka": (1, 12, 19, 104, 620),
}
"""Most calls of each command, in the order of ``COUNTED``, and most imported modules."""
SLOW_TO_IMPORT = {
    "scipy.integrate",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.sparse",
}
"""What takes longer to import than the equations of a log to solve."""
PROGRAM = """
import cProfile, json, sys
from robot_sysid.cli import main
profile = cProfile.Profile(builtins=False)
code = profile.runcall(main, sys.argv[2:])
profile.dump_stats(sys.argv[1])
print(json.dumps([code, sorted(sys.modules)]))
"""


@dataclass(frozen=True)
class Counts:
    """What a command counted: calls by what they are, and names of all modules."""

    calls: dict[str, int]
    modules: list[str]


@functools.cache
def modules_of_clarabel():
    """Modules that Clarabel imports by itself, where it searches for possible bodies."""
    program = "import clarabel, json, sys; print(json.dumps([*sys.modules]))"
    command = (sys.executable, "-c", program)
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return {*json.loads(run.stdout)}


def count(folder, *arguments):
    """Run a command in a folder and return what it counted."""
    command = (sys.executable, "-c", PROGRAM, "calls", *map(str, arguments))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    code, modules = json.loads(run.stdout.splitlines()[-1])
    assert code == 0, run.stderr
    calls = Counter(dict.fromkeys(COUNTED.values(), 0))
    profile = pstats.Stats(str(folder / "calls"))
    for (file, _, name), (_, number, *_) in profile.stats.items():
        if name in COUNTED and "robot_sysid" in file:
            calls[COUNTED[name]] += number
    return Counts({**calls, MODULES: len(modules)}, modules)


def assert_within_bounds(counts, command):
    bounds = dict(zip((*COUNTED.values(), MODULES), BOUNDS[command]))
    above = {
        what: (number, bounds[what])
        for what, number in counts.calls.items()
        if number > bounds[what]
    }
    assert not above, counts.calls


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with the example's log, without the one that a payload takes as well."""
    folder = tmp_path_factory.mktemp("counts")
    options = {**RECORDING, "plant_model": TRUTH, "seed": 1, "output_dir": folder}
    stages.run(
        SelfTestConfig.of(GUESS, **options, save_measurements=folder / "log.csv")
    )
    return folder


def test_a_log_is_read_in_few_steps(folder):
    counts = count(folder, "log", "log.csv", GUESS)
    assert_within_bounds(counts, "log")
    assert "scipy" not in counts.modules


def test_an_arm_is_identified_in_few_steps(folder):
    counts = count(folder, "identify", GUESS, "log.csv")
    assert_within_bounds(counts, "identify")
    assert not SLOW_TO_IMPORT & {*counts.modules} - modules_of_clarabel()


@pytest.mark.slow
def test_a_payload_is_weighed_in_few_steps(tmp_path):
    example = tmp_path / "kinova"
    assert main(["example", "kinova", "--output-dir", str(example)]) == 0
    logs = ("--empty", "empty_arm.csv", "--loaded", "true_arm.csv")
    assert_within_bounds(count(example, "payload", GUESS, *logs), "payload")


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the logs of real arms are not here")
def test_a_real_arm_is_identified_in_few_steps(tmp_path):
    folder = DATA / "kuka_lwr4"
    log = folder / "lwr4_hw1_200Hz.csv"
    counts = count(tmp_path, "identify", folder / "kuka_lwr4.urdf", log)
    assert_within_bounds(counts, "kuka")
    assert not SLOW_TO_IMPORT & {*counts.modules} - modules_of_clarabel()

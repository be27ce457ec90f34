"""Every option that a page types or a message names exists, and every command that a refusal of a
log prints leads to a result of that log."""

from __future__ import annotations

import ast
import json
import re
import shlex
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.files import pages
from rigs.files.command_line import COMMANDS
from robot_sysid.cli import main
from robot_sysid.commands import COMMANDS as NAMES
from robot_sysid.commands.arguments import Parser
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from tests.faults.conftest import FOUR_AXES, JOINT
from tests.test_architecture import nodes_of, package_sources

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")
FREE = {"--help", "--version"}


@cache
def options_of(command: str) -> frozenset[str]:
    """Return the options of a command, such as "motors play"."""
    parser = Parser(COMMANDS[command])
    return frozenset(o for action in parser.actions for o in action.option_strings)


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_options_that_a_page_types_exist(page):
    """A command that is not one of the names is that of a model file, a self-test."""
    for language, block in pages.blocks(page):
        for line in pages.command_lines(block) if language == "bash" else ():
            if line[0] != "robot-sysid" or "[options]" in line:
                continue
            command = ""
            if line[1] in NAMES:
                command = " ".join(line[1 : 3 if line[1] == "motors" else 2])
            typed = {word.partition("=")[0] for word in line if word.startswith("--")}
            assert typed <= options_of(command) | FREE, line


def test_options_that_a_text_of_the_package_names_exist():
    known = frozenset().union(FREE, *map(options_of, COMMANDS))
    for name, source in package_sources().items():
        for node in nodes_of(source):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert set(OPTION.findall(node.value)) <= known, (name, node.value)


SIGNS = np.array([1.0, 1.0, -1.0, 1.0])
ORDER = [0, 2, 1, 3]
WRONG_LOGS = {
    "torque sign": lambda log: replace(log, tau=SIGNS * log.tau),
    "position sign": lambda log: replace(log, q=SIGNS * log.q, qd=SIGNS * log.qd),
    "torques exchanged": lambda log: replace(log, tau=log.tau[:, ORDER]),
    "all exchanged": lambda log: replace(
        log, q=log.q[:, ORDER], qd=log.qd[:, ORDER], tau=log.tau[:, ORDER]
    ),
    "degrees": lambda log: replace(log, q=np.degrees(log.q), qd=np.degrees(log.qd)),
    "torques times 1.7": lambda log: replace(log, tau=1.7 * log.tau),
    "torques times 0.5": lambda log: replace(log, tau=0.5 * log.tau),
    "two of them": lambda log: replace(log, q=SIGNS * log.q, qd=None, tau=2 * log.tau),
}
"""Mistakes that another reading puts right."""


def printed_commands(text):
    """Return the words of the commands that a message prints, each alone on its line."""
    lines = re.findall("^  robot-sysid (.+)$", text, re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize("mistake", WRONG_LOGS)
def test_every_command_that_a_refusal_prints_leads_on(
    mistake, tmp_path, monkeypatch, capsys
):
    """One of them to a usable result, and none back to where it came from."""
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(small_arms.serial_arm(FOUR_AXES, joint=JOINT))
    robot = load_robot_model(Path("arm.xml"))
    log = WRONG_LOGS[mistake](truth_of(robot, seed=4).log)
    write_measurement_csv(Path("log.csv"), robot.joint_names, [log])
    words = ["log", "log.csv", "arm.xml"]
    assert main(words) == 2
    # A log with two mistakes is put right by one command after the other.
    commands = printed_commands(capsys.readouterr().err)
    assert commands
    tried = []
    shares = []
    while commands:
        words = commands.pop()
        first = next(k for k, word in enumerate(words) if word.startswith("--"))
        assert words[first:] not in tried
        tried.append(words[first:])
        code = main(["identify", "arm.xml", "log.csv", *words[first:]])
        error = capsys.readouterr().err
        if code == 0:
            content = json.loads(Path("sysid_output/params.json").read_text())
            assert content["valid"]["trustworthy"]
            shares.append(content["file"]["after"]["relative_error"])
        else:
            commands += printed_commands(error)
    assert shares and max(shares) < 0.05

"""Named pipes and endless devices in place of every path that a command takes."""

from __future__ import annotations

import contextlib
import os
import re
import sys

import pytest

from rigs.arms import small_arms
from rigs.files.command_line import COMMANDS, ending_within
from rigs.logs.measured_logs import XML, log_of, true_arm
from rigs.motors.damiao_rig import map_line, swing, trajectory_file
from robot_sysid.cli import main
from robot_sysid.commands.arguments import Parser
from robot_sysid.damiao.joints import write_joint_map
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model

resource = pytest.importorskip("resource")

PARSERS = {
    name: Parser(command) for name, command in COMMANDS.items() if name != "motors"
}
BASES = {
    "": "arm.xml --output-dir out",
    "plan": "arm.xml --excitation sines --output-dir out",
    "identify": "arm.xml log.csv --output-dir out",
    "payload": "arm.xml --empty log.csv --loaded log.csv --output-dir out",
    "log": "log.csv arm.xml",
    "check": "arm.xml log.csv --since log.csv",
    "report": "out",
    "example": "kinova",
    "motors check": "motion.csv --channel can0 --model two.xml",
    "motors play": "motion.csv --channel can0 --model two.xml --yes",
    "motors simulate": "motion.csv --model two.xml",
    "motors hold": "--simulate --model two.xml --motor-type DM8009 --for 1",
    "motors move": "--simulate --model two.xml --motor-type DM8009 --to .3 .3",
    "motors setup": "--channel can0 --model two.xml",
    "motors monitor": "--channel can0",
    "motors map": "--channel can0 --model two.xml",
}
"""Command to words with which it gets as far as its files."""


def is_path(action):
    """Whether an option or a word of a parser takes a path."""
    kinds = {"Path", "parse_folder", "parse_factors"}
    return getattr(action.type, "__name__", "") in kinds


def words_with(command, action, path):
    """The words of a command with one path in the place of its own, or beside it."""
    flag = next(iter(action.option_strings), "")
    arguments = BASES[command].split()
    if flag in arguments:
        arguments[arguments.index(flag) + 1] = path
    elif flag:
        arguments += [flag, path]
    else:
        positionals = [a.dest for a in PARSERS[command].actions if not a.option_strings]
        arguments[positionals.index(action.dest)] = path
    return [*command.split(), *arguments]


CASES = [
    pytest.param(
        command, action, id=f"{command} {(*action.option_strings, action.dest)[0]}"
    )
    for command, parser in PARSERS.items()
    for action in parser.actions
    if is_path(action)
]


@contextlib.contextmanager
def bounds(seconds, memory):
    """End what waits or reads without end, instead of the whole test run."""
    with open("/proc/self/statm") as file:
        used_memory = int(file.read().split()[0]) * resource.getpagesize()
    _, hard_limit = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used_memory + memory, hard_limit))
    try:
        with ending_within(seconds):
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (hard_limit, hard_limit))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with what the commands read."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "arm.xml").write_text(XML)
    (folder / "two.xml").write_text(small_arms.serial_arm((small_arms.Z, small_arms.Y)))
    arm = true_arm()
    log = log_of(arm, noise_torque=0.1)
    write_measurement_csv(folder / "log.csv", arm.joint_names, [log])
    names = load_robot_model(folder / "two.xml").joint_names
    rows = [map_line(joint, k, 0x10 + k) for k, joint in enumerate(names, start=1)]
    write_joint_map(folder / "map.csv", rows)
    path = trajectory_file(folder, swing(2, duration=0.5, amplitude=0.05)).path
    path.rename(folder / "motion.csv")
    return folder


@pytest.mark.skipif(sys.platform != "linux", reason="needs named pipes and /proc")
@pytest.mark.parametrize("name", ["pipe", "endless"])
@pytest.mark.parametrize(("command", "action"), CASES)
def test_no_path_leads_to_a_pipe_or_a_device(
    files, tmp_path, monkeypatch, capsys, bus, command, action, name
):
    arguments = words_with(command, action, name)
    for path in files.iterdir():
        (tmp_path / path.name).symlink_to(path)
    os.mkfifo(tmp_path / "pipe")
    os.symlink("/dev/zero", tmp_path / "endless")
    monkeypatch.chdir(tmp_path)
    with bounds(20, 2 * 10**9):
        code = main(arguments)
    assert os.path.islink("endless") and not os.path.isfile("pipe")
    error = capsys.readouterr().err.strip().splitlines()
    assert code == 2, error
    assert re.search(rf"\b{name}\S* (is|holds no|exists)\b", error[-1]), error

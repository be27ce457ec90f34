"""The parsers of the commands: what they take, how it arrives; what help and a shell offer."""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from robot_sysid import __version__
from robot_sysid.cli import main
from robot_sysid.commands import COMMANDS, identify, log
from robot_sysid.commands.arguments import PYTHON_ONLY, parse_command
from robot_sysid.config import PayloadConfig, SysidConfig
from tests.support import option_samples

PARSERS = {**{name: partial(identify.build_parser, name) for name in identify.SPECS}}
PARSERS["log"] = log.build_parser
POSITIONAL = {"identify": ["arm.xml", "log.csv"], "log": ["log.csv", "arm.xml"]}


@pytest.mark.parametrize("name", PARSERS)
def test_every_option_arrives_as_the_value_that_was_typed(name):
    parser = PARSERS[name]
    positional = POSITIONAL.get(name, ["arm.xml"])
    config_type = PayloadConfig if name == "payload" else SysidConfig
    samples = [*option_samples.samples(config_type)]
    option_keys = option_samples.keys_of(parser())
    sample_keys = {sample.option.key for sample in samples}
    assert option_keys - {"view", "video"} <= sample_keys - set(PYTHON_ONLY)
    for sample in (sample for sample in samples if sample.option.key in option_keys):
        values, _ = parse_command(parser, [*positional, *sample.words])
        assert values[sample.option.key] == sample.value
        assert set(values) <= {"path", "measurements", "log", sample.option.key}


@pytest.fixture
def config_of(monkeypatch):
    """Function: the configuration that a command line asks for, without running it."""
    configs = []
    monkeypatch.setattr(
        identify, "run_command", lambda config, *_: configs.append(config) or 0
    )

    def ask(*arguments):
        assert main([*arguments]) == 0
        return configs.pop()

    return ask


def test_a_command_says_what_it_does_with_the_options(config_of):
    assert config_of("arm.xml") == SysidConfig.of("arm.xml")
    logs = (Path("a.csv"), Path("b.csv"))
    assert config_of("identify", "arm.xml", "a.csv", "b.csv") == SysidConfig.of(
        "arm.xml", measurements=logs
    )
    assert config_of("identify", "arm.xml", "a.csv", "--links") == SysidConfig.of(
        "arm.xml", measurements=logs[:1], links=True
    )
    assert config_of("plan", "arm.xml") == SysidConfig.of(
        "arm.xml", plan_only=True, excitation="optimal"
    )
    saved = config_of("plan", "arm.xml", "--trajectory", "p.json")
    assert saved == SysidConfig.of("arm.xml", plan_only=True, trajectory="p.json")
    assert (
        config_of("plan", "arm.xml", "--excitation", "sines").excitation.kind == "sines"
    )


def help_lines(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("name", PARSERS)
def test_help_is_an_example_and_the_main_options_and_the_full_help_has_all(
    name, capsys
):
    lines = help_lines([*name.split(), "--help"], capsys)
    assert lines[0].startswith(f"example: robot-sysid {name or 'identify'}")
    full = help_lines([*name.split(), "--help-all"], capsys)
    assert max(map(len, (*lines, *full))) <= 100
    assert name == "log" or len(lines) <= 50
    for action in PARSERS[name]()._actions:
        assert action.help and not action.help.startswith("==")
        assert all(
            re.search(rf"{flag}\b", "\n".join(full)) for flag in action.option_strings
        )
    visible = [
        a for a in PARSERS[name](full=False)._actions if a.help != argparse.SUPPRESS
    ]
    main_options = identify.SPECS[name].main if name in identify.SPECS else ()
    assert set(main_options) <= {action.dest for action in visible}


def test_without_arguments_the_commands_are_printed_in_the_order_of_their_use(capsys):
    assert main([]) == 2
    printed = capsys.readouterr()
    heading, *lines, end = printed.out.splitlines()
    assert printed.err == "" and "order in which you need them" in heading
    names = [line.split()[0] for line in lines]
    assert list(dict.fromkeys(names)) == [
        *("log", "identify", "report", "plan", "payload", "motors", "MODEL", "example")
    ]
    assert set(COMMANDS) == {*names} - {"MODEL"} and "--help" in end
    full_help = help_lines(["--help"], capsys)
    assert full_help[2:4] == [heading, lines[0]]
    assert "usage: robot-sysid MODEL [options]" in full_help


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    lines_printed = capsys.readouterr().out.splitlines()
    assert lines_printed == help_lines(["plan", "--quiet", "--version"], capsys)
    assert lines_printed == [f"robot-sysid {__version__}"]


ASKED = {
    "pa": {"payload "},
    "plan --excitation-t": {"--excitation-time-budget "},
    "plan --excitation ": {"sines", "optimal"},
    "motors ch": {"check "},
    "motors play t.csv --rec": {"--record "},
    "arm.xml --motor-t": {"--motor-type "},
    "re": {"report "},
    "identify arm.xml lo": {"log.csv "},
}


@pytest.mark.parametrize("typed", ASKED)
def test_commands_options_values_and_files_are_completed(typed, tmp_path):
    (tmp_path / "log.csv").touch()
    line = f"robot-sysid {typed}"
    answer = tmp_path / "answer"
    asking = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    asking.update(COMP_LINE=line, COMP_POINT=str(len(line)), _ARGCOMPLETE_IFS="\n")
    call = [sys.executable, "-m", "robot_sysid"]
    subprocess.run(call, cwd=tmp_path, env={**os.environ, **asking}, check=True)
    assert set(answer.read_text().splitlines()) == ASKED[typed]

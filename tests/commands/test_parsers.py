"""The parsers of the commands: what they take, how it arrives; what help and a shell offer."""

from __future__ import annotations

import argparse
import contextlib
import re
from collections import ChainMap
from pathlib import Path

import pytest

from rigs.files import option_samples
from rigs.files.command_line import COMMANDS
from rigs.files.refusals import refused
from robot_sysid import __version__, commands
from robot_sysid.cli import main
from robot_sysid.commands.arguments import Parser
from robot_sysid.commands.identify import settings_text
from robot_sysid.config import IdentifyConfig
from robot_sysid.errors import InputError
from robot_sysid.records.option_fields import given_values
from tests.test_config import CONFIGS

IDENTIFY = COMMANDS["identify"]
MOST_OPTIONS = 32
ARM = "an 'arm'.xml"
MOTORS = ([ARM, "--motor-type", "DM4340"],)
LOGS = [ARM, "--empty", "a.csv", "--loaded", "b.csv"]
LOGS_OF_ARM = [ARM, "a 'b'.csv", "c.csv"]
CONTEXTS = {
    "": ([ARM], [ARM, "--plant-model", "truth.xml"], *MOTORS),
    "plan": ([ARM], *MOTORS),
    "identify": (LOGS_OF_ARM, [*LOGS_OF_ARM, "--torque-from", "position-error"]),
    "payload": (LOGS, [*LOGS, "--known-mass", "1"]),
}
"""Command to words that others of its options may need."""


def config_of(name, words):
    values, _ = COMMANDS[name].parse(words)
    return CONFIGS[name].of(**values)


@pytest.mark.parametrize("name", CONTEXTS)
def test_every_option_is_kept_as_it_was_typed_and_repeated_by_a_file(
    name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "run.toml"
    (tmp_path / "priors.toml").write_text("link = 7.0")
    samples = {s.option.key: s for s in option_samples.samples(CONFIGS[name])}
    assert option_samples.keys_of(Parser(COMMANDS[name])) == {*samples}
    for key, sample in samples.items():
        if key == "measurements":
            continue
        configs = []
        for context in CONTEXTS[name]:
            with contextlib.suppress(InputError):
                configs.append(config_of(name, [*context, *sample.words]))
        kept = [given_values(record) for record in vars(configs[0]).values()]
        assert ChainMap(*kept)[key] == sample.value
        file.write_text(settings_text(configs[0]))
        assert config_of(name, ["--config", str(file)]) == configs[0]


def test_what_is_typed_counts_before_the_file(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(
        'path = "arm.xml"\nunits = "deg"\nkeep = ["friction"]\nverbose = true\n'
    )
    arguments = ["other.xml", "b.csv", f"--config={file}", "--keep", "links"]
    values, console = IDENTIFY.parse([*arguments, "--units", "rad"])
    assert values == {
        **{"path": Path("other.xml"), "measurements": (Path("b.csv"),)},
        **{"units": "rad", "keep": ("links",)},
    }
    assert console.verbose and console.config == file


WRONG_FILES = {
    "unit = 8": "mine.toml: robot-sysid identify: unknown option 'unit'",
    "help = true": "mine.toml: robot-sysid identify: unknown option 'help'",
    "units = ": "mine.toml: ",
    "units = 'deg'": "the following arguments are required: MODEL, LOG",
    "path = 'a'\nmeasurements = ['b']\nlinks = 'x'": "--links must be True or Fal",
}


def test_what_is_wrong_with_a_file_is_said_in_one_line(tmp_path):
    file = tmp_path / "mine.toml"
    with refused(r"mine\.toml: No such file"):
        IDENTIFY.parse(["--config", str(file)])
    for text, message in WRONG_FILES.items():
        file.write_text(text)
        with pytest.raises(InputError) as error:
            values, _ = IDENTIFY.parse(["--config", str(file)])
            IdentifyConfig.of(**values)
        assert message in str(error.value)


def help_lines(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_an_example_and_the_main_options_and_the_full_help_has_all(
    name, capsys
):
    lines = help_lines([*name.split(), "--help"], capsys)
    assert lines[0] == f"example: robot-sysid {COMMANDS[name].example}"
    full = help_lines([*name.split(), "--help-all"], capsys)
    assert max(map(len, (*lines[1:], *full[1:]))) <= 100
    assert name == "log" or len(lines) <= 51
    for action in Parser(COMMANDS[name]).actions:
        assert all(
            re.search(rf"{flag}\b", "\n".join(full)) for flag in action.option_strings
        )
    actions = Parser(COMMANDS[name], full=False).actions
    visible = {action.dest for action in actions if action.help != argparse.SUPPRESS}
    main = COMMANDS[name].main
    hidden = {action.dest for action in actions} - visible
    assert hidden.isdisjoint(main) and bool(hidden) == bool(main)


def test_without_arguments_the_commands_are_printed_in_the_order_of_their_use(capsys):
    assert main([]) == 2
    printed = capsys.readouterr()
    heading, *lines, end = printed.out.splitlines()
    assert printed.err == "" and "order in which you need them" in heading
    names = [line.split()[0] for line in lines]
    assert list(dict.fromkeys(names)) == [
        *("log", "identify", "report", "plan", "payload", "check", "motors"),
        *("MODEL", "example"),
    ]
    assert set(commands.COMMANDS) == {*names} - {"MODEL"} and "--help" in end
    full_help = help_lines(["--help"], capsys)
    assert full_help[2:4] == [heading, lines[0]]
    assert "usage: robot-sysid MODEL [options]" in full_help


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    lines_printed = capsys.readouterr().out.splitlines()
    assert lines_printed == help_lines(["arm.xml", "--version"], capsys)
    assert lines_printed == [f"robot-sysid {__version__}"]


def test_identify_has_few_options(capsys):
    lines = help_lines(["identify", "--help-all"], capsys)
    assert sum(line.startswith("  -") for line in lines) <= MOST_OPTIONS


@pytest.mark.parametrize(
    "line", ["q t --units deg m", "q --units deg t m", "q t m --units deg"]
)
def test_options_may_stand_between_the_files_of_a_list(line):
    values, _ = COMMANDS["log"].parse(line.split())
    files = {"log": (Path("q"), Path("t")), "path": Path("m")}
    assert values == {**files, "units": "deg"}


@pytest.mark.parametrize(
    "words", ["q.csv tau.csv", "q.csv --validation-measurements tau.csv"]
)
def test_a_log_that_tests_the_result_may_be_two_files(words):
    arguments = ["arm.xml", "log.csv", "--validation-measurements", *words.split()]
    given = Parser(COMMANDS["identify"]).given_values(arguments, ())
    assert list(given["validation_measurements"]) == [Path("q.csv"), Path("tau.csv")]
    assert list(given["measurements"]) == [Path("log.csv")]

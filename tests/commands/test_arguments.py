"""Parsers made from option records: what is typed, what is refused, what the help says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from robot_sysid import __version__
from robot_sysid.commands.arguments import ConsoleOptions, Parser, default_text, described, parsed
from robot_sysid.errors import EXIT_CODES, InputError
from robot_sysid.records.options import OptionRecord, default_of, option, options_of, whole_number


@dataclass(frozen=True)
class Oven(OptionRecord):
    """A record with an option of each kind."""

    fan: bool = option(False, "blow")
    heat: float = option(180.0, "how hot, in % of what it can", unit="°C")
    mode: str = option("top", "where from", choices=("top", "bottom"))
    dish: Path | None = option(None, "what is in it", metavar="FILE", usual="the last one")
    seat: tuple[float, ...] | None = option(None, "where it stands", metavar=("X", "Y"))
    tray: tuple[int, ...] = option((), "a height", parse=whole_number, repeats=True)
    spice: tuple[str, ...] = option((), "names", several=True)


def parser(main=None, description="", **rest):
    made = Parser("bake", "robot-sysid bake bread.txt", description, main, **rest)
    made.add("oven", Oven)
    made.add_console()
    return made


def values(*arguments):
    return parsed(lambda full: parser(), arguments)[0]


def help_of(made, capsys, flag="--help"):
    with pytest.raises(SystemExit) as stop:
        made.parse_args([flag])
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_only_what_was_given_is_passed_on():
    assert values() == {}
    assert values("--fan", "--heat", "90") == {"fan": True, "heat": 90.0}


def test_words_become_values_and_lists_tuples():
    assert values("--dish", "a.txt", "--mode", "bottom") == {
        "dish": Path("a.txt"),
        "mode": "bottom",
    }
    assert values("--seat", "-1", "2e-1") == {"seat": (-1.0, 0.2)}
    assert values("--tray", "3", "--tray", "0x10") == {"tray": (3, 16)}
    assert values("--spice", "salt", "pepper") == {"spice": ("salt", "pepper")}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--heat", "hot"], "argument --heat: invalid float value: 'hot'"),
        (["--heat"], "argument --heat: expected one argument"),
        (["--mode", "side"], "argument --mode: invalid choice: 'side'"),
        (["--tray", "high"], "argument --tray: 'high' is not a whole number; write 3 or 0x03"),
        (["--seat", "1"], "argument --seat: expected 2 arguments"),
        (["--hea", "3"], "unrecognized arguments: --hea 3"),
        (["bread"], "unrecognized arguments: bread"),
    ],
)
def test_what_cannot_be_read_is_one_line_that_names_the_option(arguments, words):
    with pytest.raises(InputError) as caught:
        values(*arguments)
    message = str(caught.value)
    assert words in message and "\n" not in message
    assert message.endswith("(robot-sysid bake --help-all lists all options)")


def test_console_options_are_apart_and_exclude_each_other():
    given, console = parsed(lambda full: parser(), ["-v", "--debug"])
    assert given == {} and (console.verbose, console.quiet, console.debug) == (True, False, True)
    with pytest.raises(InputError, match="--verbose and --quiet exclude each other"):
        parsed(lambda full: parser(), ["--quiet", "--verbose"])


def test_help_begins_with_an_example_and_shows_all_options(capsys):
    text = help_of(parser(description="Bake bread."), capsys)
    assert text.startswith(
        "example: robot-sysid bake bread.txt\n\nusage: robot-sysid bake [options]"
    )
    for each in (*options_of(Oven).values(), *options_of(ConsoleOptions).values()):
        assert f"  {each.flag}" in text or f", {each.flag}" in text
    assert "in % of what it can [°C] (default: 180)" in text


def test_a_short_help_shows_the_main_options_and_the_rest_still_works(capsys):
    short = parser(("heat", "quiet"))
    text = help_of(short, capsys)
    assert "--heat" in text and "--quiet" in text
    assert "--tray" not in text and "--debug" not in text
    assert parsed(lambda full: short, ["--tray", "3"])[0] == {"tray": (3,)}


def test_a_command_takes_some_options_of_a_record_with_defaults_of_its_own(capsys):
    made = Parser("bake", "", "")
    made.add("some", Oven, only=("heat", "mode"), leave_out=("mode",), usual={"heat": 200.0})
    text = help_of_added(made, capsys)
    assert "(default: 200)" in text
    assert "--heat" in text and "--mode" not in text and "--fan" not in text


def help_of_added(made, capsys):
    made.add_console()
    return help_of(made, capsys)


def test_the_version_is_printed(capsys):
    assert help_of(parser(), capsys, "--version") == f"robot-sysid {__version__}\n"


def test_defaults_in_words():
    found = options_of(Oven)
    texts = {name: default_text(each, default_of(Oven, name)) for name, each in found.items()}
    assert texts == {
        **dict.fromkeys(("fan", "seat", "tray", "spice"), ""),
        **{"heat": "180", "mode": "top", "dish": "the last one"},
    }
    assert described(found["dish"], None) == "what is in it (default: the last one)"
    assert described(found["fan"], False) == "blow"


def test_exit_codes_are_explained(capsys):
    text = " ".join(help_of(parser(codes=EXIT_CODES), capsys).split())
    listed = ", ".join(f"{code} {words}" for code, words in EXIT_CODES.items())
    assert f"Exit codes: {listed}." in text

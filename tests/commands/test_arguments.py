"""Parsers made from option records: what is typed, what is refused, what the help says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.errors import EXIT_CODES, InputError
from robot_sysid.records.options import OptionRecord, option, whole_number


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


def parser(main=None, **rest):
    made = Parser("bake", "robot-sysid bake bread.txt", "Bake bread.", main, codes=EXIT_CODES)
    made.add("oven", Oven, **rest)
    made.add_console()
    return made


def values(*arguments):
    return parsed(lambda full: parser(), arguments)[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--heat hot", "argument --heat: invalid float value: 'hot'"),
        ("--mode side", "argument --mode: invalid choice: 'side'"),
        ("--tray high", "argument --tray: 'high' is not a whole number; write 3 or 0x03"),
        ("--seat 1", "argument --seat: expected 2 arguments"),
        ("--hea 3", "unrecognized arguments: --hea 3; --hea: did you mean --heat?"),
        ("--zzz 3", "unrecognized arguments: --zzz 3 (robot-sysid bake"),
    ],
)
def test_what_cannot_be_read_is_one_line_that_names_the_option(arguments, words):
    with pytest.raises(InputError) as caught:
        values(*arguments.split())
    message = str(caught.value)
    assert words in message and "\n" not in message
    assert message.endswith("(robot-sysid bake --help-all lists all options)")


def test_the_help_shows_units_defaults_exit_codes_and_main_options_alone(capsys):
    def printed(made):
        with pytest.raises(SystemExit):
            made.parse_args(["--help"])
        return " ".join(capsys.readouterr().out.split())

    text = printed(parser(only=("heat", "dish"), leave_out=("mode",), usual={"heat": 200.0}))
    assert text.startswith("example: robot-sysid bake bread.txt usage: robot-sysid bake [options]")
    assert "in % of what it can [°C] (default: 200)" in text and "(default: the last one)" in text
    assert not {"--mode", "--fan"} & set(text.split())
    assert "Exit codes: 0 done, 1 " in text
    short = parser(("heat", "quiet"))
    text = printed(short)
    assert "--heat" in text and "--quiet" in text and "--tray" not in text
    assert parsed(lambda full: short, ["--tray", "3"])[0] == {"tray": (3,)}

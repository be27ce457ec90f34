"""A usable value for every option of a run, made from the records themselves.

What is true of each option (it reaches its record) is tested with these, so that a new option is
tested from the day it is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import CONSOLE, Parser
from robot_sysid.config import Config
from robot_sysid.estimate.options import Priors
from robot_sysid.records.option_fields import Option, command_arguments
from robot_sysid.records.servo_setting import ServoSetting

# Values that cannot be made from the kind of value alone.
_CHOSEN = {
    "gravity": (1.0, 0.0, -0.5),
    "workspace": (-1.0, 1.0, -1.0, 1.0, 0.0, 2.0),
    "keep_out": ((0.0, 0.0, 1.0, -0.5),),
    "motor_type": ("DM4340", "DM4310"),
    "friction_model": "coulomb-viscous",
    "for_": "payload",
    "priors": Priors(link=7.0, file=Path("priors.toml")),
    "empty": (Path("a.csv"), Path("b.csv")),
    "order": "AB",
    "servo_setting": (
        ServoSetting(400.0, 7.4),
        ServoSetting(load_mass=0.2, load_position=(0.0, 0.0, -0.1)),
    ),
}


@dataclass(frozen=True)
class Sample:
    """One option of a run.

    Attributes:
        option: what is said about it.
        value: one it may have, other than its default.
    """

    option: Option
    value: Any

    @property
    def words(self) -> list[str]:
        """What is typed to give it that value."""
        return command_arguments({self.option.key: self.value}, [self.option])


def samples(config_type: type[Config]) -> list[Sample]:
    """Return a sample of every option of a command."""
    options = chain(*config_type.options().values())
    return [Sample(option, sample_value(option)) for option in options]


def sample_value(option: Option) -> Any:
    """Return a value of an option other than its default."""
    if option.key in _CHOSEN:
        return _CHOSEN[option.key]
    if isinstance(option.default, bool):
        return not option.default
    if option.choices:
        value = next(choice for choice in option.choices if choice != option.default)
    else:
        assert option.parse is not None, option.flag
        # A number that is a share, a speed, a time or a level, or a name.
        is_whole = isinstance(option.parse("7"), int)
        value = option.parse("7" if is_whole else "0.25")
    return (value,) if option.repeats or option.takes_many else value


def keys_of(parser: Parser) -> set[str]:
    """Return the keys of the options that a parser takes, the console's left out."""
    keys = {action.dest for action in parser.actions}
    console = {option.key for option in CONSOLE}
    return keys - console - {"help", "version", "help_all", "path"}

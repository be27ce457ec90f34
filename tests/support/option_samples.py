"""A usable value for every option of the command line, made from the records themselves.

What is true of each option (it reaches its record, it is refused where it makes no sense) is tested
with these, so that a new option is tested from the day it is there.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import ConsoleOptions
from robot_sysid.config import ModelOptions, SysidConfig
from robot_sysid.records.options import Option, default_of, options_of

LOG = {"measurements": (Path("log.csv"),)}
PLANT = {"plant_model": Path("truth.xml")}
PLAN = {"plan_only": True}
OPTIMAL = {"excitation": "optimal"}
FILE = {"trajectory": Path("saved.json")}
PAYLOAD = {**PLAN, "for": "payload"}
STATIC = {**PAYLOAD, "static": True}
SWEEPS = {**PLAN, "for": "friction"}
NOISY_FILE = {**FILE, **PLANT, "noise_torque": 0.1}
SERVOS = {**LOG, "torque_from": "position-error"}
MOTORS = {"export_damiao": True, "motor_type": ("DM4340",)}

# Need -> options with which it is met, and options with which it is not; {} stands for none.
MET: dict[str, tuple[dict[str, Any], ...]] = {
    "": ({},),
    "motion": ({}, PLANT, PLAN, FILE),
    "new motion": ({}, PLANT, PLAN, OPTIMAL),
    "draw": ({}, PLANT, PLAN, OPTIMAL, STATIC, NOISY_FILE),
    "design": (OPTIMAL, {**OPTIMAL, **PLAN}, {**OPTIMAL, **PLANT}),
    "estimate": ({}, PLANT, LOG),
    "friction": (PLANT, LOG),
    "measured": (PLANT, LOG),
    "log": (LOG,),
    "servos": (SERVOS,),
    "plant": (PLANT,),
    "plant or plan": (PLANT, PLAN, OPTIMAL),
    "plan": (PLAN,),
    "payload plan": (PAYLOAD,),
    "static plan": (STATIC,),
    "prior": ({"prior": "entropic"},),
    "motors": (MOTORS,),
}
UNMET: dict[str, tuple[dict[str, Any], ...]] = {
    "motion": (LOG,),
    "new motion": (LOG, FILE),
    "draw": (LOG, FILE, {**FILE, **PLANT}, {**FILE, **PLAN}, SWEEPS),
    "design": ({}, PLANT, PLAN),
    "estimate": (PLAN,),
    "friction": ({}, OPTIMAL, PLAN, {**LOG, "no_friction": True}),
    "measured": ({}, OPTIMAL),
    "log": ({}, PLANT),
    "servos": ({}, LOG),
    "plant": ({}, PLAN, OPTIMAL),
    "plant or plan": ({},),
    "plan": ({}, PLANT, LOG),
    "payload plan": ({}, PLAN),
    "static plan": (PLAN, PAYLOAD),
    "prior": ({},),
    "motors": ({}, PLAN),
}
# Values that cannot be made from the kind of value alone.
_CHOSEN = {
    "workspace": (-1.0, 1.0, -1.0, 1.0, 0.0, 2.0),
    "keep_out": ((0.0, 0.0, 1.0, -0.5),),
    "motor_type": ("DM4340", "DM4310"),
    "friction_model": "coulomb-viscous",
    "harmonics": 5,
}


@dataclass(frozen=True)
class Sample:
    """One option of a run.

    Attributes:
        record: name of its record in the configuration.
        field: name of its field there.
        option: what is said about it.
        value: one it may have, other than its default.
    """

    record: str
    field: str
    option: Option
    value: Any

    @property
    def words(self) -> list[str]:
        """What is typed to give it that value."""
        flag, value = self.option.flag, self.value
        if value is True:
            return [flag]
        if not self.option.repeats:
            return [flag, *map(str, value if isinstance(value, tuple) else (value,))]
        each = [one if isinstance(one, tuple) else (one,) for one in value]
        return [word for one in each for word in (flag, *map(str, one))]

    def __str__(self) -> str:
        return self.option.flag


def record_types() -> dict[str, type]:
    """Return name to type of the records that make a configuration."""
    others = {each.name: type(each.default) for each in fields(SysidConfig)[1:]}
    return {"model": ModelOptions, **others}


def samples() -> Iterator[Sample]:
    """Yield a sample of every option of a run."""
    for name, record in record_types().items():
        for field, option in options_of(record).items():
            yield Sample(name, field, option, _value(option, default_of(record, field)))


def typed(values: dict[str, Any]) -> list[str]:
    """Return what is typed to give options these values."""
    known = {sample.option.key: sample for sample in samples()}
    return [
        word
        for key, value in values.items()
        for word in Sample("", "", known[key].option, value).words
    ]


def _value(option: Option, default: Any) -> Any:
    if option.key in _CHOSEN:
        return _CHOSEN[option.key]
    if isinstance(default, bool):
        return not default
    if option.choices:
        choice = next(choice for choice in option.choices if choice != default)
        return (choice,) if option.repeats else choice
    assert option.parse is not None, option.flag
    # A number that is a share, a speed, a time or a level, or a name.
    text = "7" if option.parse("7") == 7 and isinstance(option.parse("7"), int) else "0.25"
    value = option.parse(text)
    assert value != default, option.flag
    return (value,) if option.repeats or option.several else value


def keys_of(parser: argparse.ArgumentParser) -> set[str]:
    """Return the keys of the options that a parser takes, the console's left out."""
    taken = {action.dest for action in parser._actions if action.option_strings}
    console = {each.key for each in options_of(ConsoleOptions).values()}
    return taken - console - {"help", "version", "help_all"}

"""What a run on motors is asked for: every option is in one record, and is repeated as given."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.files.option_samples import sample_value
from rigs.files.refusals import refused
from robot_sysid.damiao.execution import (
    LIMIT_OPTIONS,
    MODEL_LIMITS,
    NO_LIMITS,
    RUN_OPTIONS,
    SIMULATED_OPTIONS,
    RunOptions,
)
from robot_sysid.damiao.settings import HoldOptions
from robot_sysid.model import ModelOptions
from robot_sysid.records.option_fields import (
    OptionRecord,
    command_arguments,
    keys_of,
    options_of,
    options_of_all,
)

_CHOSEN = {"for_": 3.0, "speed": 0.5, "kp": (30.0,), "kd": (2.0,)}
OPTIONS = {
    option.key: option
    for option in (*RUN_OPTIONS, *SIMULATED_OPTIONS, *options_of_all(HoldOptions))
}


def value_of(key):
    return _CHOSEN[key] if key in _CHOSEN else sample_value(OPTIONS[key])


def held_values(options):
    """Return (name of the record, key) to the value of each option in the records of a run."""
    return {
        (name, stated.key): getattr(record, field)
        for name, record in vars(options).items()
        if isinstance(record, OptionRecord)
        for field, stated in options_of(record).items()
    }


@pytest.mark.parametrize("key", OPTIONS)
def test_an_option_reaches_one_record_and_changes_no_other(key):
    value = value_of(key)
    options = RunOptions.of({key: value})
    before = held_values(RunOptions())
    changed = {
        place: held
        for place, held in held_values(options).items()
        if held != before[place]
    }
    ((_, changed_key),) = changed
    assert changed_key == key and list(changed.values()) == [value]
    assert options.given == {key: value}


def test_what_was_not_given_forbids_nothing_and_is_not_repeated():
    options = RunOptions.of(dict.fromkeys(keys_of(ModelOptions)))
    assert options == RunOptions() and options.limits == NO_LIMITS
    assert command_arguments(options.given, RUN_OPTIONS) == []


def test_a_default_that_was_given_is_repeated():
    given = RunOptions.of({"speed": 1.0, "interface": "socketcan"}).given
    words = command_arguments(given, RUN_OPTIONS)
    assert sorted(words) == ["--interface", "--speed", "1", "socketcan"]


@pytest.mark.parametrize("key", [*sorted(keys_of(ModelOptions)), *MODEL_LIMITS])
def test_what_is_about_a_model_needs_one(key):
    values = {key: value_of(key)}
    with refused("is about a model; add --model"):
        RunOptions.of(values).require_model()
    RunOptions.of({**values, "model": Path("arm.xml")}).require_model()


def test_limits_of_the_motion_alone_need_no_model():
    limits = [option.key for option in LIMIT_OPTIONS if option.key not in MODEL_LIMITS]
    RunOptions.of({key: value_of(key) for key in limits}).require_model()

"""Options are checked once, with the name of the option in the message."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.config import MOST_SAMPLES, SysidConfig
from robot_sysid.errors import InputError

MODEL = Path("arm.xml")
NOT_POSITIVE = st.one_of(
    st.floats(max_value=0.0), st.sampled_from([float("nan"), float("inf"), -float("inf")])
)


def message(**options):
    with pytest.raises(InputError) as caught:
        SysidConfig(MODEL, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_defaults_are_those_of_the_command_line():
    config = SysidConfig(MODEL)
    assert (config.duration, config.sample_rate) == (15.0, 1000.0)
    assert (config.torques, config.max_velocity) == ("chain", 2.0)
    assert config.friction
    assert config.seed is None
    assert config.output_dir == Path("sysid_output")


@pytest.mark.parametrize(
    ("field", "option"),
    [
        ("duration", "--duration"),
        ("sample_rate", "--sample-rate"),
        ("max_velocity", "--max-velocity"),
    ],
)
@given(value=NOT_POSITIVE)
def test_numbers_that_must_be_positive_are_refused_otherwise(field, option, value):
    assert message(**{field: value}).startswith(f"{option} must be positive")


@given(st.floats(0.01, 1e5), st.floats(0.01, 1e5))
def test_any_duration_and_rate_with_two_samples_or_more_and_not_too_many_is_accepted(
    duration, rate
):
    if duration * rate > MOST_SAMPLES:
        assert "more than the 1e+09 a run can take" in message(duration=duration, sample_rate=rate)
    elif duration * rate >= 1.0:
        assert SysidConfig(MODEL, duration=duration, sample_rate=rate).duration == duration
    else:
        assert "less than two samples" in message(duration=duration, sample_rate=rate)


def test_a_negative_seed_is_refused():
    assert "--seed must not be negative" in message(seed=-1)
    assert SysidConfig(MODEL, seed=0).seed == 0


def test_the_damiao_export_needs_motor_types_and_the_other_way_round():
    asked = message(export_damiao=True)
    assert asked.startswith("--export-damiao requires at least one --motor-type")
    assert "--export-damiao" in message(motor_types=("DM4340",))
    assert SysidConfig(MODEL, export_damiao=True, motor_types=("DM4340",)).motor_types


def test_a_config_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        SysidConfig(MODEL).duration = 3.0

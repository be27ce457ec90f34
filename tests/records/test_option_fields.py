"""Fields of records are options: they are parsed, converted, checked and refused by name."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files.refusals import refused
from robot_sysid.errors import InputError
from robot_sysid.records.option_fields import (
    CONSTANTS,
    SCALE,
    OptionRecord,
    PerJoint,
    check_factor,
    check_not_negative,
    check_positive,
    check_speed_factor,
    given_values,
    joint_factors,
    joint_values,
    option,
    options_of,
    parse_factor,
    parse_factors,
    parse_numbers,
    parse_whole_number,
    read_factors,
    record_from,
    shared_error,
    write_torque_scale,
)


@dataclass(frozen=True)
class Oven(OptionRecord):
    """A record with an option of each kind."""

    name: str = "unnamed"
    heat: float = option(180.0, "how hot", unit="°C", check=check_positive)
    fan_speed: Optional[int] = option(None, "turns per second", flag="--fan")
    trays: tuple[float, ...] = option((), "heights", check=check_positive, repeats=True)
    recipe: Optional[Path] = option(None, "file")
    mode: str = option("top", "where from", choices=("top", "bottom"))
    gas: bool = option(False, "burn gas")
    levels: PerJoint = option(1.0, "of each joint")
    walls: tuple[tuple[float, ...], ...] = option(
        (), "planes", metavar=("X", "Y"), repeats=True
    )


def test_a_record_is_made_from_keys_and_text_becomes_what_the_annotation_names():
    parsers = [
        options_of(Oven)[name].parse
        for name in ("heat", "fan_speed", "trays", "recipe")
    ]
    assert parsers == [float, parse_whole_number, float, Path]
    record = record_from(Oven, {"fan": "3", "heat": 90.0, "trays": 0.2, "unrelated": 1})
    assert record == Oven(heat=90.0, fan_speed=3, trays=(0.2,))
    assert [option.default for option in options_of(Oven).values()] == [
        getattr(Oven, field) for field in options_of(Oven)
    ]
    oven = Oven(name="big", heat=200.0, recipe=Path("bread.txt"))
    assert given_values(oven) == {"heat": 200.0, "recipe": Path("bread.txt")}


def test_a_type_that_python_3_9_cannot_evaluate_or_that_is_no_kind_is_refused():
    @dataclass(frozen=True)
    class Union(OptionRecord):
        heat: float | None = option(None, "how hot")

    @dataclass(frozen=True)
    class Unknown(OptionRecord):
        heat: complex = option(0j, "how hot")

    for record in (Union, Unknown):
        with pytest.raises(TypeError):
            options_of(record)


REFUSED = {
    "--heat must be positive (got 0)": {"heat": 0.0},
    "--heat must be positive (got nan)": {"heat": np.nan},
    "--trays must be positive (got -0.2)": {"trays": (0.1, -0.2)},
    "--mode 'side': choose one of top, bottom": {"mode": "side"},
    "--heat must be a number (got 'hot')": {"heat": "hot"},
    "--heat must be a number (got [1.0])": {"heat": [1.0]},
    "--heat must be a number (got True)": {"heat": True},
    "--heat must be a number (got None)": {"heat": None},
    "--fan must be a whole number (got 2.5)": {"fan": 2.5},
    "--trays must be a number (got [0.1, 'x'])": {"trays": [0.1, "x"]},
    "--recipe must be a path (got 3)": {"recipe": 3},
    "--gas must be True or False (got 'no')": {"gas": "no"},
    "--levels: 'a,b' is neither a number nor a list like 0.1,0.1,0.05": {
        "levels": "a,b"
    },
    "--levels must be a number, or one per joint (got {1: 2})": {"levels": {1: 2}},
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_value_that_cannot_be_used_is_refused_in_the_name_of_its_option(message):
    with refused() as caught:
        record_from(Oven, REFUSED[message])
    assert str(caught.value) == message


def test_numpy_numbers_lists_and_text_are_converted_to_the_annotation():
    values = {
        "heat": np.float32(2.0),
        "fan": None,
        "trays": np.array([1.0, 2.0]),
        "gas": np.True_,
    }
    values |= {"levels": [1, 2.5], "recipe": "a.txt", "walls": [0.0, 1.0]}
    record = record_from(Oven, values)
    assert (
        record.trays == (1.0, 2.0) and record.gas is True and record.fan_speed is None
    )
    assert (record.levels, record.recipe, record.walls) == (
        (1, 2.5),
        Path("a.txt"),
        ((0.0, 1.0),),
    )


NUMBERS = st.one_of(st.floats(), st.sampled_from([0.0, 1.0, -1.0, np.inf, np.nan]))


@given(NUMBERS)
def test_checks_accept_exactly_their_range(value):
    finite = bool(np.isfinite(value))
    assert (check_positive(value) is None) == (finite and value > 0.0)
    assert (check_not_negative(value) is None) == (finite and value >= 0.0)
    assert (check_speed_factor(value) is None) == (0.0 < value <= 1.0)


@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=7)
)
def test_levels_read_what_was_written(numbers):
    written: PerJoint = parse_numbers(",".join(map(repr, numbers)))
    assert written == (numbers[0] if len(numbers) == 1 else tuple(numbers))


def test_one_number_serves_all_joints():
    for values, expected in (
        (0.3, 2 * [0.3]),
        ((0.3,), 2 * [0.3]),
        ((1.0, 2.0), [1.0, 2.0]),
    ):
        assert joint_values(values, 2, "noise").tolist() == expected
    for numbers in ((1.0, 2.0), ()):
        with refused("noise takes one number, or one per joint"):
            joint_values(numbers, 3, "noise")


# --- torque scales and torque constants ---

JOINTS = ("base", "elbow", "wrist")
SIZE = st.floats(1e-6, 1e6)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.text('a_ é"\\\n関', min_size=1), st.tuples(SIZE, SIZE), max_size=8
    )
)
def test_a_written_scale_reads_back_to_the_last_bit(tmp_path, scale):
    path = tmp_path / "scale.json"
    write_torque_scale(path, scale)
    assert read_factors(path) == scale


@given(st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3))
def test_factors_given_as_text_are_used_to_the_last_bit(values):
    typed = parse_factors(",".join(map(repr, values)))
    assert_array_equal(joint_factors(typed, JOINTS, SCALE)[0], values)
    one = joint_factors(parse_factors(repr(values[0])), JOINTS, SCALE)
    assert_array_equal(one, [[values[0]] * 3, [np.nan] * 3])


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=3), st.floats(1e-3, 10.0))
def test_factors_that_may_be_off_are_typed_as_they_are_read(values, error):
    rough = parse_factors(f"{','.join(map(repr, values))} ± {100.0 * error!r} %")
    assert_allclose(rough.values, values if len(values) > 1 else values[0], rtol=1e-12)
    assert shared_error(rough) == pytest.approx(error)
    again = parse_factors(str(rough))
    assert_allclose(again.values, rough.values, rtol=1e-11)
    assert shared_error(again) == pytest.approx(error)
    assert shared_error(parse_factors("1.5")) == shared_error(None) == 0.0


@pytest.mark.parametrize("text", ["1.7+-x%", "1.7+-1,2%", "1,2+-3%", "x+-3%"])
def test_a_factor_with_another_form_is_refused(text):
    with pytest.raises(InputError):
        parse_factor(text)


def test_a_file_is_read_by_joint_names(tmp_path):
    path = tmp_path / "k.json"
    table = {"wrist": 3.0, "base": 1.0, "elbow": 2.0, "gripper": 9.0}
    path.write_text(json.dumps({"version": 1, CONSTANTS: table}))
    assert_array_equal(
        joint_factors(parse_factors(str(path)), JOINTS, CONSTANTS)[0], [1.0, 2.0, 3.0]
    )
    with refused("holds no torque_scale"):
        joint_factors(path, JOINTS, SCALE)
    with refused("no torque_constants of joint hand; it lists wrist"):
        joint_factors(path, ("hand",), CONSTANTS)


DAMAGED = {
    "{": "cannot read",
    "[]": "holds no torque_scale",
    f'{{"torque_scale": {{"a": 1{400 * "0"}}}}}': "joint a must be positive",
    '{"torque_scale": {"a": 0}}': "joint a must be positive",
    '{"torque_scale": {"a": NaN}}': "joint a must be positive",
    '{"torque_scale": {"a": "x"}}': "joint a must be positive",
}


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_file_is_refused_with_the_reason(tmp_path, text):
    path = tmp_path / "scale.json"
    path.write_text(text)
    with refused(DAMAGED[text]):
        read_factors(path)


def test_factors_that_are_no_numbers_or_too_few_are_refused():
    with refused("neither a number"):
        parse_factors("nofile.json")
    assert check_factor(-1.0) and check_factor(0.0) and not check_factor(1.3)

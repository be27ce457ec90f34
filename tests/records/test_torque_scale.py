"""Torque factors are read from command-line text and from files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from robot_sysid.errors import InputError
from robot_sysid.records.torque_scale import (
    CONSTANTS,
    SCALE,
    check_factor,
    joint_factors,
    parse_factors,
    read_factors,
    write_torque_scale,
)

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


def test_a_file_is_read_by_joint_names(tmp_path):
    path = tmp_path / "k.json"
    table = {"wrist": 3.0, "base": 1.0, "elbow": 2.0, "gripper": 9.0}
    path.write_text(json.dumps({"version": 1, CONSTANTS: table}))
    assert_array_equal(
        joint_factors(parse_factors(str(path)), JOINTS, CONSTANTS)[0], [1.0, 2.0, 3.0]
    )
    with pytest.raises(InputError, match="holds no torque_scale"):
        joint_factors(path, JOINTS, SCALE)
    with pytest.raises(
        InputError, match="no torque_constants of joint hand; it lists wrist"
    ):
        joint_factors(path, ("hand",), CONSTANTS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot read"),
        (
            '{"version": 1, "torque_scale": {"a": 1' + "0" * 400 + "}}",
            "joint a must be positive",
        ),
        ("[]", "holds no torque_scale"),
        ('{"torque_scale": {"a": 1}}', "version None"),
        ('{"version": 2, "torque_scale": {"a": 1}}', "joint a must be positive"),
        (
            '{"version": 2, "torque_scale": {"a": {"value": 1}}}',
            "joint a must be positive",
        ),
        ('{"version": 1, "torque_scale": {"a": 0}}', "joint a must be positive"),
        ('{"version": 1, "torque_scale": {"a": NaN}}', "joint a must be positive"),
        ('{"version": 1, "torque_scale": {"a": "x"}}', "joint a must be positive"),
    ],
)
def test_a_damaged_file_is_refused_with_the_reason(tmp_path, text, message):
    path = tmp_path / "scale.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_factors(path)


def test_factors_that_are_no_numbers_or_too_few_are_refused():
    with pytest.raises(InputError, match="neither a number"):
        parse_factors("nofile.json")
    with pytest.raises(
        InputError, match="--torque-scale takes one number, or one for each of"
    ):
        joint_factors((1.0, 2.0), JOINTS, SCALE)
    assert check_factor(-1.0) and check_factor(0.0) and not check_factor(1.3)

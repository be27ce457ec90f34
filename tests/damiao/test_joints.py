"""From a file to joints that are mounted that way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.protocol.joints import (
    JointSpace,
    id_problems,
    read_joint_map,
    write_joint_map,
)
from robot_sysid.errors import InputError
from tests.support.damiao_rig import map_line

WAYS = st.sampled_from([-1, 1])
NUMBERS = st.floats(-10.0, 10.0)


@st.composite
def spaces(draw, n=3):
    each = [[draw(kind) for _ in range(n)] for kind in (WAYS, NUMBERS, st.floats(0.1, 5.0))]
    return JointSpace(*np.array(each, dtype=float))


@given(spaces(), st.lists(NUMBERS, min_size=3, max_size=3))
def test_to_the_motors_and_back_is_nothing(space, values):
    values = np.array(values)
    there = space.motor_position(values), space.motor_torque(values)
    np.testing.assert_allclose(space.joint_position(there[0]), values, atol=1e-9)
    np.testing.assert_allclose(space.joint_torque(there[1]), values, atol=1e-9)


@given(spaces(), st.lists(NUMBERS, min_size=15, max_size=15))
def test_a_motor_makes_the_torque_that_its_joint_is_told(space, numbers):
    """The motor's law with the motor's numbers gives the joint's torque with the joint's."""
    from robot_sysid.damiao.protocol.codec import MitCommand

    position, velocity, torque, q, qd = np.array(numbers).reshape(5, 3)
    told = MitCommand(position, velocity, np.full(3, 20.0), np.full(3, 1.0), torque)
    motor = space.to_motors(told).motor_torque(space.motor_position(q), space.direction * qd)
    np.testing.assert_allclose(space.joint_torque(motor), told.motor_torque(q, qd), atol=1e-6)


@given(st.lists(st.tuples(WAYS, st.floats(-3, 3), st.floats(0.5, 2.0)), min_size=1, max_size=7))
def test_a_map_is_read_as_it_was_written(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("map") / "map.csv"
    written = [
        map_line(f"j{k}", "can0", k + 1, k + 17, way, round(offset, 4), round(ratio, 3))
        for k, (way, offset, ratio) in enumerate(rows)
    ]
    write_joint_map(path, written)
    assert list(read_joint_map(path)) == written


def test_what_is_left_out_is_as_usual(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("# by hand\njoint, can_id, direction\nelbow, 3, -1\n")
    assert read_joint_map(path) == (map_line("elbow", "", 3, 19, -1),)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected the columns"),
        ("joint,can_id\na,1\n", "expected the columns"),
        ("joint,can_id,direction,colour\na,1,1,red\n", "expected the columns"),
        ("joint,can_id,direction\n", "has no lines"),
        ("joint,can_id,direction\na,1,2\n", r"row 1: direction must be \+1 or -1"),
        ("joint,can_id,direction\na,1,1\nb,x,1\n", "row 2: expected"),
        ("joint,can_id,direction\na,1,1\na,2,1\n", "names a twice"),
        ("joint,can_id,direction\na,1,1\nb,1,1\n", "used by more than one motor"),
        ("joint,can_id,direction,offset\na,1,1,nan\n", "offset must be a number"),
        ("joint,can_id,direction,torque_ratio\na,1,1,0\n", "torque_ratio positive"),
        ("joint,can_id,direction\na\0,1,1\n", "zero bytes"),
    ],
)
def test_a_map_that_is_none_is_refused_with_its_row(tmp_path, text, words):
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_joint_map(path)
    with pytest.raises(InputError, match="cannot read"):
        read_joint_map(tmp_path / "nowhere.csv")


def test_only_motors_on_one_bus_can_clash():
    """Replies to 0x102 read as commands to motor 2."""
    assert list(id_problems([("can0", 1, 0x102), ("can1", 2, 0x102)])) == []
    assert len(list(id_problems([("can0", 1, 0x102), ("can0", 2, 0x12)]))) == 1

"""The motor table; from a file to joints that are mounted that way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import map_line, mit_command
from robot_sysid.damiao.joints import (
    MOTORS,
    Mounting,
    damiao_joints,
    id_problems,
    matching_types,
    motor_spec,
    read_joint_map,
    write_joint_map,
)
from robot_sysid.errors import InputError

# Type, then what scales its frames: position [rad], speed [rad/s], torque [N m].
LIMITS = {
    "DM4310": (12.5, 30, 10),
    "DM4340": (12.5, 10, 28),
    "DM4340_48V": (12.5, 20, 28),
    "DM6006": (12.5, 45, 12),
    "DM8006": (12.5, 45, 20),
    "DM10010L": (12.5, 25, 200),
    "DM8009": (12.5, 45, 54),
    "DM3507": (12.566, 50, 5),
    "DM4310_48V": (12.5, 50, 10),
    "DM6248": (12.566, 20, 120),
    "DM10010": (12.5, 20, 200),
    "DMH3510": (12.5, 280, 1),
    "DMH6215": (12.5, 45, 10),
    "DMS3519": (12.5, 2000, 2),
    "DMG6220": (12.5, 45, 10),
}


def test_every_type_has_its_limits_and_finds_itself_by_them():
    assert {name: spec.limits for name, spec in MOTORS.items()} == LIMITS
    assert list(MOTORS)[:7] == list(LIMITS)[:7]
    for name, spec in MOTORS.items():
        assert 0 < spec.rated_torque < spec.peak_torque
        assert name in matching_types(spec.limits)


def test_an_unknown_type_lists_the_valid_ones():
    with pytest.raises(
        InputError, match="unknown Damiao motor type 'no such type'"
    ) as caught:
        motor_spec("no such type")
    assert all(name in str(caught.value) for name in MOTORS)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "--motor-type needs one value per joint of the chain, .*: 7, got 0"),
        (["DM4340"] * 3, "--motor-type needs .*: 7, got 3"),
    ],
)
def test_motor_types_have_to_match_the_chain(names, message):
    with pytest.raises(InputError, match=message):
        damiao_joints(names, 7)
    with pytest.raises(InputError, match="CAN id 16 is outside 1 to 15"):
        damiao_joints(["DM4340"] * 16, 16)


WAYS = st.sampled_from([-1, 1])
NUMBERS = st.floats(-10.0, 10.0)


@st.composite
def mountings(draw, n=3):
    columns = [[draw(strategy) for _ in range(n)] for strategy in (WAYS, NUMBERS)]
    return Mounting(*np.array(columns, dtype=float))


@given(mountings(), st.lists(NUMBERS, min_size=15, max_size=15))
def test_a_motor_makes_the_torque_that_its_joint_is_told(mounting, numbers):
    """The motor's law with the motor's numbers gives the joint's torque with the joint's."""
    position, velocity, torque, q, qd = np.array(numbers).reshape(5, 3)
    command = mit_command(position, velocity, 20.0, 1.0, torque)
    motor_q, motor_qd, _ = mounting.signals(q, qd, q)
    motor = mounting.command(command).motor_torque(motor_q, motor_qd)
    back = mounting.inverse.signals(motor_q, motor_qd, motor)
    np.testing.assert_allclose(back, [q, qd, command.motor_torque(q, qd)], atol=1e-6)


@given(st.lists(st.tuples(WAYS, st.floats(-3, 3)), min_size=1, max_size=7))
def test_a_map_is_read_as_it_was_written(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("map") / "map.csv"
    written = [
        map_line(f"j{k}", k + 1, k + 17, direction, round(offset, 4))
        for k, (direction, offset) in enumerate(rows)
    ]
    write_joint_map(path, written)
    assert list(read_joint_map(path)) == written


TITLES = "joint,can_id,master_id,direction,offset,verified\n"


def test_comments_and_blanks_are_passed_over(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text(f"# by hand\n{TITLES}elbow, 3, 0x13, -1, 0, \n".replace(",", ", "))
    assert read_joint_map(path) == (map_line("elbow", 3, 19, -1),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the columns"),
        ("joint,can_id\na,1\n", "expected the columns"),
        ("joint,can_id,direction,colour\na,1,1,red\n", "expected the columns"),
        (TITLES, "and a row per joint"),
        (TITLES + "a,1,17,2,0,\n", r"row 1: expected a row as .* direction \+1 or -1"),
        (TITLES + "a,1,17,1,0,\nb,x,1,1,0,\n", "row 2: expected"),
        (TITLES + "a,1,17,1,0,\na,2,18,1,0,\n", "names a twice"),
        (TITLES + "a,1,17,1,0,\nb,1,18,1,0,\n", "used by more than one motor"),
        (TITLES + "a,1,17,1,nan,\n", "row 1: expected"),
        (TITLES + "a,1,17,1\n", "row 1: expected"),
    ],
)
def test_a_map_that_is_none_is_refused_with_its_row(tmp_path, text, message):
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_joint_map(path)
    with pytest.raises(InputError, match="cannot read"):
        read_joint_map(tmp_path / "nowhere.csv")


def test_an_answer_that_is_a_command_to_another_motor_is_refused():
    """Replies to 0x102 read as commands to motor 2 of the same bus."""
    assert len(list(id_problems([(1, 0x102), (2, 0x12)]))) == 1

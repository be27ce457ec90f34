"""Names of joints and lists of them are recognised whatever they are; examples: heads.txt."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from operator import attrgetter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.files.refusals import refused
from rigs.logs.log_files import arm_of, titles_alone
from robot_sysid.damiao.trajectory import trajectory_columns
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.logs.declarations import ColumnChoices
from robot_sysid.records import ColumnMap

UR = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")


def recognise(titles, joints, first_row=()) -> ColumnMap:
    """The map of titles of which nothing is declared."""
    table = titles_alone(titles, first_row)
    return ColumnFinder(table, arm_of(joints), ColumnChoices()).find_all()


def where(columns: ColumnMap) -> tuple[list[int], list[int]]:
    """The indices of the columns of position and of torque."""
    index_of = attrgetter("index")
    return list(map(index_of, columns.position)), list(map(index_of, columns.torque))


UNITS = ("s", "m", "ms", "deg", "rad", "nm")
NAME_PIECES = (*UNITS, "j2s7s300", "right", "s0", "e1", "7", "arm")


@given(
    st.lists(
        st.lists(st.sampled_from(NAME_PIECES), min_size=1, max_size=4).map("_".join),
        min_size=2, max_size=4, unique=True,
    )
)  # fmt: skip
def test_a_unit_within_a_joints_name_is_no_unit(names):
    positions = [f"{name}_position" for name in names]
    torques = [f"{name}_torque" for name in names]
    columns = recognise(["time", *positions, *torques], names)
    title_of = attrgetter("title")
    assert list(map(title_of, columns.position)) == positions
    assert list(map(title_of, columns.torque)) == torques
    assert {column.factor for column in columns.position + columns.torque} == {1.0}


ROS_NAMES = ["gripper", "elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint"]


@pytest.mark.parametrize("prefix", ["", "ur5e_"])
@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("is_one_cell", [False, True])
def test_a_log_that_lists_its_joints_in_another_order_is_never_counted(
    prefix, first, is_one_cell
):
    """Whatever the model's names begin with, and whether numbers begin with 0 or 1."""
    numbers = range(first, first + 4)
    name_titles = ["name"] if is_one_cell else [f"name[{k}]" for k in numbers]
    cells = [str(ROS_NAMES)] if is_one_cell else ROS_NAMES
    titles = ["%time", *name_titles]
    titles += [f"{q}[{k}]" for q, k in product(("position", "effort"), numbers)]
    titles.append("header.stamp")
    joints = [f"{prefix}{name}" for name in UR]
    row = ["0", *cells, *["0"] * 9]
    columns = recognise(titles, joints, first_row=row)
    start = len(name_titles) + 1
    assert where(columns) == (
        [start + 3, start + 2, start + 1],
        [start + 7, start + 6, start + 5],
    )
    # When a message was sampled outranks when it was received.
    assert columns.time.index == start + 8
    assert len(columns.notes) == bool(prefix)
    assert all(
        note.startswith("log joints: shoulder_pan_joint") for note in columns.notes
    )
    with refused("one position column for each joint"):
        recognise(titles, ("pan", "lift", "elbow"), first_row=row)


def test_the_columns_of_a_damiao_recording_are_known():
    extra = [
        "time",
        "cmd_pos",
        "cmd_vel",
        "cmd_tau",
        "status",
        "temp_mos",
        "temp_rotor",
    ]
    titles = ["time", *trajectory_columns(3)]
    titles += [f"j{joint}_{name}" for joint, name in product(range(3), extra)]
    columns = recognise(titles, ("joint1", "joint2", "joint3"))
    used = product(("pos", "tau", "vel", "time"), range(3))
    expected = ["time", *(f"j{joint}_{name}" for name, joint in used)]
    assert list(map(attrgetter("title"), columns.columns())) == expected


@pytest.mark.parametrize(
    ("logged", "option"),
    [
        ((2, 5), ("--first-joint", "a2")),
        ((0, 3), ("--joint", "a2")),
        ((1, 4), ("--first-joint", "a1", "--joint", "a3")),
    ],
)
@pytest.mark.parametrize("missing", ["position", "torque"])
def test_a_log_of_a_part_of_the_arm_names_the_options_that_hold_the_rest(
    logged, option, missing
):
    joints = [f"a{number}" for number in range(5)]
    part = joints[slice(*logged)]
    positions = part if missing == "position" else joints
    titles = [f"{name}_position" for name in positions]
    titles += [f"{name}_torque" for name in part]
    with refused(f"if the arm is {part[0]} to {part[-1]}, ") as caught:
        recognise(["time", *titles], joints)
    lacking = [name for name in joints if name not in part]
    line = ", ".join(f"torque.{name} = none" for name in lacking)
    without = [("--columns", line)] * (missing == "torque" and bool(line))
    assert caught.value.options == (*without, option)


@pytest.mark.parametrize(
    ("titles", "lacking"),
    [
        ("q0 q1 q2 tau0 tau2", ["j1"]),
        # Torques are counted as positions are.
        ("q0 q1 q2 tau1 tau2", ["j0"]),
        ("q1 q2 q3 tau1 tau2", ["j2"]),
        ("j0_position j1_position j2_position j0_torque j2_torque", ["j1"]),
    ],
)
def test_a_joint_without_a_column_of_torque_is_told(titles, lacking):
    """What is found is what is read with the declaration that is offered."""
    joints = ("j0", "j1", "j2")
    table = titles_alone(["time", *titles.split()])
    finder = ColumnFinder(table, arm_of(joints), ColumnChoices())
    declared, without = finder.without_torque
    assert [*without] == lacking
    torque = declared.find_all().torque
    assert [joints[k] for k, c in enumerate(torque) if not c.factor] == lacking


def test_a_joint_without_torque_is_not_told_by_other_titles():
    for titles in ("q0 q1 q2 tau0 tau1 tau2", "q0 q1 q2", "q0 q1 q2 x0 x1"):
        table = titles_alone(["time", *titles.split()])
        finder = ColumnFinder(table, arm_of(("j0", "j1", "j2")), ColumnChoices())
        assert finder.without_torque[1] == ()


# --- torques beside the commands of servos --------------------------------------------------------

SERVO_TITLES = ["time", "j1_pos", "j2_pos", "action_1", "action_2"]


def recognise_servos(*further, **entries) -> ColumnMap:
    """The map of a log of two servos with further columns, some of them declared."""
    table = titles_alone([*SERVO_TITLES, *further])
    choices = ColumnChoices(commanded=True, entries=entries)
    return ColumnFinder(table, arm_of(("j1", "j2")), choices).find_all()


def test_a_measured_torque_of_each_joint_is_one_more_measurement():
    columns = recognise_servos("j1_effort [Nm]", "j2_effort [mNm]")
    assert [column.index for column in columns.torque] == [3, 4]
    assert [column.index for column in columns.motor_torque] == [5, 6]
    assert [column.factor for column in columns.motor_torque] == [1.0, 1e-3]
    described = columns.describe()
    motors = "motor torque from 'j1_effort [Nm]', 'j2_effort [mNm]' x 0.001"
    assert described.endswith(motors)


@pytest.mark.parametrize(
    "form",
    [
        "j{}_load",
        "j{}_pwm",
        "j{}_current",
        "j{}_current [mA]",
        "j{}_effort_raw",
        "j{}_effort_permille",
        "j{}_effort [%]",
        "j{}_effort [‰]",
        "j{}_tau_cmd",
        "j{}_tau_model",
    ],
)
def test_no_other_column_is_taken_for_a_torque(form):
    columns = recognise_servos(form.format(1), form.format(2))
    assert columns.motor_torque == ()
    assert replace(columns, titles=(), notes=()) == replace(
        recognise_servos(), titles=(), notes=()
    )


def test_a_torque_of_an_unknown_unit_is_named():
    (note,) = recognise_servos("j1_effort [%]", "j2_effort [%]").notes
    assert note.startswith("torque is not used, and not needed: unit 'percent'")


def test_a_torque_of_one_joint_alone_has_to_be_declared():
    assert recognise_servos("j1_effort").motor_torque == ()
    columns = recognise_servos("amps", **{"torque.j2": "1.2 * amps"})
    first, second = columns.motor_torque
    assert (first.title, first.factor, first.index) == ("none", 0.0, 1)
    assert (second.title, second.factor) == ("amps", 1.2)


def test_torques_can_be_kept_out():
    columns = recognise_servos("j1_effort", "j2_effort", torque="none")
    assert columns.motor_torque == ()

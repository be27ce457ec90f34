"""Column titles are recognised in the ways people write them, and never two ways at once."""

from __future__ import annotations

import math
import re
from itertools import product
from operator import attrgetter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.log_files import arm_of, titles_alone
from rigs.refusals import refused
from robot_sysid.damiao.trajectory import trajectory_columns
from robot_sysid.logs import declarations
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.records import ColumnMap

JOINTS = ("joint0", "joint1", "joint2")
UR = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")


def recognise(
    titles: str, joints=JOINTS, choices=None, first_row=(), is_slide=()
) -> ColumnMap:
    """The map of titles with commas between them; a title's own comma is a semicolon here."""
    choices = choices or declarations.ColumnChoices()
    texts = [title.replace(";", ",") for title in titles.split(",")]
    robot = arm_of(joints, is_slide=is_slide)
    return ColumnFinder(titles_alone(texts, first_row), robot, choices).find_all()


def declared(text, titles: str, joints=JOINTS, **others) -> ColumnMap:
    """The map of titles where a line, or a columns file or its text, declares columns."""
    choices = declarations.read_columns(text, joints)
    return recognise(titles, joints, choices, **others)


def where(columns: ColumnMap) -> tuple[list[int], list[int]]:
    """The indices of the columns of position and of torque."""
    index_of = attrgetter("index")
    return list(map(index_of, columns.position)), list(map(index_of, columns.torque))


def factors(columns) -> list[float]:
    return [column.factor for column in columns]


@pytest.mark.parametrize(
    "titles",
    [
        "time,q1,q2,q3,tau1,tau2,tau3",
        "timestamp,q[0],q[1],q[2],tau[0],tau[1],tau[2]",
        "Time,j0_pos,j1_pos,j2_pos,j0_tau,j1_tau,j2_tau",
        "time [s],Position 1 [rad],Position 2 [rad],Position 3 [rad],M1 torque [N*m],"
        "M2 torque [N*m],M3 torque [N*m]",
        "time,jointPosition1,jointPosition2,jointPosition3,jointTorque1,jointTorque2,jointTorque3",
        "timestamp,actual_q_0,actual_q_1,actual_q_2,actual_current_as_torque_0,"
        "actual_current_as_torque_1,actual_current_as_torque_2,target_moment_0,actual_current_0",
        "time,q0,q1,q2,tauEst0,tauEst1,tauEst2",
        "t,Position (A1),Position (A2),Position (A3),Moment (A1) [Nm],Moment (A2) [Nm],"
        "Moment (A3) [Nm]",
        "%time,field.position0,field.position1,field.position2,field.effort0,field.effort1,"
        "field.effort2,field.header.seq",
    ],
)
def test_counting_titles_go_by_their_numbers(titles):
    columns = recognise(titles, ("base", "elbow", "wrist"))
    assert columns.time.index == 0
    assert where(columns) == ([1, 2, 3], [4, 5, 6])


@pytest.mark.parametrize(
    "titles",
    [
        "t,position_elbow_joint,position_shoulder_lift_joint,position_shoulder_pan_joint,"
        "effort_elbow_joint,effort_shoulder_lift_joint,effort_shoulder_pan_joint",
        "t,Elbow.pos,ShoulderLift.pos,ShoulderPan.pos,Elbow.tau,ShoulderLift.tau,ShoulderPan.tau",
        "time,/joint_states/elbow_joint/position,/joint_states/shoulder_lift_joint/position,"
        "/joint_states/shoulder_pan_joint/position,/joint_states/elbow_joint/effort,"
        "/joint_states/shoulder_lift_joint/effort,/joint_states/shoulder_pan_joint/effort",
    ],
)
def test_named_titles_go_to_their_joint_whatever_the_order(titles):
    assert where(recognise(titles, UR)) == ([3, 2, 1], [6, 5, 4])


@pytest.mark.parametrize(
    "title",
    [
        "/joint_states/panda_joint{}/{}",
        "panda_joint{}_{}",
        "{1} of lbr_A{0}",
        "ur5e/j{}_link {}",
    ],
)
def test_names_around_numbers_are_matched_as_a_whole_set(title):
    """Columns of a finger and of another joint are not the arm's."""
    titles = ["time", title.format("8_finger", "position"), "gripper_position"]
    for quantity, number in product(("position", "effort"), (3, 1, 2)):
        titles.append(title.format(number, quantity))
    header = ",".join(titles)
    columns = recognise(header, ("joint1", "joint2", "joint3"))
    assert where(columns) == ([4, 5, 3], [7, 8, 6])
    (note,) = columns.notes
    assert "are joint1, joint2, joint3; not used: " in note
    with refused("one position column .*each joint"):
        recognise(header, ("joint1", "joint2", "joint3", "joint4"))


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
    header = ",".join(["time", *positions, *torques])
    columns = recognise(header, tuple(names))
    title_of = attrgetter("title")
    assert list(map(title_of, columns.position)) == positions
    assert list(map(title_of, columns.torque)) == torques
    assert set(factors(columns.position + columns.torque)) == {1.0}


ROS_NAMES = ["gripper", "elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint"]


@pytest.mark.parametrize("line", ["", "position = q*"])
def test_numbers_are_those_of_the_models_names_where_these_are_not_in_order(line):
    joints = ("arm_joint3", "arm_joint1", "arm_joint2")
    columns = declared(line, "time,q1,q2,q3,tau1,tau2,tau3", joints)
    assert where(columns) == ([3, 1, 2], [6, 4, 5])
    with refused("one position column|fits 3 columns"):
        declared(line, "time,q0,q1,q2,tau0,tau1,tau2", joints)


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
    columns = recognise(",".join(titles), joints, first_row=row)
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
        recognise(",".join(titles), ("pan", "lift", "elbow"), first_row=row)


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
    columns = recognise(",".join(titles), ("joint1", "joint2", "joint3"))
    used = product(("pos", "tau", "vel", "time"), range(3))
    expected = ["time", *(f"j{joint}_{name}" for name, joint in used)]
    assert list(map(attrgetter("title"), columns.columns())) == expected


def test_units_in_titles_become_factors():
    columns = recognise(
        "time_ms,q1 [deg],q2 [deg],q3 [deg],qd1 (deg/s),qd2_deg_s,qd3_dps,tau1_Nm,tau2,tau3_mNm"
    )
    assert columns.time.factor == 1e-3
    assert set(factors(columns.position)) == {math.pi / 180}
    assert set(factors(columns.velocity)) == {math.pi / 180}
    assert factors(columns.torque) == [1.0, 1.0, 1e-3]
    assert columns.angle_declared


def test_declared_degrees_leave_slides_alone():
    choices = declarations.ColumnChoices(angle_unit="deg", time_unit="us")
    columns = recognise(
        "t,q1,q2,q3,tau1,tau2,tau3", JOINTS, choices, is_slide=(False, True, False)
    )
    assert factors(columns.position) == [math.pi / 180, 1.0, math.pi / 180]
    assert columns.time.factor == 1e-6
    with refused(r"q1 \[rad\].*contradicts"):
        recognise("t,q1 [rad],q2,q3,tau1,tau2,tau3", choices=choices)


@pytest.mark.parametrize(
    ("titles", "fault"),
    [
        (
            "time,q1,q2,q3,tau1,tau2,tau3,torque_1",
            "'tau1' and 'torque_1' .* joint joint0",
        ),
        ("time,timestamp,q1,q2,q3,tau1,tau2,tau3", "'time' and 'timestamp'"),
        (
            "t,joint0_pos,joint1_pos,joint2_pos,q1,q2,q3,tau1,tau2,tau3",
            "'joint0_pos' and 'q1'",
        ),
        (
            "t,q1,q2,q3,q4,tau1,tau2,tau3,tau4",
            "position .* each joint of the chain .* found q1, q2, q3, q4",
        ),
        ("t,q1,q2,q3", "torque .* found none"),
        ("t,q1,q2,q3,tau1,tau2,tau3<script>", "torque .* found tau1, tau2"),
        (
            "t,q1,q2,q3,q1_cmd,q2_cmd,q3_cmd",
            "torque .* q1_cmd, ... are commanded .* --torque-from position-error",
        ),
        ("q1,q2,q3,tau1,tau2,tau3", "no time column .* rate"),
        (
            "t,joint1_pos,joint2_pos,joint3_pos,tau1,tau2,tau3",
            "position .* found joint1_pos, joint2_pos, joint3_pos",
        ),
        ("t,q1 [furlong],q2,q3,tau1,tau2,tau3", "furlong.* unknown"),
    ],
)
def test_what_is_missing_or_ambiguous_is_said(titles, fault):
    with refused(fault):
        recognise(titles)


def test_a_line_counts_columns_and_keeps_quantities_out():
    line = "rate = 100, position = #1, #2, #3, torque = #4..#6, velocity = none"
    columns = declared(line, "q1,q2,q3,qd1,qd2,qd3")
    assert where(columns) == ([0, 1, 2], [3, 4, 5])
    assert columns.velocity == () and columns.time is None and columns.rate == 100.0


def test_a_columns_file_names_flips_scales_and_leaves_out(tmp_path):
    """A joint without a motor has a torque of zero."""
    path = tmp_path / "columns.txt"
    path.write_text(
        "# remark\ntime = Zeit  # seconds\nposition = A, B, C\ntorque.joint0 = -X\n"
        "torque.joint1 = none\ntorque.joint2 = 0.5 * Z\nunits = deg,ms\n"
    )
    columns = declared(path, "X,Y,Z,A,B,C,Zeit,tau3")
    assert where(columns)[0] == [3, 4, 5]
    assert factors(columns.torque) == [-1.0, 0.0, 0.5]
    assert "torque from 'X' x -1, none, 'Z' x 0.5" in columns.describe()[0]
    assert columns.position[0].factor == math.pi / 180
    assert columns.time.factor == 1e-3


TORQUES = "tau1,tau2,tau3"


@pytest.mark.parametrize(
    ("line", "titles", "expected"),
    [
        ("position = x[*].p", f"t,x[0].p,x[1].p,x[2].p,{TORQUES}", [1, 2, 3]),
        ("position = x10*", f"t,x1012,x1010,x1011,{TORQUES}", [2, 3, 1]),
        ("position = -2 * x*#", f"t,x9#,x10#,x11#,{TORQUES}", [1, 2, 3]),
        ("position = N*m * ", f"t,N*m 0,N*m 1,N*m 2,{TORQUES}", [1, 2, 3]),
        ("position = a, b (*)", f"t,a; b (3),a; b (2),a; b (1),{TORQUES}", [3, 2, 1]),
        ("position = #2..#4", f"t,x,y,z,{TORQUES}", [1, 2, 3]),
        # A number stands in for a unit that is not known.
        ("position = 0.5 * #2..#4", f"t,q1 [furlong],y,z,{TORQUES}", [1, 2, 3]),
        ("position = 0.5 * #4..#2", f"t,x,y,z,{TORQUES}", [3, 2, 1]),
        ("position = x*, position.joint1 = y", f"t,x0,x1,x2,{TORQUES},y", [1, 7, 3]),
    ],
)
def test_a_pattern_or_a_range_stands_for_the_columns_of_all_joints(
    line, titles, expected
):
    columns = declared(line, titles)
    assert where(columns) == (expected, [4, 5, 6])
    factor = {"-": -2.0, "0": 0.5}.get(line.partition("= ")[2][0], 1.0)
    assert factors(columns.position)[0] == factor


def test_a_pattern_fits_names_as_titles_do_and_leaves_fingers_out():
    names = (
        "ur_elbow_joint",
        "ur_shoulder_lift_joint",
        "ur_shoulder_pan_joint",
        "ur_f",
    )
    titles = ",".join(f"{name}/x" for name in names)
    columns = declared("position = */x", f"t,{titles},{TORQUES}", UR)
    assert where(columns)[0] == [3, 2, 1]
    (note,) = columns.notes
    assert note.endswith("not used: ur_f")


PLAIN = f"t,q1,q2,q3,{TORQUES}"


@pytest.mark.parametrize(
    ("titles", "fault"),
    [
        ("t,x0,x1", "fits 2 columns (x0, x1), and not one for each of the 3 joints"),
        ("t,x0,x2,x4", "fits 3 columns (x0, x2, x4)"),
        ("t,x1,x01,x2", "fits 3 columns"),
        ("t,x1,x1,x2,x3", "fits 4 columns"),
        ("t,xa,xb,xc", "fits 3 columns (xa, xb, xc)"),
        (PLAIN, "'x*' fits no column"),
    ],
)
def test_a_pattern_that_fits_other_columns_is_refused_with_these(titles, fault):
    with refused(re.escape(fault)):
        declared("position = x*", titles)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("position = a, b", "lists 2 columns, the chain has 3"),
        ("position = #2..#5", "lists 4 columns"),
        ("position = #6..#8", "no single column '#8'"),
        ("positon = x*", "unknown key 'positon'; valid keys: time, position"),
        ("torque = ?", r"torque = \? is a blank"),
        ("units = ms, ?", r"units = ms, \? is a blank"),
        ("zero = 1, 2", "zero takes one number"),
        ("torque.elbow = a", "unknown joint 'elbow'"),
        ("time a", "once per key: 'time a'"),
        ("time = a\ntime = b", "once per key: 'time = b'"),
        ("rate = -3", "positive number"),
        ("units = grad", "not understood"),
        ("units = deg,rad", "not understood"),
        ("units = 0/rev", "not understood"),
        ("units = deg, deg", "not understood"),
        ("torque = 1e999 * tau1, tau2, tau3", "no single column"),
        ("torque = B, tau2, tau3", "no single column 'B'"),
    ],
)
def test_what_a_line_cannot_mean_is_refused(line, fault):
    with refused(fault):
        declared(line, PLAIN)


@pytest.mark.parametrize(
    ("units", "factor"),
    [
        ("cdeg", math.pi / 18000),
        ("mrad", 1e-3),
        ("rev", 2 * math.pi),
        ("4096/rev", 2 * math.pi / 4096),
        ("8192.5/rev", 2 * math.pi / 8192.5),
    ],
)
def test_units_of_angles_and_of_slides_are_declared_apart(units, factor):
    titles = f"t,q1,q2 [ticks],q3,{TORQUES},qd1,qd2,qd3"
    line = f"units = mm, {units}, zero = 5, zero.joint1 = -7"
    columns = declared(line, titles, is_slide=(False, False, True))
    assert factors(columns.position) == pytest.approx([factor, factor, 1e-3])
    assert factors(columns.velocity) == pytest.approx([factor, factor, 1e-3])
    assert [column.zero for column in columns.position] == [5.0, -7.0, 5.0]
    assert {column.zero for column in columns.torque + columns.velocity} == {0.0}


def test_measured_torques_outrank_others_which_a_note_names():
    kinds = ("tau_measured{}", "tau_command{}", "tau_model{}", "tau_feedback{}")
    titles = ",".join(kind.format(k) for kind in kinds for k in range(3))
    columns = recognise(f"t,q0,q1,q2,{titles},f_effort")
    assert where(columns)[1] == [4, 5, 6]
    assert columns.notes == (
        "torques that are not used: tau_command* (commanded), tau_model* (computed), "
        "tau_feedback* (measured)",
    )
    for kind in ("command", "model"):
        titles = ",".join(f"tau_{kind}{k}" for k in range(3))
        with refused(rf"not measured are tau_{kind}\*"):
            recognise(f"t,q0,q1,q2,{titles}")
        columns = declared(f"torque = tau_{kind}*", f"t,q0,q1,q2,{titles}")
        assert "not measured, as they were declared" in columns.notes[0]


@pytest.mark.parametrize(
    "titles",
    [
        "qd0,qd1,qd2,vel0,vel1,vel2",
        "qd0 [kn],qd1 [kn],qd2 [kn]",
        "joint0_vel,joint1_vel,joint2_vel,qd0,qd1,qd2",
    ],
)
def test_velocities_that_cannot_be_told_stop_no_log(titles):
    columns = recognise(f"t,q0,q1,q2,{TORQUES},{titles}")
    assert columns.velocity == ()
    assert columns.notes[0].startswith("velocity is not used, and not needed: ")

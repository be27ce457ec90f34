"""Titles stand for the quantity that their words name, and for commands where these are read."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from rigs.log_files import assert_refused, motion, read_measurements, write
from robot_sysid.logs.titles import read_title

JOINTS4 = ("joint1", "joint2", "joint3", "joint4")


COMMANDS = (
    "q_des[{}]",
    "action[{}]",
    "joint{}_command",
    "j{} goal_position",
    "jointTarget[{}]",
)


@pytest.mark.parametrize(
    ("title", "quantity"),
    [
        *((title.format(0), "command") for title in COMMANDS),
        ("state.q_d[0]", "command"), ("cmd_q1 [deg]", "command"), ("current_1", "current"),
        ("qd_des[0]", None), ("tau_ref1", None), ("current_ref1", None), ("q_ff[0]", None),
        ("joint1_position_std", None), ("tau_ext_1", None), ("q[0]", "position"),
        ("ref_joint_position", "position"), ("qd1", "velocity"), ("dq_1", "velocity"),
        ("q_dot_1", "velocity"), ("ddq1", "acceleration"), ("measured_torque_1", "torque"),
        ("current_position_1", "position"),
    ],
)  # fmt: skip
def test_a_title_stands_for_the_quantity_that_its_words_name(title, quantity):
    assert read_title(title, ("ref_joint", "joint1")).joint_quantity == quantity


@pytest.mark.parametrize(
    "title",
    [
        "/joint_states/panda_joint{}/{}",
        "panda_joint{}_{}",
        "{1} of lbr_A{0}",
        "ur5e/j{}_link {}",
    ],
)
def test_names_around_numbers_are_matched_as_a_whole_set(tmp_path, title):
    """Columns of a finger and of another joint are not the arm's."""
    data = motion()
    numbers = (3, 1, 2)
    titles = ["time", title.format("8_finger", "position"), "gripper_position"]
    columns = [data.time, data.q[:, 0], data.q[:, 0]]
    for quantity, values in (("position", data.q), ("effort", data.tau)):
        titles += [title.format(k, quantity) for k in numbers]
        columns += [values[:, k - 1] for k in numbers]
    path = write(tmp_path / "log.csv", np.column_stack(columns), titles)
    log = read_measurements(path, ("joint1", "joint2", "joint3"))
    assert_array_equal(log.q, data.q)
    assert_array_equal(log.tau, data.tau)
    (note,) = [note for note in log.notes if note.startswith("log joints: ")]
    assert "are joint1, joint2, joint3; not used: " in note
    assert_refused("one position column .*each joint", path, JOINTS4)

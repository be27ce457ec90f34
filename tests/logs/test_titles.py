"""Titles stand for the quantity that their words name."""

from __future__ import annotations

import pytest

from robot_sysid.logs.titles import read_title

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

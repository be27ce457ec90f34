"""A right log draws no alarm; each kind of wrong log is found and called by its name."""

from __future__ import annotations

import re

import pytest

from robot_sysid.diagnosis.finding import Level
from robot_sysid.diagnosis.run import check_against_model
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from tests.support import arms
from tests.support.log_files import read_measurements
from tests.support.places import DATA
from tests.support.wrong_logs import KINDS, truth_of

NAMES = {
    "millinewtonmetres": "torque-scale",
    "motor_side": "torque-scale",
    "amperes": "torque-scale",
    "times_two_or_more": "torque-scale",
    "gravity_compensated": "gravity",
    "external": "gravity",
    "computed": "computed",
    "torque_sign": "sign",
    "position_sign": "sign",
    "exchanged": "order",
    "reversed_order": "order",
    "degrees_as_radians": "angle-unit",
    "radians_as_degrees": "angle-unit",
    "dropped_samples": "clock",
    "clock_jump": "clock",
    "saturated": "saturated",
    "held": "held",
    "collision": "contact",
    "late_torque": "delay",
    "position_offset": "zero",
}


def test_a_right_log_draws_no_alarm(truth):
    assert check_against_model(truth.robot, [truth.log]) == ()


def test_a_log_that_is_too_short_for_anything_is_called_that(truth):
    log = truth.log
    brief = log.time - log.time[0] < 0.6
    part = Measurement(log.time[brief], log.q[brief], None, log.tau[brief])
    first = check_against_model(truth.robot, [part])[0]
    assert first.level is Level.REFUSE
    assert re.match(r"the log is 0\.(59|6)\d* s long, too short; record", first.text)


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMES)
def test_a_wrong_log_is_called_by_its_name(truth, kind):
    spoilt = KINDS[kind](truth_of(truth.robot, 4))
    found = check_against_model(truth.robot, [spoilt])
    assert NAMES[kind] in [each.name for each in found], found


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_right_logs_of_other_arms_draw_none_either(seed):
    axes = (arms.Z, arms.Y, arms.Y, arms.X, arms.Y, arms.Z)
    robot = arms.robot_of(arms.serial_arm(axes, joint='range="-2 2"'))
    found = check_against_model(robot, [truth_of(robot, 100 + seed).log])
    assert [each for each in found if each.level is not Level.NOTE] == []


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the logs of real arms are not here")
@pytest.mark.parametrize(
    ("model", "log"),
    [
        *(("kuka_lwr4/kuka_lwr4.urdf", f"kuka_lwr4/lwr4_hw{run}_200Hz.csv") for run in (1, 2, 3)),
        ("tx40/tx40.urdf", "tx40/tx40_500Hz.csv"),
    ],
)
def test_logs_of_real_arms_draw_no_alarm(model, log):
    robot = load_robot_model(DATA / model)
    assert check_against_model(robot, read_measurements(DATA / log, robot.joint_names).pieces) == ()

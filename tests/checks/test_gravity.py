"""Which joints are asked about gravity, and which torque is a computed one."""

from __future__ import annotations

from robot_sysid.checks.evidence import evidence_of
from robot_sysid.checks.gravity import loaded
from robot_sysid.checks.model_fit import ModelFit
from tests.support import arms
from tests.support.wrong_logs import truth_of


def test_the_newtons_of_a_lift_say_nothing_of_the_arm_on_it():
    carriage = '<inertial pos="0 0 0" mass="1000" diaginertia="9 9 9"/>'
    lift = '<joint name="lift" type="slide" axis="0 0 1" range="0 .3"/>'
    bodies = arms.serial_bodies((arms.Z, arms.Y, arms.Y), joint='range="-2 2"')
    robot = arms.robot_of(arms.world(arms.link(lift, bodies, quat="1 0 0 0", inertial=carriage)))
    fit = ModelFit(evidence_of(robot, [truth_of(robot, 7).log]))
    assert loaded(fit)[0] and loaded(fit)[2]

"""Servos in rollouts: they are the model's own actuators where it has them, and springs else."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from robot_sysid.simulation import servos
from tests.support.arms import robot_of
from tests.support.servo_logs import SERVOS, TRUTH, XML, commanded

EDGES = np.linspace(0.0, 1.0, 501)


def window(seed=0):
    time, command = commanded(4.0, seed)
    return servos.Window(1.0, command[50], np.zeros(2), time, command)


def played(robot, choice, start=None):
    """Positions of one choice of servos in one window."""
    return next(
        servos.ServoRollouts(robot).played([choice], [start or window()], EDGES)
    )[0]


def test_the_models_own_servos_move_it_as_mujoco_does():
    robot = robot_of(XML)
    start = window()
    found = played(robot, servos.model_servos(robot), start)
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.timestep = 0.002
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    data.qpos[:] = start.q
    for control in start.controls(0.0, EDGES):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(found[-1], data.qpos, atol=1e-7)


@pytest.mark.parametrize("factor", [0.3, 1.0, 4.0])
def test_servo_and_joint_share_any_damping_as_the_model_does(factor):
    robot = robot_of(XML)
    own = servos.actuators_of(robot)
    found = servos.model_servos(robot)
    changed = replace(found, damping=factor * found.damping)
    model = servos.servo_copy(robot, 0.002)
    servos.set_servos(model, robot, TRUTH)
    servos.set_servos(model, robot, changed)
    np.testing.assert_allclose(
        model.dof_damping, factor * robot.mj_model.dof_damping, rtol=1e-12
    )
    np.testing.assert_allclose(
        -model.actuator_biasprm[:, 2], factor * own.damping, rtol=1e-12
    )


def test_a_joint_without_actuator_is_pulled_by_a_spring_of_the_same_gain():
    whole = robot_of(XML.replace(' forcerange="-60 60"', ""))
    bare = robot_of(XML.replace(SERVOS, ""))
    assert servos.actuators_of(bare).index.tolist() == [servos.NONE, servos.NONE]
    both = [servos.model_servos(whole), TRUTH]
    rollouts = [
        servos.ServoRollouts(robot).played(both, [window()], EDGES)
        for robot in (whole, bare)
    ]
    found = [[*each][1] for each in rollouts]
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_choices_played_together_do_not_disturb_each_other():
    robot = robot_of(XML)
    late = replace(TRUTH, delay=0.05)
    choices = [TRUTH, late, replace(late, armature=2.0 * late.armature), TRUTH]
    together = [
        each[0]
        for each in servos.ServoRollouts(robot).played(choices, [window()], EDGES)
    ]
    np.testing.assert_array_equal(together, [played(robot, each) for each in choices])


def test_a_servo_pulls_no_harder_than_its_limit():
    robot = robot_of(XML.replace("-60 60", "-1 1"))
    assert servos.actuators_of(robot).limit.tolist() == [1.0, np.inf]
    strong, weak = (played(r, TRUTH) for r in (robot_of(XML), robot))
    assert np.ptp(weak[:, 0]) < 0.7 * np.ptp(strong[:, 0])


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.05])
def test_commands_act_late_and_hold_until_the_next(delay):
    start = window()
    control = start.controls(delay, EDGES)
    middle = start.start + 0.5 * (EDGES[1:] + EDGES[:-1]) - delay
    held = start.command[np.searchsorted(start.time, middle, side="right") - 1]
    # Steps in which a command changes hold a mean of both.
    same = np.isclose(control, held).all(axis=1)
    assert same.mean() > 0.85
    mean = start.controls(delay, np.array([0.0, 1.0]))[0]
    np.testing.assert_allclose(control.mean(axis=0), mean, atol=1e-12)


@pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "actuator_delay"),
    reason="actuators of this MuJoCo cannot act late",
)
def test_a_delay_of_the_models_own_does_not_act_a_second_time():
    delayed = XML.replace(' kp="100"', ' kp="100" delay="0.04" nsample="50"')
    robots = [robot_of(each) for each in (XML, delayed)]
    found = [
        played(robot, replace(servos.model_servos(robot), delay=0.04))
        for robot in robots
    ]
    np.testing.assert_array_equal(*found)

"""Actuators that act whatever their control is count as the arm's, as MuJoCo moves it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.files.releases import since
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.plant import ArmStepper

ARM = """<mujoco>{option}<worldbody>
<body><joint name="a" axis="0 1 0" stiffness="2"/><geom size=".1" pos=".2 0 0"/>
<body pos=".4 0 0"><joint name="b" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body>
</body></worldbody>
<tendon><fixed name="t"><joint joint="a" coef="2"/><joint joint="b" coef="-.5"/></fixed></tendon>
<actuator>{actuators}</actuator></mujoco>"""
GENERAL = '<general {} gainprm="0" biastype="affine" biasprm="{}"/>'
PASSIVE = (
    GENERAL.format('joint="a" gear="3"', "4 0 0"),
    GENERAL.format('joint="b" gear="-2"', "1 -5 -2"),
    GENERAL.format('joint="b" forcelimited="true" forcerange="-1 1"', "3 -5 0"),
    GENERAL.format('tendon="t"', "2 -1 -3"),
)
DRIVEN = (
    '<motor joint="a" gear="3"/>',
    '<position joint="a" kp="20"/>',
    '<velocity joint="b" kv="20"/>',
    '<damper joint="b" kv="2" ctrlrange="0 1"/>',
    '<general joint="a" gainprm="2" biastype="affine" biasprm="3 0 0"/>',
)
"""Whose force at its control is what a log has; a damper at no control has none."""


def load(folder, actuators, option=""):
    path = folder / "arm.xml"
    path.write_text(ARM.format(actuators=actuators, option=option))
    return load_robot_model(path, joint="b")


def acceleration(model, q, qd, torque):
    """Accelerations that MuJoCo's forward dynamics makes of a torque, all controls being 0."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    data.qvel[:] = qd
    data.qfrc_applied[:] = torque
    mujoco.mj_forward(model, data)
    return data.qacc


@pytest.mark.parametrize("actuators", [*PASSIVE, "".join(PASSIVE)])
def test_what_moves_an_arm_is_the_torque_of_motors_alone(tmp_path, actuators):
    robot = load(tmp_path, actuators)
    for q, qd, qdd in np.random.default_rng(0).normal(size=(5, 3, 2)):
        torque = ArmDynamics(robot).torque(q[None], qd[None], qdd[None])[0]
        assert_allclose(acceleration(robot.mj_model, q, qd, torque), qdd, atol=1e-9)


@since(4)
def test_cogging_is_torque_of_the_arm_and_a_current_is_not(tmp_path):
    motor = '<dcmotor joint="a" motorconst="2 2" resistance="1" cogging=".7 4 .3"/>'
    robot = load(tmp_path, motor)
    model = robot.mj_model
    model.actuator_gainprm[0, 1] = 0.0  # Without a constant, it only cogs.
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 2))
    torque = ArmDynamics(robot).torque(q[None], qd[None], qdd[None])[0]
    assert_allclose(acceleration(model, q, qd, torque), qdd, atol=1e-9)
    without = ArmDynamics(load(tmp_path, "")).torque(q[None], qd[None], qdd[None])[0]
    assert_allclose(without[0] - torque[0], 0.7 * np.sin(4.0 * q[0] + 0.3))


@pytest.mark.parametrize("actuator", DRIVEN)
def test_motors_and_servos_add_nothing(tmp_path, actuator):
    bare = load(tmp_path, "")
    motion = np.random.default_rng(0).normal(size=(3, 5, 2))
    expected = ArmDynamics(bare).torque(*motion)
    robot = load(tmp_path, actuator)
    assert_allclose(ArmDynamics(robot).torque(*motion), expected, rtol=1e-12)
    assert not any("whatever their control" in note for note in robot.notes)


def test_nothing_acts_where_the_file_switches_actuators_off(tmp_path):
    motion = np.random.default_rng(0).normal(size=(3, 5, 2))
    expected = ArmDynamics(load(tmp_path, "")).torque(*motion)
    off = '<option><flag actuation="disable"/></option>'
    robot = load(tmp_path, PASSIVE[0], off)
    assert_allclose(ArmDynamics(robot).torque(*motion), expected, rtol=1e-12)


def test_a_simulated_arm_rests_where_its_actuators_hold_it(tmp_path):
    """Torque that holds it by the inverse dynamics holds it in a simulation, too."""
    robot = load(tmp_path, "".join(PASSIVE[:2]))
    q = np.array([0.3, -0.4])
    still = np.zeros((1, 2))
    torque = ArmDynamics(robot).torque(q[None], still, still)[0]
    arm = ArmStepper(robot, q)
    for _ in range(200):
        arm.step(torque, np.zeros(2))
    assert_allclose(arm.q, q, atol=1e-9)


def test_a_model_says_that_they_count_as_the_arms_and_limits_are_the_motors(tmp_path):
    motor = '<motor joint="a" ctrllimited="true" ctrlrange="-1 1" gear="5"/>'
    pusher = GENERAL.format('name="pusher" joint="a"', "40 -9 0")
    robot = load(tmp_path, motor + pusher)
    (note,) = (each for each in robot.notes if "whatever their control" in each)
    assert "pusher" in note
    assert robot.limits.torque[0] == pytest.approx(5.0)

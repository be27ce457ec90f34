"""Dry friction that is stated as a spring that yields or as a motor's is MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.files.releases import since
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import ModelError
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import load_robot_model

pytestmark = since(4)

ARM = """<mujoco><compiler angle="radian"/><option timestep="1e-4" gravity="0 0 0"/><worldbody>
<body><joint name="a" axis="0 1 0" {a}/><geom size=".1" pos=".2 0 0"/>
<body name="tip" pos=".4 0 0"><joint name="b" axis="0 1 0" {b}/><site name="s"/>
<geom size=".1" pos=".2 0 0"/></body></body></worldbody>
<tendon><fixed name="t" {t}><joint joint="a" coef="2"/><joint joint="b" coef="-.5"/></fixed>
</tendon>
<actuator>{actuators}</actuator></mujoco>"""
MOTOR = '<dcmotor name="drive" {} motorconst="1e-3 1e-3" resistance="1" lugre="2e3 5 {} {} .05"/>'
FRICTION = {
    "spring": ({"a": 'stiffness="500" springyield="2e-3"'}, [1.0, 0.0]),
    "stiffening spring": (
        {"b": 'stiffness="500 0 5e7" springyield="2e-3"'},
        [0.0, 1.4],
    ),
    "beside its own": (
        {"a": 'stiffness="500" springyield="2e-3" frictionloss=".4"'},
        [1.4, 0.0],
    ),
    "motor": ({"actuators": MOTOR.format('joint="a" gear="3"', 2, 3)}, [6.0, 0.0]),
    "backwards": ({"actuators": MOTOR.format('joint="b" gear="-3"', 2, 2)}, [0.0, 6.0]),
}


def write(folder, a="", b="", t="", actuators=""):
    path = folder / "arm.xml"
    path.write_text(ARM.format(a=a, b=b, t=t, actuators=actuators))
    return path


def load(path):
    return load_robot_model(path, joint="b")


def sliding_torque(path, speed):
    """What holds the joints of a file back at a speed, in MuJoCo's own simulation of it."""
    model = mujoco.MjModel.from_xml_path(str(path))
    frictionloss = model.dof_frictionloss.copy()
    model.dof_frictionloss[:] = 0.0
    model.dof_armature[:] = 1e9  # So that nothing slows it down.
    data = mujoco.MjData(model)
    data.qvel[:] = speed
    for _ in range(400):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return -(data.qfrc_passive + data.qfrc_actuator) * np.sign(speed) + frictionloss


@pytest.mark.parametrize("name", FRICTION)
@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_dry_friction_is_what_mujoco_makes_of_it(tmp_path, name, speed):
    numbers, expected = FRICTION[name]
    path = write(tmp_path, **numbers)
    robot = load(path)
    assert_allclose(robot.friction.coulomb, expected, rtol=1e-9)
    assert_allclose(sliding_torque(path, speed), expected, rtol=1e-2, atol=1e-3)
    motion = np.random.default_rng(0).normal(size=(3, 5, 2))
    bare = load(write(tmp_path))
    torque = ArmDynamics(robot).torque(*motion)
    assert_allclose(torque, ArmDynamics(bare).torque(*motion), rtol=1e-9)


def test_friction_of_a_motor_over_a_tendon_is_the_tendons(tmp_path):
    path = write(tmp_path, actuators=MOTOR.format('tendon="t" gear="2"', 1.5, 2))
    robot = load(path)
    assert_allclose(robot.friction.shared, [[6.0, -1.5]])
    path = write(tmp_path, t='stiffness="500" springyield="2e-3"')
    assert_allclose(load(path).friction.shared, [[2.0, -0.5]])


def test_a_model_says_whose_friction_it_takes(tmp_path):
    spring = 'stiffness="500" springyield="2e-3"'
    motor = MOTOR.format('joint="a"', 2, 3)
    notes = load(write(tmp_path, b=spring, actuators=motor)).notes
    assert any("the springs of b yield" in note for note in notes)
    assert any("LuGre friction of actuators drive" in note for note in notes)


def test_an_elastic_spring_stays_one(tmp_path):
    robot = load(write(tmp_path, a='stiffness="500"'))
    assert_allclose(robot.friction.coulomb, 0.0)
    assert robot.mj_model.jnt_stiffness[0] == 500.0
    assert not any("spring" in note for note in robot.notes)


def test_what_is_neither_spring_nor_friction_is_refused(tmp_path):
    late = 'stiffness="5" springyield=".5" limited="true" range="-1 1"'
    with pytest.raises(ModelError, match="spring of joint a yields at 0.5"):
        load(write(tmp_path, a=late))
    motor = MOTOR.format('site="s"', 2, 3)
    with pytest.raises(ModelError, match="LuGre friction of actuator drive cannot"):
        load(write(tmp_path, actuators=motor))


def test_a_model_without_such_friction_stays_itself(tmp_path):
    path = write(tmp_path, a='frictionloss="1"', actuators='<motor joint="a"/>')
    model = mujoco.MjModel.from_xml_path(str(path))
    assert compile_model(model).mj_model is model

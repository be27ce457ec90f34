"""Tests of what a compiled model's actuators give, against MuJoCo's own forward dynamics."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files.releases import MUJOCO, since
from robot_sysid.model import actuators as module

JOINTS = ("a", "b", "c")
ARM = """<mujoco><option gravity="0 0 0"/><worldbody>
<body><joint name="a" axis="0 1 0"/><geom size=".1"/>
<body pos="0 0 .3"><joint name="b" axis="1 0 0" armature=".2" {b}/><geom size=".1"/>
<body name="tip" pos="0 0 .3"><joint name="c" type="slide" axis="1 0 0"/><geom size=".1"/></body>
</body></body></worldbody><tendon><fixed name="t" {t}><joint joint="a" coef="2"/>
<joint joint="b" coef="-.5"/></fixed></tendon>
<actuator>{actuators}</actuator></mujoco>"""
UNBOUNDED = 1e9
"""Command in place of an infinite one."""


def arm(actuators, b="", t=""):
    return mujoco.MjModel.from_xml_string(ARM.format(actuators=actuators, b=b, t=t))


def arm_or_skip(actuators, t=""):
    """An arm with actuators that older releases do not know."""
    try:
        return arm(actuators, t=t)
    except ValueError:
        pytest.skip("this release has no such actuator")


def limits_of(model):
    return module.torque_limits(model, tuple(range(model.njnt)))


def forward_limits(model):
    """Return the torque (n,) either way, or else one way, by MuJoCo with controls at their ends.

    It is infinite where a command without end moves it without end, and where nothing pulls.
    """
    data = mujoco.MjData(model)
    ends = np.where(
        model.actuator_ctrllimited[:, None],
        model.actuator_ctrlrange,
        [-UNBOUNDED, UNBOUNDED],
    )
    torques = []
    for controls in itertools.product(*ends):
        data.ctrl[:] = controls
        settle_activations(model, data)
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_actuator[: model.njnt].copy())
    lower = np.min(torques, axis=0)
    upper = np.max(torques, axis=0)
    both_ways = np.minimum(-lower, upper)
    limit = np.where(both_ways > 0, both_ways, np.maximum(-lower, upper))
    return np.where((limit == 0.0) | (limit > 1e-4 * UNBOUNDED), np.inf, limit)


def settle_activations(model, data):
    """Set the state of filters to their control, that of other actuators to its end."""
    for actuator in np.flatnonzero(model.actuator_actadr >= 0):
        controls = data.ctrl[module.control_rows(model, actuator)]
        control = controls[0] if len(controls) else 0.0
        value = control
        if model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR:
            value = UNBOUNDED * np.sign(control)
        if model.actuator_actlimited[actuator]:
            value = np.clip(value, *model.actuator_actrange[actuator])
        data.act[model.actuator_actadr[actuator]] = value


def numbers(least, largest):
    return st.floats(least, largest).map(lambda value: round(value, 3))


@st.composite
def ranges(draw, name):
    lower = draw(numbers(-50, 20))
    upper = lower + draw(numbers(0.1, 50))
    return f'{name}="{lower} {upper}"'


@st.composite
def commanded_actuators(draw):
    """An actuator whose force follows its controls, on a random joint or tendon."""
    target = draw(
        st.sampled_from(['joint="a"', 'joint="b"', 'jointinparent="c"', 'tendon="t"'])
    )
    gear = draw(numbers(0.1, 5)) * draw(st.sampled_from([-1, 1]))
    common = f'{target} gear="{gear}"'
    control = draw(ranges("ctrlrange"))
    force = draw(st.one_of(st.just(""), ranges("forcerange")))
    gain = draw(numbers(0.1, 20))
    kinds = [
        f"<motor {common} {control} {force}/>",
        f"<motor {common} {force}/>",
        f'<general {common} {control} {force} gainprm="{gain}"/>',
        f'<general {common} {control} {force} gainprm="{gain}" biastype="affine" biasprm="3"/>',
        f'<general {common} {control} gaintype="affine" gainprm="{gain} 4 2"/>',
        f'<cylinder {common} {control} {force} area="{gain}" bias="-2 0 0"/>',
        f'<general {common} {control} dyntype="filter" dynprm=".1" actrange="-8 3"/>',
        f'<general {common} dyntype="integrator" actrange="-8 3" gainprm="{gain}"/>',
        f'<damper {common} ctrlrange="0 {gain}" kv="2"/>',
        f'<velocity {common} kv="{gain}" forcerange="-7 9"/>',
        f'<position {common} kp="{gain}" forcerange="-9 7"/>',
        f'<intvelocity {common} kp="{gain}" forcerange="-9 7" actrange="-1e9 1e9"/>',
        '<adhesion body="tip" gain="3" ctrlrange="0 1"/>',
    ]
    if MUJOCO >= (3, 12):
        motor = f'<dcmotor {common} resistance="{gain}" motorconst=".3"'
        kinds += [
            f"{motor} {control}/>",
            f'{motor} {control} saturation="2 0 0"/>',
            f'{motor} input="pos vel ff" controller="{gain} 0 1 0 0 24"/>',
            f'{motor} input="pos voltage" controller="{gain} 0 1 0 0 24"/>',
            f'{motor} input="none" lugre="100 1 2 3 .1"/>',
        ]
    if MUJOCO >= (4, 0):
        kinds += [
            f'<pid {common} kp="100" kv="2" input="pos ff" forcerange="-9 7"/>',
            f'<pid {common} kp="100" kv="2" input="pos vel ff" forcerange="-7 9"/>',
        ]
    return draw(st.sampled_from(kinds))


@given(
    st.lists(commanded_actuators(), min_size=1, max_size=3),
    st.sampled_from(["", 'actuatorfrcrange="-6 11"']),
)
def test_a_joints_torque_limit_is_what_forward_dynamics_keeps(actuators, of_joint):
    model = arm("".join(actuators), of_joint)
    assert_allclose(limits_of(model), expected_limits(model), rtol=1e-9)


def expected_limits(model):
    """Return MuJoCo's limits (n,), but the joint's own where nothing drives it."""
    limits = forward_limits(model)
    is_idle = np.isinf(limits) & model.jnt_actfrclimited.astype(bool)
    return np.where(is_idle, np.min(np.abs(model.jnt_actfrcrange), axis=1), limits)


@since(4, 0)
def test_commands_are_counted_apart_from_actuators():
    motors = [
        f'<motor joint="{name}" ctrlrange="-{k} {k}"/>'
        for k, name in enumerate(JOINTS, 2)
    ]
    several = '<pid joint="a" input="pos vel ff" forcerange="-2 2"/>'
    none = '<dcmotor joint="a" input="none" resistance="1" motorconst="0" lugre="9 1 2 3 .1"/>'
    for actuators in (motors, [several, *motors[1:]], [none, *motors], [*motors, none]):
        assert_array_equal(limits_of(arm("".join(actuators))), [2, 3, 4])


def test_a_setpoints_range_bounds_no_torque():
    servos = (
        '<position joint="a" kp="100" ctrlrange="-3 3"/>'
        '<velocity joint="b" kv="10" ctrlrange="-1 1"/>'
        '<intvelocity joint="c" kp="10" actrange="-1 1"/>'
    )
    assert_array_equal(limits_of(arm(servos)), np.inf)


@since(3, 1)
def test_actuators_that_are_switched_off_give_nothing():
    model = arm(
        '<motor joint="a" ctrlrange="-3 3"/><motor joint="a" group="2" ctrlrange="-4 4"/>'
    )
    assert limits_of(model)[0] == 7.0
    model.opt.disableactuator = 1 << 2
    assert limits_of(model)[0] == forward_limits(model)[0] == 3.0


@since(3, 12)
def test_a_dc_motors_limit_is_what_it_comes_to_with_inductance():
    model = arm(
        '<dcmotor joint="a" gear="3" nominal="24 6 100" ctrlrange="-20 24" inductance="0 .01"/>'
    )
    model.dof_armature[:] = 1e9  # it stays at rest
    data = mujoco.MjData(model)
    data.ctrl[:] = -20.0
    for _ in range(200):  # of 2 ms, 40 time constants
        mujoco.mj_step(model, data)
    assert_allclose(limits_of(model)[0], -data.qfrc_actuator[0], rtol=1e-6)


def test_a_tendons_own_limit_counts():
    limited = ' actuatorfrcrange="-1 2" actuatorfrclimited="true"'
    model = arm_or_skip('<motor tendon="t" ctrlrange="-3 3"/>', limited)
    assert_allclose(limits_of(model), [2.0, 0.5, np.inf])
    assert_allclose(limits_of(model), forward_limits(model))


SERVOS = [
    ('<position joint="a" kp="100" kv="3"/>', (100.0, 3.0)),
    (
        '<general joint="a" gainprm="50" biastype="affine" biasprm="0 -50 -2"/>',
        (50.0, 2.0),
    ),
    ('<general joint="a" gainprm="50" biastype="affine" biasprm="0 -40 -2"/>', None),
    ('<general joint="a" gainprm="50" biastype="affine" biasprm="1 -50 -2"/>', None),
    ('<position joint="a" kp="100" timeconst=".1"/>', None),
    ('<velocity joint="a" kv="100"/>', None),
    ('<motor joint="a"/>', None),
    ('<pid joint="a" kp="100" kv="3"/>', (100.0, 3.0)),
    ('<pid joint="a" kp="100" kv="3" input="pos"/>', (100.0, 3.0)),
    ('<pid joint="a" kp="100" kv="3" input="vel"/>', None),
    ('<pid joint="a" kp="100" kv="3" ki="1"/>', None),
]


@pytest.mark.parametrize(("actuator", "gains"), SERVOS)
def test_gains_of_position_servos(actuator, gains):
    assert module.servo_gains(arm_or_skip(actuator), 0) == gains


ROTORS = (
    '<motor joint="a" gear="3" armature=".1" damping=".2 .1 .05"/>',
    '<motor joint="b" gear="-2" armature=".01" damping=".3"/><motor joint="b" armature=".2"/>',
    '<motor tendon="t" gear="3" armature=".1" damping=".2 .3 .1"/><motor joint="a" damping=".1"/>',
)


@pytest.mark.parametrize("actuators", ROTORS)
def test_rotors_and_damping_of_actuators_act_the_same_in_joints(actuators):
    model = arm_or_skip(actuators)
    original = model.dof_armature.copy()
    folded = module.with_actuators_in_joints(model)
    rng = np.random.default_rng(1)
    for _ in range(5):
        motion = rng.normal(size=(3, model.nv))
        expected = inverse_torque(model, *motion)
        assert_allclose(inverse_torque(folded, *motion), expected, rtol=1e-12)
    assert_array_equal(model.dof_armature, original)
    folded.actuator_armature[:] = 0.0
    assert_allclose(inverse_torque(folded, *motion), expected, rtol=1e-12)


def test_a_model_without_rotors_of_actuators_stays_itself():
    model = arm('<motor joint="a"/>')
    assert module.with_actuators_in_joints(model) is model


def inverse_torque(model, q, qd, qdd):
    data = mujoco.MjData(model)
    data.qpos[:] = q
    data.qvel[:] = qd
    data.qacc[:] = qdd
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse.copy()

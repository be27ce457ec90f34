"""Laws of forward dynamics, of a plant and of an arm that motors drive; when dry friction shows."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import SimulationError
from robot_sysid.records import Motion
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulator import simulate_inverse
from tests.support import arms
from tests.support.arms import SEEDS, random_chain, random_motion, robot_of
from tests.support.closed_loop import ForwardPlant, FrictionRamp, RampUse
from tests.support.closed_loop_proof import ramp_torque

PERIOD = 1e-3


def forward(robot, period=PERIOD):
    """The plant, judged at its reference configuration."""
    return ForwardPlant(robot, period, robot.reference[None])


@pytest.mark.parametrize(
    "name", ["seven", "slide in chain", "coupled fingers", "dry friction"]
)
def test_torques_are_rigid_body_dynamics_plus_damping_plus_dry_friction(name):
    robot = robot_of(arms.MODELS[name])
    motion = random_motion(np.random.default_rng(1), robot.n_joints, 5)
    plant = forward(robot)
    expected = ArmDynamics(robot).torque(*motion) + robot.friction.viscous * motion[1]
    expected += ramp_torque(plant.ramp, motion[1], motion[2])
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(
        plant.inverse(*motion), expected, rtol=0.0, atol=1e-9 * scale
    )


@given(random_chain(), SEEDS)
def test_the_acceleration_under_the_torque_of_a_motion_is_that_of_the_motion(xml, seed):
    friction = 'frictionloss="0.3" damping="0.1" armature="0.05"'
    robot = robot_of(xml.replace("<joint ", f"<joint {friction} "))
    q, qd, qdd = random_motion(np.random.default_rng(seed), robot.n_joints, 1)
    plant = forward(robot)
    tau = plant.inverse(q, qd, qdd)
    plant.reset(q[0], qd[0])
    result = plant.acceleration(tau[0])
    # MuJoCo's solver stops at 1e-12 of its own cost; the mass matrix of a random chain adds 1e4.
    scale = max(1.0, np.max(np.abs(qdd)))
    np.testing.assert_allclose(result, qdd[0], rtol=0.0, atol=1e-6 * scale)
    dry = ramp_torque(plant.ramp, qd, qdd)[0]
    np.testing.assert_allclose(plant.dry_friction(), dry, rtol=0.0, atol=1e-6 * scale)


def test_actuators_and_contacts_of_the_model_do_not_act():
    plain = arms.serial_arm((arms.Z, arms.Y, arms.X))
    ball = '<geom type="sphere" size=".3" mass="0"/><joint name="joint'
    servo = '<actuator><position joint="joint2" kp="500" ctrlrange="-1 1"/></actuator></mujoco>'
    busy = plain.replace('<joint name="joint', ball).replace("</mujoco>", servo)
    result = []
    for xml in (plain, busy):
        plant = forward(robot_of(xml))
        plant.reset(np.full(3, 0.3), np.ones(3))
        result.append(plant.acceleration(np.zeros(3)))
    assert robot_of(busy).mj_model.nu == 1
    np.testing.assert_array_equal(result[0], result[1])


@pytest.mark.parametrize(
    "name", ["coupled fingers", "free object beside", "home keyframe"]
)
def test_what_is_not_in_the_chain_stays_where_it_is(name):
    robot = robot_of(arms.MODELS[name])
    plant = forward(robot)
    plant.reset(robot.reference, np.full(robot.n_joints, 2.0))
    for _ in range(50):
        plant.step(np.zeros(robot.n_joints))
    others = np.setdiff1d(np.arange(robot.mj_model.nq), robot.qpos_index)
    np.testing.assert_array_equal(plant.data.qpos[others], robot.reference_qpos[others])
    assert np.max(np.abs(plant.state()[0] - robot.reference)) > 0.01


@given(st.floats(1e-3, 100.0))
def test_steps_are_short_enough_for_the_plants_damping(damping):
    xml = arms.serial_arm(
        (arms.Z,), joint=f'damping="{damping}"', option='gravity="0 0 0"'
    )
    robot = robot_of(xml)
    plant = forward(robot)
    plant.reset(np.zeros(1), np.ones(1))
    inertia = plant.times_mass(np.ones(1))[0]
    plant.step(np.zeros(1))
    # Free decay: exp(-B t / M) in closed form. Runge-Kutta at h B / M <= 1 errs by up to 1/120.
    expected = np.exp(-damping * PERIOD / inertia)
    assert plant.state()[1][0] == pytest.approx(expected, rel=0.0, abs=1.0 / 120.0)


def test_a_loaded_spring_is_not_taken_for_damping():
    joint = 'damping="0.5" stiffness="{}" springref="-90"'
    loaded, plain = (
        forward(
            robot_of(arms.serial_arm((arms.Z, arms.Y), joint=joint.format(stiffness)))
        )
        for stiffness in (1000.0, 0.0)
    )
    assert loaded.substeps == plain.substeps


def ramp(coulomb=(0.4, 0.0, 1.0), inertia=(0.9, 0.0, 5e-3), rate=(105.0, 0.0, 105.0)):
    """A joint with armature, one without dry friction, a light one."""
    return FrictionRamp(np.array(coulomb), np.array(inertia), np.array(rate))


def use_of(qd, qdd, which=None):
    """RampUse of one motion by the formula."""
    ramps = which or ramp()
    use = RampUse(ramps)
    use.add(qd, ramp_torque(ramps, qd, qdd))
    return use


@given(SEEDS, st.floats(0.01, 5.0))
def test_above_the_ramp_speed_coulombs_law_is_exact(seed, scale):
    rng = np.random.default_rng(seed)
    qd, qdd = scale * rng.normal(size=(2, 200, 3))
    ramps = ramp()
    use = use_of(qd, qdd)
    faster = np.abs(qd) > use.ramp_speed
    law = ramps.coulomb * np.sign(qd)
    result = ramp_torque(ramps, qd, qdd)
    np.testing.assert_allclose(result[faster], law[faster], rtol=1e-5, atol=0.0)


HINGE = (
    '<mujoco><compiler angle="radian"/><option gravity="0 0 {g}"/><worldbody><body>'
    '<inertial pos="{x} 0 0" mass="2" diaginertia=".01 .01 .01"/>'
    '<joint axis="0 1 0" frictionloss="{fc}" damping="{fv}"/>'
    "</body></worldbody></mujoco>"
)


def one_hinge(g=0.0, x=0.0, fc=0.0, fv=0.0, timestep=1e-3):
    robot = arms.robot_of(HINGE.format(g=g, x=x, fc=fc, fv=fv))
    return ArmStepper(robot, timestep=timestep)


def run(arm, torque, seconds, damping=0.0):
    n = arm.n_joints
    for _ in range(round(seconds / arm.timestep)):
        acted = arm.step(np.full(n, float(torque)), np.full(n, float(damping)))
    return acted


def inverse_error(robot, timestep, seconds=0.2):
    """Largest difference between what acted and the inverse dynamics of the mean motion [N m]."""
    arm = ArmStepper(robot, timestep=timestep)
    rows = []
    phase = np.arange(arm.n_joints) / arm.n_joints
    for k in range(round(seconds / timestep)):
        torque = 3.0 * np.sin(2 * np.pi * (3 * (k + 0.5) * timestep + phase))
        q = arm.q
        qd = arm.qd
        acted = arm.step(torque, np.full(arm.n_joints, 2.0))
        mean_motion = (q + arm.q) / 2, (arm.q - q) / timestep, (arm.qd - qd) / timestep
        rows.append((*mean_motion, acted, np.sign(qd)))
    q, qd, qdd, acted, direction = (np.array(x) for x in zip(*rows))
    (inverse,) = simulate_inverse(
        robot, [Motion(timestep * np.arange(len(q)), q, qd, qdd)]
    )
    # Where a joint turns round, friction and acceleration jump within a step; where one sticks,
    # Coulomb's law does not tell the friction.
    previous_direction = direction[:-2]
    now = direction[1:-1]
    next_direction = direction[2:]
    steady = np.all((previous_direction == now) & (now == next_direction), axis=1)
    error = np.abs(inverse.tau - acted)[1:-1]
    return np.max(error, where=steady[:, None] & (now != 0.0), initial=0.0)


@pytest.mark.parametrize("name", ["seven", "slide in chain", "coupled fingers"])
def test_its_torques_are_those_of_inverse_dynamics_to_second_order(name):
    robot = arms.robot_of(arms.MODELS[name])
    coarse = inverse_error(robot, 1e-3)
    fine = inverse_error(robot, 2.5e-4)
    assert coarse < 0.01
    # A quarter of the step, so about a sixteenth of the error; a quarter would be a lower order.
    assert fine < 0.13 * coarse


def damped_response_error(timestep, damping, seconds=0.02):
    """Largest error of a damped hinge's velocity after a torque sets in, as part of the last."""
    arm = one_hinge(fv=0.1, timestep=timestep)
    inertia = 0.01
    resistance = damping + 0.1
    torque = 1.0
    errors = []
    for k in range(round(seconds / timestep)):
        arm.step(np.array([torque]), np.array([damping]))
        decay = resistance / inertia * (k + 1) * timestep
        errors.append(arm.qd[0] * resistance / torque + np.expm1(-decay))
    return np.max(np.abs(errors))


@pytest.mark.parametrize("damping", [0.5, 2.0])
def test_a_damped_joint_follows_the_exact_response_to_second_order(damping):
    coarse, fine = (damped_response_error(h, damping) for h in (1e-3, 2.5e-4))
    assert coarse < 0.004 and fine < coarse / 12.0


@pytest.mark.parametrize("damping", [0.5, 5.0, 500.0])
def test_damping_adds_no_apparent_armature(damping):
    """Mean torque is inertia times mean acceleration plus friction, however stiff the damping."""
    arm = one_hinge(fv=0.1)
    for k in range(200):
        q = arm.q[0]
        qd = arm.qd[0]
        (acted,) = arm.step(np.array([np.sin(0.1 * k)]), np.array([damping]))
        acceleration = (arm.qd[0] - qd) / arm.timestep
        speed = (arm.q[0] - q) / arm.timestep
        assert acted == pytest.approx(0.01 * acceleration + 0.1 * speed, abs=1e-9)


def test_steps_of_any_length_add_up():
    """A step cut in two where a motor is sampled leads to where one step leads, to third order."""
    robot = arms.robot_of(arms.MODELS["seven"])
    uncut = ArmStepper(robot, timestep=1e-3)
    cut = ArmStepper(robot, timestep=1e-3)
    torque = np.ones(robot.n_joints)
    damping = np.full(robot.n_joints, 0.5)
    for _ in range(50):
        uncut.step(torque, damping)
        cut.step(torque, damping, 3e-4)
        cut.step(torque, damping, 7e-4)
    np.testing.assert_allclose(
        cut.qd, uncut.qd, rtol=0.0, atol=2e-3 * np.max(np.abs(uncut.qd))
    )


def test_dry_friction_holds_until_its_limit_and_then_resists_with_it():
    arm = one_hinge(fc=0.4)
    run(arm, 0.39, 0.5)
    assert arm.qd[0] == 0.0 and arm.q[0] == 0.0
    run(arm, 0.6, 0.1)
    assert arm.qd[0] == pytest.approx((0.6 - 0.4) / 0.01 * 0.1, rel=1e-9)


WRIST = (
    '<mujoco><option gravity="0 0 0"/><worldbody><body name="a">'
    '<inertial pos="0 0 0" mass="1" diaginertia=".02 .02 .02"/><joint name="a" axis="1 0 0"/>'
    '<body name="b"><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>'
    '<joint name="b" axis="0 0 1"/></body></body></worldbody><tendon><fixed frictionloss=".4">'
    '<joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon></mujoco>'
)


def test_a_motor_that_turns_two_joints_holds_and_resists_both():
    """Torques in its ratio are held up to its limit; what turns the joints against each other is
    not, because the motor then stands still.
    """
    robot = arms.robot_of(WRIST)
    np.testing.assert_array_equal(
        robot.friction.torque(np.array([[2.0, -1.0]])), [[0.4, 0.4]]
    )
    arm = ArmStepper(robot, timestep=1e-3)
    run(arm, 0.39, 0.5)
    np.testing.assert_array_equal(arm.qd, 0.0)
    for _ in range(20):
        arm.step(np.array([0.1, -0.1]), np.zeros(2))
    assert np.sum(arm.qd) == pytest.approx(0.0, abs=1e-12)
    assert arm.qd[0] == pytest.approx(0.2 / (0.03 + 0.01) * 0.02)

    arm = ArmStepper(robot, timestep=1e-3)
    run(arm, 0.6, 0.1)
    assert arm.qd[1] == pytest.approx((0.6 - 0.4) / 0.01 * 0.1, rel=0.01)


@pytest.mark.parametrize("name", ["dry friction", "shared motor"])
def test_fast_joints_have_the_dry_friction_that_mujoco_gives_them(name):
    models = {**arms.MODELS, **arms.NEWER_MODELS}
    try:
        robot = arms.robot_of(models[name])
    except ValueError:
        pytest.skip("this MuJoCo does not know the attribute")
    q, _, _ = arms.random_motion(np.random.default_rng(0), 3, 20)
    qd = 200.0 * np.random.default_rng(1).choice([-1.0, 1.0], size=q.shape)
    zero = np.zeros_like(q)
    plant = ForwardPlant(robot, 1e-3, q[:1])
    smooth = plant_without_dry_friction(robot, q).inverse(q, qd, zero)
    dry = plant.inverse(q, qd, zero) - smooth
    np.testing.assert_allclose(dry, robot.friction.dry(qd), atol=1e-6)


def plant_without_dry_friction(robot, q):
    model = copy.copy(robot.mj_model)
    model.dof_frictionloss[:] = 0.0
    model.tendon_frictionloss[:] = 0.0
    return ForwardPlant(replace(robot, mj_model=model), 1e-3, q[:1])


def test_constant_speed_takes_coulomb_plus_viscous_friction():
    arm = one_hinge(fc=0.4, fv=0.1)
    acted = run(arm, 0.9, 3.0)
    assert arm.qd[0] == pytest.approx((0.9 - 0.4) / 0.1, rel=1e-6)
    assert acted[0] == pytest.approx(0.4 + 0.1 * arm.qd[0], rel=1e-6)


@pytest.mark.parametrize("damping", [0.0, 5.0, 1e3, 1e6])
def test_any_damping_is_stable(damping):
    arm = one_hinge(g=-9.81, x=0.1, fc=0.01)
    run(arm, 0.0, 0.5, damping)
    speed = np.abs(arm.qd[0])
    assert speed < 30.0
    if damping:
        assert speed <= 2.0 * 9.81 * 0.1 / damping * 1.001


def test_a_state_that_is_not_finite_is_said():
    arm = one_hinge()
    with pytest.raises(SimulationError, match="diverged"):
        arm.step(np.array([np.nan]), np.zeros(1))

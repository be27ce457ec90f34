"""Laws of simulated arms: of an arm that motors drive, and of a plant's sensors."""

import copy
import re

import mujoco
import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.small_arms import THREE, X, Y, Z, random_motion, robot_of, serial_arm
from rigs.logs.measured_logs import plan_of
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError, SimulationError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, join_recordings
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulation.plant import (
    ArmStepper,
    forward_model,
    load_plant,
    plant_measurements,
)
from robot_sysid.simulator import simulate_inverse

RATE = 200.0


@pytest.fixture(scope="module")
def plant():
    """A small arm with armature and dry friction."""
    joint = 'range="-2 2" frictionloss=".3" damping=".2" armature=".1"'
    return robot_of(serial_arm((Z, Y, X), joint=joint))


@pytest.fixture(scope="module")
def plan(plant):
    """Five seconds of motion."""
    return plan_of(plant, duration=5.0)


def run(plant, plan, **sensors):
    """One simulation with these sensors."""
    options = SimulatedArmOptions(**sensors)
    return plant_measurements(plant, plan, options, RATE, np.random.default_rng(5))


def read(plant, plan, **sensors):
    """The measurements of one simulation, joined."""
    return join_recordings(run(plant, plan, **sensors))


def test_noise_has_its_standard_deviation_in_every_joint(plant):
    plan = plan_of(plant, duration=100.0)
    levels = np.array([0.1, 0.5, 2.0])
    exact = read(plant, plan)
    noisy = read(plant, plan, noise_torque=tuple(levels), encoder_resolution=0.02)
    # An arm with only encoders would have to compute them from the rounded positions.
    assert noisy.qd is None and noisy.qdd is None
    # 20 000 draws: the spread of an estimated deviation is 0.5 %; 1.5 % is three times that.
    np.testing.assert_allclose(
        np.std(noisy.tau - exact.tau, axis=0), levels, rtol=0.015
    )
    assert np.max(np.abs(noisy.q - exact.q)) <= 0.01 * (1.0 + 1e-9)


def test_noise_levels_must_fit_the_plant(plant, plan):
    message = (
        "--noise-torque takes one number, or one per joint of the chain, which has 3"
    )
    with pytest.raises(InputError, match=message):
        read(plant, plan, noise_torque=(0.1, 0.2))


@pytest.fixture
def robot(arm_file):
    """The three-joint arm from a file."""
    return load_robot_model(arm_file(THREE))


def test_a_plant_keeps_its_own_inertials_friction_and_armature(robot, arm_file):
    joint = 'range="-2 2" frictionloss=".7" damping=".3" armature=".05"'
    heavier = serial_arm((Z, Y, X), joint=joint).replace('mass=".8"', 'mass="1.9"')
    plant = load_plant(robot, arm_file(heavier, "plant.xml"))
    assert plant.joint_names == robot.joint_names
    assert plant.prior.mass == pytest.approx(1.9, rel=1e-12)
    np.testing.assert_array_equal(plant.friction.coulomb, 0.7)
    np.testing.assert_array_equal(plant.mj_model.dof_armature[plant.dof_index], 0.05)
    assert plant.notes == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("joint2", "j2"), "the plant plant.xml: --joint joint2: no such joint.*j2"),
        (("joint1", "r"), "joint0, r, joint2 instead of joint0, joint1, joint2"),
        (("joint1", 'joint1" type="slide'), r"joint1 \(slide\), joint2 instead of"),
        (
            ("joint0", "t", "joint1", "joint0", '"t"', '"joint1"'),
            "joint1, joint0, joint2 instead of joint0, joint1, joint2",
        ),
    ],
)
def test_a_plant_with_other_joints_is_refused_with_a_list(
    robot, arm_file, changes, message
):
    xml = THREE
    for old, new in zip(changes[::2], changes[1::2]):
        xml = xml.replace(old, new)
    with pytest.raises(InputError, match=message):
        load_plant(robot, arm_file(xml, "plant.xml"))


def test_options_of_the_model_are_no_remedy_for_a_plant(robot, arm_file):
    """A plant in tonnes is advised nothing that would make the model a thousand times heavier."""
    light = re.sub('mass="([.0-9]+)"', 'mass="1e-6"', THREE)
    light = re.sub('fullinertia="[^"]+"', 'diaginertia="1e-8 1e-8 1e-8"', light)
    with pytest.raises(
        InputError, match="the plant plant.xml: .*masses in kg"
    ) as caught:
        load_plant(robot, arm_file(light, "plant.xml"))
    assert caught.value.options == ()


HINGE = (
    '<mujoco><compiler angle="radian"/><option gravity="0 0 {g}"/><worldbody><body>'
    '<inertial pos="{x} 0 0" mass="2" diaginertia=".01 .01 .01"/>'
    '<joint axis="0 1 0" frictionloss="{fc}" damping="{fv}"/>'
    "</body></worldbody></mujoco>"
)


def one_hinge(g=0.0, x=0.0, fc=0.0, fv=0.0, timestep=1e-3):
    robot = robot_of(HINGE.format(g=g, x=x, fc=fc, fv=fv))
    return ArmStepper(robot, robot.reference, timestep)


def push(arm, torque, seconds, damping=0.0):
    n = arm.n_joints
    for _ in range(round(seconds / arm.timestep)):
        acted = arm.step(np.full(n, float(torque)), np.full(n, float(damping)))
    return acted


def inverse_error(robot, timestep, seconds=0.2):
    """Largest difference between what acted and the inverse dynamics of the mean motion [N m]."""
    arm = ArmStepper(robot, robot.reference, timestep)
    positions = [arm.q]
    velocities = [arm.qd]
    acted = []
    phase = np.arange(arm.n_joints) / arm.n_joints
    for k in range(round(seconds / timestep)):
        torque = 3.0 * np.sin(2 * np.pi * (3 * (k + 0.5) * timestep + phase))
        acted.append(arm.step(torque, np.full(arm.n_joints, 2.0)))
        positions.append(arm.q)
        velocities.append(arm.qd)
    qd = np.diff(positions, axis=0) / timestep
    qdd = np.diff(velocities, axis=0) / timestep
    q = 0.5 * (np.array(positions[1:]) + positions[:-1])
    motion = Motion(timestep * np.arange(len(q)), q, qd, qdd)
    (inverse,) = simulate_inverse(robot, [motion])
    # Where a joint turns round, friction and acceleration jump within a step; where one sticks,
    # Coulomb's law does not tell the friction.
    direction = np.sign(velocities)
    turns = np.any(np.diff(direction, axis=0) != 0.0, axis=1)
    is_steady = ~(turns[:-2] | turns[1:-1])[:, None] & (direction[1:-2] != 0.0)
    error = np.abs(inverse.tau - acted)[1:-1]
    return np.max(error, where=is_steady, initial=0.0)


@pytest.mark.parametrize("name", ["seven", "slide in chain", "coupled fingers"])
def test_its_torques_are_those_of_inverse_dynamics_to_second_order(name):
    robot = robot_of(small_arms.MODELS[name])
    coarse = inverse_error(robot, 1e-3)
    fine = inverse_error(robot, 2.5e-4)
    assert coarse < 0.01
    # A quarter of the step, so about a sixteenth of the error; a quarter would be a lower order.
    assert fine < 0.13 * coarse


@pytest.mark.parametrize("damping", [0.5, 500.0])
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
    robot = robot_of(small_arms.MODELS["seven"])
    uncut = ArmStepper(robot, robot.reference, 1e-3)
    cut = ArmStepper(robot, robot.reference, 1e-3)
    torque = np.ones(robot.n_joints)
    damping = np.full(robot.n_joints, 0.5)
    for _ in range(50):
        uncut.step(torque, damping)
        cut.step(torque, damping, 3e-4)
        cut.step(torque, damping, 7e-4)
    tolerance = 2e-3 * np.max(np.abs(uncut.qd))
    np.testing.assert_allclose(cut.qd, uncut.qd, rtol=0.0, atol=tolerance)


def energies(robot, states):
    """Kinetic and potential energy [J] of states (N, 2, n) of an arm (N,)."""
    model = forward_model(robot)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    sums = []
    for data.qpos[:], data.qvel[:] in states:
        mujoco.mj_forward(model, data)
        sums.append(np.sum(data.energy))
    return np.array(sums)


@pytest.mark.parametrize("timestep", [1e-3, 4e-3])
def test_a_falling_arm_ends_at_its_stops_and_gains_no_energy(timestep):
    """Its joints stay in their ranges, and a blow at one stop makes no other joint faster than
    energy allows. What free motion gains by rounding of second order is far less.
    """
    joint = 'range="-.4 .5" damping=".2" armature=".002"'
    robot = robot_of(serial_arm((Y, X, Y), joint=joint))
    rng = np.random.default_rng(0)
    arm = ArmStepper(robot, np.array([0.3, 0.1, -0.2]), timestep)
    states = []
    for _ in range(round(1.5 / timestep)):
        arm.step(np.zeros(3), np.zeros(3), timestep * rng.uniform(0.1, 1.0))
        states.append((arm.q, arm.qd))
    positions = np.array(states)[:, 0]
    assert np.min(positions) >= -0.4 and np.max(positions) <= 0.5
    at_ends = np.isclose(positions, -0.4) | np.isclose(positions, 0.5)
    assert np.sum(np.any(at_ends, axis=0)) > 1
    sums = energies(robot, states)
    assert np.max(np.diff(sums)) < 1e-5 * np.ptp(sums)


def test_stops_change_nothing_within_the_range():
    wide = robot_of(serial_arm((Z, Y, X), joint='frictionloss=".1"'))
    limited = robot_of(serial_arm((Z, Y, X), joint='frictionloss=".1" range="-.3 .3"'))
    states = []
    for robot in (wide, limited):
        arm = ArmStepper(robot, np.zeros(3))
        torques = 3.0 * np.sin(np.arange(400)[:, None] / 15.0 + np.arange(3))
        states.append([(arm.step(t, np.ones(3)), arm.q, arm.qd) for t in torques])
    np.testing.assert_array_equal(*states)
    assert 0.02 < np.max(np.abs(states[0])[:, 1]) < 0.3


def test_a_stop_pushes_and_does_not_pull():
    """A joint that is pressed against its stop stands there, and leaves as if there were none."""
    robot = robot_of(serial_arm((Z, Y), joint='range="-.3 .3" armature=".1"'))
    pressed = ArmStepper(robot, np.array([0.2, 0.0]))
    for _ in range(1000):
        pressed.step(np.array([8.0, 0.0]), np.full(2, 5.0))
    assert pressed.q[0] == pytest.approx(0.3, abs=1e-4) and pressed.qd[0] == 0.0
    free = ArmStepper(robot_of(serial_arm((Z, Y), joint='armature=".1"')), pressed.q)
    free.qd = pressed.qd
    for arm in (pressed, free):
        push(arm, -3.0, 0.1)
    np.testing.assert_allclose(pressed.q, free.q, rtol=0.0, atol=1e-6)
    assert pressed.q[0] < 0.25


def test_an_arm_that_begins_beyond_its_range_is_not_thrown_back():
    robot = robot_of(serial_arm((Z,), joint='range="-.3 .3" armature=".1"'))
    arm = ArmStepper(robot, np.array([0.5]))
    push(arm, 1.0, 0.1)
    assert (arm.q, arm.qd) == (0.5, 0.0)


WRIST = (
    '<mujoco><option gravity="0 0 0"/><worldbody><body name="a">'
    '<inertial pos="0 0 0" mass="1" diaginertia=".02 .02 .02"/><joint name="a" axis="1 0 0"/>'
    '<body name="b"><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>'
    '<joint name="b" axis="0 0 1"/></body></body></worldbody><tendon><fixed frictionloss=".4">'
    '<joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon></mujoco>'
)


def test_a_motor_that_turns_two_joints_holds_and_resists_both():
    """Torques in its ratio are held up to the limit of its dry friction.

    What turns the joints against each other is not, because the motor then stands still.
    """
    robot = robot_of(WRIST)
    friction = robot.friction.torque(np.array([[2.0, -1.0]]))
    np.testing.assert_array_equal(friction, [[0.4, 0.4]])
    arm = ArmStepper(robot, robot.reference, 1e-3)
    push(arm, 0.39, 0.5)
    np.testing.assert_array_equal(arm.qd, 0.0)
    for _ in range(20):
        arm.step(np.array([0.1, -0.1]), np.zeros(2))
    assert np.sum(arm.qd) == pytest.approx(0.0, abs=1e-12)
    assert arm.qd[0] == pytest.approx(0.2 / (0.03 + 0.01) * 0.02)

    arm = ArmStepper(robot, robot.reference, 1e-3)
    push(arm, 0.6, 0.1)
    assert arm.qd[1] == pytest.approx((0.6 - 0.4) / 0.01 * 0.1, rel=0.01)


@pytest.mark.parametrize("name", ["dry friction", "shared motor"])
def test_fast_joints_have_the_dry_friction_that_mujoco_gives_them(name):
    models = {**small_arms.MODELS, **small_arms.NEWER_MODELS}
    try:
        robot = robot_of(models[name])
    except ValueError:
        pytest.skip("this MuJoCo does not know the attribute")
    q, _, _ = random_motion(np.random.default_rng(0), 3, 20)
    qd = 200.0 * np.random.default_rng(1).choice([-1.0, 1.0], size=q.shape)
    model = forward_model(robot)
    smooth = copy.copy(model)
    smooth.dof_frictionloss[:] = 0.0
    smooth.tendon_frictionloss[:] = 0.0
    dynamics = ArmDynamics(robot)
    dynamics.model = model
    dry = dynamics.torque(q, qd, 0.0 * q)
    dynamics.model = smooth
    dry -= dynamics.torque(q, qd, 0.0 * q)
    np.testing.assert_allclose(dry, robot.friction.dry(qd), atol=1e-6)


@pytest.mark.parametrize("damping", [0.0, 5.0, 1e6])
def test_any_damping_is_stable(damping):
    arm = one_hinge(g=-9.81, x=0.1, fc=0.01)
    push(arm, 0.0, 0.5, damping)
    speed = np.abs(arm.qd[0])
    assert speed < 30.0
    if damping:
        assert speed <= 2.0 * 9.81 * 0.1 / damping * 1.001


def test_a_state_that_is_not_finite_is_said():
    arm = one_hinge()
    with pytest.raises(SimulationError, match="diverged"):
        arm.step(np.array([np.nan]), np.zeros(1))

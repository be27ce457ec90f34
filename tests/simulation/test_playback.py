"""Rollouts are what MuJoCo does step by step, on one processor or on many.

Servos in rollouts are the model's own actuators where it has them, and springs else.
"""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import MODELS, SEVEN, X, Y, Z, robot_of, serial_arm
from rigs.files.releases import since
from rigs.logs.servo_logs import SERVOS, TRUTH, XML, sines_and_steps
from robot_sysid.simulation import playback
from robot_sysid.simulation.plant import forward_model, set_chain_state


def random_inputs(rollouts, count=4, steps=30):
    """Starts (count, 2, n), and torques on the joints (count, steps, nu + nv)."""
    robot = rollouts.robot
    model = rollouts.model
    rng = np.random.default_rng(0)
    inputs = np.zeros((count, steps, model.nu + model.nv))
    torque = rng.normal(0.0, 5.0, (count, steps, robot.n_joints))
    inputs[:, :, model.nu + robot.dof_index] = torque
    return rng.uniform(-1.0, 1.0, (count, 2, robot.n_joints)), inputs


def test_rollouts_on_threads_are_single_steps_and_one_that_diverges_disturbs_no_other(
    monkeypatch,
):
    robot = robot_of(SEVEN)
    threads = playback.ServoRollouts(robot)
    monkeypatch.delattr(mujoco.rollout, "Rollout", raising=False)
    steps = playback.ServoRollouts(robot)
    starts, inputs = random_inputs(threads)
    diverging = inputs.copy()
    diverging[1, 10:] = 1e15
    for armature in (0.0, 0.3):
        # The numbers of a model may change between calls.
        for rollouts in (threads, steps):
            rollouts.model.dof_armature[:] = armature
        expected = threads.play(starts, inputs)
        assert_array_equal(steps.play(starts, inputs), expected)
        for rollouts in (threads, steps):
            positions = rollouts.play(starts, diverging)
            assert_array_equal(positions[[0, 2, 3]], expected[[0, 2, 3]])
            assert_array_equal(positions[1, :11], expected[1, :11])
            assert np.all(np.isnan(positions[1, 14:]))


def test_actuators_and_contacts_of_the_model_do_not_act():
    plain = serial_arm((Z, Y, X))
    ball = '<geom type="sphere" size=".3" mass="0"/><joint name="joint'
    servo = '<actuator><position joint="joint2" kp="500" ctrlrange="-1 1"/></actuator></mujoco>'
    busy = plain.replace('<joint name="joint', ball).replace("</mujoco>", servo)
    assert robot_of(busy).mj_model.nu == 1
    rollouts = [playback.ServoRollouts(robot_of(xml)) for xml in (plain, busy)]
    assert_array_equal(*(own.play(*random_inputs(own)) for own in rollouts))


@pytest.mark.parametrize("name", ["coupled fingers", "home keyframe"])
def test_joints_behind_the_chain_stay_where_they_are(name):
    robot = robot_of(MODELS[name])
    model = forward_model(robot)
    data = mujoco.MjData(model)
    speed = np.full(robot.n_joints, 2.0)
    set_chain_state(robot, model, data, robot.reference, speed)
    for _ in range(50):
        mujoco.mj_step(model, data)
    others = np.setdiff1d(np.arange(model.nq), robot.qpos_index)
    reference = robot.reference_qpos
    assert_allclose(data.qpos[others], reference[others], atol=1e-6)
    assert np.max(np.abs(data.qpos - reference)) > 0.01


FAR_SERVO = '<actuator><position joint="joint0" kp="1"/></actuator>'
EDGES = np.linspace(0.0, 1.0, 501)
TIME, COMMAND = sines_and_steps(4.0)
WINDOW = playback.ServoWindow(1.0, COMMAND[50], np.zeros(2), TIME, COMMAND)


def play(robot, *candidates):
    """Positions (S + 1, n) of each candidate in one window."""
    rollouts = playback.ServoRollouts(robot)
    return [rollouts.positions(servos, [WINDOW], EDGES)[0] for servos in candidates]


def test_the_models_own_servos_move_it_as_mujoco_does():
    robot = robot_of(XML)
    (positions,) = play(robot, playback.servos_in_model(robot))
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.timestep = 0.002
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    # As a leapfrog: velocities half a step before positions, damped by their mean.
    half_step = 0.5 * model.opt.timestep
    model.dof_armature[:] -= half_step * playback.servos_in_model(robot).numbers[1]
    data = mujoco.MjData(model)
    data.qpos[:] = WINDOW.q
    edges = WINDOW.start + EDGES - half_step
    for control in playback.mean_commands(TIME, COMMAND, edges):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    assert_allclose(positions[-1], data.qpos, atol=1e-7)


def test_rollouts_are_neither_late_nor_early():
    """Steps of 2 ms lead where steps of 0.1 ms do; a millisecond at 1 rad/s is 1e-3 rad."""
    rollouts = playback.ServoRollouts(robot_of(XML))
    edges = np.linspace(0.0, 1.0, 10001)
    exact = rollouts.positions(TRUTH, [WINDOW], edges)[0, ::20]
    (positions,) = play(robot_of(XML), TRUTH)
    assert_allclose(positions, exact, atol=2e-4)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_servo_and_joint_share_the_damping_as_is_said(share):
    """Earlier parameters leave nothing behind."""
    rollouts = playback.ServoRollouts(robot_of(XML))
    damping = TRUTH.numbers[1]
    for candidate in (TRUTH, replace(TRUTH, servo_damping=share * damping)):
        rollouts.set_servos(candidate)
    model = rollouts.model
    assert_allclose(model.dof_damping, (1.0 - share) * damping, atol=1e-12)
    assert_allclose(model.actuator_biasprm[:, 2], -share * damping, rtol=1e-12)


def test_numbers_of_the_model_are_its_own():
    """Damping is that of joint and servo together; the servo's part of it is kv."""
    robot = robot_of(XML)
    servos = playback.servos_in_model(robot)
    expected = [[100.0, 80.0], [3.0, 2.0], [0.3, 0.3], [0.05, 0.05]]
    assert_array_equal(servos.numbers, expected)
    assert servos.delay == 0.0
    assert servos.limits.tolist() == [60.0, np.inf]
    assert servos.servo_damping.tolist() == pytest.approx([2.0, 1.0], rel=1e-12)
    assert servos.firmness.tolist() == [0.9, 0.9]


def test_damping_beside_a_limit_slows_a_servo_and_damping_within_it_does_not():
    """Its speed without load is the limit over the damping, as a voltage gives it."""
    robot = robot_of(serial_arm((Z,), extra=FAR_SERVO))
    numbers = np.array([[100.0], [2.0], [0.0], [0.01]])
    beside = playback.ServoParameters(
        numbers, 0.0, np.ones(1), np.zeros(1), np.full(1, 0.9)
    )
    window = playback.ServoWindow(
        0.0, np.zeros(1), np.zeros(1), np.arange(2.0), np.full((2, 1), 100.0)
    )
    speeds = []
    for servos in (beside, replace(beside, servo_damping=np.full(1, 2.0))):
        q = playback.ServoRollouts(robot).positions(servos, [window], EDGES)[0]
        speeds.append((q[-1, 0] - q[-2, 0]) / EDGES[1])
    assert speeds[0] == pytest.approx(1.0 / 2.0, rel=0.05)
    assert speeds[1] > 2.0 * speeds[0]


@pytest.mark.parametrize(("firmness", "largest"), [(0.9, 0.1), (0.99, 0.01)])
def test_friction_that_is_firm_lets_a_joint_creep_less(firmness, largest):
    """A joint that friction of 2 N m holds under a torque of 1 N m."""
    robot = robot_of(serial_arm((Z,), extra=FAR_SERVO))
    servos = playback.ServoParameters(
        np.array([[1.0], [0.0], [2.0], [0.05]]),
        0.0,
        np.full(1, np.inf),
        np.zeros(1),
        np.full(1, firmness),
    )
    window = playback.ServoWindow(
        0.0, np.zeros(1), np.zeros(1), np.arange(2.0), np.ones((2, 1))
    )
    q = playback.ServoRollouts(robot).positions(servos, [window], EDGES)[0]
    assert 0.01 * largest < q[-1, 0] < largest


def test_friction_is_as_firm_as_in_a_file_with_the_numbers():
    """MuJoCo keeps from compilation how firmly friction holds; a stale value lets it creep."""
    robot = robot_of(XML.replace(' armature=".05"', ""))
    servos = playback.servos_in_model(robot)
    servos.numbers[3] = 0.05
    rollouts = playback.ServoRollouts(robot)
    rollouts.set_servos(servos)
    compiled = robot_of(XML).mj_model
    assert_allclose(rollouts.model.dof_invweight0, compiled.dof_invweight0, rtol=1e-9)


def test_a_joint_without_actuator_is_pulled_by_a_spring_of_the_same_gain():
    actuated = robot_of(XML.replace(' forcerange="-60 60"', ""))
    bare = robot_of(XML.replace(SERVOS, ""))
    assert np.all(playback.chain_actuators(bare).index == playback.NO_ACTUATOR)
    candidates = (playback.servos_in_model(actuated), TRUTH)
    assert_allclose(
        play(actuated, *candidates)[1], play(bare, *candidates)[1], atol=1e-6
    )


PASSIVE = """<dcmotor joint="joint0" input="none" resistance="1" motorconst="0"
 lugre="900 1 .15 .2 .1"/><general joint="joint1" dyntype="integrator"/>"""
PID = """<pid joint="joint0" kp="100" kv="2" forcerange="-60 60"/>
<pid joint="joint1" kp="80" kv="1" input="pos"/>"""


@since(4, 0)
@pytest.mark.parametrize(
    "servos",
    [
        SERVOS.replace("<general", f"{PASSIVE}<general", 1),
        f"<actuator>{PID}</actuator>",
    ],
)
def test_servos_are_the_same_beside_other_actuators_and_as_pid_controllers(servos):
    plain = robot_of(XML)
    xml = XML.replace(SERVOS, servos)
    if PASSIVE in servos:
        # A motor's dry friction of 0.15 N m is a part of its joint's.
        xml = xml.replace('frictionloss=".3"', 'frictionloss=".15"', 1)
    other = robot_of(xml)
    models = [playback.servos_in_model(robot) for robot in (plain, other)]
    assert_array_equal(models[0].numbers, models[1].numbers)
    for candidate in (models[0], TRUTH):
        expected = play(plain, candidate)[0]
        assert_allclose(play(other, candidate)[0], expected, atol=1e-9)


def test_candidates_played_together_do_not_disturb_each_other():
    robot = robot_of(XML)
    late = replace(TRUTH, delay=0.05)
    factors = np.array([[1.0], [1.0], [1.0], [2.0]])
    candidates = [TRUTH, late, replace(late, numbers=factors * late.numbers), TRUTH]
    alone = [play(robot, servos)[0] for servos in candidates]
    assert_array_equal(play(robot, *candidates), alone)


def test_a_servo_pulls_no_harder_than_its_limit():
    robot = robot_of(XML.replace("-60 60", "-1 1"))
    assert playback.chain_actuators(robot).limit.tolist() == [1.0, np.inf]
    weak_servos = replace(TRUTH, limits=np.array([1.0, np.inf]))
    strong, weak = play(robot_of(XML), TRUTH, weak_servos)
    assert np.ptp(weak[:, 0]) < 0.7 * np.ptp(strong[:, 0])
    # Parameters, and not the file, say what the limit is.
    assert_array_equal(play(robot, TRUTH)[0], strong)


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.05])
def test_commands_act_late_and_hold_until_the_next(delay):
    edges = WINDOW.start + EDGES - delay
    controls = playback.mean_commands(TIME, COMMAND, edges)
    middles = 0.5 * (edges[1:] + edges[:-1])
    held = COMMAND[np.searchsorted(TIME, middles, side="right") - 1]
    # Steps in which a command changes hold a mean of both.
    assert np.isclose(controls, held).all(axis=1).mean() > 0.85
    mean = playback.mean_commands(TIME, COMMAND, edges[[0, -1]])[0]
    assert_allclose(controls.mean(axis=0), mean, atol=1e-12)


@pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "actuator_delay"),
    reason="actuators of this MuJoCo cannot act late",
)
def test_a_delay_of_the_models_own_does_not_act_a_second_time():
    positions = []
    for attributes in ("", ' delay="0.04" nsample="50"'):
        robot = robot_of(XML.replace(' name="a"', f' name="a"{attributes}'))
        servos = replace(playback.servos_in_model(robot), delay=0.04)
        positions += play(robot, servos)
    assert_array_equal(*positions)

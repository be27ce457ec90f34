"""No run of a sound arm is stopped, on motors and physics that are none of the package's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rigs.arms.small_arms import SEVEN_AXES, robot_of, serial_arm
from rigs.arms.wrong_arms import link_torque
from rigs.motors import own_motors
from rigs.motors.arm_faults import pull, restart_motor, shift_report, table_faults
from rigs.motors.own_motors import OwnMotor, pack_command, pack_feedback, unpack_command
from rigs.motors.sound_arms import (
    STEP,
    Arm,
    JointFriction,
    Plant,
    bus_of,
    draw_friction,
    drawn_links,
)
from rigs.motors.sound_runs import (
    COMPLETED,
    SOUND_ARMS,
    STOPPED,
    RunOptions,
    disturbed_run,
    draw_options,
    run_arm,
    twin_of,
)
from robot_sysid.damiao.protocol import (
    CanFrame,
    MitCommand,
    Scaling,
    decode_feedback,
    encode_mit,
)
from robot_sysid.records import Motion

DM4340 = (12.5, 10.0, 28.0)
SHORT = 2.0
"""Length of the motions of the fast tests at full speed [s]."""
ENABLE = own_motors.SPECIAL_HEAD + bytes([own_motors.ENABLE])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where motions are planned, once per arm."""
    return tmp_path_factory.mktemp("planned")


# --- motors and bus -------------------------------------------------------------------------------


def test_commands_are_packed_as_the_maker_does():
    command = (1.0, 2.0, 20.0, 1.0, 0.5)
    data = pack_command(command, (12.5, 30.0, 10.0))
    assert data.hex(" ").upper() == "8A 3C 88 80 A3 33 38 65"
    command = (-0.7854, -1.5, 240.0, 3.0, -6.25)
    assert pack_command(command, DM4340).hex(" ").upper() == "77 F4 6C C7 AD 99 96 36"


def test_feedback_is_unpacked_as_the_maker_does():
    data = bytes.fromhex("138B217D3866231F")
    status, can_id, *measured = own_motors.unpack_feedback(data, DM4340)
    assert (status, can_id) == (1, 3)
    assert measured == pytest.approx([1.08701, -0.21734, 1.40171], abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_both_codecs_agree_within_their_rounding(seed):
    rng = np.random.default_rng(seed)
    scaling = Scaling([DM4340])
    share = rng.uniform(-0.99, 0.99, 3)
    position, velocity, torque = share * DM4340
    kp, kd = rng.uniform(0.01, 0.99, 2) * (500.0, 5.0)
    command = MitCommand(*(np.array([x]) for x in (position, velocity, kp, kd, torque)))
    data = encode_mit(command, scaling)[0].tobytes()
    steps = np.array([25.0, 0.0, 0.0, 0.0, 0.0]) / 0xFFFF
    steps += np.array([0.0, 20.0, 500.0, 5.0, 56.0]) / 0xFFF
    received = np.array(unpack_command(data, DM4340))
    assert np.all(np.abs(received - np.ravel(command)) <= 0.501 * steps)

    data = pack_feedback(1, 3, (position, velocity, torque), (40, 50), DM4340)
    feedback = decode_feedback(np.frombuffer(data, np.uint8)[None], scaling)
    assert feedback.status == 1 and feedback.temperature == 50
    decoded = (feedback.position, feedback.velocity, feedback.torque)
    error = np.abs(np.ravel(decoded) - share * DM4340)
    assert np.all(error <= 0.501 * steps[[0, 1, 4]])


def test_a_motor_answers_with_the_state_before_the_command_acts():
    motor = OwnMotor(1, 0x11, DM4340, 27.0, watchdog=0.1)
    motor.answer(1, ENABLE, 0.0)
    push = pack_command((0.0, 0.0, 0.0, 1.0, 5.0), DM4340)
    first = own_motors.unpack_feedback(motor.answer(1, push, 0.01), DM4340)
    second = own_motors.unpack_feedback(motor.answer(1, push, 0.02), DM4340)
    assert first[4] == pytest.approx(0.0, abs=0.02)
    assert second[4] == pytest.approx(5.0, abs=0.02)


def test_a_motor_stops_without_commands_and_stays_off():
    motor = OwnMotor(1, 0x11, DM4340, 27.0, watchdog=0.1)
    motor.answer(1, ENABLE, 0.0)
    motor.expire(0.09)
    assert motor.is_driving
    motor.expire(0.11)
    assert motor.status == own_motors.WATCHDOG_EXPIRED
    motor.answer(1, ENABLE, 0.12)
    assert not motor.is_driving


def test_frames_follow_one_another_and_commands_go_first():
    motors = [OwnMotor(i, 0x10 + i, DM4340, 27.0, 0.1) for i in (1, 2, 3)]
    bus = own_motors.OwnBus(motors, lambda time: None, has_echo=False)
    for i in (1, 2, 3):
        bus.send(CanFrame(i, ENABLE))
    frames = [bus.receive(1.0) for _ in motors]
    assert [frame.id for frame in frames] == [0x11, 0x12, 0x13]
    times = np.array([frame.time for frame in frames])
    assert np.all(np.diff(times) >= 111e-6) and np.all(np.diff(times) <= 135.1e-6)
    assert times[0] >= 4 * 111e-6
    assert bus.receive(2.0) is None and bus.clock.now() == 2.0


def test_an_answer_reports_each_signal_as_it_was_an_age_ago():
    motor = OwnMotor(1, 0x11, DM4340, 27.0, watchdog=1.0)
    motor.position_age = 0.01
    motor.velocity_age = 0.02
    motor.torque_age = 0.03
    motor.answer(1, ENABLE, 0.0)
    motor.answer(1, pack_command((0.0, 0.0, 10.0, 0.0, 3.0), DM4340), 0.0)
    for time in np.arange(0.0, 0.1, STEP):
        motor.link_position = 5.0 * time
        motor.link_velocity = 20.0 * time
        motor.remember(time, STEP)
    # The torque is still that of the first command.
    motor.answer(1, pack_command((0.0, 0.0, 10.0, 0.0, -3.0), DM4340), 0.08)
    answer = motor.answer(1, pack_command((0.0,) * 5, DM4340), 0.1)
    _, _, position, velocity, torque = own_motors.unpack_feedback(answer, DM4340)
    assert position == pytest.approx(0.45, abs=0.02)
    assert velocity == pytest.approx(1.6, abs=0.03)
    assert torque == pytest.approx(3.0 - 10.0 * 0.35, abs=0.3)


@pytest.mark.parametrize(
    ("share", "n_frames"), [("lost", 0.7**2), ("late", 1.0), ("doubled", 1.3)]
)
def test_a_bus_loses_delays_and_doubles_answers(share, n_frames):
    motor = OwnMotor(1, 0x11, DM4340, 27.0, watchdog=0.0)
    disturbance = own_motors.Disturbance(delay=0.01, **{share: 0.3})
    bus = own_motors.OwnBus(
        [motor], lambda time: None, has_echo=False, disturbance=disturbance
    )
    motor.answer(1, ENABLE, 0.0)
    delays = []
    for number in range(1000):
        begin = 0.02 * number
        bus.send(CanFrame(1, pack_command((0.0,) * 5, DM4340)))
        while frame := bus.receive(begin + 0.02):
            delays.append(frame.time - begin)
    assert len(delays) == pytest.approx(1000 * n_frames, abs=70)
    is_late = np.array(delays) > 0.01
    assert np.mean(is_late) == pytest.approx(0.3 * (share == "late"), abs=0.05)


# --- the arm --------------------------------------------------------------------------------------


def _no_friction(n):
    return JointFriction(*np.zeros((4, n)))


@pytest.mark.parametrize("seed", range(3))
def test_the_plant_accelerates_as_the_true_links_say(seed):
    rng = np.random.default_rng(seed)
    robot = robot_of(serial_arm(SEVEN_AXES))
    n = robot.n_joints
    q, qd = rng.uniform(-1.0, 1.0, (2, n))
    tau = rng.uniform(-5.0, 5.0, n)
    links = drawn_links(robot, seed)
    rotors = rng.uniform(0.002, 0.02, n)
    plant = Plant(robot, q, _no_friction(n), links, rotors)
    plant.set_velocity(qd)
    plant.step(tau.tolist(), [0.0] * n)
    qdd = (np.array(plant.qd) - qd) / STEP
    motion = Motion(np.zeros(1), q[None], qd[None], qdd[None])
    needed = link_torque(robot, motion, links)[0] + (robot.armature + rotors) * qdd
    assert np.abs(needed - tau).max() < 1e-9 * np.abs(tau).max()


def test_a_carried_mass_and_a_tilt_are_felt():
    robot = robot_of(serial_arm(SEVEN_AXES))
    n = robot.n_joints
    q = np.full(n, 0.5)
    ends = []
    for change in (
        lambda plant: None,
        lambda plant: plant.carry(0.7),
        lambda plant: plant.tilt(math.radians(20.0)),
    ):
        plant = Plant(robot, q, _no_friction(n))
        change(plant)
        plant.step([0.0] * n, [0.0] * n)
        ends.append(np.array(plant.qd))
    assert np.abs(ends[1] - ends[0]).max() > 1e-4
    assert np.abs(ends[2] - ends[0]).max() > 1e-4


def _creeping_joint(force):
    """Return the path (N, 1) of a joint whose friction is 1 N m at rest, under a torque [N m]."""
    robot = robot_of(serial_arm(["0 0 1"]))
    friction = JointFriction(*np.array([[0.7], [0.3], [0.0], [0.0]]))
    plant = Plant(robot, np.zeros(1), friction)
    path = []
    for number in range(4000):
        # A step of torque would shake it loose.
        plant.step([force * min(number / 1000.0, 1.0)], [0.0])
        path.append(plant.q)
    return np.array(path)


def test_a_standing_joint_neither_creeps_nor_rings():
    path = _creeping_joint(0.9)
    assert 5e-4 < path[-1, 0] < 2e-3
    assert np.ptp(path[2000:]) < 1e-6


def test_a_joint_breaks_loose_beyond_its_friction_of_rest():
    assert _creeping_joint(1.1)[-1, 0] > 0.5


def test_friction_in_motion_is_that_of_speed_and_load():
    robot = robot_of(serial_arm(["0 0 1"]))
    friction = JointFriction(*np.array([[0.5], [0.3], [0.04], [0.1]]))
    plant = Plant(robot, np.zeros(1), friction)
    for _ in range(6000):
        # A stiff hand that turns the joint at 1 rad/s, by a torque of about 0.625 N m.
        plant.step([500.0], [500.0])
    torque = 500.0 * (1.0 - plant.qd[0])
    expected = 0.5 + 0.3 * math.exp(-10.0) + 0.04 * torque + 0.1
    assert torque == pytest.approx(expected, rel=1e-3)


def test_an_arm_is_supported_until_a_motor_is_enabled():
    robot = robot_of(serial_arm(SEVEN_AXES))
    n = robot.n_joints
    friction = draw_friction(np.ones(n), np.random.default_rng(0))
    motors = [OwnMotor(i, 0x10 + i, DM4340, 27.0, 0.0) for i in range(1, n + 1)]
    arm = Arm(Plant(robot, np.full(n, 0.4), friction), motors)
    bus = bus_of(arm, fd=False)
    arm.advance(0.2)
    assert np.ptp(arm.path, axis=0).max() == 0.0
    bus.send(CanFrame(1, ENABLE))
    arm.advance(0.4)
    assert np.ptp(arm.path, axis=0).max() > 0.01


@pytest.mark.parametrize("number", range(len(table_faults(1, 4))))
def test_each_fault_changes_what_an_arm_does_or_says(number):
    fault = table_faults(1, 4)[number]
    outcomes = []
    for act in (lambda arm: None, fault.act):
        arm = _held_arm()
        arm.at(0.1, act)
        arm.advance(0.1 + STEP)
        said = []
        for moment in np.arange(0.11, 0.25, 0.01):
            arm.advance(moment)
            said += [m.answer(m.can_id, m.held, moment) for m in arm.motors]
        outcomes.append((arm.path, said))
    assert outcomes[0] != outcomes[1]
    assert np.all(np.isfinite(outcomes[1][0]))


def _held_arm():
    """Return an arm that motors begin to hold a little beside where it is."""
    robot = robot_of(serial_arm(SEVEN_AXES))
    n = robot.n_joints
    friction = draw_friction(np.ones(n), np.random.default_rng(0))
    limits = (12.5, 45.0, 54.0)
    motors = [OwnMotor(i, 0x10 + i, limits, 40.0, 0.0) for i in range(1, n + 1)]
    arm = Arm(Plant(robot, np.full(n, 0.4), friction), motors)
    for motor in motors:
        motor.answer(motor.can_id, ENABLE, 0.0)
        motor.held = pack_command((0.5, 0.1, 100.0, 2.0, 0.5), limits)
        motor.answer(motor.can_id, motor.held, 0.0)
    return arm


# --- runs -----------------------------------------------------------------------------------------

FAST_RUNS = (
    RunOptions("kinova", 1, speed=1.0, rate=60.0, kp=60.0, duration=SHORT),
    RunOptions("kinova", 2, speed=0.5, rate=50.0, kp=90.0, duration=SHORT),
    RunOptions("kinova", 3, 1.0, 50.0, 40.0, has_model=False, duration=SHORT),
)


@pytest.mark.slow
@pytest.mark.parametrize("options", FAST_RUNS)
def test_a_sound_arm_is_not_stopped(options, folder):
    run = twin_of(options, folder)
    assert (run.exit, run.code) == (COMPLETED, 0), run.message


@pytest.mark.slow
def test_a_twin_is_alike_to_the_last_bit_until_the_fault(folder):
    options = FAST_RUNS[0]
    after = 0.6
    run, effect = disturbed_run(options, folder, pull(1, 60.0, after))
    twin = twin_of(options, folder)
    assert run.fault_at == pytest.approx(run.begun_at + after, abs=2.0 * STEP)
    before = round(run.fault_at / STEP)
    assert np.array_equal(run.path[:before], twin.path[:before])
    assert effect.joint == 1 and effect.departure > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.2, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("name", SOUND_ARMS)
def test_no_drawn_arm_is_stopped_in_depth(name, speed, folder):
    if not SOUND_ARMS[name].is_at_hand:
        pytest.skip("the model is not at hand")
    for seed, has_model in ((20, True), (21, False)):
        options = draw_options(name, folder, seed, speed, has_model, SHORT)
        run = run_arm(options, folder)
        assert (run.exit, run.code) == (COMPLETED, 0), (options, run.message)


@pytest.mark.slow
def test_a_motor_that_starts_again_is_noticed(folder):
    run, effect = disturbed_run(FAST_RUNS[0], folder, restart_motor(1, 0.6))
    assert run.exit == STOPPED and run.code == 3
    assert 0.0 < effect.seconds < 3.0


@pytest.mark.slow
def test_a_false_report_is_noticed(folder):
    run, effect = disturbed_run(FAST_RUNS[0], folder, shift_report(1, 0.7, 0.6))
    assert run.exit == STOPPED and run.code == 3
    assert effect.departure >= effect.departure_in_stop

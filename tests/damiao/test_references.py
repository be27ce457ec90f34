"""References of motions and stops: interpolation, bounds, rest, and what a stop carries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms import small_arms
from rigs.motors.damiao_rig import swing, trajectory_of
from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.references import (
    Reference,
    trajectory_reference,
    transfer_reference,
)
from robot_sysid.damiao.safety.holding import HoldingTorque, torque_doubt
from robot_sysid.damiao.safety.stopping import CarriedStop, Lowering
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.records import Limits

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=7)


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_the_sampler_interpolates_and_scales_velocity_with_speed(speed):
    time, q, qd, tau = swing(3)
    sampler = trajectory_reference(trajectory_of((time, q, qd, tau)), speed)
    for moment in np.append(np.arange(0.0, 2.0 / speed, 0.137), 9.0):
        reference = sampler(moment)
        for actual, signal in zip(reference[:3], (q, speed * qd, tau)):
            expected = [np.interp(moment * speed, time, column) for column in signal.T]
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9)


@given(
    start=ANGLES,
    data=st.data(),
    speed=st.floats(0.05, 2.0),
    shortest=st.floats(0.1, 3.0),
)
def test_an_approach_goes_from_rest_to_rest_within_its_speed(
    start, data, speed, shortest
):
    """And carries the arm on its way, with what start and target ask for besides."""
    start = np.array(start)
    target = np.array([data.draw(st.floats(-3.0, 3.0)) for _ in start])
    ends = (
        Reference(start, 0 * start, 2.0 + np.sin(start)),
        Reference(target, 0 * start, 0 * start),
    )
    holding = HoldingTorque((), np.sin, np.zeros_like(start))
    path, duration = transfer_reference(*ends, speed, shortest, holding)
    assert duration >= shortest
    for moment, end in ((-1.0, 0), (0.0, 0), (duration, 1), (duration + 1.0, 1)):
        for actual, expected in zip(path(moment)[:3], ends[end]):
            np.testing.assert_allclose(actual, expected, atol=1e-9)
    times = np.linspace(0.0, duration, 401)
    q, qd, tau, *_ = (np.array(signal) for signal in zip(*map(path, times)))
    assert np.max(np.abs(qd)) <= speed * (1 + 1e-9)
    ahead = np.array([path(moment + 1e-6).position for moment in times[:-1]])
    np.testing.assert_allclose(
        (ahead - q[:-1]) / 1e-6, qd[:-1], atol=1e-3 * speed + 1e-6
    )
    extra = (tau - np.sin(q) - 2.0) / (-np.sin(target) - 2.0)
    assert np.all(np.diff(extra, axis=0) >= -1e-9)


def test_an_arm_is_lowered_to_the_end_of_its_range_and_no_farther():
    """A torque that never goes away, as of a joint that lies on its stop, does not lead it on."""
    begin = Reference(np.array([0.4, 0.0]), np.zeros(2), np.array([3.0, 0.0]))
    command_range = Limits(-0.1, 1.0, 9.0, torque=27.0)
    lowering = Lowering(begin, 0.2, command_range)
    lowering.follow(np.zeros(2), np.zeros(2), np.array([9.0, 0.0]))
    moments = np.arange(0.0, 8.0, 0.004)
    references = [lowering(moment) for moment in moments]
    positions = np.array([reference.position for reference in references])
    assert np.all(positions >= -0.1) and positions[-1, 0] == -0.1
    assert np.max(np.abs(np.diff(positions, axis=0))) <= 0.2 * 0.004 + 1e-12
    assert lowering.is_done and references[-1].velocity[0] == 0.0


ZERO = (0.0, 0.0)
KP = 180.0
KD = 4.5
PERIOD = 0.004


def stop_settings(n):
    """Settings of a run of n equal joints."""
    return PlaySettings(kp=(KP,) * n, kd=(KD,) * n, rate=1.0 / PERIOD, rest_time=0.3)


@given(off=st.floats(0.01, 0.5), side=st.sampled_from([-1.0, 1.0]))
def test_a_motor_that_may_ignore_its_stiffness_gets_no_more_of_it(off, side):
    """The torque that makes up for more stiffness would throw its joint."""
    zero = np.zeros(2)
    led = Reference(zero, zero, zero)
    state = np.array([-side * off, 0.0]), zero, zero, zero != 0.0
    ignored = -KP * side * off * np.array([1.0, 0.0])
    limits = Limits(torque=np.full(2, 27.0))
    path = CarriedStop(stop_settings(2), led, *state, limits, ignored)
    assert path.stiffness[0] == 1.0 and path.stiffness[1] > 1.0
    np.testing.assert_allclose(path(0.0).torque, zero, atol=1e-9)


def stop(
    position=ZERO, velocity=ZERO, torque=ZERO, q=ZERO, qd=ZERO, stuck=(False, False)
):
    """A stop of two joints."""
    reference = Reference(*np.array([position, velocity, torque]))
    state = np.array(q), np.array(qd), reference.torque, np.array(stuck)
    return CarriedStop(stop_settings(2), reference, *state, Limits())


STOP_ANGLES = st.tuples(*[st.floats(-2.0, 2.0)] * 2)
SPEEDS = st.tuples(*[st.floats(-3.0, 3.0)] * 2)


@given(q=STOP_ANGLES, v=SPEEDS, off=STOP_ANGLES)
def test_it_begins_where_the_joints_were_led_and_ends_at_rest(q, v, off):
    """However far the joints are from it: what held them goes on, with more stiffness."""
    q, v, off = (np.array(x) for x in (q, v, off))
    path = stop(q, v, (1.0, 2.0), q - off, v)
    begin = path(0.0)
    np.testing.assert_allclose(begin.position, q, atol=1e-12)
    held = KP * off + [1.0, 2.0]
    np.testing.assert_allclose(pull(path, begin, q - off), held, atol=1e-9)
    assert np.all(path.stiffness >= 1.0)
    if path.duration > 0.0:
        np.testing.assert_allclose(begin.velocity, v, atol=1e-12)
    path.follow(q - off + 0.5 * v * path.duration, v, 0.0 * v)
    end = path(path.duration)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-12)
    np.testing.assert_allclose(end.position, q + 0.5 * v * path.duration, atol=1e-9)
    assert path.duration == pytest.approx(np.max(np.abs(v)) / 10.0)


def step_by_step(path, q, seconds):
    """Let joints stand at q (2,) while a stop goes on; return its last reference."""
    path.follow(np.array(q), np.zeros(2), np.zeros(2))
    for k in range(round(seconds / PERIOD)):
        reference = path(k * PERIOD)
    return reference


def pull(path, reference, q):
    """What motors make of a reference of a path at q (2,), standing still [N m]."""
    distance = reference.position - np.array(q)
    return KP * path.stiffness * distance + reference.torque


LEANING = (0.0, -0.05)


def leaning(**more):
    """A stop of joints of which the second one is held back."""
    return stop(torque=(2.0, 3.0), q=LEANING, **more)


def test_what_leans_on_an_obstacle_is_given_back():
    path = leaning()
    assert pull(path, path(0.0), LEANING)[1] == pytest.approx(12.0)
    end = step_by_step(path, LEANING, 2.0)
    assert pull(path, end, LEANING)[1] == pytest.approx(3.0, abs=0.05)


def test_what_a_sagging_joint_needs_is_kept():
    """It begins to sink as soon as a part of its torque is given back."""
    path = leaning()
    pull_before = pull(path, step_by_step(path, LEANING, 0.1), LEANING)[1]
    sunk = (0.0, -0.062)
    assert pull(path, step_by_step(path, sunk, 3.0), sunk)[1] > pull_before


def test_a_joint_that_stands_against_its_motor_is_pushed_no_more_at_once():
    path = leaning(stuck=(False, True))
    assert pull(path, path(0.0), LEANING)[1] == pytest.approx(3.0)


SINKING = {"qd": (0.0, -0.3), "q": LEANING}


def test_a_sinking_joint_is_fed_its_load_twice_until_it_stands():
    """Even if it sinks again: it then has what stiffness gives it."""
    path = stop(torque=(2.0, 3.0), **SINKING)
    torques = []
    for k, depth in enumerate((0.05, 0.051, 0.051, 0.055)):
        path.follow(np.array([0.0, -depth]), np.zeros(2), np.zeros(2))
        torques.append(pull(path, path(k * PERIOD), (0.0, -depth))[1])
    held = 3.0 + KP * 0.05
    assert torques[0] == pytest.approx(held + 3.0)
    assert torques[1] > torques[0]
    assert held < torques[2] < torques[1] - 2.9 and torques[3] < held + 9.0


@pytest.mark.parametrize(
    "other",
    [
        {"qd": (0.0, 0.3)},
        {"q": (0.0, 0.05)},
        {"velocity": (0.0, -0.3)},
        {"stuck": (False, True)},
        {"torque": (2.0, -3.0)},
    ],
)
def test_only_a_joint_that_sinks_is_fed_more(other):
    """Not one that rises, is above its path, is led down, is blocked, or presses upwards."""
    options = {**SINKING, "torque": (2.0, 3.0), **other}
    path = stop(**options)
    q = np.array(options["q"])
    is_stuck = options.get("stuck", (False, False))[1]
    held = np.array(options["torque"]) - KP * q * (not is_stuck)
    velocity_part = 0.25 * KD * (path(0.0).velocity - np.array(options["qd"]))
    np.testing.assert_allclose(pull(path, path(0.0), q), held + velocity_part)


def test_an_unknown_place_is_held_as_it_was():
    nowhere = (0.0, float("nan"))
    path = stop((0.0, 0.5), (0.0, 1.0), (2.0, 3.0), nowhere, nowhere)
    path.follow(*np.array([nowhere, nowhere, nowhere]))
    for k in range(200):
        reference = path(k * PERIOD)
    assert np.all(np.isfinite(np.concatenate(reference[:3])))
    np.testing.assert_allclose(reference.torque, [2.0, 3.0])


@pytest.mark.parametrize("cycles_late", [1, 2, 3])
def test_no_energy_goes_into_a_joint_that_was_thrown(cycles_late):
    """However light, heavy or flexible it is, and also where samples are two cycles older.

    Motor and link of each joint are two inertias with a spring between them; both are thrown.
    """
    inertia, motor_share, frequency = np.meshgrid(
        np.geomspace(0.01, 3.0, 8), [0.1, 0.5, 0.9], np.geomspace(3.0, 100.0, 8)
    )
    motor_inertia = (motor_share * inertia).ravel()
    link_inertia = inertia.ravel() - motor_inertia
    reduced_inertia = motor_inertia * link_inertia / inertia.ravel()
    spring = (2.0 * np.pi * frequency.ravel()) ** 2 * reduced_inertia
    energy = thrown_energy(motor_inertia, link_inertia, spring, cycles_late)
    assert np.all(energy <= energy[0] * (1.0 + 1e-6))


def thrown_energy(motor_inertia, link_inertia, spring, cycles_late, step=1e-4):
    """Return the mechanical energy (cycles, n) of n joints that are thrown as a stop begins."""
    n = len(spring)
    zero = np.zeros(n)
    at_rest = Reference(zero, zero, zero)
    state = zero, zero, zero, zero != 0.0
    path = CarriedStop(stop_settings(n), at_rest, *state, Limits())
    q = zero
    qd = np.full(n, 0.5)
    link_q = zero
    link_qd = qd
    commands = [path(0.0)] * cycles_late
    energy = []
    for cycle in range(250):
        motion = motor_inertia * qd**2 + link_inertia * link_qd**2
        energy.append(0.5 * (motion + spring * (q - link_q) ** 2))
        path.follow(q, qd, zero)
        commands.append(path(cycle * PERIOD))
        command = commands.pop(0)
        for _ in range(round(PERIOD / step)):
            push = spring * (link_q - q)
            torque = KP * path.stiffness * (command.position - q)
            torque += command.torque + push
            qd = (qd + step / motor_inertia * torque) / (
                1.0 + step * KD / motor_inertia
            )
            link_qd = link_qd - step / link_inertia * push
            q = q + step * qd
            link_q = link_q + step * link_qd
    return np.array(energy)


@pytest.mark.parametrize(("loads", "is_judged"), [(1.8, False), (2.2, True)])
def test_a_load_is_judged_from_twice_the_torque_that_friction_hides(loads, is_judged):
    """In units of that torque: below, a joint that carries nothing is no fault."""
    joints = (DamiaoJoint("DM4310", 1, 0x11, "elbow"),)
    torque = loads * torque_doubt(joints)
    check = HoldingTorque(joints, lambda q: torque, torque_doubt(joints))
    q = np.zeros(1)
    assert check.unverified_joints(q) == ([] if is_judged else list(joints))
    assert not check.contradicts(q, torque)
    assert not check.contradicts(q, 0.6 * torque_doubt(joints))
    assert check.contradicts(q, 0.0 * torque) == is_judged
    # Against the load it turns the other way.
    assert check.contradicts(q, -torque)


@given(speed=st.floats(0.06, 1.0), moves=st.booleans())
def test_a_stop_ends_soon_where_an_encoder_says_that_its_joint_moves_and_stays(
    speed, moves
):
    """What it holds is not where it says: holding on turns the joint. What moves is held."""
    settings = stop_settings(2)
    zero = np.zeros(2)
    at_rest = Reference(zero, zero, zero)
    path = CarriedStop(settings, at_rest, zero, zero, zero, zero != 0.0, Limits())
    one = np.array([0.0, 1.0])
    time = 0.0
    while not path.is_done and time < 2.0:
        path(time)
        time += PERIOD
        path.follow(moves * speed * time * one, speed * one, zero)
    assert (time >= 2.0) == moves
    assert moves or time < settings.rest_time + 0.5


SINKS = st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=2)


@given(moved=SINKS)
def test_the_weight_of_an_upright_arm_changes_by_no_more_than_its_slopes_say(moved):
    """Those of all poses of the motion."""
    robot = small_arms.robot_of(small_arms.serial_arm((small_arms.Y, small_arms.Y)))
    arm = ArmDynamics(robot)
    upright = np.array([[np.pi / 2, 0.0]])
    if arm.weight_slopes(upright)[0] == 0.0:
        upright = -upright
    still = np.zeros((1, 2))

    def torque(q):
        return arm.torque(q[None], still, still)[0]

    turns = np.linspace(-0.5, 0.5, 11)
    poses = upright + np.stack(np.meshgrid(turns, turns), axis=-1).reshape(-1, 2)
    slope = arm.weight_slopes(poses)
    joints = (DamiaoJoint("DM4340", 1, 0x11), DamiaoJoint("DM4340", 2, 0x12))
    file = HoldingTorque(joints, torque, torque_doubt(joints), upright[0], slope=slope)
    change = torque(upright[0] + moved) - torque(upright[0])
    assert np.all(np.abs(change) <= file.change_of_weight(np.array(moved)) + 1e-9)
    unknown = HoldingTorque(joints, torque, torque_doubt(joints), upright[0])
    assert not np.any(unknown.change_of_weight(np.array(moved)))

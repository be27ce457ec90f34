"""Laws of a joint that is played by itself: exact motions, friction, limits, delays.

A step is 1 ms, of second order: a wave of w rad/s is off by (w h)^2 / 24 of its phase, 2e-5 at 20.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from rigs.logs.servo_tracks import (
    STEP,
    joined,
    numbers_of,
    play_once,
    times_of,
    track_of,
)
from robot_sysid.records import Recording
from robot_sysid.servo.play import KEPT, STEPS, STEPS_PER_SAMPLE, make_tracks, play
from robot_sysid.servo.unknowns import NAMES

AT_REST = np.zeros_like


def draws(count):
    """Random generators of drawn cases."""
    return [np.random.default_rng(seed) for seed in range(count)]


def oscillation(time, start, frequency, ratio):
    """Position and velocity of a free oscillator without damping's overshoot at given times."""
    decay = ratio * frequency
    damped = frequency * np.sqrt(1.0 - ratio**2)
    q0, qd0 = start
    other = (qd0 + decay * q0) / damped
    wave = q0 * np.cos(damped * time) + other * np.sin(damped * time)
    slope = damped * (other * np.cos(damped * time) - q0 * np.sin(damped * time))
    fading = np.exp(-decay * time)
    return fading * wave, fading * (slope - decay * wave)


@pytest.mark.parametrize("rng", draws(5))
def test_a_joint_without_friction_and_limit_is_a_damped_oscillator(rng):
    gain = rng.uniform(5.0, 50.0)
    frequency = rng.uniform(5.0, 20.0)
    ratio = rng.uniform(0.0, 0.8)
    whole = gain / frequency**2
    rotor = rng.uniform(0.1, 0.9) * whole
    begin = (0.3, rng.uniform(-1.0, 1.0))
    _, before = oscillation(-0.5 * STEP, begin, frequency, ratio)
    tracks = track_of(AT_REST, inertia=whole - rotor, start=(begin[0], before))
    numbers = numbers_of(
        gain=gain, armature=rotor / gain, damping=2.0 * ratio / frequency
    )
    expected, _ = oscillation(times_of(tracks), begin, frequency, ratio)
    assert_allclose(play_once(tracks, numbers)[0], expected, atol=2e-4)


@pytest.mark.parametrize("rng", draws(20))
def test_dry_friction_holds_what_it_can_hold(rng):
    """It grows with the load that the gears carry: of the motor and of the links together."""
    gain = 10.0
    goal = rng.uniform(-0.2, 0.2)
    weight = rng.uniform(-2.0, 2.0)
    coulomb = rng.uniform(0.0, 0.1)
    stribeck = rng.uniform(0.0, 0.1)
    share = rng.uniform(0.0, 0.5)
    tracks = track_of(lambda time: goal + 0.0 * time, torque=weight)
    numbers = numbers_of(
        gain=gain, frictionloss=coulomb, stribeck=stribeck, load_share=share
    )
    moved = np.max(np.abs(play_once(tracks, numbers)))
    motor = gain * goal
    friction = gain * (coulomb + stribeck) + share * abs(motor + weight)
    is_held = abs(motor - weight) <= friction
    if is_held:
        assert moved == 0.0
    else:
        assert moved > 1e-3 * (abs(motor - weight) - friction)


def test_stribeck_friction_is_gone_in_motion():
    """A joint that was pushed over it goes on as without it."""
    tracks = track_of(lambda time: 2.0 * (time + 0.1), start=(0.1, 2.0))
    plain = numbers_of(frictionloss=0.05, damping=0.05)
    more = numbers_of(frictionloss=0.05, damping=0.05, stribeck=0.1)
    assert_allclose(play_once(tracks, more), play_once(tracks, plain), atol=1e-4)


@pytest.mark.parametrize("rng", draws(3))
def test_the_limit_over_the_damping_is_the_speed_without_load(rng):
    damping = rng.uniform(0.02, 0.2)
    limit = rng.uniform(1.0, 2.5) * damping
    tracks = track_of(lambda time: 100.0 + 0.0 * time, inertia=0.005)
    numbers = numbers_of(torque_limit=limit, damping=damping)
    q = play_once(tracks, numbers)[0]
    speed = (q[-1] - q[-11]) / (times_of(tracks)[-1] - times_of(tracks)[-11])
    assert speed == pytest.approx(limit / damping, rel=1e-3)


def test_a_servo_at_its_limit_accelerates_by_it():
    tracks = track_of(lambda time: 100.0 + 0.0 * time)
    numbers = numbers_of(torque_limit=0.01)
    # 10 N m/rad times 0.01 rad over 0.02 kg m^2; velocities are half a step before positions.
    time = times_of(tracks)
    expected = 2.5 * time * (time + STEP)
    assert_allclose(play_once(tracks, numbers)[0], expected, rtol=1e-9)


def two_tracks():
    return joined(
        track_of(lambda time: np.sin(5.0 * time), torque=0.3, slope=1.0),
        track_of(lambda time: np.cos(3.0 * time) - 1.0, inertia=0.05, joint=1),
    )


MANY = numbers_of(
    torque_limit=0.2,
    damping=0.03,
    frictionloss=0.02,
    armature=1e-3,
    stribeck=0.01,
    load_share=0.1,
    dead_zone=0.01,
    command_delay=0.0234,
    loop_lag=0.01,
    zero=0.02,
)
"""All that a servo may have."""


def test_tracks_of_two_joints_do_not_touch_one_another():
    tracks = two_tracks()
    both = play_once(tracks, MANY)
    for k in range(2):
        assert_array_equal(play_once(tracks.at(np.array([k])), MANY), both[[k]])
    other = np.vstack((MANY, 1.7 * MANY))
    changed = play_once(tracks, other)
    assert_array_equal(changed[0], both[0])
    assert np.max(np.abs(changed[1] - both[1])) > 0.01


def test_sets_of_numbers_that_are_played_together_do_not_touch_one_another():
    tracks = two_tracks()
    rng = np.random.default_rng(0)
    numbers = MANY * np.exp(0.3 * rng.normal(size=(4, 2, len(NAMES))))
    errors = rng.normal(size=(4, 2, len(tracks.errors)))
    errors[0] = 0.0
    start = 0.1 * rng.normal(size=(4, 2, 2))
    together = play(tracks, numbers, errors, start)
    for k in range(4):
        alone = play(tracks, *(given[[k]] for given in (numbers, errors, start)))
        assert_allclose(alone[0], together[k], atol=1e-12)


@pytest.mark.parametrize("steps", [1, 40, 490])
def test_a_delay_of_whole_steps_shifts_the_commands(steps):
    def waves(time):
        return np.sin(7.0 * time + 1.0)

    late = play_once(track_of(waves), numbers_of(command_delay=steps * STEP))
    shifted = track_of(lambda time: waves(time - steps * STEP))
    assert_allclose(late, play_once(shifted, numbers_of()), atol=1e-12)


def test_a_delay_between_two_steps_leads_between_them():
    tracks = track_of(lambda time: 0.3 * time)
    delays = [0.01, 0.01025, 0.011]
    early, between, late = (
        play_once(tracks, numbers_of(command_delay=delay)) for delay in delays
    )
    assert_allclose(between, early + 0.25 * (late - early), atol=1e-12)


def test_a_loop_with_a_lag_follows_a_ramp_as_if_it_were_late():
    tracks = track_of(lambda time: 0.5 * time, seconds=2.0)
    damped = {"damping": 0.05, "armature": 1e-3}
    lags, is_late = (
        play_once(tracks, numbers_of(**damped, **{name: 0.03}))[0, -20:]
        for name in ("loop_lag", "command_delay")
    )
    # The start of a window is taken for one that the loop has followed.
    assert_allclose(lags, is_late, atol=2e-4)


@pytest.mark.parametrize("zone", [0.01, 0.05])
def test_a_servo_gives_nothing_within_its_dead_zone_and_what_is_beyond_outside(zone):
    tracks = joined(
        track_of(lambda time: 0.009 + 0.0 * time),
        track_of(lambda time: 0.1 + 0.0 * time, torque=0.2, seconds=1.0),
    )
    q = play_once(tracks, numbers_of(dead_zone=zone, damping=0.2))
    assert_array_equal(q[0], 0.0)
    assert q[1, -1] == pytest.approx(0.1 - zone - 0.2 / 10.0, abs=1e-3)


def test_a_zero_turns_the_links_and_not_the_servo():
    tracks = track_of(AT_REST, slope=2.0)
    q = play_once(tracks, numbers_of(zero=0.06, damping=0.2))[0, -1]
    # 10 q + 2 (q + 0.06) = 0.
    assert q == pytest.approx(-0.01, abs=1e-4)


@pytest.mark.parametrize("scale", [0.25, 2.0])
def test_a_gain_by_the_register_leaves_friction_and_rotor(scale):
    """Numbers over the gain are those of the first recording's gain, and so is the limit."""
    tracks = two_tracks()
    scaled = replace(tracks, scale=np.full(2, scale))
    torques = ("torque_limit", "damping", "frictionloss", "stribeck", "armature")
    is_torque = np.isin(NAMES, torques)
    numbers = np.where(is_torque, MANY / scale, MANY)
    numbers = np.where(np.isin(NAMES, "gain"), scale * MANY, numbers)
    assert_allclose(play_once(scaled, MANY), play_once(tracks, numbers), atol=1e-9)
    half = replace(tracks, strength=np.full(2, 0.5))
    weak = np.where(np.isin(NAMES, "torque_limit"), 0.5 * MANY, MANY)
    assert_allclose(play_once(half, MANY), play_once(tracks, weak), atol=1e-12)


def test_a_link_error_is_a_torque_and_an_inertia():
    plain = track_of(np.sin, error=0.3, inertia_error=0.004)
    pushed = track_of(np.sin, torque=0.6, inertia=0.02 + 0.008)
    q = play_once(plain, numbers_of(damping=0.05), errors=2.0)
    assert_allclose(q, play_once(pushed, numbers_of(damping=0.05)), atol=1e-12)


def test_what_diverges_is_as_wrong_as_can_be_and_no_number_is_lost():
    tracks = joined(track_of(AT_REST, start=(0.1, 0.0)), track_of(AT_REST))
    mad = np.vstack((numbers_of(gain=1e9), numbers_of()))
    errors = play_once(tracks, mad)
    assert np.all(np.isfinite(errors))
    assert np.max(np.abs(errors[0])) == pytest.approx(np.pi)
    assert_array_equal(errors[1], 0.0)


# --- tracks of an arm's logs ---------------------------------------------------------------------

PENDULUM = """<mujoco><worldbody><body><joint name="lift" axis="0 1 0"/>
<inertial pos=".1 0 0" mass=".5" diaginertia="1e-3 2e-3 3e-3"/></body></worldbody></mujoco>"""


def slow_waves(rate=100.0, seconds=4.0, n_joints=1):
    time = np.arange(round(seconds * rate)) / rate
    q = np.column_stack([0.5 * np.sin((2.0 + k) * time) for k in range(n_joints)])
    return Recording(time, q, None, 0.0 * q, command=q)


def test_tracks_of_a_pendulum_have_its_weight_and_its_inertia():
    piece = slow_waves()
    tracks = make_tracks(robot_of(PENDULUM), [piece], 1.0, 60)
    weight = 0.5 * 9.81 * 0.1
    assert_allclose(tracks.inertia, 2e-3 + 0.5 * 0.1**2, rtol=1e-9)
    # A turn about y lowers the mass: weight helps it.
    assert_allclose(tracks.torque, -weight * np.cos(tracks.middle), rtol=1e-3)
    assert_allclose(tracks.slope, weight * np.sin(tracks.middle), atol=1e-3 * weight)


@pytest.mark.parametrize(("window", "count"), [(1.0, 4), (3.0, 1), (9.0, 1)])
def test_windows_hold_each_sample_and_begin_as_measured(window, count):
    piece = slow_waves()
    tracks = make_tracks(robot_of(PENDULUM), [piece], window, 60)
    assert len(tracks) == count
    # The last sample of a window is the first one of the next.
    assert np.sum(tracks.is_sample) == len(piece) + count - 1
    measured = np.concatenate(
        [
            row[is_sample][:-1]
            for row, is_sample in zip(tracks.measured, tracks.is_sample)
        ]
    )
    assert_array_equal(measured, piece.q[:-1, 0])
    assert_array_equal(tracks.start[0], tracks.measured[:, 0])
    steps = tracks.sample + tracks.share
    between = np.diff(steps[tracks.is_sample])[:50] * tracks.step * KEPT
    assert_allclose(between, 0.01, rtol=1e-6)


@pytest.mark.parametrize("rate", [25.0, 50.0, 70.0, 200.0])
def test_steps_follow_the_samples_within_bounds(rate):
    tracks = make_tracks(robot_of(PENDULUM), [slow_waves(rate)], 1.0, 60)
    step = 1.0 / (rate * STEPS_PER_SAMPLE)
    assert tracks.step == pytest.approx(np.clip(step, *STEPS), rel=1e-9)


def test_of_many_windows_some_are_played():
    pieces = [slow_waves(seconds=8.0), slow_waves(seconds=8.0)]
    tracks = make_tracks(robot_of(PENDULUM), pieces, 1.0, 5)
    assert len(tracks) == 5
    # From the first to the last.
    assert tracks.start[0, 0] == pieces[0].q[0, 0]
    last = tracks.measured[-1][tracks.is_sample[-1]]
    assert last[-1] == pieces[1].q[-1, 0]


TWO = """<mujoco><option timestep="1e-3"/><worldbody><body>
<joint name="pan" axis="0 0 1" armature=".02"/>
<inertial pos="0 0 .05" mass=".2" diaginertia="2e-4 2e-4 2e-4"/><body pos="0 0 .1">
<joint name="lift" axis="0 1 0" armature=".02"/>
<inertial pos=".12 0 .02" mass=".3" diaginertia="2e-4 5e-4 5e-4"/></body></body></worldbody>
<actuator><position joint="pan" kp="20"/><position joint="lift" kp="20"/></actuator></mujoco>"""


def from_rest(tracks):
    """What starts differ by from those at rest."""
    return np.stack((np.zeros(len(tracks)), -tracks.start[1]))


@pytest.mark.parametrize(
    ("limit", "friction", "share", "tolerance"),
    [
        (np.inf, 0.0, 0.0, 5e-4),
        (np.inf, 0.0, 1.0, 5e-4),
        (0.9, 0.05, 0.0, 2.5e-3),
        (0.9, 0.05, 0.6, 2.5e-3),
    ],
)
def test_a_joint_beside_one_that_stands_is_played_as_mujoco_plays_it(
    limit, friction, share, tolerance
):
    """Commands are neither early nor late: half a millisecond would be 1.5 mrad.

    MuJoCo's dry friction creeps before it slides, however firmly it holds.
    """
    robot = robot_of(TWO)
    numbers = [[20.0, 20.0], [0.5, 0.5], [1.0, friction], [0.02, 0.02]]
    truth = servo_logs.servos(numbers, 0.03, limit)
    truth = replace(
        truth, firmness=np.full(2, 0.999), servo_damping=np.full(2, 0.5 * share)
    )
    rate = 200.0
    time = np.arange(round(2.0 * rate)) / rate
    command = np.column_stack((0.0 * time, 0.5 * np.sin(6.0 * time)))
    command[len(time) // 2 :, 1] += 0.3
    # At its limit MuJoCo's servo is as right as its steps are short.
    q = servo_logs.exact_positions(robot, time, command, truth, steps=300)
    assert np.ptp(q[:, 0]) < 1e-3 < 0.5 < np.ptp(q[:, 1])
    piece = Recording(time, q, None, command - q, command=command)
    tracks = make_tracks(robot, [piece], 2.0, 60)
    over_gain = {
        "gain": 20.0,
        "torque_limit": min(limit, 1e3) / 20.0,
        "damping": 0.5 / 20.0,
        "limited_damping": share,
        "armature": 0.02 / 20.0,
        "command_delay": 0.03,
    }
    both = np.vstack(
        [
            numbers_of(**over_gain, frictionloss=loss / 20.0)
            for loss in (numbers[2][0], friction)
        ]
    )
    # It begins at rest, which low-passed positions do not show at their end.
    errors = play_once(tracks, both, start=from_rest(tracks)) - tracks.measured
    assert np.max(np.abs(errors)) < tolerance

"""Motor trajectories whose positions, velocities and torques agree, and others."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms.small_arms import SEEDS
from rigs.motors.damiao_rig import rest_to_rest, trajectory_file, trajectory_of
from robot_sysid.damiao.checks.motion import motion_checks
from robot_sysid.damiao.checks.preflight import plan_checks
from robot_sysid.damiao.joints import peak_torques
from robot_sysid.damiao.settings import Plan
from robot_sysid.records.messages import Level
from robot_sysid.trajectory import SineTrajectory, motion_chunks

RATES = st.sampled_from([50.0, 100.0, 125.0, 250.0, 300.0, 333.0, 500.0, 1000.0])
N_JOINTS = 3
JOINTS = st.integers(0, N_JOINTS - 1)
# Of the rows, far enough from both ends for the arm to move.
PLACES = st.floats(0.15, 0.85)
DRY_FRICTION = np.array([2.0, 1.0, 0.5])
INERTIA = np.array([0.8, 0.4, 0.2])


def smooth_motion(rate, seed, seconds=3.0):
    """Rows of three joints from rest to rest, up to 2 Hz, rounded as the export writes them.

    The torque has gravity, inertia, coupling, and dry friction that turns at turns.
    """
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.05, 0.3, (3, 1, N_JOINTS))
    amplitude *= rng.choice([-1.0, 1.0], amplitude.shape)
    turns = rng.integers(1, 7, amplitude.shape)
    time, *signals = rest_to_rest(amplitude, turns, seconds, rate)
    q, qd, qdd = np.sum(signals, axis=1)
    tau = 5.0 * np.sin(q + 0.5) + INERTIA * qdd + 0.1 * qdd.sum(axis=1, keepdims=True)
    return time, q, qd, tau + DRY_FRICTION * np.sign(np.round(qd, 9))


def rounded(motion, decimals=4):
    time, *signals = motion
    return trajectory_of((time, *(np.round(signal, decimals) for signal in signals)))


def refusals(trajectory):
    checks = list(motion_checks(trajectory))
    assert all(check.level is Level.REFUSES for check in checks)
    return [check.text for check in checks]


def differences(time, q, kind):
    """Velocities (N, n) that somebody makes of positions."""
    slopes = np.diff(q, axis=0) / np.diff(time)[:, None]
    still = np.zeros((1, q.shape[1]))
    made = {
        "forward": np.vstack([slopes, still]),
        "backward": np.vstack([still, slopes]),
        "central": np.gradient(q, time, axis=0),
    }
    return made[kind]


# --- honest files -------------------------------------------------------------------------------


@given(rate=RATES, seed=SEEDS, decimals=st.sampled_from([3, 4, 9]))
def test_a_smooth_motion_passes_at_any_rate(rate, seed, decimals):
    """Times in milliseconds too, where steps of 1/300 s become 3 and 4 ms."""
    time, *signals = smooth_motion(rate, seed)
    assert refusals(rounded((time, *signals), decimals)) == []
    assert refusals(rounded((np.round(time, 3), *signals), decimals)) == []


@given(rate=RATES, seed=SEEDS, kind=st.sampled_from(["forward", "backward", "central"]))
def test_velocities_made_of_differences_pass(rate, seed, kind):
    time, q, _, tau = smooth_motion(rate, seed)
    q = np.round(q, 4)
    assert refusals(rounded((time, q, differences(time, q, kind), tau))) == []


@given(seed=SEEDS, rate=st.sampled_from([50.0, 250.0, 1000.0]))
def test_what_the_export_writes_of_an_excitation_passes(seed, rate, tmp_path_factory):
    rng = np.random.default_rng(seed)
    coefficients = rng.uniform(-0.25, 0.25, (2, 2, 4))
    plan = SineTrajectory(
        np.zeros(2), *coefficients, rng.uniform(0.5, 6.0, (2, 4)), 3.0, 0.5
    )
    chunks = (
        (motion.time, motion.q, motion.qd, 2.0 * motion.qdd / 10.0 + np.sign(motion.qd))
        for motion in motion_chunks(plan, rate)
    )
    folder = tmp_path_factory.mktemp("export")
    motion = [np.concatenate(signal) for signal in zip(*chunks)]
    assert refusals(trajectory_file(folder, motion)) == []


def trapezoid(rate, speed=0.8, acceleration=2.0):
    """Rows of a joint that goes 1 rad with steady accelerations, waits, and goes back."""
    time = np.arange(0.0, 5.0 + 0.5 / rate, 1.0 / rate)
    fine = np.arange(0.0, 5.0, 1e-4)
    rise = speed / acceleration
    run = 1.0 / speed

    def profile(since):
        return np.interp(since, [0.0, rise, run, run + rise], [0.0, speed, speed, 0.0])

    velocity = profile(fine - 0.2) - profile(fine - 2.6)
    position = np.append(0.0, np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * 1e-4))
    q = np.interp(time, fine, position)[:, None]
    qd = np.interp(time, fine, velocity)[:, None]
    slopes = np.interp(time, fine, np.gradient(velocity, fine))[:, None]
    return time, q, qd, 3.0 * slopes + 2.0 * np.sign(np.round(qd, 6))


@pytest.mark.parametrize("rate", [5.0, 10.0, 13.0, 50.0, 500.0])
def test_ramps_with_steady_accelerations_pass(rate):
    """Made by hand, at few rows per second: what lies between two rows is not known."""
    assert refusals(rounded(trapezoid(rate))) == []


def test_a_pause_of_the_clock_where_the_arm_stands_passes():
    time, *signals = smooth_motion(100.0, 0)
    twice = [np.vstack([signal, signal]) for signal in signals]
    later = np.append(time, time + time[-1] + 5.0)
    assert refusals(rounded((later, *twice))) == []


def test_a_recorded_motion_passes():
    """What motors report has steps of 0.0004 rad and 0.005 rad/s."""
    time, q, qd, tau = smooth_motion(250.0, 3)
    q = 25.0 / 65535 * np.round(q * 65535 / 25.0)
    qd = 20.0 / 4095 * np.round(qd * 4095 / 20.0)
    assert refusals(trajectory_of((time, q, qd, tau))) == []


def test_an_arm_that_stands_passes():
    still = np.full((2, 3), 0.7)
    motion = np.array([0.0, 5.0]), still, 0.0 * still, still
    assert refusals(trajectory_of(motion)) == []


# --- files that contradict themselves -----------------------------------------------------------


@given(
    rate=RATES, seed=SEEDS, joint=JOINTS, factor=st.sampled_from([-1.0, 0.0, 0.8, 1.25])
)
def test_a_velocity_of_another_scale_is_refused_at_its_joint(rate, seed, joint, factor):
    time, q, qd, tau = smooth_motion(rate, seed)
    qd[:, joint] *= factor
    (text,) = refusals(rounded((time, q, qd, tau)))
    assert text.startswith(f"motor {joint + 1}: the velocity in the file is not")
    assert "export the file again" in text


@given(rate=RATES, seed=SEEDS)
def test_velocities_of_another_joint_are_refused(rate, seed):
    time, q, qd, tau = smooth_motion(rate, seed)
    texts = refusals(rounded((time, q, np.roll(qd, 1, axis=1), tau)))
    assert len(texts) == N_JOINTS
    assert all("is not the slope" in text for text in texts)


@given(rate=RATES, seed=SEEDS, factor=st.sampled_from([0.5, 0.8, 1.25, 2.0]))
def test_times_that_all_velocities_contradict_are_named_as_times(rate, seed, factor):
    time, *signals = smooth_motion(rate, seed)
    (text,) = refusals(rounded((factor * time, *signals)))
    assert f"its times are {factor:.2g} of what its velocities say" in text


@given(
    rate=RATES,
    seed=SEEDS,
    joint=JOINTS,
    place=PLACES,
    side=st.sampled_from([-1.0, 1.0]),
)
def test_one_row_aside_is_refused_at_its_time(rate, seed, joint, place, side):
    time, q, qd, tau = smooth_motion(rate, seed)
    row = round(place * len(time))
    q[row, joint] += 0.03 * side
    (text,) = refusals(rounded((time, q, qd, tau)))
    assert text.startswith(f"motor {joint + 1}: ")
    (named,) = re.findall(r"at (\d+\.\d+) s", text)
    # Seen when it comes, and up to the row behind it.
    assert -1e-3 <= float(named) - time[row] <= 1.0 / rate + 1e-3


@given(
    rate=st.sampled_from([100.0, 250.0, 500.0]), seed=SEEDS, joint=JOINTS, place=PLACES
)
def test_one_row_aside_is_refused_where_velocities_were_made_of_it(
    rate, seed, joint, place
):
    time, q, _, tau = smooth_motion(rate, seed)
    row = round(place * len(time))
    q[row, joint] += 0.03
    motion = time, q, differences(time, q, "central"), tau
    texts = refusals(rounded(motion))
    assert len(texts) == 1 and texts[0].startswith(f"motor {joint + 1}: ")


@given(rate=RATES, seed=SEEDS, joint=JOINTS, place=PLACES)
def test_a_velocity_aside_is_refused(rate, seed, joint, place):
    """1 rad/s in one row, which moves the joint by 1 mrad at 1000 Hz."""
    time, q, qd, tau = smooth_motion(rate, seed)
    qd[round(place * len(time)), joint] += 1.0
    (text,) = refusals(rounded((time, q, qd, tau)))
    assert text.startswith(f"motor {joint + 1}: the velocity in the file is not")


@given(rate=st.sampled_from([100.0, 250.0, 500.0, 1000.0]), seed=SEEDS, joint=JOINTS)
def test_a_step_of_velocity_is_refused_where_positions_follow_it(rate, seed, joint):
    """2 rad/s from one row to the next."""
    time, q, qd, tau = smooth_motion(rate, seed)
    middle = len(time) // 2
    since = np.maximum(time - time[middle], 0.0)
    q[:, joint] += 2.0 * since
    qd[:, joint] += 2.0 * (since > 0.0)
    (text,) = refusals(rounded((time[:-50], q[:-50], qd[:-50], tau[:-50])))
    assert text.startswith(f"motor {joint + 1}: the ")


@given(rate=RATES, seed=SEEDS, joint=JOINTS, place=st.floats(0.0, 0.93))
def test_a_fifth_of_a_second_at_a_motors_peak_is_refused(rate, seed, joint, place):
    motion = smooth_motion(rate, seed)
    peaks = peak_torques(trajectory_of(motion).joints)
    first = round(place * len(motion[0]))
    motion[3][first : first + round(0.2 * rate), joint] = peaks[joint]
    (text,) = refusals(rounded(motion))
    assert text.startswith(f"motor {joint + 1}: the torque in the file is 27 N·m at ")
    (named,) = re.findall(r"at (\d+\.\d+) s", text)
    assert first / rate - 1e-3 <= float(named) <= first / rate + 0.2


# --- how it is said -----------------------------------------------------------------------------


def test_the_line_of_the_file_is_named(tmp_path):
    time, q, qd, tau = smooth_motion(250.0, 1)
    q[300, 1] += 0.03
    trajectory = trajectory_file(tmp_path, (time, q, qd, tau))
    (text,) = refusals(trajectory)
    (line, moment) = re.findall(r"line (\d+) \((.*?) s\)", text)[0]
    cells = trajectory.path.read_text().splitlines()[int(line) - 1].split(",")
    assert float(cells[0]) == float(moment) == 1.2
    assert float(cells[4]) == pytest.approx(q[300, 1], abs=1e-4)


def test_a_plan_is_refused_and_each_joint_named_once():
    time, q, qd, tau = smooth_motion(250.0, 2)
    trajectory = rounded((time, q, qd * [1.0, -1.0, 0.0], tau))
    texts = [
        check.text for check in plan_checks(Plan(trajectory)) if "slope" in check.text
    ]
    assert [text.partition(":")[0] for text in texts] == ["motor 2", "motor 3"]
    assert refusals(replace(trajectory, qd=qd)) == []

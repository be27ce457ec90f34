"""Shifts of a joint are found by torques; wrong links, loads and real arms are left alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.files.places import DATA
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.safety.holding import gravity_holding
from robot_sysid.damiao.safety.position_shift import PositionShift
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording

ZERO_JOINTS = damiao_joints(["DM4340", "DM4340", "DM4310"], 3)
PERIOD = 0.02


def play_motion(
    robot, seed, links=0.0, load=0.0, shift=0.0, slip=0.0, since=0.0, seconds=8.0
):
    """What a run of an arm shows whose links are off by a share.

    The middle joint is off by an angle ``shift`` [rad]; from a moment [s] on it slips, with a speed
    [rad/s], and the arm carries a load [kg].
    """
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, PERIOD)
    omega = 2.0 * np.pi * random.uniform(0.15, 0.5, (3, 1, 3))
    phase = omega * time[:, None] + random.uniform(0.0, 6.0, (3, 1, 3))
    q = 0.3 * np.sin(phase).sum(axis=0)
    qd = 0.3 * (omega * np.cos(phase)).sum(axis=0)
    qdd = -0.3 * (omega**2 * np.sin(phase)).sum(axis=0)
    thetas = robot.thetas * (1.0 + links * random.normal(size=(3, 1)))
    loaded = thetas.copy()
    loaded[-1, 0] += load
    slipped = shift + slip * np.maximum(time - since, 0.0)
    dynamics = LinkDynamics(robot)
    motion = dynamics.motion(q + np.outer(slipped, [0.0, 1.0, 0.0]), qd, qdd)
    is_loaded = (time >= since)[:, None]
    tau = np.where(is_loaded, motion.torque(loaded), motion.torque(thetas))
    tau += 0.3 * np.tanh(qd / 0.02) + 0.05 * random.normal(size=tau.shape)
    return Recording(time, q, qd, tau)


def finding(robot, run):
    """When a run is found wrong [s], the joint, and its shift [rad]; None where it never is."""
    check = gravity_holding(robot, ZERO_JOINTS).position_shift()
    for time, q, qd, tau in zip(run.time, run.q, run.qd, run.tau):
        finding_now = check(time, q, qd, tau)
        if finding_now is not None:
            return time, *finding_now
    return None


def heavy(axes):
    """An arm whose links weigh enough to load its motors."""
    mj_model = small_arms.compile_xml(small_arms.serial_arm(axes))
    mj_model.body_mass[:] *= 10.0
    mj_model.body_inertia[:] *= 10.0
    return small_arms.robot_of(mj_model)


SEEDS = [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 10))]
"""Motions, links and noise; the slow ones repeat the others with other draws."""


@pytest.fixture
def arm():
    """An arm on a vertical axis."""
    return heavy((small_arms.Z, small_arms.Y, small_arms.X))


@pytest.fixture
def mounted_arm():
    """An arm at a wall: gravity loads all of its joints, so that a load is told from a slip."""
    return heavy((small_arms.X, small_arms.Y, small_arms.Z))


@pytest.mark.parametrize("seed", SEEDS[:5])
@pytest.mark.parametrize("angle", [-0.3, 0.3])
def test_a_moved_zero_is_found(arm, seed, angle):
    _, joint, shift = finding(arm, play_motion(arm, seed, 0.15, shift=angle))
    assert joint == 1 and shift == pytest.approx(angle, abs=0.15)


@pytest.mark.parametrize("seed", SEEDS[:5])
@pytest.mark.parametrize("speed", [-0.3, 0.3])
def test_a_gear_that_slips_is_found_while_it_slips(mounted_arm, seed, speed):
    run = play_motion(mounted_arm, seed, 0.15, slip=speed, since=4.0)
    time, joint, shift = finding(mounted_arm, run)
    assert 4.0 < time < 6.5 and joint == 1
    assert shift == pytest.approx(speed * (time - 4.0), abs=0.2)


@pytest.mark.parametrize("seed", SEEDS[:5])
@pytest.mark.parametrize("speed", [-0.06, 0.06])
def test_a_position_that_drifts_slowly_is_found(mounted_arm, seed, speed):
    """Before it is 0.25 rad off."""
    run = play_motion(mounted_arm, seed, 0.15, slip=speed, since=2.0)
    time, joint, shift = finding(mounted_arm, run)
    assert 2.0 < time < 2.0 + 0.25 / abs(speed) and joint == 1
    assert shift == pytest.approx(speed * (time - 2.0), abs=0.1)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("load", "since"), [(0.0, 0.0), (2.0, 0.0), (2.0, 4.0)])
def test_links_and_loads_that_are_off_are_no_moved_zero(arm, seed, load, since):
    assert finding(arm, play_motion(arm, seed, 0.2, load, since=since)) is None


def test_a_short_run_says_nothing(arm):
    assert finding(arm, play_motion(arm, 0, shift=0.5, seconds=1.5)) is None


def test_an_arm_that_stands_says_nothing(arm):
    """Dry friction holds it, with any torque."""
    run = play_motion(arm, 0, shift=0.5)
    first = np.zeros(len(run), int)
    still = replace(run, q=run.q[first], qd=0.0 * run.qd, tau=run.tau[first])
    assert finding(arm, still) is None


def test_cycles_without_an_answer_are_left_out(arm):
    run = play_motion(arm, 0, 0.15, shift=0.3)
    q = run.q.copy()
    q[::7] = np.nan
    _, joint, _ = finding(arm, SimpleNamespace(**{**vars(run), "q": q}))
    assert joint == 1


LWR4_PEAK = (176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0)
UR10E_PEAK = (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)
LWR4 = "kuka_lwr4/lwr4_hw{}_200Hz.csv", "kuka_lwr4/kuka_lwr4.urdf", LWR4_PEAK
LOGS = (
    (LWR4[0].format(1), *LWR4[1:]),
    # Two more logs of the same arm.
    pytest.param(LWR4[0].format(2), *LWR4[1:], marks=pytest.mark.slow),
    pytest.param(LWR4[0].format(3), *LWR4[1:], marks=pytest.mark.slow),
    *(
        (f"ur10e_payload/{name}_100Hz.csv", "ur10e_payload/ur10e.urdf", UR10E_PEAK)
        for name in ("empty", "loaded_2p805kg")
    ),
)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="logs of real arms are not here")
@pytest.mark.parametrize(("log", "model", "peak"), LOGS)
def test_a_real_arm_that_nothing_happens_to_is_left_alone(log, model, peak):
    """With friction and rotors that no model has, and with a table of links that is wrong."""
    table = np.loadtxt(DATA / log, delimiter=",", skiprows=1)
    time = table[:, 0]
    q, tau = np.split(table[:, 1:], 2, axis=1)
    smoother = np.hanning(2 * round(0.04 / np.median(np.diff(time))) + 1)
    smooth = [np.convolve(column, smoother / smoother.sum(), "same") for column in q.T]
    qd = np.gradient(np.array(smooth), time, axis=1).T
    robot = load_robot_model(DATA / model)
    doubt = 0.06 * np.array(peak) + robot.friction.largest_dry
    check = PositionShift(robot, doubt)
    inside = slice(len(smoother), -len(smoother))
    cycles = zip(time[inside], q[inside], qd[inside], tau[inside])
    assert not any(check(*cycle) for cycle in cycles)

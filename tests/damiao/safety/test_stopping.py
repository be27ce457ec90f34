"""How an arm is stopped: braked from where it was led, and carried."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.references import CarriedStop, Reference, StopStart
from robot_sysid.damiao.safety.guards import CommandRange

FAR = CommandRange(np.full(2, -9.0), np.full(2, 9.0), np.full(2, 9.0))
KP = 180.0
KD = 4.5
PERIOD = 0.004


def stop(
    position, velocity, torque, q, qd, fed=None, stuck=(False, False), command_range=FAR
):
    """A stop of two joints."""
    reference = Reference(
        *(np.array(x, dtype=float) for x in (position, velocity, torque))
    )
    start = StopStart(
        reference,
        np.array(q, dtype=float),
        np.array(qd, dtype=float),
        np.array(torque if fed is None else fed, dtype=float),
        np.full(2, KP),
        np.full(2, KD),
        np.array(stuck),
        command_range,
    )
    return CarriedStop(start, 10.0, PERIOD, 0.3)


ANGLES = st.tuples(*[st.floats(-2.0, 2.0)] * 2)
SPEEDS = st.tuples(*[st.floats(-3.0, 3.0)] * 2)


@given(q=ANGLES, v=SPEEDS, off=ANGLES)
def test_it_begins_where_the_joints_were_led_and_ends_at_rest(q, v, off):
    """However far the joints are from it: what held them goes on."""
    q, v, off = (np.array(x) for x in (q, v, off))
    path = stop(q, v, (1.0, 2.0), q - off, v)
    begin = path(0.0)
    np.testing.assert_allclose(begin.position, q, atol=1e-12)
    np.testing.assert_allclose(begin.torque, [1.0, 2.0], atol=1e-12)
    if path.duration > 0.0:
        np.testing.assert_allclose(begin.velocity, v, atol=1e-12)
    path.q = q - off + 0.5 * v * path.duration
    end = path(path.duration)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-12)
    np.testing.assert_allclose(end.position, q + 0.5 * v * path.duration, atol=1e-9)
    assert path.duration == pytest.approx(np.max(np.abs(v)) / 10.0)


def test_a_joint_that_was_slower_brakes_from_its_own_speed():
    path = stop((0.0, 0.0), (1.0, 1.0), (0.0, 0.0), (0.0, 0.0), (0.4, -0.5))
    np.testing.assert_allclose(path(0.0).velocity, [0.4, 0.0])


def test_it_stays_within_the_range():
    narrow_range = CommandRange(np.full(2, -1.0), np.full(2, 1.0), np.full(2, 9.0))
    path = stop(
        (0.9, 0.0),
        (2.0, 0.0),
        (0.0, 0.0),
        (0.9, 0.0),
        (2.0, 0.0),
        command_range=narrow_range,
    )
    assert path(path.duration).position[0] == 1.0


def step_by_step(path, q, seconds):
    """Let joints stand at q (2,) while a stop goes on; return its last reference."""
    path.q = np.array(q)
    path.qd = np.zeros(2)
    for k in range(round(seconds / PERIOD)):
        reference = path(k * PERIOD)
    return reference


def pull(reference, q):
    """What motors make of a reference at q (2,), standing still [N m]."""
    return KP * (reference.position - np.array(q)) + reference.torque


def test_what_leans_on_an_obstacle_is_given_back():
    q = (0.0, -0.05)
    path = stop((0.0, 0.0), (0.0, 0.0), (2.0, 3.0), q, (0.0, 0.0))
    assert pull(path(0.0), q)[1] == pytest.approx(12.0)
    assert pull(step_by_step(path, q, 2.0), q)[1] == pytest.approx(3.0, abs=0.05)


def test_what_a_sagging_joint_needs_is_kept():
    """It begins to sink as soon as a part of its torque is given back."""
    q = (0.0, -0.05)
    path = stop((0.0, 0.0), (0.0, 0.0), (2.0, 3.0), q, (0.0, 0.0))
    pull_before = pull(step_by_step(path, q, 0.1), q)[1]
    sunk = (0.0, -0.062)
    assert pull(step_by_step(path, sunk, 3.0), sunk)[1] > pull_before


def test_a_joint_that_stands_against_its_motor_is_pushed_no_more_at_once():
    q = (0.0, -0.05)
    path = stop((0.0, 0.0), (0.0, 0.0), (2.0, 3.0), q, (0.0, 0.0), stuck=(False, True))
    assert pull(path(0.0), q)[1] == pytest.approx(3.0)


@given(st.floats(0.002, 0.2), st.sampled_from([-1.0, 1.0]))
def test_a_joint_that_leaves_its_way_is_held_stiffer(away, side):
    path = stop((0.0, 0.0), (0.0, 0.0), (2.0, 3.0), (0.0, 0.0), (0.0, 0.0))
    path(0.0)
    path.q = np.array([0.0, side * away])
    path.qd = np.array([0.0, side * 2.0])
    leaving = pull(path(PERIOD), path.q)[1] - 3.0
    path.qd = -path.qd
    coming = pull(path(2 * PERIOD), path.q)[1] - 3.0
    assert leaving * side < -1.5 * KP * away
    # On the way back it takes energy away: it is damped, and pulled less.
    assert abs(coming) < abs(leaving) and coming * side > leaving * side


def test_an_unknown_place_is_held_as_it_was():
    nowhere = (0.0, float("nan"))
    path = stop((0.0, 0.5), (0.0, 1.0), (2.0, 3.0), nowhere, nowhere)
    path.q = path.qd = np.array(nowhere)
    for k in range(200):
        reference = path(k * PERIOD)
    assert np.all(np.isfinite(np.concatenate(reference)))
    np.testing.assert_allclose(reference.torque, [2.0, 3.0])


def test_it_is_at_rest_when_the_joints_have_stood():
    path = stop((0.0, 0.0), (1.0, 0.0), (0.0, 0.0), (0.0, 0.0), (1.0, 0.0))
    path.qd = np.array([0.2, 0.0])
    for moment in (0.0, 0.1, 0.5, 0.9):
        path(moment)
        assert not path.is_at_rest
    path.qd = np.zeros(2)
    path(1.1)
    assert not path.is_at_rest
    path(1.25)
    assert path.is_at_rest


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
    far = np.full(n, 9.0)
    zero = np.zeros(n)
    stop_start = StopStart(
        reference=Reference(zero, zero, zero),
        q=zero,
        qd=zero,
        fed=zero,
        kp=np.full(n, KP),
        kd=np.full(n, KD),
        stuck=np.zeros(n, dtype=bool),
        command_range=CommandRange(-far, far, far),
    )
    path = CarriedStop(stop_start, 10.0, PERIOD, 0.3)
    q = zero
    qd = np.full(n, 0.5)
    link_q = zero
    link_qd = qd
    commands = [path(0.0)] * cycles_late
    energy = []
    for cycle in range(250):
        motion = motor_inertia * qd**2 + link_inertia * link_qd**2
        energy.append(0.5 * (motion + spring * (q - link_q) ** 2))
        path.q = q
        path.qd = qd
        commands.append(path(cycle * PERIOD))
        command = commands.pop(0)
        for _ in range(round(PERIOD / step)):
            push = spring * (link_q - q)
            torque = KP * (command.position - q) + command.torque + push
            qd = (qd + step / motor_inertia * torque) / (
                1.0 + step * KD / motor_inertia
            )
            link_qd = link_qd - step / link_inertia * push
            q = q + step * qd
            link_q = link_q + step * link_qd
    return np.array(energy)

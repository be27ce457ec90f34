"""A motor that turns against its command is told from one that is weak, and from a push."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from robot_sysid.damiao.joints import damiao_joints, no_load_speeds, peak_torques
from robot_sysid.damiao.safety.reversal import Reversal

JOINTS = damiao_joints(["DM4340"] * 2, 2)
PEAK = peak_torques(JOINTS)[0]
INERTIA = 0.5
STEP = 1e-4
VELOCITY_STEP = 20.0 / 4095
BRAKED_SPEED = 0.3 * no_load_speeds(JOINTS)[0]
"""From which on a motor's windings brake with about its peak torque [rad/s]."""


def search_after(
    seconds,
    rate=250.0,
    *,
    sign=1.0,
    counts=1.0,
    load=0.0,
    kp=100.0,
    push=None,
    beside=0.0,
):
    """Return whether the second joint's motor is found after something has gone wrong for so long.

    Its torque is ``sign`` times that of its law, its encoder counts ``counts`` times, its weight is
    ``load`` [N m], and ``push(t)`` [N m] acts on it. The joint ``beside`` it is thrown about with
    up to so much [rad/s] against its motor's peak torque.
    """
    reversal = Reversal(JOINTS)
    kd = kp / 40.0
    # An encoder that counts backwards begins where it is, and friction has left it a little off.
    q, qd = 1e-3, 0.0
    seen = 0.0
    time = -0.1
    for k in range(-round(0.1 * rate), round(seconds * rate) + 1):
        while time < k / rate:
            now = (counts, sign) if time >= 0.0 else (1.0, 1.0)
            seen = now[0] * q
            torque = kp * (0.0 - seen) - kd * now[0] * qd + load
            torque = min(max(torque, -PEAK), PEAK)
            pushed = push(time) if push and time >= 0.0 else 0.0
            qd += STEP * (now[1] * torque - load + pushed) / INERTIA
            q += STEP * qd
            time += STEP
        counted = counts if k >= 0 else 1.0
        speed = np.round(counted * qd / VELOCITY_STEP) * VELOCITY_STEP
        off = counted * q
        law = -kp * off - kd * speed + load
        thrown = beside * np.cos(0.5 * (k - seconds * rate))
        reversal.add(
            k / rate,
            np.array([0.0, off]),
            np.array([thrown, speed]),
            np.zeros(2),
            np.array([-np.copysign(PEAK, thrown) if beside else 0.0, law]),
            np.array([0.0, load]),
        )
    found = reversal.search(np.full(2, INERTIA))
    assert not found[0]
    return bool(found[1])


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
@pytest.mark.parametrize(
    "wrong",
    [{"sign": -1.0, "load": 6.0}, {"sign": -1.0, "load": -4.0}, {"counts": -1.0}],
)
def test_a_motor_that_turns_against_its_command_is_found(rate, wrong):
    assert any(
        search_after(k / rate, rate, **wrong) for k in range(2, round(0.5 * rate))
    )


@given(
    share=st.floats(0.2, 1.0),
    load=st.floats(3.0, 12.0),
    seconds=st.floats(0.02, 0.15),
    kp=st.floats(60.0, 300.0),
)
def test_a_weak_motor_is_not(share, load, seconds, kp):
    """Unless its load drives it so fast that it is better off without the motor."""
    falling_speed = (1.0 - share) * load / INERTIA * seconds
    assume(falling_speed < BRAKED_SPEED)
    assert not search_after(seconds, sign=share, load=load, kp=kp)


@given(
    force=st.floats(-15.0, 15.0),
    rise=st.floats(0.005, 0.1),
    seconds=st.floats(0.02, 0.15),
)
def test_a_push_is_not(force, rise, seconds):
    assert not search_after(seconds, push=lambda t: force * min(t / rise, 1.0))


def test_none_is_beside_a_joint_that_is_thrown_with_more_power():
    # Both motors are the same, and neither makes more than its peak torque.
    moments = [k / 250.0 for k in range(2, 100)]
    alone = [search_after(t, sign=-1.0, load=6.0) for t in moments]
    found_at = moments[alone.index(True)]
    assert not search_after(found_at, sign=-1.0, load=6.0, beside=1.5)
    assert search_after(found_at, sign=-1.0, load=6.0, beside=0.4)


def test_after_a_motor_was_switched_off_what_moves_then_is_not_judged():
    reversal = Reversal(JOINTS)
    reversal.restart(0.0)
    for k in range(10):
        speed = np.array([0.0, 5.0 * k])
        reversal.add(0.01 * k, 0.1 * speed, speed, 0.0 * speed, -speed, 0.0 * speed)
    assert not np.any(reversal.search(np.full(2, INERTIA)))


def test_a_weak_motor_that_its_load_drives_fast_is_better_off():
    # The message of a run names this cause, too.
    seconds = 0.5
    assert search_after(seconds, sign=0.1, load=20.0)

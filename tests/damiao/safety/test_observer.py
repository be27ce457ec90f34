"""What stops a run: a sample out of order, signals that disagree, and which cause is named."""

from __future__ import annotations

import numpy as np
import pytest

from rigs.damiao_rig import mit_command, state, undoubted
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.references import HoldingCheck, torque_doubt
from robot_sysid.damiao.safety.guards import NO_STATUS
from robot_sysid.damiao.safety.observer import Observer
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort

JOINTS = damiao_joints(["DM4340"] * 2, 2)
STEPS = np.full(2, 4e-4), np.array([0.1, 0.1]), np.full(2, 0.0137)
PEAK = np.full(2, 27.0)
LOAD = np.array([8.0, 3.0])


def gravity(q):
    """What holds two joints, each by itself."""
    return LOAD * np.cos(q)


HOLDING = HoldingCheck(JOINTS, gravity, torque_doubt(JOINTS), "the model needs")


def complete_settings(**settings):
    """Settings of a run of two joints."""
    settings = PlaySettings(**{"max_torque_error": (5.0, 7.0), **settings})
    return settings.for_motors([j.spec for j in JOINTS], BusTiming())


SETTINGS = complete_settings()


def observer(**settings):
    """An observer of two joints."""
    return Observer(JOINTS, complete_settings(**settings), STEPS, PEAK, HOLDING)


def sample(time=0.0, q=0.0, qd=0.0, tau=0.0, status=1, mos=30, rotor=30, answered=True):
    """What two joints answer: the first as it should, the second these values."""
    seen = np.where([True, answered], 0.0, np.nan)
    signals = (seen + [0.0, value] for value in (q, qd, tau))
    codes = [1, status if answered else NO_STATUS], [30, mos], [30, rotor]
    requested = np.ones(2, bool)
    return undoubted(np.isfinite(seen), seen + time, state(*signals, *codes), requested)


def stop_words(*samples, reference=(0.0, 0.0, 0.0), flags=(), **settings):
    """What an observer says to samples under one command of the second joint, or None."""
    watched = observer(**settings)
    p, v, t = ([0.0, value] for value in reference)
    try:
        for replies in samples:
            watched.update(replies)
            watched.check(replies, mit_command(p, v, kd=0.0, torque=t), *flags)
    except HardwareAbort as stopped:
        return str(stopped)
    return None


def test_while_gains_rise_a_new_load_is_judged_by_how_far_the_arm_sinks():
    """It swings about where it will settle; a rated 9 N m sink it by 0.05 rad, two stop it."""
    swings = sample(q=-0.09, tau=20.0)
    sinks = sample(q=-0.11, tau=5.0)
    assert stop_words(swings, flags=(True, True)) is None
    assert "N·m off its torque, limit 7" in stop_words(swings, swings, flags=(True,))
    assert (
        "is 0.110 rad off its path, limit 0.1, while it should stand still"
        in stop_words(sinks, flags=(True, True))
    )


WITHIN = 1.0 - 1e-6
BEYOND = 1.0 + 1e-6
# A joint without inertia that was to go on at 2 rad/s has this speed at the end of a cycle [rad/s]:
# it follows v = v_des + k (p_des - p), k = kp / kd.
FADES = SETTINGS.period * SETTINGS.kp[1] / SETTINGS.kd[1]
SLOWED = 2.0 * FADES / np.expm1(FADES)
# Commanded values at which nothing but what is tested can be out of order.
LIMITS = (
    (lambda x: sample(q=0.2 * x), (0.0, 0.0, 0.0), "motor 2 is 0.200 rad off its path"),
    (
        lambda x: sample(q=-0.2 * x),
        (0.0, 0.0, 0.0),
        "motor 2 is 0.200 rad off its path",
    ),
    # One rad/s and two steps of the velocity channel.
    (lambda x: sample(qd=2.0 + 1.2 * x), (0.0, 2.0, 0.0), "1.200 rad/s off its speed"),
    (
        lambda x: sample(qd=SLOWED - 1.2 * x),
        (0.0, 2.0, 0.0),
        "1.200 rad/s off its speed",
    ),
    (
        lambda x: sample(tau=3.0 + 7.0 * x),
        (0.0, 0.0, 3.0),
        "7.000 N·m off its torque, limit 7",
    ),
    (lambda x: sample(mos=80 + (x > 1.0)), (0.0, 0.0, 0.0), "is at 81 deg C, limit 80"),
    (
        lambda x: sample(rotor=80 + (x > 1.0)),
        (0.0, 0.0, 0.0),
        "is at 81 deg C, limit 80",
    ),
    (lambda x: sample(status=1 if x < 1.0 else 0), (0.0, 0.0, 0.0), "reports status 0"),
)


@pytest.mark.parametrize(("answer", "reference", "message"), LIMITS)
def test_each_limit_holds_to_a_millionth(answer, reference, message):
    for share in (WITHIN, BEYOND):
        # Speeds and torques count when two samples in a row agree.
        finding = stop_words(*[answer(share)] * 2, reference=reference)
        assert (finding is None) == (share < 1.0), finding
    assert message in finding
    assert finding.startswith("motor 2")


@pytest.mark.parametrize(
    ("requested", "cycles", "message"),
    [
        (True, 3, "motor 2 did not answer in time for 3 cycles"),
        (False, 6, "in time for 6 cycles"),
    ],
)
def test_a_motor_may_be_silent_for_so_long_and_no_longer(requested, cycles, message):
    """Three commands without an answer, or six cycles where it was not commanded."""
    gap = sample(answered=False)
    gap = undoubted(gap.answered, gap.time, gap.feedback, np.array([True, requested]))
    assert stop_words(*[gap] * (cycles - 1)) is None
    assert stop_words(*[gap] * (cycles - 1), sample(), *[gap] * (cycles - 1)) is None
    assert message in stop_words(*[gap] * cycles)


# --- signals that disagree -----------------------------------------------------------------------

CYCLE = 0.004


def motion(cycles, sinks=lambda p: 0.0, carries=lambda p: 3.0 * np.cos(p)):
    """Yield replies and commands of two joints that swing slowly under kp 180 and gravity.

    At a commanded position the second joint is off by ``sinks`` [rad], and is fed forward what
    ``carries`` it [N m].
    """
    for k in range(cycles):
        time = k * CYCLE
        p = 0.3 * np.sin(2.0 * time)
        v = 0.6 * np.cos(2.0 * time)
        command = mit_command([0.0, p], [0.0, v], 180.0, 4.5, [8.0, carries(p)])
        q = p + sinks(p)
        commanded = command.motor_torque(np.array([0.0, q]), np.array([0.0, v]))
        both = np.ones(2, bool)
        seen = state([0.0, q], [0.0, v], [8.0, commanded[1]])
        yield undoubted(both, np.full(2, time), seen, both), command


def stop_words_of(cycles):
    """Return what stops a motion, or None."""
    watched = observer(max_torque_error=(25.0,))
    try:
        for replies, command in cycles:
            watched.update(replies)
            watched.check(replies, command)
    except HardwareAbort as stopped:
        return str(stopped)
    return None


def test_an_arm_that_does_as_it_should_is_left_alone():
    assert stop_words_of(motion(500)) is None


def test_a_joint_that_carries_the_arm_the_other_way_is_another_joint():
    """So it is where the cables of two arms were exchanged in a symmetric pose."""

    def load(p):
        return 18.0 * np.sin(p)

    words = stop_words_of(motion(500, lambda p: 2.0 * load(p) / 180.0, load))
    assert words.startswith("motor 2") and "cables of two arms exchanged" in words

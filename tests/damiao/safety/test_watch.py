"""What stops a run: faults on the bus, and position, speed or torque that disagree.

Single incidents are rows of ``tests/damiao/test_incidents.py``.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import mit_command, state, undoubted_replies
from rigs.motors.watched_samples import (
    CYCLE,
    KD,
    KP,
    LENIENT,
    complete_settings,
    cycle,
    reference_of,
    refuse_answer,
    stand,
    swing,
    watch,
    words_of,
)
from robot_sysid.damiao.protocol import DISABLED, ENABLED
from robot_sysid.damiao.safety.watch import Phase
from robot_sysid.errors import HardwareAbort

# --- the bus --------------------------------------------------------------------------------------


@given(st.lists(st.sampled_from([ENABLED, DISABLED, 3, 0xA]), max_size=40))
def test_a_status_that_an_answer_repeats_stops_the_run_and_each_one_is_counted(codes):
    """Whether the answers are believed or not."""
    watched = watch(**LENIENT)
    pairs = [k for k in range(1, len(codes)) if codes[k] == codes[k - 1] != ENABLED]
    first = min(pairs, default=None)
    for k, code in enumerate(codes):
        replies, command = refuse_answer(k, code) if code != ENABLED else [*stand(1)][0]
        replies = replace(replies, reported=np.array([ENABLED, code]))
        watched.health.update(replies)
        if k != first:
            watched.check(replies, command, reference_of(command))
            continue
        words = "was switched off, or started again" if code == DISABLED else "reports"
        with pytest.raises(HardwareAbort, match=f"motor 2 {words}.*status {code:X}: "):
            watched.check(replies, command, reference_of(command))
        break
    played = codes if first is None else codes[: first + 1]
    faults = [code for code in played if code != ENABLED]
    assert watched.health.reports == [{}, Counter(faults)]
    assert watched.health.failed.tolist() == [False, first is not None]


# --- position, speed and torque -------------------------------------------------------------------


@pytest.mark.parametrize(("velocity", "is_old"), [(0.0, False), (0.9, True)])
def test_answers_that_stay_the_same_though_they_report_motion_are_not_trusted(
    velocity, is_old
):
    """The stop must not use them, whatever row of the watch began it."""
    watched = watch()
    command = mit_command(np.zeros(2), 0.0, KP, KD)
    signals = [0.0, 0.0], [0.0, velocity], [0.0, -KD * velocity]
    with pytest.raises(HardwareAbort) if is_old else contextlib.nullcontext():
        for k in range(9):
            replies, _ = cycle(k, command, True, *signals)
            watched.check(replies, command, reference_of(command), Phase(rises=True))
    assert watched.trusted_joints.tolist() == [True, not is_old]


@pytest.mark.parametrize("rate", [-0.06, 0.06])
def test_a_position_that_drifts_in_spite_of_its_velocity_is_found_in_time(rate):
    """Before it is 0.15 rad off; its joint moves to and fro ten times as fast."""
    cycles = [*swing(seconds=6.0, slip=rate)]
    within = round(0.15 / abs(rate) / CYCLE)
    assert words_of(cycles[:within], **LENIENT) is not None


def test_while_gains_rise_a_new_load_is_judged_by_how_far_the_arm_sinks():
    """It swings about where it will settle; a rated 9 N m sink it by 0.05 rad, two stop it."""
    rising = {"phase": Phase(stands=True, rises=True), "kp": (KP,)}
    assert words_of(stand(50, q=-0.09), **rising) is None
    words = words_of(stand(50, q=-0.11), **rising)
    assert words == (
        "motor 2 disagrees in position: it is at -0.110 rad, and commanded to 0.000"
    )


def test_a_joint_that_slows_down_within_a_cycle_is_not_taken_for_one_of_another_scale():
    """Light joints follow v = v_des + k (p_des - p), and are sampled at the end of each cycle."""
    settings = complete_settings(rate=50.0)
    watched = watch(rate=50.0)
    kp = np.array(settings.kp)
    kd = np.array(settings.kd)
    cycle = 0.02
    fade = cycle * kp[0] / kd[0]
    q = target = np.zeros(2)
    for k in range(200):
        speed = np.full(2, 1.0 + 0.5 * np.sin(0.3 * k * cycle))
        target = target + speed * cycle
        ahead = speed / (kp[0] / kd[0])
        # By the exponential of the equation.
        away = (q - target - ahead) * np.exp(-fade)
        q = target + ahead + away
        qd = -away * kp[0] / kd[0]
        command = mit_command(target, speed, kp, kd)
        now = state(q, qd, command.motor_torque(q, qd))
        both = np.ones(2, bool)
        replies = undoubted_replies(both, np.full(2, k * cycle), now, both)
        watched.check(replies, command, reference_of(command))


@pytest.mark.parametrize(("moves", "is_misled"), [(True, False), (False, True)])
def test_a_position_that_does_not_go_as_its_speed_is_not_trusted_in_a_stop(
    moves, is_misled
):
    watched = watch()
    found = np.zeros(2, bool)
    for k in range(100):
        q = moves * 1.0 * k * CYCLE
        command = mit_command(np.zeros(2), 0.0, KP, KD)
        replies, _ = cycle(k, command, True, [0.0, q], [0.0, 1.0], [0.0, 0.0])
        found |= watched.misled_joints(replies)
    assert found.tolist() == [False, is_misled]

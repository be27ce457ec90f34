"""Clock and sensor faults, seen in the rows themselves."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.log_checks import (
    clock_findings,
    sensor_findings,
    velocity_findings,
)
from robot_sysid.records import Measurement
from tests.support.log_files import JOINTS, motion

DATA = motion(2000)
NOISY = replace(
    DATA, tau=DATA.tau + 0.01 * np.random.default_rng(1).normal(size=DATA.tau.shape)
)


def test_a_right_log_draws_nothing():
    assert list(clock_findings([NOISY])) == []
    assert list(sensor_findings([NOISY], JOINTS)) == []


@given(st.integers(0, 2**32), st.floats(0.04, 0.2))
def test_lost_samples_behind_a_counted_time_are_refused(seed, share):
    kept = np.flatnonzero(np.random.default_rng(seed).random(len(DATA)) > share)
    log = Measurement(DATA.time[: len(kept)], DATA.q[kept], None, DATA.tau[kept])
    (found,) = clock_findings([log])
    assert found.level is Level.REFUSE and "lost samples" in found.text
    honest = replace(log, time=DATA.time[kept])
    assert list(clock_findings([honest])) == []


@given(st.integers(100, 1900), st.floats(0.05, 0.4))
def test_a_jump_of_the_clock_is_told_from_a_hole(at, jump):
    time = DATA.time.copy()
    time[at:] += jump
    (found,) = clock_findings([replace(DATA, time=time)])
    assert "jumps ahead 1 times" in found.text


@given(st.floats(0.8, 1.3))
def test_a_stretched_time_contradicts_recorded_velocities(factor):
    qd = np.gradient(DATA.q, DATA.time, axis=0)
    found = list(
        velocity_findings([replace(DATA, time=factor * DATA.time, qd=qd)], JOINTS)
    )
    if abs(factor - 1.0) > 0.035:
        said = re.search(r"time = ([0-9.]+) \* TITLE", found[0].text)
        assert float(said[1]) == pytest.approx(1.0 / factor, rel=0.01)
    elif abs(factor - 1.0) < 0.025:
        assert found == []
    assert (
        list(
            velocity_findings([replace(DATA, time=factor * DATA.time, qd=None)], JOINTS)
        )
        == []
    )


@pytest.mark.parametrize(
    ("recorded", "name", "said"),
    [
        (lambda qd: -qd, "sign", " -1 times that"),
        (
            lambda qd: qd * [1.0, -1.0, *[1.0] * (len(JOINTS) - 2)],
            "sign",
            f"({JOINTS[1]} -1 times",
        ),
        (np.degrees, "angle-unit", " 57.3 times that"),
        (lambda qd: qd[:, ::-1], "order", f"({JOINTS[0]} another motion"),
        (lambda qd: np.roll(np.round(qd, 2), 10, axis=0) + 0.2, None, ""),
        (
            lambda qd: sosfiltfilt(butter(2, 3.0, fs=200.0, output="sos"), qd, 0),
            None,
            "",
        ),
    ],
)
def test_velocities_of_another_motion_are_named_late_and_smooth_ones_are_not(
    recorded, name, said
):
    qd = recorded(np.gradient(DATA.q, DATA.time, axis=0))
    found = list(velocity_findings([replace(DATA, qd=qd)], JOINTS))
    assert [each.name for each in found] == [name] * (name is not None)
    assert all(said in each.text and each.level is Level.NOTE for each in found)


def test_repeated_samples_are_found():
    q = DATA.q.copy()
    q[1::10] = q[0:-1:10]
    assert any(
        "repeat the position" in f.text for f in clock_findings([replace(DATA, q=q)])
    )


@given(st.integers(0, 2), st.floats(0.2, 0.7))
def test_a_sensor_at_its_end_is_found(joint, part):
    tau = NOISY.tau.copy()
    low = tau[:, joint].min()
    high = tau[:, joint].max()
    tau[:, joint] = np.minimum(tau[:, joint], low + part * (high - low))
    names = [f.name for f in sensor_findings([replace(NOISY, tau=tau)], JOINTS)]
    assert "saturated" in names


@pytest.mark.parametrize("joint", range(3))
def test_a_channel_that_holds_is_found_and_named(joint):
    tau = NOISY.tau.copy()
    tau[500:800, joint] = tau[500, joint]
    (found,) = sensor_findings([replace(NOISY, tau=tau)], JOINTS)
    assert (
        found.name == "held"
        and f"joint {JOINTS[joint]} stands still for 1.5 s" in found.text
    )


def test_a_channel_that_holds_while_the_arm_goes_and_comes_back_is_found():
    time = np.arange(2000) / 200.0
    back = np.sin(2.0 * np.pi * time[:, None] / 3.0) * np.ones(3)
    tau = np.random.default_rng(0).normal(size=back.shape)
    tau[600:1201, 1] = tau[600, 1]
    (found,) = sensor_findings([Measurement(time, back, None, tau)], JOINTS)
    assert found.name == "held" and "stands still for 3 s" in found.text


def test_a_torque_in_coarse_steps_is_no_fault():
    steps = replace(NOISY, tau=np.round(NOISY.tau / 0.01) * 0.01)
    assert list(sensor_findings([steps], JOINTS)) == []

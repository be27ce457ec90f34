"""Kinds of trajectories: derivatives, rest at both ends, slower playback, and files."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import SEEDS
from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import (
    LineTrajectory,
    at_speed,
    load_trajectory,
    save_samples,
    save_trajectory,
)
from robot_sysid.trajectory import SineTrajectory

NAMES = ("base", "elbow", "wrist")


def sines(seed):
    """Return random sinusoids of three joints."""
    rng = default_rng(seed)
    amplitude, frequency, phase = rng.normal(size=(3, 3, 4))
    return SineTrajectory(
        rng.normal(size=3), amplitude, np.abs(frequency), phase, 7.3, 1.1
    )


@given(SEEDS, st.sampled_from([1.0, 0.37, 1.0 / 3.0]))
def test_sines_rest_at_their_ends_scale_in_time_and_survive_a_file(
    tmp_path_factory, seed, speed
):
    """Derivatives are exact, the slower path is equal, and a file holds every bit."""
    plan = sines(seed)
    path = tmp_path_factory.mktemp("saved") / "plan.json"
    slow = at_speed(plan, speed)
    save_trajectory(path, slow, NAMES, "abc")
    saved = load_trajectory(path)
    assert (saved.joint_names, saved.sha256) == (NAMES, "abc")
    save_trajectory(path.with_name("again.json"), saved.plan, NAMES, "abc")
    assert path.read_bytes() == path.with_name("again.json").read_bytes()

    assert slow.duration == pytest.approx(plan.duration / speed)
    time = np.linspace(0.0, plan.duration, 41)
    full = plan.evaluate(time)
    later = slow.evaluate(time / speed)
    loaded = saved.plan
    for name, power in (("q", 0), ("qd", 1), ("qdd", 2)):
        exact = getattr(later, name)
        assert_array_equal(getattr(loaded.evaluate(time / speed), name), exact)
        assert_allclose(exact, speed**power * getattr(full, name), atol=1e-6)

    ends = plan.evaluate(np.array([0.0, plan.duration]))
    assert_allclose((ends.qd, ends.qdd), 0.0, atol=1e-8)
    time = np.linspace(0.01, plan.duration - 0.01, 40)
    ahead, behind, middle = (plan.evaluate(time + s) for s in (1e-5, -1e-5, 0.0))
    error = 1e-4 * (1.0 + np.max(np.abs(middle.qdd)))
    assert_allclose((ahead.q - behind.q) / 2e-5, middle.qd, atol=error)
    assert_allclose((ahead.qd - behind.qd) / 2e-5, middle.qdd, atol=200.0 * error)


@given(SEEDS)
def test_a_line_is_straight_and_at_rest_at_both_ends(seed):
    begin, end = default_rng(seed).normal(size=(2, 3))
    plan = LineTrajectory(begin, end)
    motion = plan.evaluate(np.linspace(0.0, plan.duration, 501))
    assert_allclose(motion.q[[0, -1]], (begin, end), atol=1e-12)
    assert_allclose((motion.qd[[0, -1]], motion.qdd[[0, -1]]), 0.0, atol=1e-9)
    across = np.cross(motion.q - begin, end - begin)
    assert_allclose(across, 0.0, atol=1e-9)
    middle = 0.5 * (motion.qd[1:] + motion.qd[:-1])
    step = motion.time[1]
    assert_allclose(np.diff(motion.q, axis=0) / step, middle, atol=1e-2)
    assert plan.duration == max(1.0, np.max(np.abs(end - begin)))


def test_invalid_trajectories_are_refused():
    with pytest.raises(InputError, match="has shape"):
        replace(sines(0), amplitude=np.ones((3, 6)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 1}, "not a trajectory of version 2 .*; plan the motion again"),
        ({"phase": None}, "lacks the entry 'phase'"),
        ({"center": ["x", 0, 0]}, "not a usable trajectory"),
        ({"joints": NAMES[:2]}, "a trajectory of 3 joints names 2: base, elbow"),
        ({"center": [0.0, float("nan"), 0.0]}, "center"),
        ("time,q1\n0,0\n", "takes the .json file"),
        (None, "cannot read .*plan.json"),
    ],
)
def test_an_invalid_file_is_refused_in_one_line(tmp_path, changes, message):
    """Entries of a saved trajectory are changed, or removed by None."""
    path = tmp_path / "plan.json"
    if isinstance(changes, dict):
        save_trajectory(path, sines(0), NAMES)
        content = {**json.loads(path.read_text()), **changes}
        entries = {key: value for key, value in content.items() if value is not None}
        changes = json.dumps(entries)
    path.unlink(missing_ok=True)
    if changes is not None:
        path.write_text(changes, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        load_trajectory(path)
    assert "\n" not in str(caught.value)


def test_samples_are_the_motion_to_the_last_bit(tmp_path):
    plan = sines(1)
    save_samples(tmp_path / "plan.csv", plan, NAMES, 100.0)
    with open(tmp_path / "plan.csv", encoding="utf-8", newline="") as file:
        titles, *rows = csv.reader(file)
    motion = plan.evaluate(np.arange(731) / 100.0)
    table = np.hstack((motion.time[:, None], motion.q, motion.qd, motion.qdd))
    assert titles[:4] == ["time", "q_base", "q_elbow", "q_wrist"]
    assert titles[-1] == "qdd_wrist"
    assert np.array_equal(np.array(rows, dtype=float), table)

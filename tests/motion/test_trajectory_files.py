"""Saved trajectories come back bit by bit; what is not one is refused in one line."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import FourierBasis
from robot_sysid.motion.trajectory_files import (
    at_speed,
    load_trajectory,
    save_samples,
    save_trajectory,
)
from robot_sysid.trajectory import SineTrajectory
from tests.motion.test_trajectories import bases, trajectory
from tests.support.arms import SEEDS

NAMES = ("base", "elbow", "wrist")


def sines(seed):
    """A random sum of sinusoids."""
    rng = np.random.default_rng(seed)
    amplitude, frequency, phase = rng.normal(size=(3, 3, 4))
    return SineTrajectory(rng.normal(size=3), amplitude, np.abs(frequency), phase, 7.3, 1.1)


@st.composite
def plans(draw):
    """Any trajectory the tool makes."""
    seed = draw(SEEDS)
    plan = sines(seed) if draw(st.booleans()) else trajectory(draw(bases()), seed)
    return at_speed(plan, draw(st.sampled_from([1.0, 0.37, 1.0 / 3.0])))


@given(plans())
def test_round_trip_is_exact(tmp_path_factory, plan):
    path = tmp_path_factory.mktemp("saved") / "plan.json"
    save_trajectory(path, plan, NAMES)
    saved = load_trajectory(path)
    time = np.linspace(0.0, plan.duration, 50)
    before, after = plan.evaluate(time), saved.plan.evaluate(time)
    assert saved.joint_names == NAMES
    assert saved.plan.duration == plan.duration
    for name in ("time", "q", "qd", "qdd"):
        assert np.array_equal(getattr(before, name), getattr(after, name))


def test_an_editor_may_have_changed_line_ends_and_added_a_mark(tmp_path):
    path = tmp_path / "plan.json"
    save_trajectory(path, sines(3), NAMES)
    plain = load_trajectory(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    time = np.linspace(0.0, plain.plan.duration, 7)
    marked = load_trajectory(path)
    assert np.array_equal(marked.plan.evaluate(time).q, plain.plan.evaluate(time).q)


def test_saving_twice_gives_the_same_file(tmp_path):
    save_trajectory(tmp_path / "one.json", sines(0), NAMES)
    save_trajectory(tmp_path / "two.json", load_trajectory(tmp_path / "one.json").plan, NAMES)
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


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


def test_an_arm_with_other_joints_is_refused(tmp_path):
    save_trajectory(tmp_path / "plan.json", sines(0), NAMES)
    saved = load_trajectory(tmp_path / "plan.json")
    saved.require_fits(NAMES)
    for others in (("a", "b", "c"), ("elbow", "base", "wrist"), NAMES[:2], (*NAMES, "hand")):
        with pytest.raises(InputError, match="made for the 3 joints base, elbow, wrist") as caught:
            saved.require_fits(others)
        assert f"this arm has the {len(others)} joints {', '.join(others)}" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_the_model_it_was_made_for_is_kept(tmp_path):
    save_trajectory(tmp_path / "plan.json", sines(0), NAMES, "abc")
    assert load_trajectory(tmp_path / "plan.json").sha256 == "abc"
    save_trajectory(tmp_path / "plan.json", sines(0), NAMES)
    assert load_trajectory(tmp_path / "plan.json").sha256 == ""


def changed(**changes):
    """Text of a saved trajectory with some entries changed; None removes one."""
    content = {
        "format": "robot-sysid trajectory",
        "version": 1,
        "joints": list(NAMES),
        "kind": "sines",
        "duration": 5.0,
        "fade": 1.0,
        "center": [0.0, 0.0, 0.0],
        "amplitude": [[0.1]] * 3,
        "frequency_hz": [[0.1]] * 3,
        "phase": [[0.0]] * 3,
        **changes,
    }
    return json.dumps({key: value for key, value in content.items() if value is not None})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,q1\n0,0\n", "takes the .json file"),
        ("[1, 2]", "not a trajectory of this program"),
        (changed(format="other"), "not a trajectory of this program"),
        (changed(version=9), "has version 9 of the format"),
        (changed(kind="splines"), "unknown kind of trajectory 'splines'; valid: sines, fourier"),
        (changed(phase=None), "lacks the entry 'phase'"),
        (changed(phase=[[0.0]]), "phase has shape"),
        (changed(center=["x", 0, 0]), "not a usable trajectory"),
        (changed(fade=9.0), "does not fit twice"),
        (changed(speed=3.0), "--speed must be above 0"),
        (changed(joints=["base", "elbow"]), "a trajectory of 3 joints names 2: base, elbow"),
        (changed(joints=None), "lacks the entry 'joints'"),
        (changed(center=[0.0, float("nan"), 0.0]), "center"),
        ("[" * 100_000, "is not JSON"),
        (changed(duration=float("inf")), "finite"),
        (changed(duration=10**400), "finite"),
        (changed(center=[10**400, 0.0, 0.0]), "center is not finite"),
        (changed(kind=["sines"]), "not a usable trajectory"),
    ],
)
def test_refuses_in_one_line(tmp_path, text, words):
    path = tmp_path / "plan.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words) as caught:
        load_trajectory(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="cannot read .*none.json"):
        load_trajectory(tmp_path / "none.json")


def test_only_trajectories_with_coefficients_can_be_saved(tmp_path):
    class Other:
        duration = 1.0

    with pytest.raises(InputError, match="Other has no coefficients"):
        save_trajectory(tmp_path / "plan.json", Other(), ("a",))
    assert not list(tmp_path.iterdir())


BASIS = FourierBasis(6.0, 0.2, 4, 1.0)
SPEEDS = st.floats(0.01, 1.0)


@given(SEEDS, SPEEDS)
def test_same_path_later(seed, speed):
    plan = trajectory(BASIS, seed)
    slow = at_speed(plan, speed)
    time = np.linspace(0.0, plan.duration, 40)
    full, later = plan.evaluate(time), slow.evaluate(time / speed)
    assert slow.duration == pytest.approx(plan.duration / speed)
    assert np.allclose(later.q, full.q, atol=1e-9)
    assert np.allclose(later.qd, speed * full.qd, atol=1e-8)
    assert np.allclose(later.qdd, speed**2 * full.qdd, atol=1e-7)


@given(SEEDS, SPEEDS)
def test_velocity_and_acceleration_are_the_derivatives(seed, speed):
    slow = at_speed(trajectory(BASIS, seed), speed)
    step = 1e-4 / speed
    time = np.linspace(2 * step, slow.duration - 2 * step, 30)
    before, here, after = (slow.evaluate(time + d) for d in (-step, 0.0, step))
    tolerance = 1e-4 * (1.0 + np.max(np.abs(here.qdd)))
    assert np.max(np.abs((after.q - before.q) / (2 * step) - here.qd)) < tolerance
    assert np.max(np.abs((after.qd - before.qd) / (2 * step) - here.qdd)) < tolerance


@given(SEEDS, SPEEDS)
def test_at_rest_at_both_ends(seed, speed):
    slow = at_speed(trajectory(BASIS, seed), speed)
    ends = slow.evaluate(np.array([0.0, slow.duration]))
    assert np.max(np.abs(ends.qd)) < 1e-9
    assert np.max(np.abs(ends.qdd)) < 1e-9


def test_full_speed_is_the_trajectory_itself():
    plan = trajectory(BASIS, 0)
    assert at_speed(plan, 1.0) is plan


@pytest.mark.parametrize("speed", [0.0, -0.5, 1.2, float("nan")])
def test_refuses_what_is_not_slower(speed):
    with pytest.raises(InputError, match="--speed must be above 0 and at most 1"):
        at_speed(trajectory(BASIS, 0), speed)

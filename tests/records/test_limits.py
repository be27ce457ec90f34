"""Limits of several sources: the tightest ones count, and what breaks them is named."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_array_equal

from rigs.arms.small_arms import SEEDS
from rigs.files.refusals import refused
from robot_sysid.records import LIMITED, HalfSpace, Limits
from robot_sysid.records.limits import LARGEST

JOINTS = ("joint a", "joint b", "joint c")


def random_limits(rng):
    """Limits of three joints about zero, one of them without a range."""
    lower, upper, *others = rng.uniform(0.1, 2.0, size=(5, 3))
    lower[1] = upper[1] = np.inf
    return Limits(-lower, upper, *others, tool_speed=rng.uniform(0.1, 2.0))


def excesses(limits, signals, tool=0.0, rounding=0.0):
    """What samples of a motion (4, N, 3) break, taken in stretches."""
    samples = limits.signals(*signals, tool)
    time = np.arange(float(len(samples)))
    starts = range(0, len(time), 9)
    chunks = [(time[k : k + 9], samples[k : k + 9]) for k in starts]
    uses = limits.uses(chunks, JOINTS, rounding)
    return [use for use in uses if not use.is_kept]


@given(SEEDS, st.floats(0.05, 1.0))
def test_a_motion_keeps_the_limits_of_all_sources_or_breaks_one(seed, size):
    rng = default_rng(seed)
    sources = [random_limits(rng) for _ in range(3)]
    signals = size * rng.normal(size=(4, 50, 3))
    by_source = {use.name for source in sources for use in excesses(source, signals)}
    assert {use.name for use in excesses(Limits.of(*sources), signals)} == by_source


@given(SEEDS)
def test_an_excess_states_the_farthest_sample_and_the_limit_on_its_side(seed):
    rng = default_rng(seed)
    limits = random_limits(rng)
    signals, tool = 1.5 * rng.normal(size=(4, 50, 3)), 3.0 * rng.uniform(size=50)
    for use in excesses(limits, signals, tool):
        values, ends = tool, (-limits.tool_speed, limits.tool_speed)
        if use.owner in JOINTS:
            row, joint = [*LIMITED].index(use.quantity), JOINTS.index(use.owner)
            values, largest = signals[row][:, joint], limits.largest[row, joint]
            ends = -largest, largest
            if row == 0:
                ends = limits.lower[joint], limits.upper[joint]
        middle = np.mean(ends)
        farthest = values[int(use.time)]
        assert abs(farthest - middle) == np.max(np.abs(values - middle))
        assert abs(farthest - middle) == abs(use.value)
        # Only of a position it is said on which side it is.
        side = 1.0 if use.quantity == "position" else np.sign(farthest)
        end = ends[int(farthest > middle)]
        assert side * farthest == pytest.approx(use.middle + use.value)
        assert side * end == pytest.approx(use.middle + use.limit)
        assert use.share > 1.0


@pytest.mark.parametrize(
    ("value", "is_kept"), [(1.0, True), (1.0 + 2e-9, False), (np.nan, False)]
)
def test_rounding_is_left_to_a_value_and_nan_is_none(value, is_kept):
    limits = Limits(velocity=np.ones(3))
    zero = np.zeros((1, 3))
    motion = zero, np.array([[value, 0.5, -1.0]]), zero, zero
    names = [use.name for use in excesses(limits, motion)]
    assert ("velocity limit of joint a" in names) == bool(names) == (not is_kept)
    assert bool(excesses(limits, motion, rounding=1e-8)) == np.isnan(value)


def test_every_field_has_a_tighter_side():
    space = HalfSpace(np.eye(3)[2], 0.0, 0.01, (1,), "floor")
    largest = dict.fromkeys((*LARGEST, "tool_speed"), 1.0)
    tight = Limits(-1.0, 1.0, **largest, clearance=0.02, spaces=(space,))
    loose = Limits(-2.0, 2.0, **dict.fromkeys(largest, 2.0), clearance=0.01)
    for field in fields(Limits):
        mixed = replace(loose, **{field.name: getattr(tight, field.name)})
        merged = Limits.of(loose, mixed)
        assert getattr(merged, field.name) == getattr(tight, field.name)
    assert Limits.of(tight, loose, Limits()) == tight


@pytest.mark.parametrize(
    "numbers",
    [
        {"lower": 1.0, "upper": -1.0},
        {"lower": 1.0},
        {"lower": np.nan, "upper": np.nan},
        {"velocity": 0.0},
        {"torque": np.array([1.0, np.nan])},
        {"tool_speed": -1.0},
    ],
)
def test_limits_that_nothing_keeps_are_refused(numbers):
    with refused("limits are empty"):
        Limits(**numbers)


def test_a_missing_range_lies_about_the_reference_and_positions_may_widen_it():
    lower = np.array([-np.inf, -1.0])
    ranged = Limits(lower, -lower).around(np.array([0.5, 0.5]), 2.0)
    wide = ranged.with_positions(np.array([np.nan, 3.0]))
    assert_array_equal(ranged.center, [0.5, 0.0])
    assert_array_equal([wide.lower, wide.upper], [[-1.5, -1.0], [2.5, 3.0]])
    assert_array_equal(lower, [-np.inf, -1.0])

"""Every excitation option is checked once, with a message that names it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.motion.options import (
    LONGEST_PERIOD,
    TOP_FREQUENCY_HZ,
    ExcitationOptions,
    LimitOptions,
)

NOT_POSITIVE = st.one_of(st.floats(max_value=0.0), st.sampled_from([np.nan, np.inf, -np.inf]))


def refused(record, **changes):
    """The one line with which a record's options are refused."""
    with pytest.raises(InputError) as caught:
        record(**changes)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("record", "name", "flag"),
    [
        (ExcitationOptions, "time_budget", "--excitation-time-budget"),
        (ExcitationOptions, "base_frequency", "--base-frequency"),
        (LimitOptions, "max_velocity", "--max-velocity"),
        (LimitOptions, "max_acceleration", "--max-acceleration"),
        (LimitOptions, "max_torque", "--max-torque"),
    ],
)
@given(value=NOT_POSITIVE)
def test_numbers_that_must_be_positive_are_refused_otherwise(record, name, flag, value):
    assert refused(record, **{name: value}).startswith(f"{flag} must be positive (got ")


@pytest.mark.parametrize(
    ("record", "changes", "words"),
    [
        (ExcitationOptions, {"kind": "best"}, "--excitation 'best': choose one of sines, optimal"),
        (ExcitationOptions, {"criterion": "E"}, "--criterion 'E': choose one of A, D, cond"),
        (ExcitationOptions, {"ends": "open"}, "--excitation-ends 'open': choose one of faded, "),
        (ExcitationOptions, {"workers": 0}, "workers must be at least 1 (got 0)"),
        (ExcitationOptions, {"draws": 0}, "draws must be at least 1 (got 0)"),
        (ExcitationOptions, {"iterations": 0}, "iterations must be at least 1 (got 0)"),
        (ExcitationOptions, {"rounds": -1}, "rounds must be at least 0 (got -1)"),
        (LimitOptions, {"max_torque": (5.0, -1.0)}, "--max-torque must be positive (got -1)"),
        (LimitOptions, {"clearance": -0.01}, "--clearance must be a number that is not negative"),
        (LimitOptions, {"clearance": np.nan}, "--clearance must be a number that is not negative"),
        (LimitOptions, {"workspace": (1.0, -1.0, 0.0, 1.0, 0.0, 1.0)}, "empty along x"),
        (LimitOptions, {"keep_out": ((0.0, 0.0, 0.0, 1.0),)}, "normal that is not zero"),
    ],
)
def test_refuses(record, changes, words):
    assert words in refused(record, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"harmonics": 0}, "--harmonics 0 is too few"),
        ({"harmonics": 2, "ends": "periodic"}, "--harmonics 2 is too few"),
        ({"ends": "periodic", "base_frequency": 0.1}, "whole number of periods"),
    ],
)
def test_a_basis_that_cannot_be_is_refused_with_the_option_that_is_in_the_way(changes, words):
    with pytest.raises(InputError, match=words):
        ExcitationOptions(**changes).basis(15.0)


@given(st.floats(1.0, 600.0), st.sampled_from(["faded", "periodic"]))
def test_default_band_ends_at_the_top_frequency(duration, ends):
    basis = ExcitationOptions(ends=ends).basis(duration)
    periods = basis.base_frequency_hz * duration
    assert (basis.duration, periods) == (duration, pytest.approx(round(periods)))
    assert round(periods) == max(1, np.ceil(duration / LONGEST_PERIOD))
    assert basis.harmonics >= 3
    if basis.harmonics > 3:
        assert basis.top_frequency_hz <= TOP_FREQUENCY_HZ * (1.0 + 1e-9)
        assert basis.top_frequency_hz > TOP_FREQUENCY_HZ - basis.base_frequency_hz


def test_a_longer_budget_improves_more_starts():
    assert ExcitationOptions().n_starts == 2
    assert ExcitationOptions(time_budget=20.0).n_starts == 2
    assert ExcitationOptions(time_budget=300.0).n_starts == 10
    assert ExcitationOptions(time_budget=300.0, starts=3).n_starts == 3


@pytest.mark.parametrize(("allowed", "used"), [(1, 1), (2, 2), (8, 2)])
def test_workers_are_no_more_than_the_processors_this_process_may_use(allowed, used, monkeypatch):
    mine = set(range(allowed))
    monkeypatch.setattr("os.sched_getaffinity", lambda process: mine, raising=False)
    assert ExcitationOptions().n_workers == used
    assert ExcitationOptions(time_budget=1.0).n_workers == 1


def test_the_workspace_and_the_planes_are_made_of_the_numbers():
    limits = LimitOptions(
        workspace=(-1.0, 1.0, -2.0, 2.0, 0.0, 3.0), keep_out=((0.0, 0.0, 2.0, 1.0),)
    )
    plane, *box = limits.half_spaces([1, 2], [2])
    assert (*plane.normal, plane.offset, plane.bodies) == (0.0, 0.0, 1.0, 0.5, (1, 2))
    assert [side.offset for side in box] == [-1.0, -1.0, -2.0, -2.0, 0.0, -3.0]
    assert all(side.bodies == (2,) for side in box)
    assert LimitOptions().half_spaces([1], [1]) == ()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LimitOptions(workspace=(1, 2, 3)), "six numbers"),
        (lambda: LimitOptions(workspace=(1, -1, 0, 1, 0, 1)), "empty along x"),
        (lambda: LimitOptions(keep_out=((1, 2, 3),)), "four numbers"),
        (lambda: LimitOptions(keep_out=((0, 0, 0, 1),)), "normal that is not zero"),
        (lambda: LimitOptions(keep_out=((0, 0, 1, float("inf")),)), "normal that is not zero"),
    ],
)
def test_refuses_boxes_and_planes(make, words):
    with pytest.raises(InputError, match=words):
        make()

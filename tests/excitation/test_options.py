"""Every excitation option is checked once, with a message that names it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.collision.halfspaces import Box, Plane, box_from, plane_from
from robot_sysid.errors import InputError
from robot_sysid.excitation.options import TOP_FREQUENCY_HZ, ExcitationOptions, per_joint


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"criterion": "E"}, "--criterion E: choose one of A, D, cond"),
        ({"ends": "open"}, "--excitation-ends open: choose one of faded, periodic"),
        ({"torques": "all"}, "--torques all"),
        ({"duration": 0.0}, "--duration must be positive"),
        ({"sample_rate": -1.0}, "--sample-rate must be positive"),
        ({"time_budget": 0.0}, "--excitation-time-budget must be positive"),
        ({"base_frequency": 0.0}, "--base-frequency must be positive"),
        ({"max_acceleration": -2.0}, "--max-acceleration must be positive"),
        ({"noise_torque": (0.1, 0.0)}, "--noise-torque must be positive"),
        ({"noise_torque": ()}, "--noise-torque needs at least one number"),
        ({"max_torque": (-1.0,)}, "--max-torque must be positive"),
        ({"clearance": -0.01}, "--clearance must not be negative"),
        ({"clearance": float("nan")}, "--clearance must not be negative"),
        ({"harmonics": 0}, "--harmonics 0 is too few"),
        ({"ends": "periodic", "base_frequency": 0.1}, "whole number of periods"),
        ({"workers": 0}, "workers must be at least 1"),
        ({"draws": 0}, "draws must be at least 1"),
    ],
)
def test_refuses(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        ExcitationOptions(**changes)
    assert "\n" not in str(caught.value)


@given(st.floats(1.0, 600.0), st.sampled_from(["faded", "periodic"]))
def test_default_band_ends_at_the_top_frequency(duration, ends):
    basis = ExcitationOptions(duration=duration, ends=ends).basis()
    assert basis.harmonics >= 3
    if basis.harmonics > 3:
        assert basis.top_frequency_hz <= TOP_FREQUENCY_HZ * (1.0 + 1e-9)
        assert basis.top_frequency_hz > TOP_FREQUENCY_HZ - 1.0 / duration


def test_a_longer_budget_improves_more_starts():
    assert ExcitationOptions().n_starts == 2
    assert ExcitationOptions(time_budget=20.0).n_starts == 2
    assert ExcitationOptions(time_budget=300.0).n_starts == 10
    assert ExcitationOptions(time_budget=300.0, starts=3).n_starts == 3


def test_box_and_plane_from_numbers():
    assert box_from((-1, 1, -2, 2, 0, 3)) == Box((-1, -2, 0), (1, 2, 3))
    assert plane_from((0, 0, 2, 1)) == Plane((0.0, 0.0, 1.0), 0.5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: box_from((1, 2, 3)), "six numbers"),
        (lambda: box_from((1, -1, 0, 1, 0, 1)), "empty along x"),
        (lambda: plane_from((1, 2, 3)), "four numbers"),
        (lambda: plane_from((0, 0, 0, 1)), "normal that is not zero"),
        (lambda: plane_from((0, 0, 1, float("inf"))), "normal that is not zero"),
    ],
)
def test_refuses_boxes_and_planes(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_one_number_serves_all_joints():
    assert per_joint((0.3,), 3, "--noise-torque").tolist() == [0.3, 0.3, 0.3]
    assert per_joint((1.0, 2.0), 2, "--noise-torque").tolist() == [1.0, 2.0]
    with pytest.raises(InputError, match="--noise-torque takes one number, or one for each of"):
        per_joint((1.0, 2.0), 3, "--noise-torque")

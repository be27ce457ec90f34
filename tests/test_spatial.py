"""Laws of the inertia conversions: round trips, frame shifts, consistency in every frame."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from rigs.arms.small_arms import SEEDS, random_rotation, random_theta
from robot_sysid import spatial

assert_close = partial(assert_allclose, rtol=0.0)
"""Compare arrays within the absolute tolerance ``atol`` alone."""

# Down to a needle: the shortest direction holds 1e-12 of the mass's second moment.
SPREADS = st.sampled_from([1.0, 1e-3, 1e-6])


def random_frame(rng):
    """Return a random rotation (3, 3) and translation (3,)."""
    return random_rotation(rng), rng.normal(size=3)


def scale_theta(theta):
    """Return the parameters (10,) in units of their typical size."""
    return theta / spatial.parameter_scale(
        theta[0], spatial.characteristic_length(theta)
    )


def point_masses(rng, count=8):
    """Return masses (count,) and positions (count, 3), which define every conversion."""
    return rng.uniform(0.1, 1.0, count), rng.normal(size=(count, 3))


def theta_of_points(masses, points):
    """Return the parameters (10,) of point masses about the origin."""
    squares = np.sum(points**2, axis=1)[:, None, None] * np.eye(3)
    inertia = np.einsum(
        "n,nij->ij", masses, squares - points[:, :, None] * points[:, None, :]
    )
    moment = masses @ points
    return np.concatenate(
        ([np.sum(masses)], moment, spatial.six_from_symmetric(inertia))
    )


@given(SEEDS)
def test_theta_from_com_is_the_sum_over_point_masses(seed):
    masses, points = point_masses(default_rng(seed))
    com = masses @ points / np.sum(masses)
    about_com = theta_of_points(masses, points - com)
    actual = spatial.theta_from_com(
        np.sum(masses), com, spatial.symmetric_from_six(about_com[4:])
    )
    assert_close(actual, theta_of_points(masses, points), atol=1e-12)


@given(SEEDS)
def test_moving_the_frame_moves_the_points(seed):
    rng = default_rng(seed)
    masses, points = point_masses(rng)
    rotation, translation = random_frame(rng)
    moved = theta_of_points(masses, points @ rotation.T + translation)
    theta = theta_of_points(masses, points)
    actual = spatial.transform_theta(theta, rotation, translation)
    assert_close(actual, moved, atol=1e-11)


@given(SEEDS, SPREADS)
def test_origin_to_com_and_back_is_the_identity(seed, spread):
    theta = random_theta(default_rng(seed), spread=spread)
    back = spatial.theta_from_com(*spatial.com_from_theta(theta))
    assert_close(scale_theta(back), scale_theta(theta), atol=1e-13)


@given(SEEDS, st.booleans())
def test_consistency_does_not_depend_on_the_frame(seed, possible):
    rng = default_rng(seed)
    theta = random_theta(rng)
    if not possible:
        theta = theta + inconsistent_change(rng, theta)
    moved = spatial.transform_theta(theta, *random_frame(rng))
    assert spatial.is_consistent(theta) == spatial.is_consistent(moved) == possible


def inconsistent_change(rng, theta):
    """Return a change (10,) that makes one principal second moment clearly negative."""
    _, com, inertia = spatial.com_from_theta(theta)
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    values, vectors = np.linalg.eigh(second)
    values[0] = -values[0] - 0.1 * values[2]
    second = (vectors * values) @ vectors.T
    broken = np.trace(second) * np.eye(3) - second
    return spatial.theta_from_com(theta[0], com, broken) - theta


def test_both_orders_of_an_inertia_name_the_same_matrix():
    six = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    matrix = spatial.symmetric_from_six(six)
    assert_array_equal(matrix, matrix.T)
    assert_array_equal(spatial.six_from_symmetric(matrix), six)
    assert_array_equal(
        spatial.fullinertia_from_symmetric(matrix), [1.0, 4.0, 6.0, 2.0, 3.0, 5.0]
    )


def test_a_massless_body_has_its_com_at_the_origin_and_is_not_possible():
    theta = np.zeros(10)
    mass, com, inertia = spatial.com_from_theta(theta)
    assert mass == 0.0
    assert_array_equal(com, 0.0)
    assert_array_equal(inertia, 0.0)
    assert not spatial.is_consistent(theta)
    assert spatial.characteristic_length(theta) == 1.0


@pytest.mark.parametrize("invalid", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_inconsistent(invalid):
    theta = spatial.theta_from_com(1.0, np.zeros(3), np.eye(3))
    assert spatial.is_consistent(theta)
    theta[4] = invalid
    assert spatial.is_consistent(theta) is False


def draw_rotation(rng, family):
    """Return a random rotation: any, at right angles, or so near gimbal lock that angles mix."""
    if family == "any":
        return random_rotation(rng)
    if family == "right angles":
        return Rotation.from_euler(
            "ZYX", 90.0 * rng.integers(-2, 3, 3), degrees=True
        ).as_matrix()
    tilt = rng.choice([-1.0, 1.0]) * (0.5 * np.pi - 10.0 ** rng.uniform(-17.0, -3.0))
    return Rotation.from_euler(
        "ZYX", [rng.uniform(-3, 3), tilt, rng.uniform(-3, 3)]
    ).as_matrix()


ROTATIONS = st.sampled_from(["any", "right angles", "nearly locked"])


@given(SEEDS, ROTATIONS)
def test_angles_and_quaternions_turn_back_into_the_rotation(seed, family):
    rotation = draw_rotation(default_rng(seed), family)
    roll, pitch, yaw = spatial.roll_pitch_yaw(rotation)
    back = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    assert_close(back, rotation, atol=3e-14)
    angles = np.array([roll, pitch, yaw])
    assert_close(spatial.rotation_of_angles(angles), back, atol=1e-14)
    w, *xyz = spatial.quaternion(rotation)
    assert np.linalg.norm([w, *xyz]) == pytest.approx(1.0, abs=1e-14)
    assert_close(Rotation.from_quat([*xyz, w]).as_matrix(), rotation, atol=1e-14)
    assert w >= 0.0


@given(SEEDS, st.sampled_from([1.0, 1e-6, 1e-12, 0.0]))
def test_principal_axes_restore_the_inertia_with_the_smallest_turn(seed, spread):
    rng = default_rng(seed)
    drawn_axes = random_rotation(rng)
    inertia = (
        drawn_axes @ np.diag(1.0 + spread * rng.uniform(0.0, 1.0, 3)) @ drawn_axes.T
    )
    moments, axes = spatial.principal_axes(inertia)
    assert_close(axes @ np.diag(moments) @ axes.T, inertia, atol=1e-14)
    assert_close(axes.T @ axes, np.eye(3), atol=1e-14)
    assert np.linalg.det(axes) > 0.0
    # No frame is further than 62.8 degrees from the nearest of its 24 turns.
    assert np.trace(axes) >= 1.0 + 2.0 * np.cos(np.radians(62.8))

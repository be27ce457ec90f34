"""Tilt of gravity and columns of encoder zeros against MuJoCo's torque."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.newton_euler import (
    LinkDynamics,
    split_motion,
    tilt_angles,
    tilt_axes,
    turn_gravity,
    zero_columns,
)
from robot_sysid.errors import InputError
from robot_sysid.records import Motion
from tests.support.arms import SEEDS, random_chain, random_motion, robot_of

angle = st.floats(-0.3, 0.3)


@given(SEEDS, angle, angle)
def test_turning_keeps_the_strength_and_turns_by_the_angle(seed, first, second):
    down = 9.81 * default_rng(seed).normal(size=3)
    turned = turn_gravity(down, np.array([first, second]))
    assert_allclose(np.linalg.norm(turned), np.linalg.norm(down), rtol=1e-12)
    # Both axes are perpendicular to gravity, so the whole turn shows.
    sine = np.linalg.norm(np.cross(down, turned)) / (down @ down)
    assert_allclose(sine, np.sin(np.hypot(first, second)), rtol=0.0, atol=1e-12)


@given(SEEDS, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_tilt_angles_invert_turn_gravity(seed, first, second):
    level = 9.81 * default_rng(seed).normal(size=3)
    angles = np.array([first, second])
    assert_allclose(tilt_angles(level, turn_gravity(level, angles)), angles, atol=1e-9)
    assert_allclose(tilt_angles(level, -level), [np.pi, 0.0])


@given(SEEDS, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_transported_axes_stay_orthonormal_and_small_turns_add_up(seed, first, second):
    level = 9.81 * default_rng(seed).normal(size=3)
    angles = np.array([first, second])
    tilted = turn_gravity(level, angles)
    axes = tilt_axes(level, tilted)
    directions = np.array([*axes, tilted / np.linalg.norm(tilted)])
    assert_allclose(directions @ directions.T, np.eye(3), atol=1e-9)
    # A small turn of a tilted arm adds to its tilt, but for the curvature of the sphere.
    small = 1e-4 * np.array([0.6, 0.8])
    added = tilt_angles(level, turn_gravity(tilted, small, axes)) - angles
    curvature = (first**2 + second**2) / 3.0
    assert_allclose(added, small, rtol=0.0, atol=1e-4 * (curvature + 1e-3))
    assert_allclose(tilt_axes(level, level), tilt_axes(level), atol=1e-12)


def test_without_gravity_there_is_no_tilt():
    with pytest.raises(InputError, match="--tilt auto needs gravity"):
        tilt_axes(np.zeros(3))


@given(random_chain(), SEEDS)
def test_columns_of_encoder_zeros_equal_differences(xml, seed):
    robot = robot_of(xml)
    rng = default_rng(seed)
    step = 1e-5
    q, qd, qdd = random_motion(rng, robot.n_joints, 5)
    thetas = robot.thetas
    dynamics = LinkDynamics(robot)
    offsets = step * np.eye(robot.n_joints)
    torques = []
    for offset in (*-offsets, *offsets):
        torques.append(dynamics.motion(q + offset, qd, qdd).torque(thetas))
    below, above = np.split(np.stack(torques, axis=-1), 2, axis=-1)
    columns = zero_columns(robot, thetas, Motion(np.arange(5.0), q, qd, qdd))
    rounding = 1e-9 * np.max(np.abs(above), initial=1.0)
    assert_allclose(columns, (below - above) / (2.0 * step), rtol=1e-6, atol=rounding)


@given(st.integers(0, 40), st.integers(0, 10**6))
def test_split_motion_gives_small_chunks_of_the_motion(samples, width):
    motion = np.arange(3.0 * samples).reshape(-1, 3), np.arange(samples)
    chunks = list(split_motion(width, *motion))
    for pieces, signal in zip(zip(*chunks), motion):
        assert_array_equal(np.concatenate(pieces), signal)
    # Up to one sample more, where they do not divide evenly.
    assert all(width * (len(chunk) - 1) < 10**6 for chunk, _ in chunks)

"""Laws of the regressor: the printed terms, Newton and Euler, MuJoCo."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid import derived_regressor
from robot_sysid.derived_regressor import PLACES, entries
from robot_sysid.dynamics import spatial
from robot_sysid.model.inertia import body_theta
from robot_sysid.records import BodyMotion
from robot_sysid.regressor import (
    derive_regressor,
    derived_source,
    joint_regressor,
    joint_torque,
    wrench_regressor,
)
from tests.support.arms import SEEDS, random_rotation, rigid_bodies

PRINTED_TERMS = """
0 | 0 | avz + wx*vy - wy*vx | -avy + wx*vz - wz*vx | awx | awy - wx*wz | awz + wx*wy | -wy*wz | wy**2 - wz**2 | wy*wz
0 | -avz - wx*vy + wy*vx | 0 | avx + wy*vz - wz*vy | wx*wz | awx + wy*wz | -wx**2 + wz**2 | awy | awz - wx*wy | -wx*wz
0 | avy - wx*vz + wz*vx | -avx - wy*vz + wz*vy | 0 | -wx*wy | wx**2 - wy**2 | awx - wy*wz | wx*wy | awy + wx*wz | awz
avx + wy*vz - wz*vy | -wy**2 - wz**2 | -awz + wx*wy | awy + wx*wz | 0 | 0 | 0 | 0 | 0 | 0
avy - wx*vz + wz*vx | awz + wx*wy | -wx**2 - wz**2 | -awx + wy*wz | 0 | 0 | 0 | 0 | 0 | 0
avz + wx*vy - wy*vx | -awy + wx*wz | awx + wy*wz | -wx**2 - wy**2 | 0 | 0 | 0 | 0 | 0 | 0
"""  # noqa: E501
"""Rows [n, f], columns theta; w and v are the twist, aw and av its rate."""

SPEEDS = st.sampled_from([0.0, 1e-6, 1.0, 100.0])


def printed_matrix():
    rows = [line.split("|") for line in PRINTED_TERMS.strip().splitlines()]
    return sp.Matrix([[sp.sympify(term) for term in row] for row in rows])


def newton_euler_wrench(theta, omega, alpha, acceleration):
    """[n, f] about the body origin; ``acceleration`` of that origin is classical, minus gravity."""
    mass, com, inertia = spatial.com_from_theta(theta)
    at_com = acceleration + np.cross(alpha, com) + np.cross(omega, np.cross(omega, com))
    force = mass * at_com
    moment = inertia @ alpha + np.cross(omega, inertia @ omega) + np.cross(com, force)
    return np.concatenate((moment, force))


def wrench_scale(theta, omega, alpha, acceleration):
    """Sum of the magnitudes that add up to the wrench: what rounding errors are relative to."""
    rates = np.linalg.norm(alpha) + omega @ omega
    linear = np.linalg.norm(acceleration)
    length = spatial.characteristic_length(theta)
    return theta[0] * (linear + rates * length) * np.array([length] * 3 + [1.0] * 3) + 1e-30


def regressor_of(omega, alpha, v, acceleration):
    twist = np.concatenate((omega, v))[None]
    rate = np.concatenate((alpha, acceleration - np.cross(omega, v)))[None]
    return wrench_regressor(twist, rate)[:, :, 0]


def test_all_sixty_terms_are_those_printed():
    matrix, _ = derive_regressor()
    assert sp.expand(matrix - printed_matrix()) == sp.zeros(6, 10)


def test_the_kept_derivation_is_a_fresh_one():
    """``derived_source`` writes derived_regressor.py; an entry that is not kept has to be zero."""
    matrix, symbols = derive_regressor()
    kept = sp.zeros(6, 10)
    for place, entry in zip(PLACES, entries(*symbols)):
        kept[place] = entry
    assert (kept - matrix).expand() == sp.zeros(6, 10)


def test_the_source_that_a_derivation_writes_is_the_kept_one():
    fresh: dict = {}
    exec(derived_source(), fresh)
    values = [Fraction(k, 7) for k in range(1, 13)]
    assert fresh["PLACES"] == PLACES
    assert fresh["entries"](*values) == entries(*values)


def test_a_fresh_source_differs_from_the_kept_one_in_its_formulas_at_most():
    """How sums are printed is SymPy's affair, and may change with its releases."""
    kept = Path(derived_regressor.__file__).read_text(encoding="utf-8")
    start, formulas = "    x0 = ", "    return (\n"
    fresh = derived_source()
    assert fresh.partition(start)[0] == kept.partition(start)[0]
    *values, end = fresh.partition(formulas)[2].splitlines()
    assert end == "    )"
    for line in values:
        assert line[:8].isspace() and not line[8].isspace() and line.endswith(",")
        assert len(line) <= 100


def test_numeric_regressor_is_the_symbolic_one():
    matrix, symbols = derive_regressor()
    values = np.random.default_rng(0).normal(size=12)
    expected = np.array(matrix.subs(dict(zip(symbols, values))), dtype=float)
    actual = wrench_regressor(values[None, :6], values[None, 6:])[:, :, 0]
    np.testing.assert_allclose(actual, expected, rtol=1e-14, atol=1e-14)


@given(rigid_bodies(), SEEDS, SPEEDS, SPEEDS)
def test_regressor_times_theta_is_the_newton_euler_wrench(theta, seed, spin, acceleration):
    rng = np.random.default_rng(seed)
    omega, alpha = spin * rng.normal(size=3), spin**2 * rng.normal(size=3)
    v, linear = rng.normal(size=3), acceleration * rng.normal(size=3)
    wrench = regressor_of(omega, alpha, v, linear) @ theta
    expected = newton_euler_wrench(theta, omega, alpha, linear)
    scale = wrench_scale(theta, omega, alpha, np.abs(linear) + np.linalg.norm(omega) * abs(v))
    np.testing.assert_array_less(np.abs(wrench - expected), 1e-12 * scale + 1e-30)


@given(rigid_bodies(), SEEDS)
def test_velocity_of_an_unaccelerated_frame_does_not_matter(theta, seed):
    """Galilei: only the classical acceleration counts, not the speed of the frame."""
    rng = np.random.default_rng(seed)
    omega, alpha, linear, v = rng.normal(size=(4, 3))
    still = regressor_of(omega, alpha, np.zeros(3), linear) @ theta
    moving = regressor_of(omega, alpha, 10.0 * v, linear) @ theta
    scale = wrench_scale(theta, omega, alpha, 100.0 + np.abs(linear))
    np.testing.assert_array_less(np.abs(still - moving), 1e-12 * scale)


def free_body(theta):
    """MuJoCo model of one free body with these parameters."""
    mass, com, inertia = spatial.com_from_theta(theta)
    full = " ".join(f"{value:.17g}" for value in spatial.fullinertia_from_symmetric(inertia))
    at = " ".join(f"{value:.17g}" for value in com)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="1 2 -9"/><worldbody><body><freejoint/><inertial pos="{at}" '
        f'mass="{mass:.17g}" fullinertia="{full}"/></body></worldbody></mujoco>'
    )


def round_body(seed):
    """theta that MuJoCo's compiler accepts: principal moments well above its smallest number."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3, 3))
    second = factor @ factor.T + 0.01 * np.eye(3)
    return spatial.theta_from_com(
        rng.uniform(0.1, 5.0), rng.normal(size=3), np.trace(second) * np.eye(3) - second
    )


@given(SEEDS)
def test_wrench_of_a_free_body_is_mujocos(seed):
    """A free joint takes the force in the world's axes and the moment in the body's."""
    rng = np.random.default_rng(seed)
    model, rotation = free_body(round_body(seed)), random_rotation(rng)
    # Some releases round the axes they find for a fullinertia to six digits.
    theta = body_theta(model, 1)
    data = mujoco.MjData(model)
    omega, alpha, v, linear = rng.normal(size=(4, 3))
    mujoco.mju_mat2Quat(data.qpos[3:], rotation.ravel())
    data.qvel[:], data.qacc[:] = np.append(rotation @ v, omega), np.append(rotation @ linear, alpha)
    mujoco.mj_inverse(model, data)
    gravity = rotation.T @ model.opt.gravity
    wrench = regressor_of(omega, alpha, v, linear - gravity) @ theta
    expected = np.append(data.qfrc_inverse[3:], rotation.T @ data.qfrc_inverse[:3])
    scale = wrench_scale(theta, omega, alpha, linear - gravity)
    np.testing.assert_array_less(np.abs(wrench - expected), 1e-11 * scale)


@given(SEEDS, st.integers(1, 5), st.integers(1, 7))
def test_joint_rows_are_the_transposed_jacobian_times_the_wrench_rows(seed, samples, joints):
    rng = np.random.default_rng(seed)
    twist, rate = rng.normal(size=(2, samples, 6))
    jacobian = rng.normal(size=(samples, 6, joints))
    motion = BodyMotion(twist, rate, jacobian, np.zeros((samples, joints)))
    chosen = rng.permutation(joints)[: rng.integers(1, joints + 1)]
    rows = joint_regressor(motion, chosen)
    wrench = wrench_regressor(twist, rate)
    for block, joint in zip(rows, chosen):
        for k in range(samples):
            expected = jacobian[k, :, joint] @ wrench[:, :, k]
            np.testing.assert_allclose(block[k], expected, rtol=1e-12, atol=1e-12)


@given(SEEDS, st.integers(1, 5), st.integers(1, 7), rigid_bodies())
def test_joint_torque_is_that_of_the_rest_plus_the_power_of_the_links_wrench(
    seed, samples, joints, theta
):
    """d'Alembert: qd^T (tau - tau_rest) = V^T wrench for whatever speeds of the joints."""
    rng = np.random.default_rng(seed)
    twist, rate = rng.normal(size=(2, samples, 6))
    jacobian = rng.normal(size=(samples, 6, joints))
    rest, qd = rng.normal(size=(2, samples, joints))
    tau = joint_torque(BodyMotion(twist, rate, jacobian, rest), theta)
    moved = np.einsum("kij,kj->ki", jacobian, qd)
    wrench = np.einsum("ijk,j->ki", wrench_regressor(twist, rate), theta)
    power = np.sum(moved * wrench, axis=1)
    scale = np.sum(np.abs(qd * rest), axis=1) + np.sum(np.abs(theta)) * 1e3
    np.testing.assert_array_less(np.abs(np.sum(qd * (tau - rest), axis=1) - power), 1e-12 * scale)


def test_gravity_alone_shows_as_weight_at_the_centre_of_mass():
    theta = spatial.theta_from_com(2.0, np.array([0.1, 0.0, 0.0]), np.eye(3))
    rate = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 9.81]])
    wrench = wrench_regressor(np.zeros((1, 6)), rate)[:, :, 0] @ theta
    assert wrench == pytest.approx([0.0, -2.0 * 9.81 * 0.1, 0.0, 0.0, 0.0, 2.0 * 9.81], abs=1e-14)

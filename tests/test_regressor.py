"""The regressor against its symbolic derivation and against MuJoCo."""

import mujoco
import numpy as np
from hypothesis import given
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_less

from rigs.arms.small_arms import SEEDS, random_rotation, random_theta, vector_text
from robot_sysid import spatial
from robot_sysid.model.bodies import body_theta
from robot_sysid.regressor import derive_regressor, wrench_regressor


def wrench_scale(theta, omega, alpha, acceleration):
    """Return the sum (6,) of the magnitudes of the wrench's terms, the unit of rounding errors."""
    rates = np.linalg.norm(alpha) + omega @ omega
    linear = np.linalg.norm(acceleration)
    length = spatial.characteristic_length(theta)
    force = theta[0] * (linear + rates * length)
    return force * np.array([length] * 3 + [1.0] * 3) + 1e-30


def regressor_of(omega, alpha, v, acceleration):
    """Return the wrench regressor (6, 10) for classical linear acceleration."""
    twist = np.concatenate((omega, v))[None]
    rate = np.concatenate((alpha, acceleration - np.cross(omega, v)))[None]
    return wrench_regressor(twist, rate)[:, :, 0]


def test_numeric_regressor_is_the_symbolic_one():
    matrix, symbols = derive_regressor()
    values = default_rng(0).normal(size=12)
    expected = np.array(matrix.subs(dict(zip(symbols, values))), dtype=float)
    actual = wrench_regressor(values[None, :6], values[None, 6:])[:, :, 0]
    assert_allclose(actual, expected, rtol=1e-14, atol=1e-14)


def free_body(theta):
    """Return the MuJoCo model of one free body with parameters theta (10,)."""
    mass, com, inertia = spatial.com_from_theta(theta)
    full = vector_text(spatial.fullinertia_from_symmetric(inertia))
    at = vector_text(com)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="1 2 -9"/><worldbody><body><freejoint/><inertial pos="{at}" '
        f'mass="{mass:.17g}" fullinertia="{full}"/></body></worldbody></mujoco>'
    )


@given(SEEDS)
def test_the_wrench_of_a_free_body_equals_mujoco(seed):
    """A free joint takes the force in the world's axes and the moment in the body's."""
    rng = default_rng(seed)
    model = free_body(random_theta(rng, rng.uniform(0.1, 5.0), 1.0))
    rotation = random_rotation(rng)
    # Some releases round the axes they find for a fullinertia to six digits.
    theta = body_theta(model, 1)
    data = mujoco.MjData(model)
    omega, alpha, v, linear = rng.normal(size=(4, 3))
    mujoco.mju_mat2Quat(data.qpos[3:], rotation.ravel())
    data.qvel[:] = np.append(rotation @ v, omega)
    data.qacc[:] = np.append(rotation @ linear, alpha)
    mujoco.mj_inverse(model, data)
    gravity = rotation.T @ model.opt.gravity
    wrench = regressor_of(omega, alpha, v, linear - gravity) @ theta
    expected = np.append(data.qfrc_inverse[3:], rotation.T @ data.qfrc_inverse[:3])
    scale = wrench_scale(theta, omega, alpha, linear - gravity)
    assert_array_less(np.abs(wrench - expected), 1e-11 * scale)

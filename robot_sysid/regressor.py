"""The spatial dynamics regressor: derived with SymPy, evaluated with numpy on whole chunks.

One rigid body, frame at the body origin, body coordinates, twist V = [omega, v]:

    F = G V' - ad(V)^T G V,   F = [n, f] = Y6(V, V') theta

(Lynch and Park, "Modern Robotics", 2017, eq. 8.40). V' is the SPATIAL acceleration minus gravity:
its linear part is the classical acceleration minus omega x v minus g, so that gravity enters once.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_sysid.records import Array
from robot_sysid.spatial import N_INERTIAL, PARAMETER_NAMES


def derive_regressor() -> tuple[Any, tuple[Any, ...]]:
    """Derive Y6 = dF / dtheta symbolically.

    Returns:
        (Y6, symbols): the (6, 10) SymPy matrix in the order of ``spatial.PARAMETER_NAMES``, and the
        twelve symbols [omega, v, omega', v'] it depends on.
    """
    import sympy as sp

    def hat(x: Any, y: Any, z: Any) -> Any:
        """Return the matrix (3, 3) whose product with b is the cross product (x, y, z) x b."""
        return sp.Matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])

    motion = sp.symbols("wx wy wz vx vy vz awx awy awz avx avy avz")
    twist = sp.Matrix(motion[:6])
    acceleration = sp.Matrix(motion[6:])
    omega = hat(*twist[:3])
    v = hat(*twist[3:])
    # ad(V) = [[[omega]x, 0], [[v]x, [omega]x]].
    adjoint = sp.Matrix([[omega, sp.zeros(3)], [v, omega]])
    theta = sp.symbols(" ".join(PARAMETER_NAMES))
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = theta
    # G = [[I, [h]x], [-[h]x, m 1]].
    inertia = sp.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    h = hat(hx, hy, hz)
    spatial_inertia = sp.Matrix([[inertia, h], [-h, m * sp.eye(3)]])
    wrench = spatial_inertia * acceleration - adjoint.T * spatial_inertia * twist
    return wrench.jacobian(theta), motion


def wrench_regressor(velocity: Array, acceleration: Array) -> Array:
    """Return Y6, with wrench = Y6 theta, for N samples of one body.

    The formulas are those that ``derive_regressor`` derives, written out, because importing SymPy
    takes longer than an identification; a test compares the two.

    Args:
        velocity: (N, 6) twist [omega, v] in body coordinates [rad/s, m/s].
        acceleration: (N, 6) spatial acceleration minus gravity [rad/s^2, m/s^2].

    Returns:
        (6, 10, N) regressor of the wrench [n, f] at the body origin in body coordinates.
    """
    wx, wy, wz, vx, vy, vz = np.ascontiguousarray(velocity.T)
    alpha_x, alpha_y, alpha_z, *linear = np.ascontiguousarray(acceleration.T)
    # Classical acceleration of the origin minus gravity: v' + omega x v.
    ax = linear[0] - vy * wz + vz * wy
    ay = linear[1] + vx * wz - vz * wx
    az = linear[2] - vx * wy + vy * wx
    xx = wx**2
    yy = wy**2
    zz = wz**2
    xy = wx * wy
    xz = wx * wz
    yz = wy * wz
    less_x = alpha_x - yz
    less_y = alpha_y - xz
    less_z = alpha_z - xy
    more_x = alpha_x + yz
    more_y = alpha_y + xz
    more_z = alpha_z + xy
    regressor = np.zeros((6, N_INERTIAL, len(velocity)))
    regressor[0, 2:] = (az, -ay, alpha_x, less_y, more_z, -yz, yy - zz, yz)
    regressor[1, 1] = -az
    regressor[1, 3:] = (ax, xz, more_x, zz - xx, alpha_y, less_z, -xz)
    regressor[2, 1:3] = (ay, -ax)
    regressor[2, 4:] = (-xy, xx - yy, less_x, xy, more_y, alpha_z)
    regressor[3, :4] = (ax, -zz - yy, -less_z, more_y)
    regressor[4, :4] = (ay, more_z, -zz - xx, -less_x)
    regressor[5, :4] = (az, -less_y, more_x, -yy - xx)
    return regressor

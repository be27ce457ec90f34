"""Rigid-body inertia: every conversion between representations, exactly once.

Legend. theta = [m, hx, hy, hz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz]: mass [kg], first moment of mass
h = m c [kg m], rotational inertia about the body-frame ORIGIN [kg m^2]. MuJoCo's ``fullinertia`` is
about the CENTRE OF MASS in the order xx yy zz xy xz yz.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ALUMINIUM = 2700.0
"""Density of aluminium [kg/m^3]."""
ROD = float(np.sqrt(3.0))
"""Length of a uniform rod over the root mean square distance of its mass from its end."""
ROD_MOMENT = 1.0 / 18.0
"""Mean moment of inertia of a thin rod about its middle, over its mass and squared length."""
PARAMETER_NAMES = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Names of the inertial parameters theta of one body, in their order."""
N_INERTIAL = len(PARAMETER_NAMES)
"""Number of inertial parameters of one body."""
# Index in theta of each entry of [[I, h], [h^T, m]].
_OF_THETA = np.array([[4, 5, 6, 1], [5, 7, 8, 2], [6, 8, 9, 3], [1, 2, 3, 0]])
# Index in [xx, xy, xz, yy, yz, zz] of each entry of a symmetric matrix.
_OF_SIX = _OF_THETA[:3, :3] - 4
# Entries of its upper triangle, in the same order.
_UPPER = np.triu_indices(3)
# Index in [xx, xy, xz, yy, yz, zz] of each of MuJoCo's xx yy zz xy xz yz.
_FULL = np.array([0, 3, 5, 1, 2, 4])


def cross(a: Array, b: Array) -> Array:
    """Return a x b for component-first arrays (3, ...); numpy's own takes ten times as long."""
    return np.stack(
        (
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        )
    )


def skew(vector: Array) -> Array:
    """Return [v]x (3, 3) of v (3,), for which [v]x b = v x b."""
    return cross(vector, np.eye(3))


def lower_triangular(turn: Array, shift: Array) -> Array:
    """Return [[turn, 0], [shift, turn]] (6, 6) of two (3, 3) matrices."""
    return np.block([[turn, np.zeros((3, 3))], [shift, turn]])


def symmetric_from_six(six: Array) -> Array:
    """Return the (3, 3) symmetric matrix of [xx, xy, xz, yy, yz, zz]."""
    return six[_OF_SIX]


def six_from_symmetric(matrix: Array) -> Array:
    """Return [xx, xy, xz, yy, yz, zz] of a (3, 3) symmetric matrix."""
    return matrix[_UPPER]


def fullinertia_from_symmetric(matrix: Array) -> Array:
    """Return MuJoCo's order [xx, yy, zz, xy, xz, yz] of a (3, 3) symmetric matrix."""
    return six_from_symmetric(matrix)[_FULL]


def six_from_fullinertia(full: Array) -> Array:
    """Return [xx, xy, xz, yy, yz, zz] from MuJoCo's order [xx, yy, zz, xy, xz, yz]."""
    return full[np.argsort(_FULL)]


def theta_from_com(mass: float, com: Array, inertia_com: Array) -> Array:
    """Return theta (10,) from mass [kg], centre of mass (3,) [m] and inertia about the centre of
    mass (3, 3) [kg m^2].

    Parallel-axis theorem: I_origin = I_com + m (|c|^2 1 - c c^T).
    """
    six = six_from_symmetric(inertia_com + _steiner(mass, com))
    return np.hstack((mass, mass * com, six))


def com_from_theta(theta: Array) -> tuple[float, Array, Array]:
    """Return (mass, centre of mass (3,), inertia about the centre of mass (3, 3)) of a body with
    theta (10,); the centre of mass of a body without mass is the origin.
    """
    mass = float(theta[0])
    com = theta[1:4] / mass if mass != 0.0 else np.zeros(3)
    return mass, com, symmetric_from_six(theta[4:10]) - _steiner(mass, com)


def _steiner(mass: float, com: Array) -> Array:
    """Return the inertia (3, 3) of a point mass [kg] at com (3,) [m] about the origin."""
    return mass * (com @ com * np.eye(3) - np.outer(com, com))


def aluminium_ball(mass: float, com: Array) -> Array:
    """Return theta (10,) of a solid aluminium ball, I = 0.4 m r^2, of a mass [kg] around com (3,)
    [m].
    """
    radius = (3.0 * mass / (4.0 * np.pi * ALUMINIUM)) ** (1.0 / 3.0)
    return theta_from_com(mass, com, 0.4 * mass * radius**2 * np.eye(3))


def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments (3,) of an inertia (3, 3), and their axes (3, 3) as columns of a
    rotation.

    Of all orders and signs of the axes, those that turn the frame's own axes least, which is never
    a mirror: the trace of a mirrored rotation is at most 1, that of the nearest one at least 1.9.
    """
    moments, axes = np.linalg.eigh(inertia)
    rows = range(3)
    orders = [list(order) for order in permutations(rows)]
    order = max(orders, key=lambda each: np.sum(np.abs(axes[rows, each])))
    nearest = axes[:, order]
    return moments[order], nearest * np.sign(np.diag(nearest))


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return the angles roll, pitch and yaw (3,) [rad] of a rotation R (3, 3) about the fixed axes
    x, y and z: R = Rz(yaw) Ry(pitch) Rx(roll).

    Where pitch is a right angle, only the sum or difference of roll and yaw counts: yaw is zero.
    """
    x_axis = rotation[:, 0]
    # Roll and yaw then turn about one axis.
    is_locked = np.hypot(*x_axis[:2]) < 1e-14
    yaw = 0.0 if is_locked else np.arctan2(x_axis[1], x_axis[0])
    # Near a right angle yaw is mostly rounding; roll is computed from it and makes up for it.
    turn = rotation_of_angles(np.array([0.0, 0.0, -yaw])) @ rotation
    roll = np.arctan2(-turn[1, 2], turn[1, 1])
    pitch = np.arctan2(-turn[2, 0], turn[0, 0])
    return np.array([roll, pitch, yaw])


def rotation_of_angles(roll_pitch_yaw: Array) -> Array:
    """Return the rotation R (3, 3) of angles roll, pitch and yaw (3,) [rad] about the fixed axes x,
    y and z, as in a URDF: R = Rz(yaw) Ry(pitch) Rx(roll). ValueError if there are not three.
    """
    # Written out: SciPy's takes longer to import than a log to identify.
    (cr, cp, cy), (sr, sp, sy) = np.cos(roll_pitch_yaw), np.sin(roll_pitch_yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion p (4,) w x y z of a rotation (3, 3), w not negative.

    The rotation shows the ten products of its components; of 4 p p', each row is a multiple of p,
    and the one with the largest diagonal entry has the most digits (Shepperd, "Quaternion from
    rotation matrix", Journal of Guidance and Control 1(3), 1978).
    """
    trace = np.trace(rotation)
    odd = rotation - rotation.T
    products = np.empty((4, 4))
    products[0, 0] = 1.0 + trace
    products[0, 1:] = products[1:, 0] = odd[2, 1], odd[0, 2], odd[1, 0]
    products[1:, 1:] = rotation + rotation.T + (1.0 - trace) * np.eye(3)
    row = products[np.argmax(np.diag(products))]
    unit = row / np.linalg.norm(row)
    return np.asarray(-unit if unit[0] < 0.0 else unit)


def transform_theta(theta: Array, rotation: Array, translation: Array) -> Array:
    """Return theta (10,) in frame A of a body with ``theta`` (10,) in frame B; ``rotation`` R_AB
    (3, 3) has the axes of B as columns, ``translation`` (3,) is the origin of B in A [m].
    """
    sigma = np.eye(4)
    sigma[:3, :3] = rotation
    sigma[:3, 3] = translation
    return theta_from_pseudo_inertia(sigma @ pseudo_inertia(theta) @ sigma.T)


def pseudo_inertia(theta: Array) -> Array:
    """Return the (..., 4, 4) pseudo-inertia J = [[S, h], [h^T, m]] of theta (..., 10), that is mass
    m, first moment h and inertia I, with S = tr(I)/2 1 - I.

    theta is physically consistent exactly when J is positive definite (Wensing, Kim, Slotine,
    "Linear matrix inequalities for physically consistent inertial parameter identification",
    2018, eq. 17).
    """
    matrix = theta[..., _OF_THETA]
    second = matrix[..., :3, :3]
    half_trace = 0.5 * (theta[..., 4] + theta[..., 7] + theta[..., 9])
    second[:] = half_trace[..., None, None] * np.eye(3) - second
    return np.asarray(matrix)


def theta_from_pseudo_inertia(matrix: Array) -> Array:
    """Return theta (10,) of a (4, 4) pseudo-inertia; I = tr(S) 1 - S, S its upper left block."""
    second = matrix[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    return np.hstack((matrix[3, 3], matrix[:3, 3], six_from_symmetric(inertia)))


def is_consistent(theta: Array) -> bool:
    """Return whether theta (..., 10) can belong to rigid bodies of positive mass (each J positive
    definite).
    """
    if not np.all(np.isfinite(theta)):
        return False
    # Unlike eigenvalues, this depends on no unit: not even rounding does.
    try:
        np.linalg.cholesky(pseudo_inertia(theta))
    except np.linalg.LinAlgError:
        return False
    return True


def parameter_scale(mass: float, length: float) -> Array:
    """Return (10,) typical magnitudes of theta of a body of this mass [kg] and length [m]: m, m L
    for first moments, m L^2 for inertias.
    """
    return mass * np.array([1.0] + [length] * 3 + [length**2] * 6)


def characteristic_length(theta: Array) -> float:
    """Return the size sqrt(tr(I) / (2 m)) [m] of a body, with I about its origin, from its ten
    parameters theta; 1 where that is no positive number.
    """
    if theta[0] <= 0.0:
        return 1.0
    half_trace = 0.5 * (theta[4] + theta[7] + theta[9])
    return float(np.sqrt(max(half_trace, 0.0) / theta[0])) or 1.0


def nearest_consistent_body(theta: Array, reference: Array, floor: float) -> Array:
    """Return theta (10,) of a body near theta (10,) that is physically consistent by a margin.

    See ``nearest_consistent_bodies``, of which this is one.
    """
    return nearest_consistent_bodies(theta[None], reference[None], floor)[0]


def nearest_consistent_bodies(thetas: Array, references: Array, floor: float) -> Array:
    """Return thetas (L, 10) of bodies near thetas (L, 10) that are physically consistent by a
    margin.

    Eigenvalues of a pseudo-inertia, made dimensionless with mass and size of the body in
    ``references`` (L, 10), are raised to at least ``floor`` times the largest magnitude (or 1, if
    that is larger). Where none has to be raised, a theta stays as it is.
    """
    masses = references[:, 0]
    # Entry (i, j) of a pseudo-inertia has the unit units[i] units[j].
    units = np.ones((len(references), 4))
    units[:, :3] = np.array([*map(characteristic_length, references)])[:, None]
    units *= np.sqrt(np.where(masses > 0.0, masses, 1.0))[:, None]
    scales = units[:, :, None] * units[:, None]
    values, vectors = np.linalg.eigh(pseudo_inertia(thetas) / scales)
    largest = np.maximum(np.max(np.abs(values), axis=1), 1.0)
    lifted = np.maximum(values, floor * largest[:, None])
    nearest = thetas.copy()
    for body in np.flatnonzero(lifted[:, 0] != values[:, 0]).tolist():
        raised = (vectors[body] * lifted[body]) @ vectors[body].T
        nearest[body] = theta_from_pseudo_inertia(raised * scales[body])
    return nearest

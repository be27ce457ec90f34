"""Rigid-body inertia: every conversion between representations, exactly once.

Legend. theta = [m, hx, hy, hz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz]: mass [kg], first moment of mass
h = m c [kg m], rotational inertia about the body-frame ORIGIN [kg m^2]. MuJoCo's ``fullinertia`` is
about the CENTRE OF MASS in the order xx yy zz xy xz yz. ``(..., 10)`` arrays may be batched.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PARAMETER_NAMES = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MUJOCO_UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def skew(vector: Array) -> Array:
    """Return the cross-product matrix [v]x of a (3,) vector, so that [v]x w = v x w."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def cross(a: Array, b: Array) -> Array:
    """Return a x b for component-first arrays (3, ...); numpy's own takes ten times as long."""
    return np.stack(
        (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )


def symmetric_from_six(six: Array) -> Array:
    """Return the (3, 3) symmetric matrix of [xx, xy, xz, yy, yz, zz]."""
    matrix = np.empty((3, 3))
    for value, (i, j) in zip(six, _UPPER):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def six_from_symmetric(matrix: Array) -> Array:
    """Return [xx, xy, xz, yy, yz, zz] of a (3, 3) symmetric matrix."""
    return np.array([matrix[i, j] for i, j in _UPPER])


def fullinertia_from_symmetric(matrix: Array) -> Array:
    """Return MuJoCo's order [xx, yy, zz, xy, xz, yz] of a (3, 3) symmetric matrix."""
    return np.array([matrix[i, j] for i, j in _MUJOCO_UPPER])


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Return the (3, 3) rotation matrix of a quaternion in MuJoCo order [w, x, y, z]."""
    w, x, y, z = np.asarray(quaternion, dtype=float) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the unit quaternion [w, x, y, z] of a (3, 3) rotation matrix.

    Shepperd, "Quaternion from rotation matrix", 1978: the largest component is found first, so
    that no division is by a small number.
    """
    trace = float(np.trace(rotation))
    diagonal = np.append(trace, np.diag(rotation))
    largest = int(np.argmax(diagonal))
    anti = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    if largest == 0:
        quaternion = np.append(1.0 + trace, anti)
    else:
        i = largest - 1
        quaternion = np.append(anti[i], rotation[i] + rotation[:, i])
        quaternion[largest] = 1.0 + 2.0 * rotation[i, i] - trace
    return quaternion / np.linalg.norm(quaternion)


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Return Rz(yaw) Ry(pitch) Rx(roll) (3, 3), URDF's ``rpy`` [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return about_z @ about_y @ about_x


def rotation_from_vector(vector: Array) -> Array:
    """Return the (3, 3) rotation by |v| radians about a (3,) vector v (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    axis = skew(np.asarray(vector) / angle)
    return np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis


def theta_from_com(mass: float, com: Array, inertia_com: Array) -> Array:
    """Return theta (10,) from mass, centre of mass (3,) and inertia about it (3, 3).

    Parallel-axis theorem: I_origin = I_com + m (|c|^2 1 - c c^T).
    """
    com = np.asarray(com, dtype=float)
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate(([mass], mass * com, six_from_symmetric(inertia_com + steiner)))


def com_from_theta(theta: Array) -> tuple[float, Array, Array]:
    """Return (mass, centre of mass (3,), inertia about it (3, 3)); a massless body keeps c = 0."""
    mass, h = float(theta[0]), np.asarray(theta[1:4], dtype=float)
    com = h / mass if mass != 0.0 else np.zeros(3)
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, symmetric_from_six(theta[4:10]) - steiner


def theta_from_mujoco(mass: float, ipos: Array, iquat: Array, principal: Array) -> Array:
    """Return theta (10,) of a compiled MuJoCo body (``body_mass/ipos/iquat/inertia``)."""
    rotation = rotation_from_quaternion(iquat)
    return theta_from_com(mass, ipos, rotation @ np.diag(principal) @ rotation.T)


def transform_theta(theta: Array, rotation: Array, translation: Array) -> Array:
    """Express theta of frame B in frame A.

    Args:
        theta: (10,) parameters in frame B.
        rotation: (3, 3) R_AB, axes of B in A.
        translation: (3,) origin of B in A [m].
    """
    sigma = np.zeros((4, 4))
    sigma[:3, :3], sigma[:3, 3], sigma[3, 3] = rotation, translation, 1.0
    return theta_from_pseudo_inertia(sigma @ pseudo_inertia(theta) @ sigma.T)


def pseudo_inertia(theta: Array) -> Array:
    """Return the (..., 4, 4) pseudo-inertia J = [[S, h], [h^T, m]], S = tr(I)/2 1 - I.

    theta is physically consistent exactly when J is positive definite (Wensing, Kim, Slotine,
    "Linear matrix inequalities for physically consistent inertial parameter identification",
    2018, eq. 17).
    """
    theta = np.asarray(theta, dtype=float)
    return np.einsum("...k,kij->...ij", theta, _PSEUDO_BASIS)


def theta_from_pseudo_inertia(matrix: Array) -> Array:
    """Return theta (10,) of a (4, 4) pseudo-inertia; I = tr(S) 1 - S."""
    second = matrix[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    return np.concatenate(([matrix[3, 3]], matrix[:3, 3], six_from_symmetric(inertia)))


def pseudo_inertia_basis() -> Array:
    """Return the (10, 4, 4) matrices B_k with J(theta) = sum_k theta_k B_k."""
    return _PSEUDO_BASIS.copy()


def smallest_pseudo_eigenvalue(theta: Array) -> float:
    """Return the smallest eigenvalue of J(theta): positive for a physically possible body."""
    return float(np.linalg.eigvalsh(pseudo_inertia(theta))[0])


def is_consistent(theta: Array) -> bool:
    """Tell whether theta can belong to a rigid body of positive mass (J positive definite)."""
    return bool(np.all(np.isfinite(theta))) and smallest_pseudo_eigenvalue(theta) > 0.0


def parameter_scale(mass: float, length: float) -> Array:
    """Return (10,) typical magnitudes of theta for a body of this mass [kg] and size [m]."""
    return mass * np.array([1.0] + [length] * 3 + [length**2] * 6)


def characteristic_length(theta: Array) -> float:
    """Return the body's size as seen from its origin: sqrt(tr(I) / (2 m)) [m]."""
    if theta[0] <= 0.0:
        return 1.0
    half_trace = 0.5 * float(theta[4] + theta[7] + theta[9])
    return float(np.sqrt(max(half_trace, 0.0) / theta[0])) or 1.0


def _build_pseudo_basis() -> Array:
    basis = np.zeros((10, 4, 4))
    for k in range(10):
        unit = np.eye(10)[k]
        inertia = symmetric_from_six(unit[4:])
        basis[k, :3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        basis[k, :3, 3] = basis[k, 3, :3] = unit[1:4]
        basis[k, 3, 3] = unit[0]
    return basis


_PSEUDO_BASIS = _build_pseudo_basis()

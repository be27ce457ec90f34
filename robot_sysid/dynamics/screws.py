"""Twists of rigid bodies, component first: (6, ...) is [omega, v]."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.spatial import cross, skew
from robot_sysid.records.arm import Array


def exponential(twist: Array, angle: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3, N) and translation (3, N) of exp([twist] angle), angle (N,).

    Of twists (6, L): (3, 3, L, N) and (3, L, N). Rodrigues' formula (Modern Robotics, eq. 3.51 and
    3.88); a twist with omega = 0 slides.
    """
    hat, linear = skew(twist[:3]), twist[3:]
    square = np.einsum("ab...,bc...->ac...", hat, hat)
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    rotation = np.multiply.outer(hat, sine) + np.multiply.outer(square, versine)
    rotation[range(3), range(3)] += 1.0
    translation = np.multiply.outer(linear, angle)
    for matrix, size in ((hat, versine), (square, angle - sine)):
        translation += np.multiply.outer(np.einsum("ab...,b...->a...", matrix, linear), size)
    return rotation, translation


def bracket(a: Array, b: Array) -> Array:
    """Return ad(a) b = [w_a x w_b, v_a x w_b + w_a x v_b] for twists (6, ...)."""
    return np.concatenate((cross(a[:3], b[:3]), cross(a[3:], b[:3]) + cross(a[:3], b[3:])), axis=0)


def bracket_transposed(a: Array, b: Array) -> Array:
    """Return ad(a)^T b = -[w_a x m + v_a x f, w_a x f] for b = [m, f] (6, ...)."""
    return -np.concatenate((cross(a[:3], b[:3]) + cross(a[3:], b[3:]), cross(a[:3], b[3:])), axis=0)

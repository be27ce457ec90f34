"""Random trajectories that obey all limits: where the optimiser starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.design.design_objective import Design
from robot_sysid.design.motion_constraints import LIMIT_NAMES, ROUNDING, MotionConstraints
from robot_sysid.records import Array

SHRINK = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.04, 0.01, 0.003, 0.001)
"""Factors tried until a drawn motion obeys torque limits and touches nothing."""

FEW = 6
"""Every how many grid points are looked at first."""

Functions = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Draw:
    """One random trajectory.

    Attributes:
        score: its criterion; infinite where no factor made it feasible.
        x: (n, M) free coefficients.
        obstacle: which limit even the smallest multiple of it exceeds; "" where one is feasible.
    """

    score: float
    x: Array
    obstacle: str


def draw_trajectories(design: Design, seed: int, numbers: Sequence[int]) -> list[Draw]:
    """Return draws number ``numbers``; each depends on the seed and its own number alone."""
    functions = design.functions(design.grid)
    checks = _Checks(design)
    draws = []
    for number in numbers:
        rng = np.random.default_rng([seed, number])
        full = _within_motion_limits(design, functions, rng)
        draws.append(_shrunk(design, functions, checks, full))
    return draws


def _random_shape(design: Design, rng: np.random.Generator) -> Array:
    """Return free coefficients (n, M) of harmonics whose speeds, not angles, are alike."""
    size = (design.problem.n_joints, design.basis.size)
    falling = np.tile(1.0 / design.basis.order, 2) ** rng.uniform(0.0, 1.0)
    shape = rng.normal(size=size) * rng.uniform(0.2, 1.0, size=size)
    shape[:, 1:] *= falling
    shape[:, 0] = 0.0
    return shape @ design.directions


def _random_offset(design: Design, functions: Functions, rng: np.random.Generator) -> Array:
    """Return free coefficients (n, M) that move each joint to a random middle and back.

    Only a faded trajectory has such an offset; the offset of a periodic one follows from the rest.
    """
    limits, rest = design.problem.limits, design.problem.rest
    x = np.zeros((design.problem.n_joints, design.n_free))
    middle = rng.uniform(0.2, 0.8, size=len(rest))
    if design.basis.fade > 0.0:
        x[:, 0] = limits.lower + middle * (limits.upper - limits.lower) - rest
    return x * np.minimum(1.0, 0.7 * _room(design, functions, np.zeros_like(x), x))[:, None]


def _within_motion_limits(design: Design, functions: Functions, rng: np.random.Generator) -> Array:
    """Return a random motion, each joint as large as position, speed and acceleration allow."""
    offset = _random_offset(design, functions, rng)
    shape = _random_shape(design, rng)
    return offset + shape * (0.98 * _room(design, functions, offset, shape))[:, None]


def _room(design: Design, functions: Functions, base: Array, x: Array) -> Array:
    """Return the largest factors (n,) for which base + factor x keeps the motion limits."""
    limits, rest = design.problem.limits, design.problem.rest
    ranges = (
        (limits.lower - rest, limits.upper - rest),
        (-limits.velocity, limits.velocity),
        (-limits.acceleration, limits.acceleration),
    )
    factor = np.full(len(rest), np.inf)
    for function, (low, high) in zip(functions, ranges):
        at, step = function @ base.T, function @ x.T
        room = np.where(step > 0.0, high - at, low - at)
        share = np.abs(step) > 1e-12
        ratio = np.where(share, room / np.where(share, step, 1.0), np.inf)
        factor = np.minimum(factor, np.min(ratio, axis=0))
    return np.where(np.isfinite(factor), np.maximum(factor, 0.0), 0.0)


class _Checks:
    """Constraints of a motion on a few grid points first: most that is infeasible shows there."""

    def __init__(self, design: Design) -> None:
        self._few = MotionConstraints(design.problem, share=1.0, extra_slack=0.0)
        self._all = MotionConstraints(design.problem, share=1.0, extra_slack=0.0)

    def worst(self, motion: Functions) -> tuple[Array, Array]:
        """Return constraint values (k, 4 n + 1), of all points if the few are feasible, and q."""
        q, qd, qdd = (signal[::FEW] for signal in motion)
        value = self._few.evaluate((q, qd, qdd)).value
        if np.max(value) > ROUNDING:
            return value, q
        return self._all.evaluate(motion).value, motion[0]


def _shrunk(design: Design, functions: Functions, checks: _Checks, full: Array) -> Draw:
    """Return the largest tried multiple of a motion that is feasible on the grid."""
    b, db, ddb = functions
    for factor in SHRINK:
        x = factor * full
        value, q = checks.worst((design.problem.rest + b @ x.T, db @ x.T, ddb @ x.T))
        if np.max(value) <= ROUNDING:
            return Draw(design.criterion_of(x), x, "")
    return Draw(np.inf, np.zeros_like(full), _obstacle(design, value, q))


def _obstacle(design: Design, value: Array, q: Array) -> str:
    """Name the constraint that is exceeded most."""
    sample, column = np.unravel_index(int(np.argmax(value)), value.shape)
    kind, joint = divmod(int(column), design.problem.n_joints)
    if kind < len(LIMIT_NAMES):
        return f"{LIMIT_NAMES[kind]} limit of joint {design.problem.joint_names[joint]}"
    return f"clearance of {design.problem.obstacles.closest(q[sample]).label}"

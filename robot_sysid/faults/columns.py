"""The columns of faults that no fit has columns of: they stand beside a fit's own, in its rows.

Most faults act in columns that every fit has: a scale of torques, a zero, a tilt, a body. The
others get theirs here. Throughout, m is the number of rows of a chunk, J that of joints.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import LinksMotion
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import Point, Term
from robot_sysid.records import Array
from robot_sysid.records.parameters import Parameter
from robot_sysid.spatial import PARAMETER_NAMES

INERTIAL = "inertia"
"""Name of the column of the links' torque without their weight."""
WEIGHT = "weight"
"""Name of the column of the links' weight."""
OTHER_WEIGHT = "weight of other links"
"""Name of the column of the weight of the model's links but the last."""
SPRING = ("position",)
"""A spring at a joint."""
ECCENTRIC_SPRING = ("sine of position", "cosine of position")
"""A spring that pulls at a joint from a point beside it."""
HUM = ("cosine of time", "sine of time")
NEIGHBOURS = ("torque of joint before", "torque of joint after")
LAST_WEIGHT = tuple(f"weight of last {name}" for name in PARAMETER_NAMES[:4])
FORCE = tuple(f"force {axis} {name}" for name in PARAMETER_NAMES[:4] for axis in "xyz")
_STEPS_PER_PERIOD = 4
"""Steps of a period of the whole log in which rates of a hum are tried: a rate between two steps
loses at most a tenth of the amplitude."""
_LEAST_PERIODS = 2
"""Periods of a hum in a log below which a sine is the motion's own shape."""
_LARGEST_RATE_SHARE = 0.4
"""Largest rate that is looked at, as a share of the sampling rate: a half is the Nyquist limit, and
just below it a sine is sampled twice in a period."""


def fault_columns(fitted: Fit) -> list[Term]:
    """Return the terms whose columns faults need, beside those of every fit."""
    arm = fitted.arm
    robot = arm.robot
    recordings = fitted.recordings
    time = np.concatenate([recording.motion.time for recording in recordings])
    first = np.min(time)
    residuals = np.nan_to_num(fitted.residuals)
    rates = [strongest_rate(time - first, residual) for residual in residuals.T]

    def of_last(moves: LinksMotion) -> Array:
        """Return the torque (m, J, 4) of the last link's mass and first moments, one each."""
        return moves.columns([robot.n_joints - 1])[:, arm.indices, :4]

    def columns(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 26): each fault's own, in the order of the names."""
        moves = rows.at_rest(robot, point.gravity)
        # Bodies that stand for placeholders of the model are those of the view of weight.
        others = np.stack([link.reference for link in robot.links])
        others[-1] = 0.0
        weight = moves.torque(point.carried_links(rows.is_loaded))[:, arm.indices]
        torque = arm.links_torque(rows, point)
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        forces = np.stack([of_last(rows.at_rest(robot, axis)) for axis in -np.eye(3)])
        own = rows.motion.q[:, arm.indices]
        # Waves at each joint's own rate.
        phases = np.outer(rows.motion.time - first, rates)
        beside = [torque @ np.eye(len(rates), k=side) for side in (1, -1)]
        return np.dstack(
            (
                torque - weight,
                weight,
                moves.torque(others)[:, arm.indices],
                of_last(moves),
                *np.moveaxis(forces, -1, 0).reshape(len(FORCE), *own.shape),
                own,
                np.sin(own),
                np.cos(own),
                np.cos(phases),
                np.sin(phases),
                *beside,
            )
        )

    names = (
        INERTIAL,
        WEIGHT,
        OTHER_WEIGHT,
        *LAST_WEIGHT,
        *FORCE,
        *SPRING,
        *ECCENTRIC_SPRING,
        *HUM,
        *NEIGHBOURS,
    )
    return [Term("", tuple(map(Parameter, names)), columns)]


def strongest_rate(time: Array, residual: Array) -> float:
    """Return the rate of the strongest sine in a residual (K,) at times (K,) [rad/s].

    From 2 periods per log on, in steps of a quarter of a period, by a Fourier transform of the
    residual on an even grid.
    """
    step = max(np.median(np.diff(time)), 1e-9)
    grid = np.bincount(np.rint(time / step).astype(int), residual)
    size = _STEPS_PER_PERIOD * len(grid)
    least = _LEAST_PERIODS * _STEPS_PER_PERIOD
    spectrum = np.abs(np.fft.rfft(grid, size))[: int(_LARGEST_RATE_SHARE * size)]
    return float(2.0 * np.pi * (least + np.argmax(spectrum[least:])) / (size * step))

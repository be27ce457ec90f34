"""Measured torques beside predicted ones, from the equations that a result was made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from robot_sysid.identify.samples import DecimatedSamples, joined
from robot_sysid.records import Array, JointLimits, Motion, RobotModel
from robot_sysid.records.traces import Traces

_NOT_FRICTION = ("armature", "zero", "scale", "drift")


def traced(
    robot: RobotModel,
    samples: Sequence[DecimatedSamples],
    motions: Sequence[Motion],
    after: Mapping[str, float],
    before: Mapping[str, float],
) -> Traces:
    """Return what was measured and predicted.

    Args:
        robot: the arm.
        samples: equations of each log.
        motions: the motion of each log, about at the instants of its equations.
        after, before: parameter name to value of the result and of what was known before; what is
            missing is zero.
    """
    rows = joined(samples)
    place = [robot.joint_names.index(joint) for joint in rows.joints]
    used = np.isfinite(np.stack(rows.tau, axis=1))
    measured = np.stack(rows.measured, axis=1)
    missing = np.stack(rows.tau, axis=1)
    limits = robot.limits
    return Traces(
        joints=rows.joints,
        is_slide=tuple(bool(robot.is_slide[j]) for j in place),
        time=rows.time,
        q=_joined_at(samples, motions, "q")[:, place],
        qd=_joined_at(samples, motions, "qd")[:, place],
        measured=np.where(used, measured, np.nan),
        predicted=measured - missing + _products(rows, after),
        before=measured - missing + _products(rows, before),
        friction=_products(rows, {k: v for k, v in after.items() if _is_friction(k)}),
        limits=JointLimits(
            limits.lower[place], limits.upper[place], limits.velocity[place], limits.torque[place]
        ),
    )


def _products(rows: DecimatedSamples, values: Mapping[str, float]) -> Array:
    """Return (K, joints) the torque that some parameters make [N m]."""
    known = np.array([values.get(name, 0.0) for name in rows.names])
    pairs = zip(rows.rows, rows.columns)
    return np.stack([block @ known[columns] for block, columns in pairs], axis=1)


def _is_friction(name: str) -> bool:
    term, bracket, _ = name.partition("[")
    return bool(bracket) and term not in _NOT_FRICTION


def _joined_at(
    samples: Sequence[DecimatedSamples], motions: Sequence[Motion], quantity: str
) -> Array:
    """Return a quantity (K, n) of the motions at the instants of the samples."""
    parts = []
    for each, motion in zip(samples, motions):
        values = np.asarray(getattr(motion, quantity))
        columns = [np.interp(each.time, motion.time, column) for column in values.T]
        parts.append(np.stack(columns, axis=1))
    return np.concatenate(parts)

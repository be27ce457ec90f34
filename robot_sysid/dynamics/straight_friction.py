"""Friction of an arm as cards of simulators state it: straight lines, and friction of a load.

Most readers know dry and viscous friction alone. Where a model states damping that is a polynomial
of speed, cards have the straight line that is nearest to it over the speeds of the logs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.friction import LEAST_TOP, POLYNOMIAL
from robot_sysid.records import Array, RobotModel, Traces
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.messages import position_unit
from robot_sysid.records.quantities import Quantity

SPEEDS = 200
"""Number of speeds, evenly spaced up to a joint's limit, that stand for those of an unknown log."""


@dataclass(frozen=True)
class StraightFriction:
    """Friction of n joints, dry and viscous.

    Attributes:
        dry: (n,) [N m; N of slides].
        viscous: (n,) [N m s/rad; N s/m of slides].
        replaced: what the model states instead, a line for each joint of which this is not all.
    """

    dry: Array
    viscous: Array
    replaced: tuple[str, ...] = ()


def straight_friction(robot: RobotModel, traces: Traces | None) -> StraightFriction:
    """Return the straight lines nearest to the friction that an arm's model states.

    Args:
        robot: the arm.
        traces: speeds of its logs; without them all speeds up to a joint's limit count the same.
    """
    dry = robot.friction.coulomb.copy()
    viscous = robot.friction.viscous.copy()
    quadratic, cubic = (term.stated_value(robot) for term in POLYNOMIAL)
    lines = []
    for k in np.flatnonzero((quadratic != 0.0) | (cubic != 0.0)).tolist():
        name = robot.joint_names[k]
        speed = _speeds(traces, name, float(robot.limits.velocity[k]))
        linear = viscous[k]
        torque = dry[k] + (linear + (quadratic[k] + cubic[k] * speed) * speed) * speed
        dry[k], viscous[k] = _nearest((np.ones_like(speed), speed), torque)
        lines.append(
            f"{name!r}: {linear:.4g} v + {quadratic[k]:.4g} v |v| + {cubic[k]:.4g} v^3, line up to "
            f"{np.max(speed):.3g} {position_unit(robot.is_slide[k])}/s"
        )
    return StraightFriction(dry, viscous, tuple(lines))


def _speeds(traces: Traces | None, joint: str, limit: float) -> Array:
    """Return how fast (K,) a joint was at the samples of its logs that were used [rad/s or m/s]."""
    if traces is not None and joint in traces.joints:
        k = traces.joints.index(joint)
        is_used = np.isfinite(traces.measured[:, k])
        if np.any(is_used):
            return np.abs(traces.qd[is_used, k])
    return np.linspace(0.0, limit if np.isfinite(limit) else LEAST_TOP, SPEEDS)


def _nearest(columns: Sequence[Array], torque: Array) -> Iterable[float]:
    """Return the factors, none of them negative, of columns (K,) whose sum is nearest to a torque.

    Friction that drives a joint would be worse than a line that is a little further off.
    """
    from scipy.optimize import nnls

    factors, _ = nnls(np.column_stack(columns), torque)
    return [*map(float, factors)]


@dataclass(frozen=True)
class LoadedFriction:
    """Friction of a joint that grows with the torque of its motor.

    Attributes:
        base: dry friction without a load [N m; N of slides].
        viscous: [N m s/rad; N s/m of slides].
        load: friction per torque of the motor.
    """

    base: float
    viscous: float
    load: float = 0.0


def load_shares(rows: Iterable[Quantity]) -> dict[str, float]:
    """Return joint name to the share of its load that it loses to friction.

    Only of joints whose share is two standard errors from zero. ``rows`` are those of a result.
    """
    shares = {}
    for row in rows:
        if row.name not in ("load", "further_load") or row.error is None:
            continue
        if row.value > INTERVAL * row.error:
            shares[row.of] = float(row.value)
    return shares


def loaded_friction(
    robot: RobotModel,
    straight: StraightFriction,
    traces: Traces | None,
    shares: Mapping[str, float],
) -> dict[str, LoadedFriction]:
    """Return joint name to its friction, a part of which grows with load.

    Over the samples of the logs friction stays that of the straight line: the dry part gets smaller
    by what the load makes of it there.

    Args:
        robot: the arm.
        straight: its friction without that part.
        traces: speeds and torques of its logs; without them no part grows with load.
        shares: joint name to the part's share of the load; a missing one is zero.
    """
    friction = {}
    for k, name in enumerate(robot.joint_names):
        dry = float(straight.dry[k])
        viscous = float(straight.viscous[k])
        share = 0.0
        if name in shares and traces is not None and name in traces.joints:
            share = shares[name]
            column = traces.joints.index(name)
            is_used = np.isfinite(traces.measured[:, column])
            speed = np.abs(traces.qd[is_used, column])
            load = np.abs(traces.predicted[is_used, column])
            torque = dry + viscous * speed - share * load
            dry, viscous = _nearest((np.ones_like(speed), speed), torque)
        friction[name] = LoadedFriction(dry, viscous, share)
    return friction

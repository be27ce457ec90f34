"""Finding the one cause that best explains a sudden change of an arm's holding torques."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.references import HoldingCheck
from robot_sysid.records import Array

_NO_CHANGE = 1.0
"""Torque change below which no joint has changed, in units of ``HoldingCheck.doubt``."""
_EXPLAINED = 0.6
"""Least share of the sum of squares that a named cause has to explain."""
_BETTER = 0.5
"""Most unexplained squares of a cause, relative to a weak motor's, to be named in its place."""
_ALONE = 0.3
"""Share of the largest change below which the changes of other joints are negligible."""
_LEAST_LOAD = 0.1
"""Least mass of a new load that is named [kg] (a judgement)."""
_LEAST_ZERO_SHIFT = 0.02
"""Least shift of a zero that is named [rad] (a judgement)."""
_MOST_ZERO_SHIFT = 1.0
"""Largest shift of a zero that is named [rad] (a judgement)."""
_ZERO_STEP = 0.02
"""Step of the central difference of the torque by a joint's position [rad]."""


@dataclass(frozen=True)
class EffortChange:
    """A sudden change of the torque that a joint's control adds to the feed-forward torque.

    Attributes:
        joint: index of the joint in which the change was noticed.
        baseline: torque (n,) that the control of all joints added before the change [N m].
        at_once: torque (n,) that it added when the change was noticed [N m].
    """

    joint: int
    baseline: Array
    at_once: Array


class _Cause(NamedTuple):
    """A possible cause: a sentence, and the torque (n,) that it makes, up to a factor [N m]."""

    text: str
    shape: Array


def explain_change(
    change: EffortChange,
    holding: HoldingCheck,
    q: Array,
    commanded: Array,
    fed: Array,
    joints: Sequence[DamiaoJoint],
) -> str:
    """Return a sentence with the cause of the change that stopped an arm.

    Each possible cause makes torques of a certain shape over the joints, times an unknown factor.
    The cause whose fitted torques leave the least sum of squares unexplained is named. A weak motor
    changes the torque of its own joint only, and is named unless another cause explains much more.

    Args:
        change: change that stopped the run.
        holding: computes the torque that carries the arm, from a model or the trajectory file.
        q: positions (n,) of the stopped arm [rad].
        commanded: commanded torque (n,) that holds the arm there [N m].
        fed: feed-forward torque (n,) that should hold the arm where there is no model [N m].
        joints: joints of the arm, base to terminal.
    """
    n_joints = holding.n_joints
    needed = (holding.torque(q) if holding.is_model else fed)[:n_joints]
    residual = (commanded - change.baseline)[:n_joints] - needed
    weighted = residual / holding.doubt
    if np.max(np.abs(weighted)) < _NO_CHANGE:
        return _explain_passing_change(change, needed, holding, joints)
    weak_motors = _weak_motor_causes(residual, needed, joints)
    weak = [_unexplained_squares(cause, weighted, holding) for cause in weak_motors]
    changes = _load_and_zero_causes(holding, q, residual, joints)
    others = [_unexplained_squares(cause, weighted, holding) for cause in changes]
    best_weak = min(weak, default=(np.inf, ""))
    best_other = min(others, default=(np.inf, ""))
    unexplained, text = (
        best_other if best_other[0] < _BETTER * best_weak[0] else best_weak
    )
    if unexplained > (1.0 - _EXPLAINED) * float(weighted @ weighted):
        return "something pushes it or holds it back, or it carries more than before"
    return text


def _explain_passing_change(
    change: EffortChange,
    needed: Array,
    holding: HoldingCheck,
    joints: Sequence[DamiaoJoint],
) -> str:
    """Return a sentence with the cause of a change that has vanished since the arm stopped.

    ``needed`` is the torque (n,) that carries the arm [N m].
    """
    sudden = (change.at_once - change.baseline)[: holding.n_joints]
    weighted = np.abs(sudden / holding.doubt)
    is_alone = change.joint == int(np.argmax(weighted)) and (
        np.sort(weighted)[-2:].min() < _ALONE * weighted[change.joint]
    )
    if is_alone and sudden[change.joint] * needed[change.joint] > 0.0:
        return f"{joints[change.joint].label} was held back for a moment, or its motor is weak"
    return "something pushed it for a moment"


def _unexplained_squares(
    cause: _Cause, weighted: Array, holding: HoldingCheck
) -> tuple[float, str]:
    """Return the sum of squares that a cause leaves unexplained, and the cause's text.

    ``weighted`` (n,) are the torques to be explained, in units of ``holding.doubt``.
    """
    shape = cause.shape / holding.doubt
    explained = float(weighted @ shape) ** 2 / max(float(shape @ shape), 1e-12)
    return float(weighted @ weighted) - explained, cause.text


def _weak_motor_causes(
    residual: Array, needed: Array, joints: Sequence[DamiaoJoint]
) -> Iterator[_Cause]:
    """Yield a cause for each joint whose motor may make only a share of its commanded torque.

    ``residual`` (n,) is commanded minus expected torque, ``needed`` (n,) the expected one [N m].
    """
    commanded = needed + residual
    for j, shape in enumerate(np.eye(len(residual))):
        share = needed[j] / commanded[j] if commanded[j] else 1.0
        if 0.0 < share < 1.0:
            statement = f"{joints[j].label} makes {share:.2f} times the torque that it is commanded"
            yield _Cause(f"{statement}: its motor is weak", shape)


def _load_and_zero_causes(
    holding: HoldingCheck, q: Array, residual: Array, joints: Sequence[DamiaoJoint]
) -> Iterator[_Cause]:
    """Yield a cause for a new load and for each joint whose zero may have moved.

    Nothing is yielded without a model. ``q`` (n,) are the positions [rad], ``residual`` (n,) is
    commanded minus expected torque [N m].
    """
    if not holding.is_model:
        return
    load = holding.load(q)
    mass = _fit_coefficient(load, residual, holding.doubt)
    if mass > _LEAST_LOAD:
        yield _Cause(
            f"the arm carries about {mass:.1f} kg more at its end than before", load
        )
    for j, unit in enumerate(np.eye(len(q))[: len(residual)]):
        step = _ZERO_STEP * unit
        slope = (holding.torque(q + step) - holding.torque(q - step)) / (
            2.0 * _ZERO_STEP
        )
        shift = _fit_coefficient(slope[: len(residual)], residual, holding.doubt)
        if _LEAST_ZERO_SHIFT < abs(shift) < _MOST_ZERO_SHIFT:
            moved = f"the zero of {joints[j].label} has moved by {abs(shift):.2f} rad"
            yield _Cause(
                f"{moved}: its gear or its encoder slips", slope[: len(residual)]
            )


def _fit_coefficient(shape: Array, residual: Array, doubt: Array) -> float:
    """Return the factor of ``shape`` (n,) that fits ``residual`` (n,) best [N m].

    It is the least-squares solution with each joint divided by its ``doubt`` (n,) [N m].
    """
    weighted = shape / doubt
    return float(weighted @ (residual / doubt)) / max(float(weighted @ weighted), 1e-12)

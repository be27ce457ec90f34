"""Finding the one cause that best explains a sudden change of an arm's holding torques.

The unit "doubts" is the torque of each joint that friction alone may explain,
``HoldingCheck.doubt``: torques are divided by it before they are compared. The n joints of the arm
may be followed by m further motors, which are only held; they are left out here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.references import HoldingCheck
from robot_sysid.records import Array

_NO_CHANGE = 1.0
"""Torque change below which a joint counts as unchanged [doubts]."""
_EXPLAINED = 0.6
"""Least share of the sum of squared torques that a cause has to explain to be named."""
_BETTER = 0.5
"""A cause is named in place of a weak motor if the sum of squares that it leaves unexplained is
less than this share of the sum that the weak motor leaves."""
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
        baseline: torque (n + m,) that the control of all joints added before the change [N m].
        at_once: torque (n + m,) that it added when the change was noticed [N m].
    """

    joint: int
    baseline: Array
    at_once: Array


class _Cause(NamedTuple):
    """A possible cause: a sentence, and the torque (n,) that it makes, up to a factor [doubts]."""

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
    """Return a sentence with the cause of the change that stopped an arm; "" if a torque is NaN.

    Each possible cause makes torques of a certain shape over the joints, times an unknown factor.
    The cause whose fitted torques leave the least sum of squares unexplained is named. A weak motor
    changes the torque of its own joint only, and is named unless another cause explains much more.

    Args:
        change: change that stopped the run.
        holding: computes the torque that carries the arm, from a model or the trajectory file.
        q: positions (n + m,) of the stopped arm [rad].
        commanded: commanded torque (n + m,) that holds the arm there [N m].
        fed: feed-forward torque (n + m,) that should hold the arm where there is no model [N m].
        joints: joints of the arm, base to terminal, then the further motors.
    """
    n_joints = holding.n_joints
    needed = (holding.torque(q) if holding.is_model else fed)[:n_joints]
    residual = (commanded - change.baseline)[:n_joints] - needed
    weighted = residual / holding.doubt
    if np.max(np.abs(weighted)) < _NO_CHANGE:
        return _explain_passing_change(change, needed, holding, joints)
    weak_motors = _weak_motor_causes(residual, needed, holding.doubt, joints)
    changes = _load_and_zero_causes(holding, q, weighted, joints)
    best_weak = _best_cause(weak_motors, weighted)
    best_other = _best_cause(changes, weighted)
    is_weak = best_other[0] >= _BETTER * best_weak[0]
    unexplained, text = best_weak if is_weak else best_other
    # A NaN passes all comparisons here; the text of the best cause is then "".
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

    One joint alone was held back, or is weak, if no other one changed much and the control pushed
    it in the direction of ``needed`` (n,), the torque that carries the arm [N m]. The other
    arguments are those of ``explain_change``.
    """
    sudden = (change.at_once - change.baseline)[: holding.n_joints]
    weighted = np.abs(sudden / holding.doubt)
    # The second largest change; of a single joint its own.
    runner_up = np.sort(weighted)[-2:].min()
    is_largest = change.joint == int(np.argmax(weighted))
    is_alone = is_largest and runner_up < _ALONE * weighted[change.joint]
    if is_alone and sudden[change.joint] * needed[change.joint] > 0.0:
        return f"{joints[change.joint].label} was held back for a moment, or its motor is weak"
    return "something pushed it for a moment"


def _best_cause(causes: Iterator[_Cause], weighted: Array) -> tuple[float, str]:
    """Return the least sum of squares that one of ``causes`` leaves unexplained, and its text.

    Each cause is fitted alone, with a factor of its own. Without any cause the sum is infinite and
    the text "". ``weighted`` (n,) is the torque to be explained [doubts].
    """
    best = np.inf, ""
    for text, shape in causes:
        explained = float(weighted @ shape) ** 2 / max(float(shape @ shape), 1e-12)
        best = min(best, (float(weighted @ weighted) - explained, text))
    return best


def _weak_motor_causes(
    residual: Array, needed: Array, doubt: Array, joints: Sequence[DamiaoJoint]
) -> Iterator[_Cause]:
    """Yield a cause for each joint whose motor may make only a share of its commanded torque.

    ``residual`` (n,) is commanded minus expected torque, ``needed`` (n,) the expected one, and
    ``doubt`` (n,) the torque that friction alone may explain [N m].
    """
    commanded = needed + residual
    for j, unit_torque in enumerate(np.eye(len(residual))):
        share = needed[j] / commanded[j] if commanded[j] else 1.0
        if 0.0 < share < 1.0:
            statement = f"{joints[j].label} makes {share:.2f} times the torque that it is commanded"
            yield _Cause(f"{statement}: its motor is weak", unit_torque / doubt)


def _load_and_zero_causes(
    holding: HoldingCheck, q: Array, weighted: Array, joints: Sequence[DamiaoJoint]
) -> Iterator[_Cause]:
    """Yield a cause for a new load and for each joint whose zero may have moved.

    Nothing is yielded without a model.

    Args:
        holding: computes the torque that carries the arm, or a load at its end.
        q: positions (n + m,) of the n joints and m further motors [rad].
        weighted: commanded minus expected torque (n,) [doubts].
        joints: joints of the arm, base to terminal, then the further motors.
    """
    if not holding.is_model:
        return
    load = holding.load(q) / holding.doubt
    mass = _fit_coefficient(load, weighted)
    if mass > _LEAST_LOAD:
        text = f"the arm carries about {mass:.1f} kg more at its end than before"
        yield _Cause(text, load)
    for step, joint in zip(_ZERO_STEP * np.eye(len(q)), joints[: len(weighted)]):
        change = holding.torque(q + step) - holding.torque(q - step)
        slope = (change / (2.0 * _ZERO_STEP))[: len(weighted)] / holding.doubt
        shift = _fit_coefficient(slope, weighted)
        if _LEAST_ZERO_SHIFT < abs(shift) < _MOST_ZERO_SHIFT:
            text = f"the zero of {joint.label} has moved by {abs(shift):.2f} rad"
            yield _Cause(f"{text}: its gear or its encoder slips", slope)


def _fit_coefficient(shape: Array, weighted: Array) -> float:
    """Return the factor of ``shape`` (n,) that fits ``weighted`` (n,) best by least squares."""
    return float(shape @ weighted) / max(float(shape @ shape), 1e-12)

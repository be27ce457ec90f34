"""Dry friction that a model states otherwise than as that of a joint or tendon.

MuJoCo 4 has two forms of dry friction that bends before it slides: a spring that yields
(``springyield``), and a DC motor whose bristles bend (LuGre: Canudas de Wit and others, "A new
model for control of systems with friction", 1995). Once a joint has moved on by the travel at which
they yield, the spring's torque is stiffness times yield and the motor's is Coulomb friction, both
against the motion: nothing depends on the position. So they are read as ``frictionloss`` of the
joint or fixed tendon, in which all else finds dry friction, and identified friction takes their
place.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.passive import DC_BIAS
from robot_sysid.errors import ModelError
from robot_sysid.model.actuators import (
    AT_JOINT,
    AT_TENDON,
    gear_ratio,
    tendon_coefficients,
)

LARGEST_YIELD = 0.1
"""Largest travel at which a spring yields, as a share of its joint's range, for it to be dry
friction: one that yields later is elastic over much of what a log shows, and stiffness times yield
is no friction of it."""
COULOMB_OF_MOTOR = 3
"""Place of a DC motor's Coulomb friction among the numbers of its bias; static friction and the
speed between the two follow."""
BRISTLES = 5
"""Place of the stiffness of its bristles among the numbers of its dynamics; damping follows."""
SPRING_NUMBERS = ("stiffness", "springyield")
"""Attributes of a joint or tendon that make a spring that yields."""
_ONE_DOF = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def with_dry_friction_in_joints(mj_model: Any) -> Any:
    """Return a model whose joints and tendons have all its dry friction as ``frictionloss``.

    Springs that yield have no stiffness any more, and DC motors no bristles; their yield and
    Coulomb friction stay as they are, by which they are found. Without any, it is the model itself.
    """
    joints = _yielding(mj_model, "jnt") & np.isin(mj_model.jnt_type, _ONE_DOF)
    tendons = _yielding(mj_model, "tendon")
    motors = has_lugre(mj_model)
    if motors.any():
        motors &= mj_model.actuator_dynprm[:, BRISTLES] > 0.0
    if not (joints.any() or tendons.any() or motors.any()):
        return mj_model
    folded = copy.copy(mj_model)
    for joint in np.flatnonzero(joints).tolist():
        dof = mj_model.jnt_dofadr[joint]
        folded.dof_frictionloss[dof] += _take_spring(folded, "jnt", joint)
    for tendon in np.flatnonzero(tendons).tolist():
        if np.any(tendon_coefficients(mj_model, tendon)):
            folded.tendon_frictionloss[tendon] += _take_spring(folded, "tendon", tendon)
    for actuator in np.flatnonzero(motors).tolist():
        _fold_motor(folded, actuator)
    return folded


def has_lugre(mj_model: Any) -> NDArray[np.bool_]:
    """Return which actuators (k,) of a compiled model are DC motors with dry friction."""
    is_motor = mj_model.actuator_biastype == DC_BIAS
    friction = mj_model.actuator_biasprm[:, COULOMB_OF_MOTOR]
    return np.asarray(is_motor & (friction > 0.0))


def yields(mj_model: Any, owner: str, row: int) -> bool:
    """Return whether a joint's ("jnt") or tendon's ("tendon") spring (row) is dry friction."""
    travel = getattr(mj_model, f"{owner}_springyield", None)
    return travel is not None and bool(travel[row] > 0.0)


def _yielding(mj_model: Any, owner: str) -> NDArray[np.bool_]:
    """Return which joints ("jnt") or tendons ("tendon") have springs that yield."""
    stiffness = getattr(mj_model, f"{owner}_stiffness")
    if not hasattr(mj_model, f"{owner}_springyield"):
        return np.zeros(len(stiffness), dtype=bool)
    travel = getattr(mj_model, f"{owner}_springyield")
    is_spring = stiffness != 0.0
    is_spring |= np.any(getattr(mj_model, f"{owner}_stiffnesspoly"), axis=1)
    return np.asarray(is_spring & (travel > 0.0))


def _take_spring(folded: Any, owner: str, row: int) -> float:
    """Take the spring of a joint or tendon out of a model, and return its torque as it yields."""
    travel = getattr(folded, f"{owner}_springyield")[row]
    stiffness = getattr(folded, f"{owner}_stiffness")
    further = getattr(folded, f"{owner}_stiffnesspoly")
    # The mean of both directions has no even powers.
    friction = stiffness[row] * travel + further[row, 1] * travel**3
    stiffness[row] = 0.0
    further[row] = 0.0
    return max(float(friction), 0.0)


def _fold_motor(folded: Any, actuator: int) -> None:
    """Give the joint or tendon of a DC motor (id) its dry friction, in place.

    ModelError where it acts on neither.
    """
    target = int(folded.actuator_trnid[actuator, 0])
    kind = int(folded.actuator_trntype[actuator])
    friction = folded.actuator_biasprm[actuator, COULOMB_OF_MOTOR]
    friction *= abs(gear_ratio(folded, actuator))
    if kind in AT_JOINT:
        folded.dof_frictionloss[folded.jnt_dofadr[target]] += friction
    elif kind in AT_TENDON and np.any(tendon_coefficients(folded, target)):
        folded.tendon_frictionloss[target] += friction
    else:
        raise ModelError(
            f"the LuGre friction of actuator {actuator_label(folded, actuator)} cannot be counted, "
            "because it acts on neither a joint nor a fixed tendon; give the joints frictionloss"
        )
    folded.actuator_dynprm[actuator, BRISTLES : BRISTLES + 2] = 0.0
    # The state of the bristles; those of other actuators keep their places.
    folded.actuator_actnum[actuator] -= 1


def actuator_label(mj_model: Any, actuator: int) -> str:
    """Return the name of an actuator (id), or "#id" where it has none."""
    return mj_model.actuator(actuator).name or f"#{actuator}"


def refuse_late_yield(
    mj_model: Any, joints: Sequence[int], names: Sequence[str]
) -> None:
    """Raise ModelError where a spring of the arm's joints (ids) is neither spring nor friction."""
    for joint, name in zip(joints, names):
        low, high = mj_model.jnt_range[joint]
        travel = high - low if mj_model.jnt_limited[joint] else 2.0 * np.pi
        if not yields(mj_model, "jnt", joint):
            continue
        yielding = float(mj_model.jnt_springyield[joint])
        if yielding > LARGEST_YIELD * travel:
            raise ModelError(
                f"the spring of joint {name} yields at {yielding:.3g}, which is more than "
                f"{100 * LARGEST_YIELD:g} % of the joint's range: it is neither a spring nor dry "
                "friction; remove springyield from the model, or give the joint frictionloss"
            )


def friction_notes(
    mj_model: Any, joints: Sequence[int], names: Sequence[str]
) -> Iterator[str]:
    """Yield sentences on dry friction of the arm's joints (ids) that is stated otherwise."""
    springs = [
        name for joint, name in zip(joints, names) if yields(mj_model, "jnt", joint)
    ]
    replaced = "a written model has what is identified of friction in"
    if springs:
        yield (
            f"the springs of {', '.join(springs)} yield (springyield): they count as dry friction, "
            f"and {replaced} their place"
        )
    motors = [
        actuator_label(mj_model, actuator)
        for actuator in np.flatnonzero(has_lugre(mj_model)).tolist()
    ]
    if motors:
        yield (
            f"the LuGre friction of actuators {', '.join(motors)} counts as dry friction of what "
            f"they move, and {replaced} its place"
        )

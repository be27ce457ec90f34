"""The friction that was identified, as a model file can hold it: Coulomb and viscous."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.mjcf.changes import JointChange
from robot_sysid.records import Array, Identification, Motion

_NOT_FRICTION = ("offset", "armature")


def friction_changes(
    found: Identification, motion: Motion
) -> tuple[tuple[JointChange, ...], tuple[str, ...]]:
    """Return (what the joints get, a sentence on what cannot be written).

    Terms that a model does not have are drawn into the Coulomb and viscous friction that come
    nearest to all of them over the speeds of the motion. What the data does not show, or knows so
    badly that the model's value is as good, stays the model's.

    Args:
        found: a result; that of the model's own simulation changes no friction.
        motion: the joints' speeds.
    """
    model = friction_model(found.friction_model or "none")
    if not found.data.source.is_measured or not {"coulomb", "viscous"} <= set(model.terms):
        return (), ()
    if "load" in model.terms:
        return (), ("friction that grows with the load fits no model file: the model's is kept",)
    changes = []
    for index, joint in enumerate(found.joint_names):
        values = _values(found, model, joint)
        if values is not None:
            nearest = _nearest(model, values, motion.qd[:, index])
            coulomb, viscous = (
                None if _is_unproven(found, index, term, value) else value
                for term, value in zip(("coulomb", "viscous"), nearest)
            )
            changes.append(JointChange(joint, None, viscous, coulomb))
    return tuple(change for change in changes if change.numbers), ()


def _is_unproven(found: Identification, index: int, term: str, value: float) -> bool:
    """Whether a coefficient is smaller than its error, and no farther from the model's."""
    if found.model_friction is None:
        return False
    error = found.estimate.error(f"{term}[{found.joint_names[index]}]") or 0.0
    own = float(getattr(found.model_friction, term)[index])
    return value < error and abs(value - own) <= error


def _values(found: Identification, model: FrictionModel, joint: str) -> Array | None:
    """Return the coefficients (k,) of a joint, or None where the data does not show them."""
    names = model.parameter_names(joint)
    beside = np.isin(model.terms, _NOT_FRICTION)
    errors = np.array([found.estimate.error(name) for name in names], dtype=float)
    if not np.all(np.isfinite(errors[~beside])):
        return None
    return np.where(beside, 0.0, [found.estimate.value(name) or 0.0 for name in names])


def _nearest(model: FrictionModel, values: Array, qd: Array) -> tuple[float, float]:
    """Return the Coulomb and viscous friction, not negative, nearest to a friction curve."""
    from scipy.optimize import nnls

    curve = model.columns(qd, np.zeros_like(qd), np.zeros_like(qd)) @ values
    (coulomb, viscous), _ = nnls(np.column_stack((np.sign(qd), qd)), curve)
    return float(coulomb), float(viscous)

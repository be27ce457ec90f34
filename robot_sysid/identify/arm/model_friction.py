"""Each joint's friction as a model file can hold it, what it cannot hold, and the measured curve.

A file has Coulomb and viscous friction, MJCF for MuJoCo 3.7 and later also quadratic and cubic
damping, all of them >= 0. They are fitted to the friction torque that the logs show: what is left
of the measured torque once links, rotor, offset and zeros are taken off.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import BENT, TERMS, FrictionModel, friction_model, speed_name
from robot_sysid.estimation.arm.errors import correlation_stretch
from robot_sysid.identify.arm.fit import ArmFit, block_masks
from robot_sysid.identify.arm.friction_choice import is_clearly_lower
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.whole_arm import ArmEstimate, FrictionCurve, HeldFriction

LINEAR, POLYNOMIAL = ("coulomb", "viscous"), ("coulomb", "viscous", "quadratic", "cubic")
PROVEN = 2.0
"""Standard errors that a value has to be away from zero to be proven."""
OFFSET = "offset_or_asymmetry"
_POINTS, _BINS, _FEWEST_ROWS, _ONE_WAY = 61, 12, 3, 0.99
_NO_FRICTION = ("offset", "armature")


def model_friction(
    robot: RobotModel, fit: ArmFit, estimate: ArmEstimate, offsets: bool = False
) -> dict[str, HeldFriction]:
    """Return, per joint, what a model file can hold.

    Args:
        robot: the arm, with the file's own numbers.
        fit: what was found.
        estimate: the same with standard errors.
        offsets: whether proven offsets go into the file too.
    """
    errors = dict(zip(estimate.names, estimate.standard_errors.tolist()))
    held = {
        joint: _held(robot, fit, index, errors) for index, joint in enumerate(robot.joint_names)
    }
    if not offsets:
        return held
    return {
        joint: _with_offset(robot, index, held[joint], errors.get(f"offset[{joint}]", 0.0))
        for index, joint in enumerate(robot.joint_names)
    }


def _with_offset(robot: RobotModel, index: int, held: HeldFriction, error: float) -> HeldFriction:
    """Return what a file can hold with a spring that makes the offset, where it is proven."""
    missing, joint = dict(held.missing), robot.joint_names[index]
    offset = missing.pop(OFFSET, None)
    if offset is None:
        return held
    own = held.written("coulomb")
    coulomb = float(robot.friction.coulomb[index]) if own is None else own
    reason = _why_no_offset(robot, index, abs(offset), coulomb)
    if reason:
        return replace(held, notes=(*held.notes, f"{joint}: no offset is written, {reason}"))
    values, errors = {**held.values, "offset": offset}, {**held.errors, "offset": error}
    return replace(held, values=values, errors=errors, missing=missing)


def _why_no_offset(robot: RobotModel, index: int, size: float, coulomb: float) -> str | None:
    """Return why a file must not get an offset of a size [N m], or None."""
    if robot.kind != "mjcf":
        return "a URDF cannot hold it"
    joint = robot.mj_model.dof_jntid[robot.dof_index[index]]
    further = getattr(robot.mj_model, "jnt_stiffnesspoly", np.zeros((joint + 1, 1)))
    if robot.mj_model.jnt_stiffness[joint] or np.any(further[joint]):
        return "its spring is the model's own"
    if size >= coulomb:
        return (
            f"{size:.2g} is more than its Coulomb friction of {coulomb:.2g}: the joint would creep "
            "by itself"
        )
    return None


@dataclass(frozen=True)
class _Rows:
    """One joint's rows of all logs.

    Attributes:
        columns: term to (K,) its column.
        found: (K,) friction torque of the terms that were found [N m].
        torque: (K,) the same with what the fit leaves over.
        load: (K,) the part of the gear's load.
        blocks: (K,) which part of the logs each row is in.
    """

    columns: Mapping[str, Array]
    found: Array
    torque: Array
    load: Array
    blocks: NDArray[np.int64]

    def matrix(self, terms: Sequence[str]) -> Array:
        """Return the columns (K, k) of some terms."""
        return np.column_stack([self.columns[term] for term in terms])


def _rows(fit: ArmFit, index: int, joint: str) -> _Rows:
    names, values = fit.columns.names, dict(zip(fit.columns.names, fit.values.tolist()))
    own = [f"{term}[{joint}]" for term in TERMS if term not in _NO_FRICTION]
    own += [speed_name(term, joint) for term in BENT]
    parts: list[tuple[dict[str, Array], Array, Array]] = []
    blocks = []
    for log in fit.samples:
        used = np.isfinite(log.tau[index])
        rows, places = log.rows[index][used], log.columns[index]
        column = {names[c]: rows[:, k] for k, c in enumerate(places)}
        left = log.tau[index][used] - rows @ fit.values[places]
        parts.append((column, sum(values[n] * column[n] for n in own) + 0.0 * left, left))
        blocks.append(np.argmax([mask[used] for mask in block_masks(log)], axis=0))
    every = {n: np.concatenate([column[n] for column, _, _ in parts]) for n in own}
    found = np.concatenate([friction for _, friction, _ in parts])
    left = np.concatenate([rest for _, _, rest in parts])
    load = f"load[{joint}]"
    columns = {name.partition("[")[0]: value for name, value in every.items()}
    return _Rows(columns, found, found + left, values[load] * every[load], np.concatenate(blocks))


def _held(robot: RobotModel, fit: ArmFit, index: int, errors: Mapping[str, float]) -> HeldFriction:
    joint = robot.joint_names[index]
    rows = _rows(fit, index, joint)
    if not len(rows.torque):
        return _unknown(joint)
    terms = POLYNOMIAL if _holds_polynomial(robot, index) and _bends(rows) else LINEAR
    own = {
        "coulomb": float(robot.friction.coulomb[index]),
        "viscous": float(robot.friction.viscous[index]),
        "armature": float(fit.columns.prior[fit.columns.names.index(f"armature[{joint}]")]),
    }
    values, spread = _bounded(rows, terms)
    rotor = dict(zip(fit.columns.names, fit.values.tolist())).get(f"armature[{joint}]", 0.0)
    values["armature"] = max(rotor, 0.0)
    for term in values:
        known = errors.get(f"{term}[{joint}]", 0.0)
        spread[term] = max(spread.get(term, 0.0), known)
    sought = "armature" in friction_model(fit.friction[joint]).terms
    kept = tuple(_unproven(values, spread, own, sought))
    held = {term: own[term] for term in kept if term in terms}
    values.update(_bounded(rows, terms, held)[0] if held else {})
    shown = {**values, **held}
    rest = rows.found - rows.matrix(terms) @ [shown[term] for term in terms]
    notes = tuple(_notes(joint, values, spread, own, kept))
    missing = dict(_missing(fit, joint, rows, rest, errors))
    return HeldFriction(values, spread, kept, missing, _curve(fit, index, rows), notes)


def _unknown(joint: str) -> HeldFriction:
    """Return what is known of a joint that does not move."""
    note = (
        f"{joint} does not move fast enough in these logs: nothing is learnt of its friction and "
        "rotor inertia, the model's own stay"
    )
    nothing = FrictionCurve(*[np.zeros(0)] * 6)
    return HeldFriction({}, {}, ("armature", *LINEAR), {}, nothing, (note,))


def _holds_polynomial(robot: RobotModel, index: int) -> bool:
    """Tell whether the file can hold nonlinear damping, and has none of its own there."""
    own = getattr(robot.mj_model, "dof_dampingpoly", None)
    return robot.kind == "mjcf" and own is not None and not np.any(own[robot.dof_index[index]])


def _bends(rows: _Rows) -> bool:
    """Tell whether the polynomial predicts held-out friction clearly better."""
    squared = {terms: [] for terms in (LINEAR, POLYNOMIAL)}  # type: ignore[var-annotated]
    for block in np.unique(rows.blocks):
        out = rows.blocks == block
        for terms, errors in squared.items():
            matrix = rows.matrix(terms)
            left = rows.torque[out] - matrix[out] @ _solved(matrix[~out], rows.torque[~out])
            errors.append(float(np.mean(left**2)))
    linear, bent = (np.array(squared[terms]) for terms in (LINEAR, POLYNOMIAL))
    return len(linear) > 1 and is_clearly_lower(bent, linear)


def _solved(matrix: Array, right: Array) -> Array:
    from scipy.optimize import nnls

    size = np.linalg.norm(matrix, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    return np.asarray(nnls(matrix / size, right)[0] / size)


def _bounded(
    rows: _Rows, terms: Sequence[str], held: Mapping[str, float] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the values >= 0 nearest to the measured friction, and their standard errors.

    Values of ``held`` are given; the others are fitted with them.
    """
    known, torque = held or {}, rows.torque
    for term, value in known.items():
        torque = torque - value * rows.columns[term]
    terms = [term for term in terms if term not in known]
    if not terms:
        return {}, {}
    matrix = rows.matrix(terms)
    values = _solved(matrix, torque)
    left = torque - matrix @ values
    size = np.where(np.any(matrix, axis=0), np.linalg.norm(matrix, axis=0), 1.0)
    inverse = np.linalg.pinv((matrix / size).T @ (matrix / size), hermitian=True)
    stretch = float(correlation_stretch([left])[0])
    noise = float(left @ left) / max(len(left) - len(terms), 1)
    errors = np.sqrt(np.maximum(np.diag(inverse) * noise * stretch, 0.0)) / size
    return dict(zip(terms, values.tolist())), dict(zip(terms, errors.tolist()))


def _unproven(
    values: Mapping[str, float], errors: Mapping[str, float], own: Mapping[str, float], sought: bool
) -> Iterator[str]:
    """Yield the terms of which the data shows neither that they are there nor the file wrong."""
    for term, before in own.items():
        room = PROVEN * errors[term]
        is_near = max(values[term], abs(values[term] - before)) <= room
        if is_near or (term == "armature" and not sought):
            yield term


def _notes(
    joint: str,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    own: Mapping[str, float],
    kept: Sequence[str],
) -> Iterator[str]:
    left = [f"{k} {values[k]:.2g} ± {errors[k]:.1g} (model {own[k]:.3g})" for k in own if k in kept]
    if left:
        yield f"{joint}: not proven, so that the model's own stays: {', '.join(left)}"
    for term in own:
        if term not in kept and values[term] == 0.0:
            yield f"{joint}: {term} would be negative; 0 is written, the rest fitted with it"


def _missing(
    fit: ArmFit, joint: str, rows: _Rows, rest: Array, errors: Mapping[str, float]
) -> Iterator[tuple[str, float]]:
    """Yield what a file cannot hold [N m]: each proven effect's size, what is left over in all."""
    values = dict(zip(fit.columns.names, fit.values.tolist()))
    for name, term in (("stribeck_drop", "stribeck"), (OFFSET, "offset")):
        size = values[f"{term}[{joint}]"]
        if abs(size) > PROVEN * errors.get(f"{term}[{joint}]", 0.0):
            yield name, size
    if np.any(rows.load):
        yield "load_dependent_rms", float(np.sqrt(np.mean(rows.load**2)))
    yield "left_over_rms", float(np.sqrt(np.mean(rest**2))) if len(rest) else 0.0


def _curve(fit: ArmFit, index: int, rows: _Rows) -> FrictionCurve:
    """Return the law that was found over the logs' speeds, and means of the measured rows."""
    joint = fit.samples[0].joints[index]
    # The viscous column is the speed itself, low-passed like the torque.
    speed, torque = rows.columns["viscous"], rows.torque - rows.load
    fastest = float(np.max(np.abs(speed), initial=0.0))
    grid = np.linspace(-1.0, 1.0, _POINTS) ** 3 * fastest
    values = dict(zip(fit.columns.names, fit.values.tolist()))
    law = np.zeros(_POINTS)
    for term in TERMS:
        if term in (*_NO_FRICTION, "load"):
            continue
        if term in BENT:
            column = BENT[term].column(grid, fit.bends.speed[term][index])
        else:
            column = FrictionModel((term,)).columns(grid, grid, grid)[:, 0]
        law += values[f"{term}[{joint}]"] * column
    # Rows that see the joint turn round show friction of both directions.
    one_way = np.abs(rows.columns["coulomb"]) > _ONE_WAY
    points = list(_means(speed[one_way], torque[one_way]))
    table = np.array(points).reshape(len(points), 4).T
    return FrictionCurve(grid, law, *table)


def _means(speed: Array, torque: Array) -> Iterator[tuple[float, float, float, int]]:
    """Yield mean speed, mean torque, its standard error and the number of rows, by speed."""
    for sign in (-1.0, 1.0):
        order = np.flatnonzero(sign * speed > 0.0)
        order = order[np.argsort(speed[order])]
        for part in np.array_split(order, _BINS):
            if len(part) >= _FEWEST_ROWS:
                error = float(np.std(torque[part], ddof=1)) / np.sqrt(len(part))
                yield float(np.mean(speed[part])), float(np.mean(torque[part])), error, len(part)

"""Invisible parameter combinations as short phrases an engineer can read.

A null space has many bases. The one shown is sparse: first what lies within the first moment or
within the inertia alone, then what mixes them, each in reduced row echelon form. A single parameter
that is invisible always appears by itself then.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid import spatial
from robot_sysid.records import Array

_TOLERANCE = 1e-6
_ROUNDING = 5e-3
_FIRST_MOMENT, _INERTIA = range(1, 4), range(4, 10)
_SINGLE = {
    "m": "mass",
    "hx": "first moment along x",
    "hy": "first moment along y",
    "hz": "first moment along z",
    "coulomb": "Coulomb friction",
    "viscous": "viscous friction",
}


def describe(null: Array, scale: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return one phrase per invisible direction.

    Args:
        null: (p, d) orthonormal basis of the invisible scaled coordinates.
        scale: (p,) parameters = scale * scaled coordinates.
        names: (p,) parameter names, the ten inertial ones first.
    """
    return tuple(_phrase(v * scale, names) for v in readable_basis(null))


def readable_basis(null: Array) -> list[Array]:
    """Return d vectors (p,) that span the null space and have few non-zero entries."""
    size, dimension = null.shape
    found: list[Array] = []
    for group in (_FIRST_MOMENT, _INERTIA, range(10), range(size)):
        for candidate in _row_echelon(_within(null, group)):
            if len(found) < dimension and _is_new(candidate, found):
                found.append(candidate)
    return sorted(found, key=lambda v: int(np.flatnonzero(v)[0]))


def _within(null: Array, group: Sequence[int]) -> Array:
    """Return (p, e) basis of the part of the null space that lives on ``group`` alone."""
    outside = np.setdiff1d(np.arange(len(null)), np.asarray(group))
    if len(outside) == 0 or null.shape[1] == 0:
        return null
    _, singular, right = np.linalg.svd(null[outside], full_matrices=True)
    padded = np.zeros(null.shape[1])
    padded[: len(singular)] = singular
    basis = null @ right[padded < _TOLERANCE].T
    basis[outside] = 0.0
    return basis


def _row_echelon(basis: Array) -> list[Array]:
    """Return the reduced row echelon form of the columns (p, e), largest pivots first."""
    rows = basis.T.copy()
    for k in range(len(rows)):
        _eliminate(rows, k)
    rows[np.abs(rows) < _TOLERANCE] = 0.0
    return [row / np.linalg.norm(row) for row in rows if np.any(row)]


def _eliminate(rows: Array, k: int) -> None:
    pivot_row, column = np.unravel_index(np.argmax(np.abs(rows[k:])), rows[k:].shape)
    rows[[k, k + pivot_row]] = rows[[k + pivot_row, k]]
    if abs(rows[k, column]) < _TOLERANCE:
        return
    rows[k] /= rows[k, column]
    others = np.arange(len(rows)) != k
    rows[others] -= np.outer(rows[others, column], rows[k])


def _is_new(candidate: Array, found: list[Array]) -> bool:
    if not found:
        return True
    known = np.array(found).T
    rest = candidate - known @ np.linalg.lstsq(known, candidate, rcond=None)[0]
    return bool(np.linalg.norm(rest) > _TOLERANCE)


def _phrase(direction: Array, names: Sequence[str]) -> str:
    used = [int(k) for k in np.flatnonzero(direction)]
    unit = direction / np.linalg.norm(direction)
    unit = unit * np.sign(unit[used[0]])
    if len(used) == 1:
        return _single(names[used[0]])
    if set(used) <= set(_FIRST_MOMENT):
        return f"first moment along {_axis(unit[1:4])}"
    if set(used) <= set(_INERTIA):
        return _inertia_phrase(unit, used, names)
    return _combination(unit, used, names)


def _single(name: str) -> str:
    kind, _, joint = name.partition("[")
    words = _SINGLE.get(kind, f"inertia {name}" if name in spatial.PARAMETER_NAMES else kind)
    return f"{words} of {joint.rstrip(']')}" if joint else words


def _inertia_phrase(unit: Array, used: list[int], names: Sequence[str]) -> str:
    if len(used) == 2 and abs(abs(unit[used[0]]) - abs(unit[used[1]])) < _ROUNDING:
        same = unit[used[0]] * unit[used[1]] > 0.0
        kind, sign = ("sum", "+") if same else ("difference", "-")
        return f"the {kind} {names[used[0]]} {sign} {names[used[1]]}"
    moments, axes = np.linalg.eigh(spatial.symmetric_from_six(unit[4:10]))
    spread = np.abs(moments - np.array([0.0, moments[2], moments[2]]))
    if np.max(spread) < _ROUNDING * moments[2]:
        return f"the sum of the two inertias transverse to {_axis(axes[:, 0])}"
    return _combination(unit, used, names)


def _axis(vector: Array) -> str:
    vector = vector / np.linalg.norm(vector)
    leading = vector[np.argmax(np.abs(vector) > _ROUNDING)]
    entries = np.round(vector * np.sign(leading), 2) + 0.0
    return "(" + ", ".join(f"{entry:g}" for entry in entries) + ")"


def _combination(unit: Array, used: list[int], names: Sequence[str]) -> str:
    text = f"{unit[used[0]]:.2g} {names[used[0]]}"
    for k in used[1:]:
        text += f" {'-' if unit[k] < 0 else '+'} {abs(unit[k]):.2g} {names[k]}"
    return text

"""Identifiability: rank, condition numbers, unidentifiable combinations, base parameters.

Columns are scaled first, so that units do not decide about rank: one scale for the mass, one for
the three first moments, one for the six inertias, one for each further parameter. Parameters of
one unit share a scale, because a column that is short beside the others of its unit is weakly
identified: an axis that is off by a hair shows the first moment along it at a millionth of the
others, and scaling that up would turn rounding into an estimate. A column that is nothing but
rounding noise is set to zero.

A null space has many bases. The reported basis is sparse: first directions within the first moment
or within the inertia alone, then mixed ones, each group in reduced row echelon form. A single
parameter that cannot be identified therefore always is a direction of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array, Identifiability

RELATIVE_CUT = 1e-10
"""Singular values (and column lengths) below this share of the largest count as zero."""
# Components of unit vectors below this count as zero; a choice, far above their rounding (1e-13).
_TOLERANCE = 1e-6
# Indices of the first moments among the parameters.
_FIRST_MOMENT = range(1, 4)
# Indices of the inertias among the parameters.
_INERTIA = range(4, 10)


@dataclass(frozen=True)
class VisibleSpace:
    """Decomposition A diag(scale) = left diag(singular) right^T of a matrix A (M, p) of rank r.

    A singular value decomposition without the singular values that count as zero. Visible are
    combinations of parameters that change A x, invisible those of its null space.

    Attributes:
        scale: (p,) x = scale * y turns scaled coordinates y into parameters x.
        left: (M, r) orthonormal basis of the visible right-hand sides.
        singular: (r,) singular values above ``RELATIVE_CUT``, descending.
        right: (p, r) orthonormal basis of the visible y.
        null: (p, p - r) orthonormal basis of the invisible y.
        zero: (p,) bool, whether a column is rounding noise.
    """

    scale: Array
    left: Array
    singular: Array
    right: Array
    null: Array
    zero: np.ndarray

    @property
    def rank(self) -> int:
        """Number of visible combinations r."""
        return len(self.singular)

    @property
    def is_identified(self) -> tuple[bool, ...]:
        """Per parameter (p,), whether it is zero in all invisible directions."""
        is_zero = np.linalg.norm(self.null, axis=1) < _TOLERANCE
        return tuple(is_zero.tolist())

    def solve(self, right_hand_side: Array) -> Array:
        """Return the least-squares solution x (p,) of A x = b (M,), of minimum norm in scaled y."""
        solution = self.right @ ((self.left.T @ right_hand_side) / self.singular)
        return np.where(self.zero, 0.0, self.scale * solution)

    def inverse_root(self) -> Array:
        """Return G (p, r) with G G^T = pseudo-inverse of A^T A in parameter units."""
        return self.scale[:, None] * self.right / self.singular

    def inverse(self) -> Array:
        """Return (p, p) the pseudo-inverse of A^T A in parameter units."""
        root = self.inverse_root()
        return root @ root.T


def visible_space(matrix: Array) -> VisibleSpace:
    """Return the visible space and null space of a stacked regressor (M, p).

    Its first ten columns are those of the inertial parameters of one link.
    """
    scale, zero = column_scale(matrix)
    scaled = np.where(zero, 0.0, matrix * scale)
    # At least p rows, so that ``right`` contains a basis of the null space as well.
    missing = max(matrix.shape[1] - len(matrix), 0)
    padded = np.pad(scaled, ((0, missing), (0, 0)))
    left, singular, right = np.linalg.svd(padded, full_matrices=False)
    rank = _count_visible(singular, np.max(singular, initial=0.0))
    left = left[: len(matrix), :rank]
    return VisibleSpace(
        scale, left, singular[:rank], right[:rank].T, right[rank:].T, zero
    )


def _count_visible(singular: NDArray[Any], largest: float) -> int:
    """Return how many singular values (k,) exceed ``RELATIVE_CUT`` of the ``largest`` one."""
    return int(np.count_nonzero(singular > RELATIVE_CUT * largest))


def column_scale(matrix: Array) -> tuple[Array, np.ndarray]:
    """Return (scale (p,), zero (p,)): the inverse length of each column of a matrix (M, p), and
    whether the column is rounding noise, below ``RELATIVE_CUT`` of the longest one.

    The first ten columns are those of the inertial parameters; the three first moments share the
    scale of their longest column, and so do the six inertias.
    """
    length = np.linalg.norm(matrix, axis=0)
    zero = length <= RELATIVE_CUT * np.max(length, initial=0.0)
    for group in (_FIRST_MOMENT, _INERTIA):
        length[group] = np.max(length[group], initial=0.0)
    return 1.0 / np.where(zero, 1.0, length), zero


def analyse_identifiability(
    matrix: Array, names: Sequence[str], joint: str
) -> Identifiability:
    """Return the identifiability of the terminal link and of its joint's friction.

    The parameters of interest are the link's ten inertial parameters and this joint's Coulomb and
    viscous friction, all others are nuisances. The rank is that which remains after nuisances are
    eliminated: rank [Y_interest Y_nuisance] - rank Y_nuisance. The condition numbers are those of
    Y_interest alone, so that they are comparable between a plan, a simulation and a log, which have
    different nuisances. All joints' rows weigh alike. ``identified`` and ``unidentifiable`` cover
    nuisances, too.

    Args:
        matrix: (M, p) rows of all joints.
        names: (p,) of the parameters, the ten inertial ones first.
        joint: name of the terminal joint.
    """
    space = visible_space(matrix)
    interest = np.isin(names, [f"coulomb[{joint}]", f"viscous[{joint}]"])
    interest[: spatial.N_INERTIAL] = True
    visible = np.where(space.zero, 0.0, matrix)
    length = np.where(space.zero, 1.0, np.linalg.norm(matrix, axis=0))
    # Rank of the nuisances alone, counted by the same cut as that of all columns.
    singular = np.linalg.svd((visible * space.scale)[:, ~interest], compute_uv=False)
    nuisance_rank = _count_visible(singular, np.max(space.singular, initial=0.0))
    return Identifiability(
        rank=space.rank - nuisance_rank,
        n_parameters=int(np.count_nonzero(interest)),
        condition_number=_condition(visible[:, interest]),
        scaled_condition_number=_condition((visible / length)[:, interest]),
        identified=space.is_identified,
        unidentifiable=describe(space.null, space.scale, names),
    )


def _condition(matrix: Array) -> float:
    """Return the condition number of a regressor (M, k) without the directions of its null space.

    It is the largest singular value over the r-th, r the rank; infinite where the rank is zero.
    """
    singular = np.linalg.svd(matrix, compute_uv=False)
    rank = visible_space(matrix).rank
    return float(singular[0] / singular[rank - 1]) if rank else float("inf")


# Relative difference within which weights count as equally large.
_SAME = 5e-4
# Phrases for single parameters, by the name before "[joint]".
_SINGLE = {
    "m": "mass",
    "hx": "first moment along x",
    "hy": "first moment along y",
    "hz": "first moment along z",
    "coulomb": "Coulomb friction",
    "viscous": "viscous friction",
}


def describe(null: Array, scale: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return one phrase per invisible direction, such as "mass" or "hx - 0.5*m".

    Args:
        null: (p, d) orthonormal basis of the invisible scaled coordinates.
        scale: (p,) parameters = scale * scaled coordinates.
        names: (p,) parameter names, the ten inertial ones first.
    """
    phrases = []
    for vector in readable_basis(null):
        row = vector * scale
        # The first parameter whose weight is the largest but for rounding begins the phrase.
        first = int(np.argmax(np.abs(row) > (1.0 - _SAME) * np.max(np.abs(row))))
        phrase = _single(names[first])
        if np.count_nonzero(row) > 1:
            phrase = in_words(row / row[first], first, names)
        phrases.append(phrase)
    return tuple(phrases)


def in_words(weights: Array, first: int, names: Sequence[str]) -> str:
    """Return a combination of parameters as text, such as "hx - 0.5*m".

    Args:
        weights: (p,) of the parameters; the one at ``first`` is one.
        first: index of the parameter that the text begins with.
        names: (p,) parameter names.
    """
    text = names[first]
    for index in np.flatnonzero(weights).tolist():
        weight = float(weights[index])
        if index != first:
            size = f"{abs(weight):.4g}*".removeprefix("1*")
            text += f" {'-' if weight < 0.0 else '+'} {size}{names[index]}"
    return text


def readable_basis(null: Array) -> list[Array]:
    """Return d unit vectors (p,) that span a null space and have few non-zero entries.

    They are in the order of the first parameter that each one contains.

    Args:
        null: (p, d) orthonormal basis of the null space, in scaled coordinates.
    """
    size, dimension = null.shape
    basis: list[Array] = []
    # Vectors within few parameters first; one that depends on previous ones leaves the rank as it
    # is and is left out.
    for group in (_FIRST_MOMENT, _INERTIA, range(10), range(size)):
        for candidate in _row_echelon(_within(null, group)):
            extended = np.array([*basis, candidate])
            rank = np.linalg.matrix_rank(extended, _TOLERANCE)
            if len(basis) < min(dimension, rank):
                basis.append(candidate)
    return sorted(basis, key=lambda v: int(np.flatnonzero(v)[0]))


def _within(null: Array, group: Sequence[int]) -> Array:
    """Return a basis (p, e) of the e-dimensional part of a null space that is zero outside a group.

    Args:
        null: (p, d) orthonormal basis of the null space.
        group: indices of the parameters that may be non-zero.
    """
    # Not setdiff1d, which imports numpy.ma.
    outside = [k for k in range(len(null)) if k not in group]
    _, singular, directions = np.linalg.svd(null[outside])
    # Directions beyond the last singular value are in the null space of null[outside], too.
    padded = np.zeros(null.shape[1])
    padded[: len(singular)] = singular
    basis = null @ directions[padded < _TOLERANCE].T
    basis[outside] = 0.0
    return basis


def _row_echelon(basis: Array) -> list[Array]:
    """Return at most e unit vectors (p,) that span the columns of ``basis`` (p, e).

    They are the rows of the reduced row echelon form of ``basis`` transposed. Each pivot is the
    largest remaining entry; its row is exchanged with row k. Pivots below ``_TOLERANCE`` are
    rounding.
    """
    rows = basis.T.copy()
    for k in range(len(rows)):
        largest = np.argmax(np.abs(rows[k:]))
        pivot_row, column = divmod(int(largest), rows.shape[1])
        rows[[k, k + pivot_row]] = rows[[k + pivot_row, k]]
        if abs(rows[k, column]) >= _TOLERANCE:
            rows[k] /= rows[k, column]
            others = np.arange(len(rows)) != k
            rows[others] -= np.outer(rows[others, column], rows[k])
    rows[np.abs(rows) < _TOLERANCE] = 0.0
    return [row / np.linalg.norm(row) for row in rows if np.any(row)]


def _single(name: str) -> str:
    """Return the phrase for one parameter: "viscous friction of j1" for "viscous[j1]"."""
    term, _, joint = name.partition("[")
    phrase = f"inertia {name}" if name in spatial.PARAMETER_NAMES else term
    phrase = _SINGLE.get(term, phrase)
    return f"{phrase} of {joint.removesuffix(']')}" if joint else phrase

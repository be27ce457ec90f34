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

Base parameters are the combinations that joint torques do identify. Of the ten parameters of a
link, many change no torque by themselves, but only in combination with those of links closer to the
base. A QR factorisation with column pivoting finds them (Gautier, "Numerical calculation of the
base inertial parameters of robots", ICRA 1990): with W P = Q [R1 R2; 0 0], R1 of full rank r, the
first r columns of W P span all columns, and

    x_base = x_1 + R1^-1 R2 x_2.

Which base parameters a log needs (the essential ones) follows from backward elimination: the one
with the largest relative standard deviation is removed and the others are fitted again, until the
largest is no more than 30 times the smallest (Pham, Gautier, "Essential parameters of robots",
CDC 1991) or is below 10 %. Essential parameters are reported only; the estimate does not use them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array, Identifiability, SquareRootInformation

RELATIVE_CUT = 1e-10
"""Singular values (and column lengths) below this share of the largest count as zero."""
# Frobenius norm of a triangle's inverse below which no singular value counts as zero: the least one
# is above 1e-8 then, and the cut is at 1e-10 of the largest, which is at most the root of the
# number of unit columns.
_WELL_SEEN = 1e8
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
    ``triangle_space`` fills ``left``, ``singular`` and ``right`` differently, with an equal
    pseudo-inverse right diag(1 / singular) left^T.

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


def triangle_space(triangle: Array) -> VisibleSpace:
    """Return the visible space and null space of an upper triangular matrix (M, p).

    It is faster than ``visible_space`` where the matrix is well-conditioned: the null space is
    empty then, ``right`` is the inverse of the scaled triangle, and ``left`` and ``singular`` are
    unit matrices.
    """
    size = triangle.shape[1]
    scale, zero = column_scale(triangle)
    if len(triangle) >= size and not np.any(zero | (np.diag(triangle)[:size] == 0.0)):
        inverse = np.asarray(np.linalg.inv(triangle[:size] * scale))
        if np.linalg.norm(inverse) < _WELL_SEEN:
            left = np.eye(len(triangle), size)
            null = np.zeros((size, 0))
            return VisibleSpace(scale, left, np.ones(size), inverse, null, zero)
    return visible_space(triangle)


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


def analyse_identifiability(information: SquareRootInformation) -> Identifiability:
    """Return the identifiability of the terminal link and of its joint's friction.

    The last joint is the terminal one. The parameters of interest are the link's ten inertial
    parameters and this joint's Coulomb and viscous friction, all others are nuisances. The rank is
    that which remains after nuisances are eliminated: rank [Y_interest Y_nuisance] - rank
    Y_nuisance. The condition numbers are those of Y_interest alone, so that they are comparable
    between a plan, a simulation and a log, which have different nuisances. All joints' rows weigh
    alike, without the prior. ``identified`` and ``unidentifiable`` cover nuisances, too.
    """
    matrix, _ = information.equations()
    space = visible_space(matrix)
    joint = information.joints[-1].joint
    interest = np.isin(information.names, [f"coulomb[{joint}]", f"viscous[{joint}]"])
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
        unidentifiable=describe(space.null, space.scale, information.names),
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


BASE_CUT = 1e-8
"""Diagonal entries of R below this share of the largest count as zero."""
ESSENTIAL_RATIO = 30.0
"""How many times the smallest relative standard deviation an essential parameter may have."""
WELL_KNOWN = 0.1
"""Relative standard deviation below which a parameter is essential in any case."""
# Weights of parameters in a base parameter below this count as zero.
_ROUNDING = 1e-5
# Relative decrease of the scale from one column to the next, which decides between columns that
# are equal but for rounding.
_ALIKE = 1e-6


@dataclass(frozen=True)
class BaseCombinations:
    """The r combinations of p parameters that a regressor identifies, x_base = matrix x.

    Attributes:
        matrix: (r, p) weights of the parameters in each combination.
        leading: (r,) index of one parameter per combination, ascending, whose weight is one there
            and zero in all other combinations; the combination's name begins with it.
    """

    matrix: Array
    leading: NDArray[np.int64]

    @property
    def rank(self) -> int:
        """Number of combinations r."""
        return len(self.leading)

    def names(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return each combination as text, such as "hx + 0.5*m", from parameter names (p,)."""
        pairs = zip(self.matrix, self.leading.tolist())
        return tuple(in_words(row, first, names) for row, first in pairs)


def base_combinations(regressor: Array, scale: Array) -> BaseCombinations:
    """Return the combinations of parameters that a regressor identifies: its base parameters.

    Args:
        regressor: (M, p).
        scale: (p,) typical sizes of the parameters, which weight the columns when pivots are
            chosen.
    """
    from scipy.linalg import qr, solve_triangular

    # Of columns that are equal but for rounding, the first one leads.
    scale = scale * (1.0 - _ALIKE * np.arange(len(scale)))
    triangle, order = qr(regressor * scale, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(triangle))
    rank = int(np.count_nonzero(diagonal > BASE_CUT * np.max(diagonal, initial=0.0)))
    weights = solve_triangular(triangle[:rank, :rank], triangle[:rank, rank:])
    weights[np.abs(weights) < _ROUNDING] = 0.0
    matrix = np.zeros((rank, len(order)))
    first = order[:rank]
    others = order[rank:]
    matrix[np.arange(rank), first] = 1.0
    matrix[:, others] = scale[first][:, None] * weights / scale[others]
    sorting = np.argsort(first)
    return BaseCombinations(matrix[sorting], first[sorting])


def essential(base: Array, nuisance: Array, right_side: Array) -> NDArray[np.bool_]:
    """Return a mask (r,) of the base parameters that backward elimination keeps as essential.

    The parameter with the largest relative standard deviation is removed, and the others are fitted
    again, until the largest is at most ``ESSENTIAL_RATIO`` times the smallest, or at most
    ``WELL_KNOWN``. One parameter always stays.

    Args:
        base: (M, r) whitened columns of the base parameters.
        nuisance: (M, k) whitened columns of all other parameters, which are always fitted.
        right_side: (M,) whitened right-hand sides.
    """
    from scipy.linalg import qr

    span, triangle, _ = qr(nuisance, mode="economic", pivoting=True)
    size = np.abs(np.diag(triangle))
    span = span[:, size > BASE_CUT * np.max(size, initial=0.0)]
    # What the other parameters cannot explain of columns and right-hand sides.
    columns = base - span @ (span.T @ base)
    target = right_side - span @ (span.T @ right_side)
    is_essential = np.ones(base.shape[1], dtype=bool)
    while np.count_nonzero(is_essential) > 1:
        length = np.linalg.norm(columns[:, is_essential], axis=0)
        scaled = columns[:, is_essential] / np.where(length > 0.0, length, 1.0)
        inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)
        values = inverse @ (scaled.T @ target)
        errors = np.sqrt(np.maximum(np.diag(inverse), 0.0))
        relative = errors / np.maximum(np.abs(values), 1e-300)  # no division by zero
        if np.max(relative) <= max(ESSENTIAL_RATIO * np.min(relative), WELL_KNOWN):
            break
        is_essential[np.flatnonzero(is_essential)[int(np.argmax(relative))]] = False
    return is_essential

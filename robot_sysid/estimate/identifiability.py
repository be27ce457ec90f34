"""Identifiability: rank, condition numbers, unidentifiable and base parameters.

Columns are scaled first, so that units do not decide about rank: one scale for the mass, one for
the three first moments, one for the six inertias, one for each further parameter. Parameters of
one unit share a scale, because a column that is short beside the others of its unit is weakly
identified: an axis that is off by a hair shows the first moment along it at a millionth of the
others, and scaling that up would turn rounding into an estimate. A column that is nothing but
rounding noise is set to zero.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.dynamics.friction import COULOMB, VISCOUS
from robot_sysid.records import Array, FitQuality

RELATIVE_CUT = 1e-10
"""Singular values (and column lengths) below this share of the largest count as zero."""
ROUNDING = 1e-12
"""Share of the largest below which a number is nothing but rounding."""


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
    zero: NDArray[np.bool_]

    @property
    def rank(self) -> int:
        """Number of visible combinations r."""
        return len(self.singular)

    @property
    def is_identified(self) -> NDArray[np.bool_]:
        """Per parameter (p,), whether it is zero in all invisible directions."""
        return ~_is_hidden(self.null)

    def solve(self, right_hand_side: Array) -> Array:
        """Return the least-squares solution x (p,) of A x = b (M,), of minimum norm in scaled y."""
        solution = self.right @ ((self.left.T @ right_hand_side) / self.singular)
        return np.where(self.zero, 0.0, self.scale * solution)

    def inverse(self) -> Array:
        """Return (p, p) the pseudo-inverse of A^T A in parameter units."""
        root = self.scale[:, None] * self.right / self.singular
        return root @ root.T


def visible_space(matrix: Array) -> VisibleSpace:
    """Return the visible space and null space of a stacked regressor (M, p).

    Its first ten columns are those of the inertial parameters of one link; the three first moments
    share the scale of their longest column, and so do the six inertias.
    """
    length = np.linalg.norm(matrix, axis=0)
    zero = length <= RELATIVE_CUT * np.max(length, initial=0.0)
    for group in (slice(1, 4), slice(4, 10)):
        length[group] = np.max(length[group], initial=0.0)
    scale = 1.0 / np.where(zero, 1.0, length)
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


def square_root(normal: Array) -> Array:
    """Return rows R (p, p) with the products R'R (p, p) of a matrix's columns.

    Directions that are nothing but the products' rounding are zero.
    """
    length = np.sqrt(np.diag(normal))
    scale = np.where(length > 0.0, length, 1.0)
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    values = np.where(values > ROUNDING * values[-1], values, 0.0)
    return np.sqrt(values)[:, None] * vectors.T * scale


def fit_quality(
    matrix: Array,
    names: Sequence[str],
    joints: Sequence[str],
    squares: Array,
    counts: Array,
    noise: Mapping[str, float],
) -> FitQuality:
    """Return what the equations of a fit determine, and how well it describes them.

    Parameters of interest are the terminal link's ten inertial parameters and its joint's Coulomb
    and viscous friction, all others are nuisances. The rank is that which remains after nuisances
    are eliminated: rank [Y_interest Y_nuisance] - rank Y_nuisance. The condition number is that of
    Y_interest alone, so that it is comparable between a plan, a simulation and a log, which have
    different nuisances. All joints' rows weigh alike. ``unidentifiable`` covers nuisances, too.

    Args:
        matrix: (M, p) rows of all joints.
        names: (p,) of the parameters, the ten inertial ones first.
        joints: names of the J joints with equations, the terminal one last.
        squares: (J,) sum of squared residuals of each joint [N^2 m^2].
        counts: (J,) number of samples in these sums.
        noise: joint to standard deviation of its torque noise [N m].
    """
    space = visible_space(matrix)
    interest = np.isin(names, [each.key_of(joints[-1]) for each in (COULOMB, VISCOUS)])
    interest[: spatial.N_INERTIAL] = True
    visible = np.where(space.zero, 0.0, matrix)
    # Rank of the nuisances alone, counted by the same cut as that of all columns.
    singular = np.linalg.svd((visible * space.scale)[:, ~interest], compute_uv=False)
    largest = float(np.max(space.singular, initial=0.0))
    nuisance_rank = _count_visible(singular, largest)
    # The largest singular value over the r-th, r the rank; infinite where the rank is zero.
    of_interest = visible[:, interest]
    sizes = np.linalg.svd(of_interest, compute_uv=False)
    own_rank = visible_space(of_interest).rank
    return FitQuality(
        joint_names=tuple(joints),
        blocks=squares[np.newaxis],
        counts=counts,
        condition_number=float(sizes[0] / sizes[own_rank - 1]) if own_rank else np.inf,
        n_base_params=space.rank - nuisance_rank,
        unidentifiable=describe(space.null, names),
        noise_per_joint=noise,
    )


# Phrases for single parameters, by the name before "[joint]".
_SINGLE = {
    "m": "mass",
    **{f"h{axis}": f"first moment along {axis}" for axis in "xyz"},
    **{name: f"inertia {name}" for name in spatial.PARAMETER_NAMES[4:]},
    **{term.name: term.label for term in (COULOMB, VISCOUS)},
}


def describe(null: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that are not identified by themselves, in words, such as "mass".

    Of several, sums may be identified: the last joint's torque alone shows Ixx - Iyy, and neither.

    Args:
        null: (p, d) orthonormal basis of the invisible directions.
        names: (p,) parameter names.
    """
    return tuple(itertools.compress(map(_phrase, names), _is_hidden(null)))


def _is_hidden(null: Array) -> NDArray[np.bool_]:
    """Return which parameters (p,) an invisible direction (p, d) changes by more than rounding."""
    return np.linalg.norm(null, axis=1) >= 1e-6


def _phrase(name: str) -> str:
    """Return the phrase for one parameter: "viscous friction of j1" for "viscous[j1]"."""
    term, _, joint = name.rstrip("]").partition("[")
    phrase = _SINGLE.get(term, term)
    return f"{phrase} of {joint}" if joint else phrase

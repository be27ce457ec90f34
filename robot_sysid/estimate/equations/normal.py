"""The normal equations of a question: products of its columns, priors and bounds.

Shapes: p parameters in the sums, k of them estimated, of which m have columns in a joint's rows; J
joints with equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import ArmTerms, Term
from robot_sysid.records import Array
from robot_sysid.spatial import N_INERTIAL

MOST_WHOLE = 10**7
"""Most numbers of all joints' products in one array, side by side: long arms have too many."""


@dataclass(frozen=True)
class JointColumns:
    """Of the columns of a joint's rows, those m that a question estimates, and the torque left.

    Attributes:
        places: (m + 1,) of the columns among the k estimated ones; the last one is k, that of the
            torque which held parameters leave to explain.
        at: (m,) of the columns among those of the joint.
        left: factors of the joint's columns whose sum is the torque that is left.
    """

    places: NDArray[np.int64]
    at: NDArray[np.int64]
    left: Array

    @classmethod
    def of(cls, places: NDArray[np.int64], left: Array) -> JointColumns:
        """Return the columns that have a place; that of the others is -1, of the last one too."""
        at = np.flatnonzero(places >= 0)
        return cls(np.append(places[at], -1), at, left)

    def products(self, gram: Array) -> Array:
        """Return the products (m + 1, m + 1) from those of all columns of the joint."""
        size = len(self.at)
        products = np.empty((size + 1, size + 1))
        of_left = gram @ self.left
        products[:-1, :-1] = gram[self.at[:, None], self.at]
        products[-1, :-1] = products[:-1, -1] = of_left[self.at]
        products[-1, -1] = self.left @ of_left
        return products

    def change(self, values: Array) -> Array:
        """Return factors of the joint's columns whose sum is its residual at values (k,)."""
        change = self.left.copy()
        change[self.at] -= values[self.places[:-1]]
        return change


@dataclass(frozen=True)
class WeightedEquations:
    """Equations with the weights of each joint's rows.

    Attributes:
        weights: (J,) [1/(N m)].
        normal: (k + 1, k + 1) products of priors and of weighted rows.
        reference: (k,) values that stay where nothing shows them.
    """

    weights: Array
    normal: Array
    reference: Array

    @cached_property
    def solution(self) -> tuple[Array, Array]:
        """Estimate (k,) without bounds, and its covariance (k, k) by noise and priors."""
        return solve(self.normal, self.reference)


class Equations:
    """Normal equations of a question's k parameters: data and priors, all others held.

    Args:
        sums: of all rows, in p parameters.
        terms: the question.
        held: (p,) values of the parameters that are not estimated.

    Attributes:
        index: (k,) of the estimated parameters in ``sums.names``.
        names: (k,) their names.
        spans: each term with the indices of its parameters among the estimated ones.
        lower, upper: (k,) bounds.
        yields: (k,) which are held at their bound before others are that cross theirs.
        reference: (k,) values that stay where nothing shows them.
        prior: (k + 1, k + 1) products of the priors' equations.
        selection: (p + 1, k + 1) takes all columns and the torque to the estimated ones and the
            torque that is left to explain.
        bodies: (L, 10) indices of the parameters of each body that has to be possible.
        least: (k,) bodies that these have to contain; zero for none.
    """

    def __init__(self, sums: Sums, terms: Sequence[Term], held: Array) -> None:
        self.sums = sums
        self.held = held
        self.terms = tuple(terms)
        self.names = tuple(name for term in terms for name in term.names)
        self.index = sums.at(self.names)
        size = len(self.names)
        self.prior = np.zeros((size + 1, size + 1))
        self.reference = np.zeros(size)
        self.least = np.zeros(size)
        self.lower = np.full(size, -np.inf)
        self.upper = np.full(size, np.inf)
        self.yields = np.zeros(size, dtype=bool)
        self.bodies = np.zeros((0, N_INERTIAL), dtype=np.int64)
        self._weighted: WeightedEquations | None = None
        self.selection = np.zeros((len(held) + 1, size + 1))
        self.selection[:, -1] = np.append(-held, 1.0)
        self.selection[self.index] = np.eye(size, size + 1)
        ends = np.cumsum([len(term.names) for term in terms], dtype=np.int64)
        self.spans = list(zip(terms, np.split(np.arange(size), ends[:-1])))
        for term, span in self.spans:
            if term.is_bounded:
                self.lower[span] = [each.lower for each in term.parameters]
                self.upper[span] = [each.upper for each in term.parameters]
                self.yields[span] = [each.yields for each in term.parameters]
            self.reference[span] = term.reference
            self.least[span] = term.least
            if term.prior is not None:
                at = np.append(span, size)
                self.prior[at[:, None], at] += term.prior.rows.T @ term.prior.rows
                self.reference[span] = term.prior.mean
            if term.bodies:
                self.bodies = np.vstack((self.bodies, span.reshape(-1, N_INERTIAL)))

    @cached_property
    def joint_columns(self) -> tuple[JointColumns, ...]:
        """Of each joint's columns those that are estimated, and the torque that is left."""
        places = np.full(len(self.selection), -1)
        places[self.index] = np.arange(len(self.index))
        return tuple(
            JointColumns.of(places[columns], self.selection[columns, -1])
            for columns in self.sums.columns
        )

    @cached_property
    def _totals(self) -> tuple[Array, ...]:
        """Products (m + 1, m + 1) of each joint's rows, of all blocks.

        They are made once for all rounds of a noise.
        """
        return self._products_of(None)

    @cached_property
    def _whole(self) -> Array | None:
        """The same in one array (J, k + 1, k + 1); None where that has too many numbers.

        Sums over it take a tenth of the time of those joint by joint.
        """
        size = len(self.prior)
        if len(self.joint_columns) * size**2 > MOST_WHOLE:
            return None
        whole = np.zeros((len(self.joint_columns), size, size))
        for own, columns, gram in zip(whole, self.joint_columns, self._totals):
            own[columns.places[:, None], columns.places] = gram
        return whole

    def _products_of(self, blocks: Sequence[int] | None) -> tuple[Array, ...]:
        """Return the products (m + 1, m + 1) of each joint's rows, of all blocks or some."""
        pairs = zip(self.joint_columns, self.sums.of_blocks(blocks))
        return tuple(columns.products(gram) for columns, gram in pairs)

    def products(self, blocks: Sequence[int] | None = None) -> tuple[Array, ...]:
        """Return the products (m + 1, m + 1) of the ``joint_columns`` of each joint's rows.

        They are those of all blocks or some.
        """
        return self._totals if blocks is None else self._products_of(blocks)

    def data(self, weights: Array, blocks: Sequence[int] | None = None) -> Array:
        """Return the products (k + 1, k + 1) of weighted rows, of all blocks or some."""
        if blocks is None and self._whole is not None:
            return np.tensordot(weights**2, self._whole, 1)
        data = np.zeros_like(self.prior)
        of_joints = zip(weights, self.joint_columns, self.products(blocks))
        for weight, columns, gram in of_joints:
            data[columns.places[:, None], columns.places] += weight**2 * gram
        return data

    def normal(self, weights: Array) -> Array:
        """Return the products (k + 1, k + 1) of priors and of weighted rows."""
        return self.prior + self.data(weights)

    def weighted(self, weights: Array) -> WeightedEquations:
        """Return the equations with weights (J,), which are kept as long as these are the last."""
        if self._weighted is None or not np.array_equal(
            self._weighted.weights, weights
        ):
            normal = self.normal(weights)
            self._weighted = WeightedEquations(weights, normal, self.reference)
        return self._weighted

    def squared_residuals(
        self, values: Array, blocks: Sequence[int] | None = None
    ) -> Array:
        """Return each joint's sum of squared residuals (J,) at values (k,) [N^2 m^2]."""
        squares = []
        for columns, gram in zip(self.joint_columns, self.sums.of_blocks(blocks)):
            own = columns.change(values)
            squares.append(own @ gram @ own)
        return np.maximum(squares, 0.0)

    def spread(self, covariance: Array, blocks: Sequence[int] | None = None) -> Array:
        """Return the squared errors (J,) to expect from those of an estimate (k, k) [N^2 m^2]."""
        if blocks is None and self._whole is not None:
            padded = np.pad(covariance, (0, 1))
            return self._whole.reshape(len(self._whole), -1) @ padded.ravel()
        errors = []
        for columns, gram in zip(self.joint_columns, self.products(blocks)):
            at = columns.places[:-1]
            errors.append(np.vdot(gram[:-1, :-1], covariance[at[:, None], at]))
        return np.array(errors)

    def are_possible_bodies(self, values: Array) -> bool:
        """Tell whether all bodies are possible at values (k,)."""
        return spatial.is_consistent((values - self.least)[self.bodies])

    def inside(self, values: Array) -> Array:
        """Return values (k,) with those that cross a bound moved to it."""
        return np.clip(values, self.lower, self.upper)

    def crossing(self, values: Array) -> NDArray[np.bool_]:
        """Return which of values (k,) cross a bound by more than rounding."""
        inside = self.inside(values)
        return np.abs(values - inside) > 1e-9 * (1.0 + np.abs(inside))

    def full(self, values: Array) -> Array:
        """Return all parameters (p,) from the estimated ones (k,)."""
        return self.selection[:-1] @ np.append(values, -1.0)


def equations_of(
    arm: ArmTerms, sums: Sums, terms: Sequence[Term], held: Mapping[str, float]
) -> Equations:
    """Return the equations of a question, without parameters that have neither data nor prior.

    All others are held at ``held``, else at the model's values, else at zero.
    """
    squares = np.sum(sums.squares, axis=0)
    shown = []
    for term in terms:
        if term.prior is None and not term.bodies:
            own = squares[sums.at(term.names)]
            term = term.only(np.flatnonzero(own).tolist())
        if term.names:
            shown.append(term)
    values = {**arm.model, **held}
    return Equations(
        sums, shown, np.array([values.get(name, 0.0) for name in sums.names])
    )

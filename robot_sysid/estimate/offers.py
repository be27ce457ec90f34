"""What a fit says of further columns: their gain, their values, and what they leave unexplained.

Columns stand beside those of the question in the same sums. They act in all rows, or at one joint,
and in all blocks or in each block times a number of its own: so one column of the last link's mass
also serves a load that is picked up on the way, and one of torque scales their drift.

With data and priors M of a fit, columns E with prior N(0, F F') and residuals r of the fit,

    v = F (1 + F' U F)^-1 F' E'W r,    U = E'W E - E'W A M^-1 A'W E.

Their gain is that in the log marginal likelihood (MacKay, "Bayesian interpolation", Neural
Computation 4(3), 1992), with the noise as it is, or each fit with its own noise and both with the
memory of the residuals that the columns leave: what is missing makes residuals large and slow, and
would hide in them.

Shapes: J joints, B blocks, k parameters of the fit, m further columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.identifiability import ROUNDING
from robot_sysid.estimate.terms import Term
from robot_sysid.records import Array


@dataclass(frozen=True)
class Effect:
    """Columns that may be missing from a fit, and where they act.

    Attributes:
        names: (m,) of columns of the fit's sums, which may be the fit's own once more.
        factor: (m, r) F of their prior.
        joint: index of the joint at which they act; None for all.
        shares: (B,) by which they are multiplied in each block; None for one.
    """

    names: tuple[str, ...]
    factor: Array
    joint: int | None = None
    shares: Array | None = None

    @classmethod
    def of(cls, term: Term) -> Effect:
        """Return the effect of a term with a prior, everywhere."""
        assert term.prior is not None
        return cls(term.names, term.prior.factor)


@dataclass(frozen=True)
class Offer:
    """What a fit says of an effect.

    Attributes:
        effect: the columns.
        gain: in log marginal likelihood [nats].
        values: (m,) of their parameters.
        covariance: (m, m) of the values.
        distance: of the values from zero, in their errors.
        change: (k,) of the fit's own parameters.
        relief: by which the squared deviations from priors become smaller.
        moves: (p + 1, m) of all parameters per unit of the further ones.
    """

    effect: Effect
    gain: float
    values: Array
    covariance: Array
    distance: float
    change: Array
    relief: float
    moves: Array
    _offers: Offers

    @property
    def errors(self) -> Array:
        """Standard errors (m,) of the values."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @cached_property
    def _after(self) -> tuple[Array, Array]:
        """What the columns change in squared residuals (J,), and their leverage (J,)."""
        return self._offers.after(self, False)

    @cached_property
    def squares(self) -> Array:
        """Squared residuals (J,) with the columns [N^2 m^2]."""
        before = self._offers.squares
        return np.maximum(before + self._after[0], ROUNDING * before)

    @cached_property
    def successive(self) -> Array:
        """Sums of products of successive residuals (J,), with the columns [N^2 m^2]."""
        change, _ = self._offers.after(self, True)
        return self._offers.successive + change

    @property
    def leverage(self) -> Array:
        """Number of the columns (J,) that each joint's rows determine."""
        return self._offers.weights**2 * self._after[1]


class Offers:
    """A fit to which effects are offered.

    Args:
        fitted: the fit.
        weights: (J,) of each joint's rows [1/(N m)]; those of white noise of its size by default.
    """

    def __init__(self, fitted: Fit, weights: Array | None = None) -> None:
        self.fitted = fitted
        self.sums = fitted.sums
        self.weights = 1.0 / fitted.noise if weights is None else weights
        equations = fitted.equations
        weighted = equations.weighted(self.weights)
        self._normal = weighted.normal
        # Bounds do not count: evidence of a negative friction would hide in other columns.
        free, self.inverse = weighted.solution
        self._own = np.append(free, -1.0)
        self._full = equations.selection @ self._own
        self.squares = self.sums.squared_residuals(self._full[:-1])
        self.successive = self.sums.successive(self._full[:-1])
        self.squares = np.maximum(self.squares, 1e-300)
        slow = np.clip(self.successive / self.squares, 1e-3, 1.0)
        # Rows for which what is slow in the residuals lasts.
        self._memory = (fitted.correlation - 1.0) / slow

    def offer(self, effect: Effect) -> Offer:
        """Return what the fit says of an effect, with the weights as they are."""
        count = len(effect.names)
        cross = np.zeros((len(self._full), count))
        own = np.zeros((count, count))
        for joint, columns in enumerate(self.sums.columns):
            if effect.joint not in (None, joint):
                continue
            products, squares = self._effect_products(effect, joint, False)
            cross[columns] += self.weights[joint] ** 2 * products
            own += self.weights[joint] ** 2 * squares
        # How all parameters move per unit of the further ones.
        estimated = self.fitted.equations.index
        moves = np.zeros_like(cross)
        moves[estimated] = -self.inverse @ cross[estimated]
        factor = effect.factor
        inner = factor.T @ (own + cross.T @ moves) @ factor + np.eye(factor.shape[1])
        covariance = factor @ np.linalg.inv(inner) @ factor.T
        gradient = -self._full @ cross
        values = covariance @ gradient
        explained = float(gradient @ values)
        change = moves[estimated] @ values
        step = np.append(change, 0.0)
        prior = self.fitted.equations.prior
        return Offer(
            effect,
            0.5 * (explained - float(np.linalg.slogdet(inner)[1])),
            values,
            covariance,
            float(np.sqrt(max(explained, 0.0))),
            change,
            float(-step @ prior @ (2.0 * self._own + step)),
            moves,
            self,
        )

    def _totals(self, lagged: bool) -> Sequence[Array]:
        """Return the products of each joint's rows, or of successive rows if ``lagged``."""
        return self.sums.lagged_totals if lagged else self.sums.totals

    def _effect_products(
        self, effect: Effect, joint: int, lagged: bool
    ) -> tuple[Array, Array]:
        """Return the products (k, m) of a joint's k columns with an effect's, and the latter's.

        They are those of rows, or of successive rows if ``lagged``.
        """
        sums = self.sums
        count = len(effect.names)
        cross = np.zeros((len(sums.columns[joint]), count))
        squares = np.zeros((count, count))
        if effect.joint not in (None, joint):
            return cross, squares
        at = self._places[joint][sums.at(effect.names)]
        # The effect has few of all columns, and a joint's rows not all of these.
        there = np.flatnonzero(at >= 0)
        own = at[there]
        if effect.shares is None:
            total = self._totals(lagged)[joint]
            cross[:, there] = total[:, own]
            squares[there[:, None], there] = total[own[:, None], own]
        else:
            blocks = sums.products[joint][int(lagged)][:, :, own]
            cross[:, there] = np.tensordot(effect.shares, blocks, 1)
            squares[there[:, None], there] = np.tensordot(
                effect.shares**2, blocks[:, own], 1
            )
        return cross, squares

    @cached_property
    def _places(self) -> list[NDArray[np.int64]]:
        """Per joint (p + 1,) the place of each parameter among its columns; -1 for none."""
        places = []
        for columns in self.sums.columns:
            place = np.full(len(self.sums.names) + 1, -1)
            place[columns] = np.arange(len(columns))
            places.append(place)
        return places

    def after(self, offer: Offer, lagged: bool) -> tuple[Array, Array]:
        """Return what an offer changes in each joint's sums of squares (J,), and determines (J,).

        Sums are those of products of successive rows if ``lagged``.
        """
        values = offer.values
        totals = self._totals(lagged)
        change = np.zeros(len(self.weights))
        explained = np.zeros(len(self.weights))
        for joint, columns in enumerate(self.sums.columns):
            cross, squares = self._effect_products(offer.effect, joint, lagged)
            moves = offer.moves[columns]
            moved = totals[joint] @ moves + cross
            slope = self._full[columns] @ moved
            bend = moves.T @ moved + cross.T @ moves + squares
            change[joint] = 2.0 * slope @ values + values @ bend @ values
            explained[joint] = np.vdot(offer.covariance, bend)
        return change, explained

    def slow_gain(self, offer: Offer) -> tuple[float, float]:
        """Return (what an offer explains of the residuals [nats], the part that is not noise).

        Noise of positions is in all columns: one that is a smoother copy of another lowers it.
        """
        weights = 0.5 * self.weights**2
        total = weights @ (self.squares - offer.squares)
        return float(total), float(weights @ (self.successive - offer.successive))

    def correlation(self, squares: Array, successive: Array) -> Array:
        """Return the rows (J,) that count as one where residuals have these sums (J,).

        What is slow is taken to last as long as in the fit's own residuals.
        """
        slow = np.clip(successive / np.maximum(squares, 1e-300), 0.0, 1.0)
        return np.clip(1.0 + self._memory * slow, 1.0, self.fitted.correlation)

    def weigh(self, effect: Effect) -> Offer:
        """Return what the fit says of an effect, each fit with its own noise."""
        before = after = self
        # Three times the noise is taken from what the columns leave.
        for _ in range(3):
            offer = after.offer(effect)
            correlation = self.correlation(offer.squares, offer.successive)
            leverage = after.leverage + offer.leverage
            after = self._with_noise_of(offer.squares, leverage, correlation)
            before = self._with_noise_of(before.squares, before.leverage, correlation)
        independent = self.sums.row_counts / correlation
        offer = after.offer(effect)
        sizes = independent @ np.log(after.weights / before.weights)
        gain = offer.gain + after.evidence - before.evidence + float(sizes)
        return replace(offer, gain=gain)

    def _with_noise_of(
        self, squares: Array, leverage: Array, correlation: Array
    ) -> Offers:
        """Return the fit with weights by what residuals, parameters and memory (J,) leave."""
        noise = self.sums.noise(squares, leverage)
        return Offers(self.fitted, 1.0 / (noise * np.sqrt(correlation)))

    @cached_property
    def leverage(self) -> Array:
        """Number of parameters (J,) that each joint's rows determine."""
        return self.weights**2 * self.fitted.equations.spread(self.inverse)

    @property
    def evidence(self) -> float:
        """Log marginal likelihood of the fit, but for the size of the noise."""
        misfit = self._own @ self._normal @ self._own
        return 0.5 * float(np.linalg.slogdet(self.inverse)[1] - misfit)

"""Fits of all links to any part of the data, with any choice of columns.

The data is cut into blocks of time; a fit leaves one of them out, or none. Columns that a choice
leaves out are held at zero.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import SysidError
from robot_sysid.estimation.arm.consistent_links import ConsistentLinks, LinksProblem, unbounded
from robot_sysid.estimation.information import combined, joint_rmse, sample_counts, update_triangle
from robot_sysid.estimation.least_squares import noise_floor
from robot_sysid.records import Array, SquareRootInformation

_ROUNDS = 4
_SETTLED = 0.02
# Share of each joint's torque that is taken for noise before anything is known.
_FIRST_NOISE = 0.1
# No joint's torque is known better than this part of that.
_LEAST_NOISE = 1e-4

Columns = NDArray[np.int64]


@dataclass(frozen=True)
class LinkFits:
    """The data in blocks and what is known beside it.

    Attributes:
        parts: information of each block, all with the same parameters and joints.
        problem: links, model and bounds of all parameters.
        prior: (p,) standard deviation about zero of parameters known beforehand, infinite where
            nothing is.
        noise: (joints,) by which each joint's equations are divided [N m].
    """

    parts: tuple[SquareRootInformation, ...]
    problem: LinksProblem
    prior: Array
    noise: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return self.parts[0].names

    @cached_property
    def whole(self) -> SquareRootInformation:
        """The information of all blocks."""
        return combined(self.parts)

    def weighed_by(self, noise: Array) -> LinkFits:
        """Return the fits with another noise (joints,) [N m]."""
        changed = replace(self, noise=noise)
        # What does not depend on the noise is not made again.
        vars(changed)["whole"] = self.whole
        return changed

    @cached_property
    def _known(self) -> Array:
        """What is known before, as equations (k, p+1)."""
        known = np.flatnonzero(np.isfinite(self.prior))
        before = np.zeros((len(known), len(self.prior) + 1))
        before[np.arange(len(known)), known] = 1.0 / self.prior[known]
        return before

    @cached_property
    def _all(self) -> Array:
        """Triangle (p+1, p+1) of all whitened equations and of what is known before."""
        return self._whitened(self.whole, self._known)

    @cached_property
    def _without(self) -> tuple[Array, ...]:
        """The same without each block in turn."""
        each = [self._whitened(part, self._known[:0]) for part in self.parts]
        if len(each) < 2:
            return ()
        rests = [each[:block] + each[block + 1 :] for block in range(len(each))]
        return tuple(update_triangle(self._known, np.vstack(rest)) for rest in rests)

    def _whitened(self, part: SquareRootInformation, known: Array) -> Array:
        return update_triangle(known, np.column_stack(part.stacked(1.0 / self.noise)))

    def path(
        self, kept: Columns, gammas: Sequence[float], without: int | None = None
    ) -> Iterator[Array]:
        """Yield the estimate (p,) for each gamma, largest first.

        Args:
            kept: which parameters are sought.
            gammas: weights of the model.
            without: number of a block to leave out.
        """
        triangle = self._all if without is None else self._without[without]
        solver = ConsistentLinks(triangle[:, kept], triangle[:, -1], self.problem.of(kept))
        for values in solver.path(gammas):
            yield self._full(kept, values)

    def solve(self, kept: Columns, gamma: float) -> Array:
        """Return the estimate (p,) for one gamma from all blocks."""
        return next(self.path(kept, (gamma,)))

    def held_out(self, kept: Columns, gammas: Sequence[float]) -> Array:
        """Return (gammas, blocks, joints) squared error of each block, predicted from the rest.

        It is infinite from where a fit does not converge.
        """
        errors = np.full((len(gammas), len(self.parts), len(self.noise)), np.inf)
        for block, part in enumerate(self.parts):
            with contextlib.suppress(SysidError):
                for index, values in enumerate(self.path(kept, gammas, block)):
                    errors[index, block] = part.squared_residuals(values)
        return errors

    def roughly_held_out(self, kept: Columns, gamma: float) -> Array:
        """Return the same (blocks, joints) of fits without bounds, which take no time."""
        errors, problem = [], self.problem.of(kept)
        for block, part in enumerate(self.parts):
            triangle = self._without[block]
            values = unbounded(triangle[:, kept], triangle[:, -1], problem, gamma)
            errors.append(part.squared_residuals(self._full(kept, values)))
        return np.array(errors)

    def _full(self, kept: Columns, values: Array) -> Array:
        full = np.zeros(len(self.names))
        full[kept] = values
        return full

    def scores(self, squared: Array) -> Array:
        """Return (..., blocks) mean of squared errors (..., blocks, joints) over their variance."""
        counts = np.array([np.sum(sample_counts(part)) for part in self.parts])
        return np.sum(squared / self.noise**2, axis=-1) / np.maximum(counts, 1.0)

    def weighed(self, kept: Columns, gamma: float) -> tuple[LinkFits, Array]:
        """Return the fits with the noise that their own residuals show, and the estimate (p,)."""
        whole = self.whole
        floor = _LEAST_NOISE * first_noise(self.parts)
        fits = self
        for _ in range(_ROUNDS):
            values = fits.solve(kept, gamma)
            noise = np.maximum(joint_rmse(whole, values), floor)
            change = np.max(np.abs(noise / fits.noise - 1.0))
            fits = fits.weighed_by(noise)
            if change < _SETTLED:
                break
        return fits, values


def first_noise(parts: Sequence[SquareRootInformation]) -> Array:
    """Return (joints,) a tenth of each joint's root mean square torque [N m]."""
    whole = combined(parts)
    rms = joint_rmse(whole, np.zeros(len(whole.names)))
    return np.maximum(_FIRST_NOISE * rms, noise_floor(whole))


def is_clearly_lower(after: Array, before: Array, share: float, errors: float) -> bool:
    """Tell whether scores per block are lower by a share and by some standard errors."""
    if not np.all(np.isfinite(after)) or not np.all(np.isfinite(before)):
        return bool(np.all(np.isfinite(after)))
    gain = before - after
    error = float(np.std(gain, ddof=1)) / np.sqrt(len(gain))
    mean = float(np.mean(gain))
    return mean > share * float(np.mean(before)) and mean > errors * error

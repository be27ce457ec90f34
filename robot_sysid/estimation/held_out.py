"""How well parts of the recordings are predicted from the others: the one judge of all choices.

In-sample errors fall with every term; what counts is the error of stretches of time that were not
fitted. Blocks are compared by ratios, because a joint may show its friction in one of them far more
than in the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.consistent_links import ConsistentLinks
from robot_sysid.estimation.algebra.information import sample_counts, update_triangle
from robot_sysid.estimation.fit import Evidence, Fit, links_problem
from robot_sysid.estimation.unknowns import Unknowns
from robot_sysid.records import Array, Validation
from robot_sysid.records.results import validation_of

OWN_SOURCE = "the logs, each fifth predicted from the others"
CLEAR_SHARE, CLEARLY = 0.1, 2.0
"""A term (or a coupling) has to lower the held-out squared error by this share, and by this many
standard errors."""
_TINY, _RIDGE = 1e-30, 1e-12


@dataclass(frozen=True)
class HeldOut:
    """Recordings in blocks, each to be predicted from the others.

    Attributes:
        data: the blocks.
        noise: (joints,) standard deviation of each joint's torque, as it counts [N m].
    """

    data: Evidence
    noise: Array

    @cached_property
    def counts(self) -> Array:
        """How many rows each block has of each joint (blocks, joints)."""
        return np.array([sample_counts(part) for part in self.data.blocks])

    @cached_property
    def _grams(self) -> tuple[Array, ...]:
        """Gram matrix (p+1, p+1) of all whitened equations without each block in turn."""
        rows = [np.column_stack(part.stacked(1.0 / self.noise)) for part in self.data.blocks]
        each = [block.T @ block for block in rows]
        return tuple(sum(each[:k] + each[k + 1 :]) for k in range(len(each)))

    @cached_property
    def _rests(self) -> tuple[Array, ...]:
        """Triangle (p+1, p+1) of all whitened equations without each block in turn."""
        rows = [np.column_stack(part.stacked(1.0 / self.noise)) for part in self.data.blocks]
        nothing = np.zeros((rows[0].shape[1],) * 2)
        each = [update_triangle(nothing, block) for block in rows]
        others = (each[:k] + each[k + 1 :] for k in range(len(each)))
        return tuple(update_triangle(nothing, np.vstack(parts)) for parts in others)

    def squared(self, sought: Unknowns) -> Array:
        """Return (blocks, joints) squared error of each block, predicted from the others."""
        pairs = zip(self._predicted(sought), self.data.blocks)
        return np.array([part.squared_residuals(values) for values, part in pairs])

    def _predicted(self, sought: Unknowns) -> Iterator[Array]:
        """Yield for each block the values (p,) that all others ask for."""
        kept, held = sought.kept, sought.held.copy()
        held[kept] = 0.0
        prior = _prior_rows(sought)
        for gram in self._grams:
            known = gram[kept, -1] - gram[kept, :-1] @ held
            normal = gram[np.ix_(kept, kept)] + prior[:, :-1].T @ prior[:, :-1]
            yield sought.full(_solved(normal, known + prior[:, :-1].T @ prior[:, -1]))

    def of(self, fit: Fit) -> Array:
        """Return the same of a fit, with bodies that are possible."""
        sought, errors = fit.unknowns, []
        problem = links_problem(sought)
        places = [at for at, _ in sought.bodies.values()]
        for number, values in enumerate(self._predicted(sought)):
            if places and not all(spatial.is_consistent(values[at]) for at in places):
                rest, kept = self._rests[number], sought.kept
                held = np.delete(rest[:, :-1], kept, 1) @ np.delete(sought.held, kept)
                own = np.column_stack((rest[:, kept], rest[:, -1] - held))
                rows = np.vstack((own, _prior_rows(sought)))
                values = sought.full(ConsistentLinks(rows[:, :-1], rows[:, -1], problem).best())
            errors.append(self.data.blocks[number].squared_residuals(values))
        return np.array(errors)

    def score(self, squared: Array) -> Array:
        """Return (blocks,) mean of squared errors (blocks, joints) over their variance."""
        counts = np.maximum(np.sum(self.counts, axis=1), 1.0)
        return np.asarray(np.sum(squared / self.noise**2, axis=-1) / counts)

    def validation(self, squared: Array, source: str) -> Validation:
        """Return squared errors (blocks, joints) as one record."""
        joints = [joint.joint for joint in self.data.blocks[0].joints]
        torque, counts = np.sum(self.data.squared_torque, axis=0), np.sum(self.counts, axis=0)
        return validation_of(joints, np.sum(squared, axis=0), torque, counts, source)


def held_out(fit: Fit) -> HeldOut:
    """Return what judges choices around a fit."""
    return HeldOut(fit.evidence, fit.weighted.noise)


def _prior_rows(sought: Unknowns) -> Array:
    rows = [group.rows(sought.kept_names) for group in sought.groups]
    return np.vstack(rows) if rows else np.zeros((0, len(sought.kept) + 1))


def _solved(normal: Array, right: Array) -> Array:
    """Return the solution (k,) of normal equations (k, k).

    What they do not show stays near zero; priors and friction terms leave nothing else.
    """
    size = np.sqrt(np.diag(normal))
    scale = 1.0 / np.where(size > 0.0, size, 1.0)
    scaled = scale[:, None] * normal * scale
    scaled[np.diag_indices_from(scaled)] += _RIDGE
    return np.asarray(scale * np.linalg.solve(scaled, scale * right))


def is_clearly_lower(after: Array, before: Array) -> bool:
    """Tell whether squared errors per block (blocks,) are clearly lower."""
    if not np.all(np.isfinite(after)) or not np.all(np.isfinite(before)):
        return bool(np.all(np.isfinite(after)))
    ratio = np.log((after + _TINY) / (before + _TINY))
    mean, spread = float(np.mean(ratio)), float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    needed = np.log(1.0 - CLEAR_SHARE)
    lower = np.sum(after) < (1.0 - CLEAR_SHARE) * np.sum(before)
    return bool(lower and mean < needed and mean + CLEARLY * spread < 0.0)

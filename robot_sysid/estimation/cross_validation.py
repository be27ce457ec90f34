"""How well parameters predict torques that were not used to find them, and which model does best.

A richer model always fits the data it was fitted to better. What counts is how it predicts a
stretch of time it has not seen, so the log is cut into blocks, each is predicted from a fit to the
others, and the simplest model is taken whose error is not clearly above the best one's (the
one-standard-error rule: Breiman, Friedman, Olshen, Stone, "Classification and Regression Trees",
1984, sec. 3.4.3; on paired differences here). A fit needs only the blocks' triangles, so a fold
costs microseconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.estimation.information import combined, joint_rmse, sample_counts
from robot_sysid.estimation.least_squares import noise_floor
from robot_sysid.records import Array, SquareRootInformation, Validation

Mask = NDArray[np.bool_]


def validate(
    information: SquareRootInformation, values: Array, source: str, squared_torque: Array
) -> Validation:
    """Return the prediction error from the information of held-out data alone.

    Args:
        information: of data that was not fitted.
        values: (p,) the estimate, in the order of ``information.names``.
        source: which data it was, in words.
        squared_torque: (joints,) sum of squares of the whole measured torque [N^2 m^2]; the
            right-hand sides lack the part that the rest of the arm explains.

    Raises:
        InputError: the information holds no samples.
    """
    counts = sample_counts(information)
    if not np.any(counts):
        raise InputError(f"no usable torque samples to validate on in {source}")
    names = [joint.joint for joint in information.joints]
    wrong = information.squared_residuals(values)
    relative = [_ratio(*squares) for squares in zip(wrong, squared_torque)]
    return Validation(
        source=source,
        n_samples=int(np.max(counts)),
        rmse=float(np.sqrt(np.sum(wrong) / np.sum(counts))),
        relative_error=_ratio(np.sum(wrong), np.sum(squared_torque)),
        rmse_per_joint=dict(zip(names, joint_rmse(information, values).tolist())),
        relative_error_per_joint=dict(zip(names, relative)),
    )


def _ratio(wrong: float, total: float) -> float | None:
    return float(np.sqrt(wrong / total)) if total > 0.0 else None


LONG_BLOCKS, MOST_BLOCKS = 20, 10
"""A held-out stretch comes out of so many gaps' length of rows at least; there are at most so many
stretches."""


def hold_out(moving: Mask, fraction: float, gap: int) -> tuple[Mask, Mask]:
    """Split rows into those to fit and stretches of those in which the arm moves, to validate on.

    Each stretch ends one of up to ``MOST_BLOCKS`` equal parts of the moving rows.

    Args:
        moving: (K,) whether the arm moves.
        fraction: part of the moving rows that is held out, at least 0 and below 1.
        gap: rows left out around a stretch, because filtering lets neighbours share samples.

    Returns:
        (fitted (K,), held out (K,)).

    Raises:
        InputError: one part is left without rows.
    """
    held = np.zeros(len(moving), dtype=bool)
    if fraction == 0.0:
        return ~held, held
    rows = np.flatnonzero(moving)
    count = int(np.clip(len(rows) // max(LONG_BLOCKS * gap, 1), 1, MOST_BLOCKS))
    for block in blocks(len(rows), count) if len(rows) else ():
        inside = rows[block]
        held[inside[len(inside) - math.ceil(fraction * len(inside)) :]] = True
    count_to, row = np.concatenate(([0], np.cumsum(held))), np.arange(len(held))
    near = count_to[np.minimum(row + gap + 1, len(held))] > count_to[np.maximum(row - gap, 0)]
    if not np.any(held) or not np.any(moving & ~near):
        raise InputError(
            f"{len(rows)} rows in which the arm moves cannot be split into fitted and held-out "
            f"ones with --validate {fraction:g}; record longer, or pass --validate 0"
        )
    return ~near, held


def blocks(n_rows: int, count: int) -> tuple[slice, ...]:
    """Cut consecutive rows into ``count`` blocks of nearly equal length.

    Raises:
        InputError: there are fewer rows than blocks.
    """
    if n_rows < count:
        raise InputError(f"{n_rows} rows cannot be cut into {count} blocks; record longer")
    edges = [round(k * n_rows / count) for k in range(count + 1)]
    return tuple(slice(start, stop) for start, stop in zip(edges, edges[1:]))


Solve = Callable[[SquareRootInformation], Array]


@dataclass(frozen=True)
class ModelChoice:
    """The chosen model and how all candidates did.

    Attributes:
        name: the chosen candidate.
        rmse: candidate to root mean square error on the held-out blocks, all joints [N m].
    """

    name: str
    rmse: Mapping[str, float]

    @property
    def note(self) -> str:
        """One sentence about the choice."""
        listed = ", ".join(f"{name} {value:.3g}" for name, value in self.rmse.items())
        return f"{self.name} chosen by cross-validation; held-out torque error in N m: {listed}"


def choose_model(
    candidates: Mapping[str, Sequence[SquareRootInformation]], solve: Solve
) -> ModelChoice:
    """Choose a model by predicting each block of data from the others.

    Each joint's squared error is divided by its noise variance, so that joints with large torques
    do not decide alone.

    Args:
        candidates: model name to its information per block; the same blocks and joints for all.
            From one pass with the columns of all models, ``information.restricted`` makes them.
        solve: returns the estimate (p,) for the information of the blocks that are fitted.
    """
    richest = max(candidates, key=lambda name: len(candidates[name][0].names))
    whole = combined(candidates[richest])
    counts = np.array([sample_counts(part) for part in candidates[richest]])
    noise = whole.squared_residuals(solve(whole)) / np.maximum(counts.sum(axis=0), 1)
    noise = np.maximum(noise, noise_floor(whole) ** 2)
    squared = {name: _held_out(parts, solve) for name, parts in candidates.items()}
    usable = np.maximum(counts.sum(axis=1), 1)
    folds = {name: np.sum(s / noise, axis=1) / usable for name, s in squared.items()}
    score = {name: float(np.mean(values)) for name, values in folds.items()}
    best = min(score, key=lambda name: score[name])
    close = [name for name, values in folds.items() if _is_close(values, folds[best])]
    simplest = min(close, key=lambda name: (len(candidates[name][0].names), score[name]))
    rmse = {name: float(np.sqrt(s.sum() / counts.sum())) for name, s in squared.items()}
    return ModelChoice(simplest, rmse)


def _held_out(parts: Sequence[SquareRootInformation], solve: Solve) -> Array:
    """Return (K, joints) squared error of each block, predicted from the other blocks."""
    errors = []
    for held, part in enumerate(parts):
        others = [other for index, other in enumerate(parts) if index != held]
        errors.append(part.squared_residuals(solve(combined(others))))
    return np.array(errors)


def _is_close(values: Array, best: Array) -> bool:
    """Tell whether errors per block are at most one standard error above the best model's."""
    excess = values - best
    return bool(np.mean(excess) <= np.std(excess, ddof=1) / np.sqrt(len(excess)))

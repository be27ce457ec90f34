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

from robot_sysid.errors import InputError
from robot_sysid.estimation.information import combined
from robot_sysid.records import Array, SquareRootInformation, Validation


def validate(
    information: SquareRootInformation,
    values: Array,
    source: str,
    squared_torque: Array,
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
    counts = np.array([joint.n_samples for joint in information.joints], dtype=float)
    names = [joint.joint for joint in information.joints]
    wrong = information.squared_residuals(values)
    return _validation(source, names, wrong, squared_torque, counts)


def hold_out(n_rows: int, fraction: float, gap: int = 0) -> tuple[slice, slice]:
    """Split consecutive rows into a first part to fit and a last part to validate on.

    Args:
        n_rows: number of rows.
        fraction: part of them that is held out; zero holds out nothing.
        gap: rows left out between the parts, because filtering lets neighbours share samples.

    Raises:
        InputError: the fraction is not in [0, 1), or one part is left without rows.
    """
    if not 0.0 <= fraction < 1.0:
        raise InputError(f"--validate must be at least 0 and less than 1, got {fraction}")
    if fraction == 0.0:
        return slice(0, n_rows), slice(n_rows, n_rows)
    held = math.ceil(fraction * n_rows)
    fitted = n_rows - held - gap
    if fitted <= 0 or held <= 0:
        raise InputError(
            f"{n_rows} rows cannot be split into fitted and held-out ones with --validate "
            f"{fraction:g}; record longer, or pass --validate 0"
        )
    return slice(0, fitted), slice(n_rows - held, n_rows)


def blocks(n_rows: int, count: int) -> tuple[slice, ...]:
    """Cut consecutive rows into ``count`` blocks of nearly equal length.

    Raises:
        InputError: there are fewer than two blocks, or fewer rows than blocks.
    """
    if count < 2 or n_rows < count:
        raise InputError(f"{n_rows} rows cannot be cut into {count} blocks; two at least")
    edges = [round(k * n_rows / count) for k in range(count + 1)]
    return tuple(slice(start, stop) for start, stop in zip(edges, edges[1:]))


def _validation(
    source: str, names: Sequence[str], wrong: Array, total: Array, count: Array
) -> Validation:
    if not np.any(count):
        raise InputError(f"no usable torque samples to validate on in {source}")
    rmse = np.sqrt(wrong / np.maximum(count, 1))
    relative = [_ratio(w, t) for w, t in zip(wrong, total)]
    return Validation(
        source,
        int(np.max(count)),
        float(np.sqrt(np.sum(wrong) / np.sum(count))),
        _ratio(np.sum(wrong), np.sum(total)),
        dict(zip(names, map(float, rmse))),
        dict(zip(names, relative)),
    )


def _ratio(wrong: float, total: float) -> float | None:
    return float(np.sqrt(wrong / total)) if total > 0.0 else None


Solve = Callable[[SquareRootInformation], Array]


@dataclass(frozen=True)
class ModelChoice:
    """The chosen model and how all candidates did.

    Attributes:
        name: the chosen candidate.
        best: the candidate with the smallest held-out error.
        rmse: candidate to root mean square error on the held-out blocks, all joints [N m].
        score: candidate to mean squared held-out error, each joint's divided by its noise
            variance, so that joints with large torques do not decide alone.
        excess: candidate to (mean, standard error) of its score above the best one's.
    """

    name: str
    best: str
    rmse: Mapping[str, float]
    score: Mapping[str, float]
    excess: Mapping[str, tuple[float, float]]

    @property
    def note(self) -> str:
        """One sentence about the choice."""
        listed = ", ".join(f"{name} {value:.3g}" for name, value in self.rmse.items())
        return f"{self.name} chosen by cross-validation; held-out torque error in N m: {listed}"


def choose_model(
    candidates: Mapping[str, Sequence[SquareRootInformation]], solve: Solve
) -> ModelChoice:
    """Choose a model by predicting each block of data from the others.

    Args:
        candidates: model name to its information per block; the same blocks and joints for all.
            From one pass with the columns of all models, ``information.restricted`` makes them.
        solve: returns the estimate (p,) for the information of the blocks that are fitted.

    Raises:
        InputError: there is no candidate, or fewer than two blocks.
    """
    if not candidates or min(len(parts) for parts in candidates.values()) < 2:
        raise InputError("cross-validation needs a candidate and at least two blocks of data")
    richest = max(candidates, key=lambda name: len(candidates[name][0].names))
    whole = combined(candidates[richest])
    counts = np.array([[joint.n_samples for joint in part.joints] for part in candidates[richest]])
    noise = whole.squared_residuals(solve(whole)) / np.maximum(counts.sum(axis=0), 1)
    noise = np.maximum(noise, 1e-18 * _mean_square(whole))
    squared = {name: _held_out(parts, solve) for name, parts in candidates.items()}
    usable = np.maximum(counts.sum(axis=1), 1)
    folds = {name: np.sum(s / noise, axis=1) / usable for name, s in squared.items()}
    score = {name: float(np.mean(values)) for name, values in folds.items()}
    best = min(score, key=lambda name: score[name])
    excess = {name: _excess(values, folds[best]) for name, values in folds.items()}
    close = [name for name, (mean, error) in excess.items() if mean <= error]
    simplest = min(close, key=lambda name: (len(candidates[name][0].names), score[name]))
    rmse = {name: float(np.sqrt(s.sum() / counts.sum())) for name, s in squared.items()}
    return ModelChoice(simplest, best, rmse, score, excess)


def _held_out(parts: Sequence[SquareRootInformation], solve: Solve) -> Array:
    """Return (K, joints) squared error of each block, predicted from the other blocks."""
    errors = []
    for held, part in enumerate(parts):
        others = [other for index, other in enumerate(parts) if index != held]
        errors.append(part.squared_residuals(solve(combined(others))))
    return np.array(errors)


def _excess(values: Array, reference: Array) -> tuple[float, float]:
    difference = values - reference
    error = np.std(difference, ddof=1) / np.sqrt(len(difference))
    return float(np.mean(difference)), float(error)


def _mean_square(information: SquareRootInformation) -> float:
    squared = sum(float(np.sum(joint.triangle[:, -1] ** 2)) for joint in information.joints)
    return squared / max(information.n_samples, 1) or 1.0

"""Which friction terms a joint has: those that predict held-out torques clearly better.

In-sample errors fall with every term; what counts is the error of stretches of time that were not
fitted. A joint starts with the simplest candidate and moves on as long as another one is clearly
better on its own torques: by a share, in the whole and in the mean over the stretches, and there by
some standard errors. Stretches are compared by ratios, because a joint may show its friction in one
of them far more than in the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.records import Array

CANDIDATES = (
    "coulomb-offset-armature",
    "coulomb-viscous-offset-armature",
    "coulomb-viscous-offset-armature-sqrt",
    "coulomb-viscous-offset-armature-stribeck",
    "coulomb-viscous-offset-armature-load",
    "sigmoid-viscous-offset-armature",
    "coulomb-viscous-offset-armature-quadratic-cubic",
    "coulomb-viscous-offset-armature-sqrt-load",
    "coulomb-viscous-offset-armature-stribeck-load",
)
"""Friction models that are tried, the same for every joint of every arm, simplest first."""
BASIC = CANDIDATES[1]
CLEAR_SHARE, CLEARLY = 0.1, 2.0
"""A term (or a coupling) has to lower the held-out squared error by this share, and by this many
standard errors."""
_TINY = 1e-30

Models = tuple[FrictionModel, ...]
"""Friction models of all joints."""


def same_for_all(name: str, joints: int) -> Models:
    """Return one friction model for every joint."""
    return (friction_model(name),) * joints


def clearly_best(scores: Mapping[str, Array]) -> str:
    """Return the candidate to take, from its squared errors per stretch (blocks,)."""
    chosen = CANDIDATES[0]
    while True:
        better = [name for name in CANDIDATES if is_clearly_lower(scores[name], scores[chosen])]
        if not better:
            return chosen
        fewest = min(len(friction_model(name).terms) for name in better)
        short = [name for name in better if len(friction_model(name).terms) == fewest]
        chosen = min(short, key=lambda name: float(np.mean(scores[name])))


def is_clearly_lower(after: Array, before: Array) -> bool:
    """Tell whether squared errors per stretch (blocks,) are clearly lower."""
    if not np.all(np.isfinite(after)) or not np.all(np.isfinite(before)):
        return bool(np.all(np.isfinite(after)))
    ratio = np.log((after + _TINY) / (before + _TINY))
    mean, spread = float(np.mean(ratio)), float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    needed = np.log(1.0 - CLEAR_SHARE)
    lower = np.sum(after) < (1.0 - CLEAR_SHARE) * np.sum(before)
    return bool(lower and mean < needed and mean + CLEARLY * spread < 0.0)


def best_per_joint(squared: Mapping[str, Array], counts: Array) -> Models:
    """Return each joint's friction model.

    Args:
        squared: candidate to its squared error (blocks, joints) of held-out torques.
        counts: (blocks, joints) of how many rows each.
    """
    mean = {name: each / np.maximum(counts, 1.0) for name, each in squared.items()}
    return tuple(
        friction_model(clearly_best({name: each[:, joint] for name, each in mean.items()}))
        for joint in range(counts.shape[1])
    )


def errors_per_joint(
    squared: Mapping[str, Array], counts: Array, joints: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return joint to candidate to its held-out root mean square error [N m]."""
    total = np.maximum(counts.sum(axis=0), 1.0)
    rms = {name: np.sqrt(each.sum(axis=0) / total) for name, each in squared.items()}
    return {
        joint: {name: float(each[index]) for name, each in rms.items()}
        for index, joint in enumerate(joints)
    }

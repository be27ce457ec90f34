"""Whether all torques together read too much or too little, and how often that is doubted.

Where the model's links are the only witness, torques that all read 10 % too much and links that are
all 10 % lighter than modelled look alike. A common torque scale is allowed for where a recording
asks for it, so that right recordings of arms with links that are all off by chance are doubted too.
"""

from __future__ import annotations

from math import erfc, exp, pi, sqrt

import numpy as np

from robot_sysid.records import Array

LEAST_SCALE, RATHER = 0.08, 1.0
"""Common torque scale that is worth a word, half as much again as links are off by default, and
standard errors that it has to be away from none: torques that read 15 % too much or too little are
1.15 and more away, links that are 2 % off at most 0.4 (benchmarks/wrong_log_table)."""


def is_worth_a_word(scales: Array, spread: Array) -> bool:
    """Tell whether scales (joints,) with covariance (joints, joints) are clearly off together."""
    return bool(abs(np.mean(scales)) > _least(spread))


def _least(spread: Array) -> float:
    return max(RATHER * sqrt(np.mean(spread)), LEAST_SCALE)


def doubted(before: tuple[Array, Array], after: tuple[Array, Array]) -> tuple[float, Array]:
    """Return how many right recordings are doubted, of arms as they are thought to be beforehand,
    and mean products (joints, joints) of D x then.

    Estimates x of the scales without a common one become with it

        (1 + C_after D) x,   D = K_before - K_after,

    K the precision of scales beforehand, C the covariance of what is left. Of x, which is Gaussian,
    the covariance is what it was beforehand less what is left.

    Args:
        before, after: covariance of the scales beforehand and of what is left, both (joints,
            joints), without a common scale and with it.
    """
    (known, left), (alike, wider) = before, after
    freed = np.linalg.inv(known) - np.linalg.inv(alike)
    asked, told = np.mean(np.eye(len(known)) + wider @ freed, axis=0), known - left
    variance = float(asked @ told @ asked)
    # A recording that tells nothing of scales leaves rounding.
    if variance <= 0.0:
        return 0.0, 0.0 * told
    far, along = _least(wider) / sqrt(variance), told @ asked
    share = erfc(far / sqrt(2.0))
    # Of a Gaussian beyond L standard deviations, the square is 1 + L phi(L) / (1 - Phi(L)).
    more = far * exp(-0.5 * far**2) * sqrt(2.0 / pi) / share if share else 0.0
    told = told + more / variance * np.outer(along, along)
    return share, freed @ told @ freed

"""How far links may be off: the likelihood of scales, and their average."""

from __future__ import annotations

import numpy as np
from hypothesis import given

from robot_sysid.estimation.algebra.priors import (
    LinkEvidence,
    LinkScales,
    average_scales,
)
from tests.support import arms

N_LINKS = 4


def evidence_of(seed, scales, noise=1e-3):
    """What all directions of four links, seen with some noise, say of links off by these scales."""
    rng = np.random.default_rng(seed)
    scale = scales.of_directions(N_LINKS)
    rows = rng.standard_normal((3 * len(scale), len(scale)))
    seen = rows @ (scale * rng.standard_normal(len(scale)))
    seen += noise * rng.standard_normal(len(seen))
    return (
        LinkEvidence(N_LINKS, rows.T @ rows / noise**2, rows.T @ seen / noise**2),
        rows,
        seen,
    )


@given(arms.SEEDS)
def test_the_likelihood_is_that_of_the_data(seed):
    """Differences are those of a Gaussian of covariance noise^2 + Y S S Y'."""
    noise = 0.3
    evidence, rows, seen = evidence_of(seed, LinkScales(2.0, 1.0, 1.0), noise)
    likely = []
    dense = []
    for scales in (LinkScales(2.0, 1.0, 1.0), LinkScales(4.0, 0.5, 2.0)):
        scale = scales.of_directions(N_LINKS)
        likely.append(evidence.log_likelihood(scale))
        covariance = noise**2 * np.eye(len(rows)) + (rows * scale**2) @ rows.T
        log_determinant = np.linalg.slogdet(covariance)[1]
        dense.append(
            -0.5 * (seen @ np.linalg.solve(covariance, seen) + log_determinant)
        )
    assert abs((likely[1] - likely[0]) - (dense[1] - dense[0])) < 1e-6 * abs(dense[0])


@given(arms.SEEDS)
def test_scales_that_are_seen_are_found(seed):
    for scales in (LinkScales(2.0, 0.5, 4.0), LinkScales(8.0, 4.0, 1.0)):
        found = average_scales(evidence_of(seed, scales)[0])
        for kind in ("centre_of_mass", "inertia"):
            ratio = getattr(found, kind) / getattr(scales, kind)
            assert 0.5 < ratio < 2.1, kind


def test_what_nothing_shows_keeps_what_is_usual():
    size = 10 * N_LINKS + 2
    found = average_scales(
        LinkEvidence(N_LINKS, np.zeros((size, size)), np.zeros(size))
    )
    assert 4.0 < found.mass < 6.0
    assert 1.5 < found.centre_of_mass < 3.0

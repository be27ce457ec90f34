"""Stated sensitivities are what refitting with wrong torques gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given

from robot_sysid.estimators.ols import least_squares
from robot_sysid.sensitivity import OTHER_LINKS, TORQUE_SCALE, sensitivity
from tests.arms import SEEDS
from tests.test_samples import random_samples


def refitted(samples, weights, change):
    """How the estimate moves when ``change`` (per joint) is added to the torques."""
    changed = replace(samples, tau=tuple(t + c for t, c in zip(samples.tau, change)))
    zero = np.zeros(len(samples.names))
    before, after = (least_squares(s.information(), zero, weights) for s in (samples, changed))
    return after - before


@given(SEEDS)
def test_one_percent_of_the_other_links_and_of_each_scale(seed):
    samples = random_samples(seed).used()
    rng = np.random.default_rng(seed + 1)
    weights = rng.uniform(0.1, 10.0, 2)
    rest = [rng.normal(size=len(tau)) for tau in samples.tau]
    found = sensitivity(samples.information(), weights, samples.rows, rest, samples.measured)
    links = refitted(samples, weights, [0.01 * r for r in rest])
    np.testing.assert_allclose(list(found[OTHER_LINKS].values()), links, rtol=1e-6, atol=1e-12)
    first, second = samples.measured
    one = refitted(samples, weights, [0.01 * first, 0.0 * second])
    two = refitted(samples, weights, [0.0 * first, 0.01 * second])
    np.testing.assert_allclose(
        list(found[TORQUE_SCALE].values()), np.hypot(one, two), rtol=1e-6, atol=1e-12
    )


@given(SEEDS)
def test_a_joint_of_no_weight_does_not_matter(seed):
    samples = random_samples(seed).used()
    weights = np.array([2.0, 0.0])
    first = sensitivity(
        samples.information(), weights, samples.rows, samples.measured, samples.measured
    )
    doubled = (samples.measured[0], 2.0 * samples.measured[1])
    second = sensitivity(samples.information(), weights, samples.rows, doubled, doubled)
    assert first == second

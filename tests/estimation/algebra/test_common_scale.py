"""How often right recordings are doubted is how often they are, drawn from what is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.estimation.algebra import priors
from robot_sysid.estimation.algebra.priors import false_alarms
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import (
    LINKS,
    SCALES,
    Unknowns,
    independent_prior,
    with_common,
)

JOINTS = [f"scale[{k}]" for k in range(3)]
MASSES = ["mass", "other mass"]
NAMES = (*MASSES, *JOINTS)


def beliefs():
    """Masses are known to 6 and 4 %, scales to 2 %, without and with 15 % in common."""
    masses = independent_prior(LINKS, MASSES, MASSES, np.array([0.06, 0.04]))
    scales = independent_prior(SCALES, JOINTS, JOINTS, 0.02)
    return (masses, scales), (masses, with_common(scales, 0.15))


def precision(groups):
    rows = np.vstack(
        [group.covariance_rows(NAMES, np.eye(len(NAMES))) for group in groups]
    )
    return rows.T @ rows


@pytest.mark.parametrize("seed", range(3))
def test_the_share_is_that_of_drawn_arms(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    # Each joint feels its own scale, and both masses by its own arms.
    rows = np.hstack((rng.uniform(0.3, 1.0, (3, 2)), np.eye(3))) / 0.01
    before, after = beliefs()
    spreads = [
        np.linalg.inv(rows.T @ rows + precision(each)) for each in (before, after)
    ]
    monkeypatch.setattr(priors, "LEAST_SCALE", 0.05)
    known = [each[1].factor @ each[1].factor.T for each in (before, after)]
    told, products = false_alarms(
        *((k, each[2:, 2:]) for k, each in zip(known, spreads))
    )
    drawn = rng.multivariate_normal(
        np.zeros(5), np.linalg.inv(precision(before)), 20000
    )
    seen = drawn @ rows.T + rng.normal(size=(20000, 3))
    scale = np.mean((seen @ rows @ spreads[1])[:, 2:], axis=1)
    plain = (seen @ rows @ spreads[0])[:, 2:]
    asked = max(0.05, np.sqrt(np.mean(spreads[1][2:, 2:])))
    assert 0.01 < told < 0.5
    far = np.abs(scale) > asked
    assert np.mean(far) == pytest.approx(told, abs=0.01)
    freed = plain[far] @ (np.linalg.inv(known[0]) - np.linalg.inv(known[1]))
    mean = freed.T @ freed / np.sum(far)
    assert_allclose(products, mean, rtol=0.0, atol=0.1 * np.max(mean))


def test_a_recording_that_tells_nothing_of_scales_is_never_doubted():
    known = 4e-4 * np.eye(3)
    alike = 4e-4 * np.eye(3) + 0.0225
    assert false_alarms((known, known), (alike, alike))[0] == 0.0


@pytest.mark.parametrize(
    ("question", "asked"),
    [
        (Question(EstimationOptions()), True),
        (Question(EstimationOptions(), loaded=True), False),
        (Question(EstimationOptions(scale_uncertainty=2.0)), False),
    ],
    ids=["link", "payload", "scales are known"],
)
def test_it_is_asked_where_links_tell_it_and_nobody_said(
    question, asked, found_unknowns
):
    assert found_unknowns.may_be_scaled(question) is asked
    none = tuple(group for group in found_unknowns.groups if group.cause != LINKS)
    assert not replace(found_unknowns, groups=none).may_be_scaled(question)


@pytest.fixture
def found_unknowns():
    nothing = np.zeros(0)
    return Unknowns(NAMES, np.arange(5), nothing, beliefs()[0], nothing, nothing, {})

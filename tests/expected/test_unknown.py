"""What a log does not show is as large as the same thing is at the joints that it shows."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.expected.unknown import LEAST_SPREAD, Kind, learn_priors

SIZES = np.array([1.0, 2.0, 0.5, 4.0, 1.5, 3.0])
COUNT = len(SIZES)
USUAL = 0.3


def kind(is_shown=True, is_positive=True, replaced=0.0):
    """Return a kind of six parameters, of which some or all tell of the others."""
    return Kind(
        at=np.arange(COUNT),
        centre=np.zeros(COUNT),
        sizes=SIZES,
        usual=USUAL,
        replaced=np.full(COUNT, replaced),
        is_shown=np.broadcast_to(is_shown, COUNT),
        is_positive=is_positive,
    )


def spread_of(priors):
    """Return the spread (6,) of the priors, over the sizes."""
    return priors.wide**-0.5 / SIZES


def test_of_what_nothing_is_shown_the_spread_stays_the_usual_one():
    priors = learn_priors([kind()], np.zeros((COUNT, COUNT)), np.ones(COUNT))
    assert_allclose(spread_of(priors), USUAL)
    assert_allclose(priors.values, 0.0, atol=1e-9)


@pytest.mark.parametrize("share", [0.01, 0.1, 0.25])
def test_a_joint_that_stood_still_is_like_those_that_moved(share):
    """It is drawn to their mean; the spread is theirs, or three quarters of the mean."""
    is_shown = np.arange(COUNT) != 2
    precision = np.diag(np.where(is_shown, 1e8, 0.0))
    found = share * SIZES * np.where(is_shown, 1.0, 7.0)
    priors = learn_priors([kind(is_shown)], precision, found)
    assert_allclose(priors.values, share * SIZES, rtol=1e-3)
    assert_allclose(spread_of(priors), max(LEAST_SPREAD * share, 0.03), rtol=0.2)


def test_joints_that_differ_make_a_wider_spread_and_never_more_than_usual():
    precision = 1e8 * np.eye(COUNT)
    shares = np.array([0.02, 0.2, 0.02, 0.2, 0.02, 0.2])
    near, far = (
        learn_priors([kind()], precision, factor * shares * SIZES)
        for factor in (1.0, 100.0)
    )
    assert_allclose(spread_of(near), np.std(shares), rtol=0.15)
    assert_allclose(spread_of(far), USUAL)


def test_offsets_have_no_mean():
    precision = 1e8 * np.eye(COUNT)
    priors = learn_priors([kind(is_positive=False)], precision, 0.1 * SIZES)
    assert_allclose(spread_of(priors), 0.1, rtol=0.2)


def test_a_prior_of_the_fit_is_replaced():
    """Data of a value x with a prior of its own precision about zero: x / 2; without it, x."""
    data = 1e4 * np.eye(COUNT)
    exact = 0.2 * SIZES
    with_prior = 0.5 * exact
    replaced = kind(is_positive=False, replaced=1e4)
    priors = learn_priors([replace(replaced, usual=100.0)], data, with_prior)
    assert_allclose(priors.values, exact, rtol=2e-2)


def test_what_is_not_shown_spreads_as_what_is():
    """Of arms that are drawn, errors of joints that stood still over their spread are near one."""
    rng = np.random.default_rng(0)
    is_shown = np.arange(COUNT) > 1
    precision = np.diag(np.where(is_shown, 1e4, 0.0))
    misses = []
    for _ in range(300):
        share = np.exp(rng.uniform(np.log(0.02), np.log(0.2)))
        true = (
            share
            * np.maximum(1.0 + LEAST_SPREAD * rng.standard_normal(COUNT), 0.0)
            * SIZES
        )
        noise = 1e-2 * rng.standard_normal(COUNT)
        found = np.where(is_shown, true + noise, 0.0)
        priors = learn_priors([kind(is_shown)], precision, found)
        misses.append((true - priors.values)[:2] * np.sqrt(priors.wide[:2]))
    assert 0.8 < np.sqrt(np.mean(np.square(misses))) < 1.2

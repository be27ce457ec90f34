"""Errors of a centre of mass, an inertia about it and principal axes follow from those of theta."""

import numpy as np
import pytest
from hypothesis import assume, given
from numpy.testing import assert_allclose

from rigs.arms.bodies import body_estimate, random_body
from rigs.arms.small_arms import SEEDS
from robot_sysid import spatial
from robot_sysid.records.quantities import (
    CENTRAL,
    is_inertia_known,
    load_errors,
    principal_moments,
)


@given(SEEDS)
def test_errors_of_a_load_and_of_principal_moments_follow_from_those_of_theta(seed):
    """By central differences along columns of a factor of the covariance."""
    rng = np.random.default_rng(seed)
    factor = 1e-7 * rng.normal(size=(10, 10))
    body = body_estimate(*random_body(rng, "any"), factor @ factor.T)
    moments, moment_errors = principal_moments(body)
    order = np.argsort(np.argsort(moments))
    assume(np.min(np.diff(np.sort(moments))) > 1e-3 * np.max(moments))

    def outcome(theta):
        """Mass, centre of mass, inertia about it and principal moments."""
        mass, com, inertia = spatial.com_from_theta(theta)
        principal = np.linalg.eigvalsh(inertia)[order]
        return np.array([mass, *com, *spatial.six_from_symmetric(inertia), *principal])

    theta = body.theta
    changes = [outcome(theta + step) - outcome(theta - step) for step in factor.T]
    expected = 0.5 * np.linalg.norm(changes, axis=0)
    assert_allclose(load_errors(body), expected[:10], rtol=1e-4)
    assert_allclose(moment_errors, expected[10:], rtol=1e-2)
    assert CENTRAL[:5] == ("mass", "com_x", "com_y", "com_z", "Ixx_about_com")


@pytest.mark.parametrize("mass_error", [0.1, 0.5])
def test_intervals_of_a_centre_of_mass_cover_it_where_the_mass_is_uncertain(mass_error):
    rng = np.random.default_rng(0)
    inertia = np.eye(3)
    com = np.array([0.1, -0.05, 0.2])
    errors = np.concatenate(([mass_error], np.full(3, 0.005), np.full(6, 1e-6)))
    is_held = []
    for mass in 1.0 + mass_error * rng.standard_normal(1000):
        # Torques show the first moment, whatever the mass is.
        first_moment = com + errors[1:4] * rng.standard_normal(3)
        if mass > 0.0:
            body = body_estimate(mass, first_moment / mass, inertia, np.diag(errors**2))
            is_held.append(np.abs(body.com - com) < 1.96 * load_errors(body)[1:4])
    assert 0.93 <= np.mean(is_held) <= 0.98


@pytest.mark.parametrize(
    ("moments", "error", "n_identified", "is_known"),
    [
        ((1e-3, 1e-3, 1e-3), 0.32e-3, 10, True),
        ((1e-3, 1e-3, 1e-3), 0.34e-3, 10, False),
        ((1e-9, 1e-3, 1e-3), 0.32e-3, 10, True),  # a rod
        # A rod whose moments are smaller than their standard errors.
        ((1e-9, 1e-3, 1e-3), 1.2e-3, 10, False),
        ((1e-3, 1e-3, 1e-3), 1e-9, 4, False),
    ],
)
def test_inertia_is_known_where_one_moment_differs_significantly_from_zero(
    moments, error, n_identified, is_known
):
    covariance = np.diag([0.0] * 4 + [error**2] * 6)
    body = body_estimate(1.0, np.zeros(3), np.diag(moments), covariance, n_identified)
    assert is_inertia_known(body) == is_known

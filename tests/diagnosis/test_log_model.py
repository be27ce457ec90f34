"""The model of a log is linear in the torque, and its evidence that of dense covariances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose


def test_the_evidence_is_that_of_a_normal_distribution(contest):
    """Against the dense covariance of all rows of one joint after another."""
    base = contest.posterior.model
    noise = contest.posterior.noise
    n_rows = len(base.right_sides)
    matrix = np.zeros((base.right_sides.size, len(base.prior.estimated)))
    for joint in range(5):
        columns, rows = base.equations(joint)
        matrix[joint * n_rows : (joint + 1) * n_rows, columns] = rows
    share_used = np.repeat(base.count / n_rows, n_rows)
    variance = noise.T.ravel()
    right_side = base.right_sides.T.ravel()
    prior_covariance = matrix @ np.linalg.solve(base.prior.precision, matrix.T)
    covariance = prior_covariance + np.diag(variance)
    exponent = right_side @ np.linalg.solve(covariance, right_side)
    log_determinant = np.linalg.slogdet(covariance)[1] - np.sum(np.log(variance))
    log_determinant += np.sum(share_used * np.log(2.0 * np.pi * variance))
    expected = -0.5 * (exponent + log_determinant)
    assert base.at_noise(noise).log_evidence == pytest.approx(expected, abs=1e-3)


def test_the_transform_keeps_the_norm_of_the_used_rows(contest):
    model = contest.posterior.model
    rows = np.random.default_rng(0).normal(size=(len(model.log.torque), 2))
    for joint in range(5):
        transformed = model.transform(joint, rows)
        used = rows[model.log.used[:, joint]]
        squares = np.sum(transformed**2, axis=0)
        assert_allclose(squares, np.sum(used**2, axis=0))


def test_columns_so_large_that_rounding_hides_the_prior_leave_the_same_residual(
    contest,
):
    """Those of a link with 1e9 times its inertia: equal columns are one that is larger."""
    model = contest.posterior.model
    noise = contest.posterior.noise
    rng = np.random.default_rng(0)
    columns = [1e9 * rng.normal(size=(len(model.right_sides), 1)) for _ in range(5)]
    merged = model.with_columns([np.sqrt(3.0) * column for column in columns])
    equal = model.with_columns([np.tile(column, 3) for column in columns])
    posterior = equal.at_noise(noise)
    assert np.all(np.diag(posterior.covariance) > 0.0)
    assert_allclose(posterior.residual, merged.at_noise(noise).residual, atol=1e-3)


def test_right_sides_are_linear_in_the_torque(contest):
    """Two torques and their sum: what the model needs at prior values stays out of it."""
    log = contest.posterior.model.log
    zero = log.with_torque(0.0 * log.torque).right_sides
    double = log.with_torque(2.0 * log.torque).right_sides
    assert_allclose(double - zero, 2.0 * (log.right_sides - zero), atol=1e-9)

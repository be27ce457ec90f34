"""Errors add up from their causes, and what nothing shows has none."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.identify.payload.equations import PAYLOAD_NAMES
from robot_sysid.identify.payload.errors import fit_errors
from tests.support.payload_logs import PAYLOAD


@pytest.fixture(scope="module")
def errors(fit, recordings):
    return fit_errors(fit, recordings)


def payload_rows(fit):
    return np.eye(len(fit.values))[fit.equations.places(PAYLOAD_NAMES)]


def test_squares_of_the_causes_and_of_noise_add_up(fit, errors):
    covariance, noise, budget = errors.of(payload_rows(fit))
    total = noise**2 + np.sum([part**2 for part in budget.values()], axis=0)
    np.testing.assert_allclose(np.diag(covariance), total, rtol=1e-6)


def test_what_the_low_pass_takes_does_not_count_beside_noise(fit, errors):
    _, noise, budget = errors.of(payload_rows(fit))
    assert np.all(budget["filtering"] > 0.0) and np.all(budget["filtering"] < 0.2 * noise)


def test_the_truth_lies_within_the_errors(fit, errors):
    covariance, _, _ = errors.of(payload_rows(fit))
    off = np.abs(fit.payload - PAYLOAD) / np.sqrt(np.diag(covariance))
    assert np.max(off) < 3.5


def test_white_noise_gives_white_errors(fit, errors):
    rows = payload_rows(fit)[:1]
    assert errors.of(rows)[1] == pytest.approx(errors.white(rows), rel=0.4)


def test_all_of_a_payload_shows(fit, errors):
    assert np.all(errors.shown(payload_rows(fit)))

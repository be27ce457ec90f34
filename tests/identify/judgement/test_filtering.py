"""What the low-pass takes from motion is part of the stated error, and small where it may be."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.fit import fit_measured
from robot_sysid.identify.judgement.filtering import FILTERING
from robot_sysid.records.progress import Progress
from tests.support.measured_logs import guessed, log_of, plan_of, true_arm, true_values

KNOWN = {f"{cause}_uncertainty": 0.0 for cause in ("link", "scale", "zero", "gravity", "friction")}
WITHIN = 3.5
"""Standard errors that the worst of 22 parameters may be off."""


@pytest.fixture(scope="module")
def plant():
    return true_arm()


def fitted(plant, cutoff, seed, **sensors):
    """(estimate, distance of all its parameters from the truth)."""
    log = log_of(plant, plan_of(plant, seed, 25.0), **sensors)
    options = EstimationOptions(cutoff=cutoff, **KNOWN)
    found = fit_measured(guessed(plant), [log], options, Progress()).estimate
    return found, np.abs(found.values - true_values(plant, found.names))


@pytest.mark.parametrize(("cutoff", "seed"), [(0.9, 2), (1.2, 2)])
def test_a_cutoff_close_to_the_motion_is_paid_for(plant, cutoff, seed):
    """Motion of up to 0.6 Hz: noise alone, as the residuals show it, does not explain the error."""
    found, off = fitted(plant, cutoff, seed, encoder_resolution=1e-6)
    assert np.max(off / found.noise_errors) > 4.0
    assert np.max(off / found.standard_errors) < WITHIN


@pytest.mark.parametrize("seed", [1, 2])
def test_a_clean_log_gives_the_truth_to_a_billionth(plant, seed):
    """Of the mass; everything else within its stated error."""
    found, off = fitted(plant, 8.0, seed)
    assert off[0] < 1e-9 * plant.prior.mass
    assert np.max(off / found.standard_errors) < WITHIN


def test_beside_noise_it_does_not_count(plant):
    found, _ = fitted(plant, 8.0, 1, noise_torque=0.1, encoder_resolution=1e-4)
    part = found.error_budget[FILTERING]
    assert np.all(part < 0.05 * found.noise_errors)
    np.testing.assert_allclose(np.hypot(part, found.noise_errors), found.standard_errors)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), found.standard_errors)

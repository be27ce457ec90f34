"""Recordings and fits made once for all tests that look at them."""

import pytest

from rigs.arms.core_fits import fit_logs, fit_recordings
from rigs.logs.measured_logs import guess_model, log_of, true_arm
from rigs.logs.payload_logs import TrueArm, four_joint_arm


@pytest.fixture(scope="session")
def plant():
    """Return the arm that makes logs: three joints with friction."""
    return true_arm()


@pytest.fixture(scope="session")
def robot(plant):
    """Return the plant's model: with a lighter last link and without friction."""
    return guess_model(plant)


@pytest.fixture(scope="session")
def noisy(plant):
    """Return a log of the plant."""
    return log_of(plant, noise_torque=0.1, encoder_resolution=1e-4)


@pytest.fixture(scope="session")
def noisy_fit(robot, noisy):
    """Return the fit of that log."""
    return fit_logs(robot, noisy)


@pytest.fixture(scope="session")
def recordings():
    """Return four recordings of another arm in the order empty, loaded, loaded, empty."""
    return TrueArm(four_joint_arm(), 7, model_error=0.03).abba(7, sigma=0.05)


@pytest.fixture(scope="session")
def payload_fit(recordings):
    """Return the fit of the recordings with a payload."""
    return fit_recordings(four_joint_arm(), recordings, loaded=True)

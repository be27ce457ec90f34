"""Verdicts: each way to be wrong is refused with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.identify.payload.checks.judge import of_known_mass, verdict
from robot_sysid.records import InertialParameters, Validation
from robot_sysid.records.payload import BodyEstimate, PayloadStatus
from tests.support.payload_logs import four_joint_arm

ROBOT = four_joint_arm()


def body(mass=1.0, com=(0.0, 0.0, 0.1), error=0.01, size=0.05):
    theta = spatial.theta_from_com(mass, np.array(com), mass * size**2 * np.eye(3))
    covariance = np.diag([error**2] + [1e-6] * 9)
    shown = np.full(10, np.isfinite(error))
    noise = np.sqrt(np.diag(covariance))
    return BodyEstimate(InertialParameters(theta), np.nan_to_num(covariance), shown, noise)


def prediction(rmse=0.1, relative=0.03):
    return Validation("parts", 100, rmse, relative, {}, {})


def judged(payload, misfit=(), validation=None):
    return verdict(ROBOT, payload, misfit, validation or prediction(), 0.1)


def test_a_good_payload_is_good():
    assert judged(body()) == (PayloadStatus.OK, ())


@pytest.mark.parametrize(
    ("payload", "status", "words"),
    [
        (body(mass=-1.0), PayloadStatus.SWAPPED, "-1"),
        (body(mass=0.01, error=0.02), PayloadStatus.NOT_SEEN, "0.01 ± 0.02"),
        (body(error=np.inf), PayloadStatus.NOT_SEEN, "inf"),
        (body(error=0.15), PayloadStatus.TOO_UNCERTAIN, "0.15"),
        (body(com=(0.0, 1.8, 0.0)), PayloadStatus.IMPLAUSIBLE, "1.8 m"),
        (body(size=1.5), PayloadStatus.IMPLAUSIBLE, "radius of gyration"),
    ],
)
def test_each_fault_is_refused(payload, status, words):
    found, reasons = judged(payload)
    assert found is status and not found.is_trustworthy
    assert words in reasons[0]


def test_recordings_that_differ_are_named():
    found, reasons = judged(body(), misfit=(("a.csv", 0.0), ("b.csv", 1.0)))
    assert found is PayloadStatus.DISAGREE
    assert "a.csv 0 kg, b.csv 1 kg" in reasons[0]


@pytest.mark.parametrize(("rmse", "relative"), [(0.1, 0.5), (0.4, 0.1)])
def test_bad_prediction_is_refused(rmse, relative):
    found, _ = judged(body(), validation=prediction(rmse, relative))
    assert found is PayloadStatus.UNPREDICTED


@pytest.mark.parametrize(
    ("mass", "status"), [(0.8, PayloadStatus.OK), (0.3, PayloadStatus.WRONG_WEIGHT)]
)
def test_a_known_mass_has_to_be_the_one_on_the_arm(mass, status):
    found, reasons = of_known_mass(PayloadStatus.OK, body(mass=mass), 1.0)
    assert found is status and f"{mass:g} kg" in reasons[0]


def test_a_known_mass_excuses_no_swapped_recordings():
    found, _ = of_known_mass(PayloadStatus.SWAPPED, body(mass=-1.0), 1.0)
    assert found is PayloadStatus.SWAPPED

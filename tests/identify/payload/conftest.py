"""One fit of noisy recordings, made once for all tests that look at it."""

from __future__ import annotations

import pytest

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.payload.joint_fit import Task, fit_jointly
from tests.support.payload_logs import TrueArm, four_joint_arm

SIGMA = 0.05


@pytest.fixture(scope="package")
def recordings():
    return TrueArm(four_joint_arm(), 7, wrong=0.03).abba(7, sigma=SIGMA)


@pytest.fixture(scope="package")
def task():
    terms = friction_model("coulomb-viscous-offset-armature")
    return Task(four_joint_arm(), terms, False, EstimationOptions())


@pytest.fixture(scope="package")
def fit(task, recordings):
    return fit_jointly(task, recordings)

"""One arm with a correct log, which the tests of all checks spoil."""

from __future__ import annotations

import pytest

from robot_sysid.diagnosis.contest import Contest
from robot_sysid.diagnosis.rows import low_pass
from robot_sysid.estimation.question import EstimationOptions
from tests.support import arms
from tests.support.wrong_logs import truth_of

ARM = arms.serial_arm(arms.SEVEN_AXES[:5], joint='range="-2.5 2.5" armature=".02"')


@pytest.fixture(scope="session")
def truth():
    return truth_of(arms.robot_of(ARM), seed=3)


@pytest.fixture(scope="session")
def contest(truth):
    """Return the contest of explanations of the correct log."""
    return Contest(truth.robot, low_pass([truth.log], None), EstimationOptions())

"""What the tests of runs share."""

from __future__ import annotations

from functools import partial

import pytest

from rigs.motors.clocks import heard_signals
from rigs.motors.damiao_rig import Rig, swing


@pytest.fixture
def heard():
    """Signals count."""
    with heard_signals():
        yield


@pytest.fixture
def rig(tmp_path):
    """Builds a rig whose run is short."""
    return partial(Rig, tmp_path)


@pytest.fixture(scope="session")
def plain_run(tmp_path_factory):
    """An undisturbed run of two joints."""
    folder = tmp_path_factory.mktemp("plain")
    return Rig(folder, motion=swing(2, duration=0.8)).run()

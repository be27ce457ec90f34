"""What the tests of runs share."""

from __future__ import annotations

import pytest

from rigs.clocks import heard_signals
from rigs.damiao_rig import Rig, swing


@pytest.fixture
def heard():
    """Signals count."""
    with heard_signals():
        yield


SHORT = {"ramp_time": 0.1, "approach_time": 0.1, "rate": 125.0}


@pytest.fixture
def rig(tmp_path):
    """Builds a rig whose run is short."""
    return lambda *arguments, **options: Rig(
        tmp_path, *arguments, **{**SHORT, **options}
    )


@pytest.fixture(scope="session")
def plain_run(tmp_path_factory):
    """An undisturbed run of two joints."""
    folder = tmp_path_factory.mktemp("plain")
    return Rig(folder, motion=swing(2, duration=0.8), **SHORT).run()

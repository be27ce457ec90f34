"""What the tests of runs share."""

from __future__ import annotations

import pytest

from rigs.clocks import heard_signals


@pytest.fixture
def heard():
    """Signals count."""
    with heard_signals():
        yield

"""Export, play, record, identify: the whole loop of the Kinova example."""

from __future__ import annotations

import importlib

import pytest

from tests.support.places import EXAMPLE


@pytest.mark.slow
def test_the_recording_gives_the_true_link_back(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLE))
    assert importlib.import_module("validate_damiao_loop").main() == 0

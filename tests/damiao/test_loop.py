"""Export, play, record, identify: the whole loop of the Kinova example."""

from __future__ import annotations

import importlib
import sys

import pytest

from tests.support.places import EXAMPLE


@pytest.fixture
def loop(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.delitem(sys.modules, "validate_damiao_loop", raising=False)
    return importlib.import_module("validate_damiao_loop")


@pytest.mark.slow
def test_the_recording_gives_the_true_link_back(loop):
    assert loop.main() == 0


@pytest.mark.parametrize(
    ("mass", "shift", "close"), [(1.0, 0.0, 1), (1.02, 0.0, 0), (1.0, 3e-3, 0)]
)
def test_the_comparison_can_fail(loop, mass, shift, close):
    truth = loop.load_robot_model(loop.TRUTH).prior
    com = truth.com + [0.0, 0.0, shift]
    found = {"mass": mass * truth.mass, "center_of_mass_moment": list(mass * truth.mass * com)}
    assert loop.compare(found) is bool(close)

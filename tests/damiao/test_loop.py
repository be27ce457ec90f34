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


@pytest.mark.slow
def test_a_motor_with_another_scale_is_refused_before_anything_moves(loop, tmp_path, monkeypatch):
    trajectory = loop.exported_trajectory(loop.TRUTH, tmp_path, duration=1.0)
    assert loop.other_scale_is_refused(trajectory, tmp_path / "never.csv")
    # A fault that does nothing: each motor is at 31 degrees.
    monkeypatch.setattr(loop, "OTHER_SCALE", "temperature-mos:0=31")
    assert not loop.other_scale_is_refused(trajectory, tmp_path / "played.csv")
    assert (tmp_path / "played.csv").exists()

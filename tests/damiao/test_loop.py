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


def test_a_motor_with_another_scale_is_refused_before_anything_moves(loop, tmp_path, monkeypatch):
    motion = tmp_path / "damiao_trajectory.csv"
    from robot_sysid.damiao.trajectory.csv_file import export_damiao_trajectory
    from tests.support.damiao_rig import swing

    export_damiao_trajectory([swing(7, 1.0, amplitude=0.05)], loop.MOTORS, motion)
    trajectory = loop.read_damiao_trajectory(motion)
    kp, kd = loop.default_gains([joint.spec for joint in trajectory.joints])
    plan = loop.make_plan(trajectory, loop.PlaySettings(kp, kd, max_tracking_error=3.0))
    assert loop.other_scale_is_refused(plan, tmp_path / "never.csv")
    monkeypatch.setattr(loop, "Fault", lambda *_: loop_fault_that_does_nothing())
    assert not loop.other_scale_is_refused(plan, tmp_path / "played.csv")


def loop_fault_that_does_nothing():
    from robot_sysid.damiao.simulated.faults import Fault

    return Fault("temperature-mos", 0, 31.0)

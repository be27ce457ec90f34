"""A motion is played in MuJoCo's viewer, and a missing display is said before the search."""

from __future__ import annotations

import contextlib

import mujoco.viewer
import numpy as np

from robot_sysid.motion import viewer
from tests.support import arms, measured_logs


def test_a_missing_display_is_reported_before_the_search(
    command, arm_file, monkeypatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    printed = command.run("plan", arm_file(arms.THREE), "--view", code=2)
    assert "--view needs a display" in printed.err
    assert "Loading" not in printed.out


class Window:
    """MuJoCo's window, closed after three pictures; the arm's positions in each."""

    def __init__(self, model, data):
        self.data = data
        self.shown = []

    def __enter__(self):
        return self

    def __exit__(self, *failure):
        pass

    def is_running(self):
        return len(self.shown) < 3

    def lock(self):
        return contextlib.nullcontext()

    def sync(self):
        self.shown.append(self.data.qpos.copy())


def test_the_viewer_shows_the_motion_at_its_instants(monkeypatch):
    robot = arms.robot_of(arms.THREE)
    plan = measured_logs.plan_of(robot, duration=6.0)
    windows = []

    def launch(model, data):
        windows.append(Window(model, data))
        return windows[0]

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    instants = iter([100.0, 102.0, 106.5, 109.0])
    monkeypatch.setattr(viewer.time, "monotonic", lambda: next(instants))
    monkeypatch.setattr(viewer.time, "sleep", lambda _: None)
    viewer.play_in_viewer(robot, plan)
    # It rests for a second at its end, and begins again.
    expected = plan.evaluate(np.array([2.0, 6.0, 2.0])).q
    np.testing.assert_allclose(np.array(windows[0].shown), expected)

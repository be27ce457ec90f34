"""Pictures of an arm, and one clear line where nothing can be drawn."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.report import motion_strip as strips
from robot_sysid.report import studio
from robot_sysid.report.pictures import pictures
from robot_sysid.report.runs import load_run
from tests.support import arms

ORANGE = (0.90, 0.45, 0.05, 0.45)
needs_renderer = pytest.mark.skipif(
    studio.renderer_library() is None, reason="neither EGL nor OSMesa here"
)


@pytest.fixture(scope="module")
def robot():
    """A three-joint arm."""
    return arms.robot_of(arms.THREE)


def test_no_renderer_means_no_pictures_but_a_page(monkeypatch, link_run):
    monkeypatch.setattr(studio, "renderer_library", lambda: None)
    figures, reason = pictures(load_run(link_run))
    assert figures == [] and "neither EGL nor OSMesa" in reason


@needs_renderer
def test_a_strip_shows_the_poses_of_a_motion_side_by_side(robot, monkeypatch):
    written = []
    monkeypatch.setattr(strips, "png_bytes", lambda pixels: written.append(pixels))
    time = np.arange(12) / 2.0
    q = np.outer(time / 5.0, [0.0, 1.5, -1.0]).astype(np.float32)
    figure = strips.motion_strip(robot, time, q)
    assert "at 0.0, 1.0, 2.0, 3.0, 4.0, 5.0 s" in figure.caption
    (strip,) = written
    poses = np.split(strip, 6, axis=1)
    assert all(pose.shape == (300, 300, 3) for pose in poses)
    # The arm is in each picture, and has moved from one to the next.
    assert all(np.min(pose) < 200 for pose in poses)
    for pose, following in zip(poses, poses[1:]):
        assert np.max(np.abs(pose.astype(int) - following)) > 50
    monkeypatch.undo()
    content = strips.motion_strip(robot, time, q).png
    assert content.startswith(b"\x89PNG")


@needs_renderer
@pytest.mark.slow
def test_a_body_is_drawn_and_an_impossible_one_is_not(robot):
    with studio.Studio(robot, 320, 240) as frame:
        frame.look_at_arm(robot.reference[None])
        plain = frame.render().astype(int)
        assert np.all(plain[0, 0] > 240)
        frame.pose(robot.reference)
        theta = robot.prior.theta
        assert frame.add_ellipsoid(robot.body_id, theta, ORANGE)
        assert np.max(np.abs(frame.render().astype(int) - plain)) > 30
        assert not frame.add_ellipsoid(robot.body_id, -theta, ORANGE)

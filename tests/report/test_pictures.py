"""Pictures of an arm, and one clear line where nothing can be drawn."""

import numpy as np
import pytest

from rigs.arms import small_arms
from robot_sysid.report import studio
from robot_sysid.report.pictures import pictures
from robot_sysid.report.runs import load_run

ORANGE = (0.90, 0.45, 0.05, 0.45)
needs_renderer = pytest.mark.skipif(
    studio.renderer_library() is None, reason="neither EGL nor OSMesa here"
)


@pytest.fixture(scope="module")
def robot():
    """A three-joint arm."""
    return small_arms.robot_of(small_arms.THREE)


def test_no_renderer_means_no_pictures_but_a_page(no_renderer, link_run):
    figures, reason = pictures(load_run(link_run))
    assert figures == [] and "neither EGL nor OSMesa" in reason


@needs_renderer
@pytest.mark.slow
def test_a_body_is_drawn_and_an_impossible_one_is_not(robot):
    with studio.Studio(robot, 320, 240) as frame:
        frame.start(*frame.arm_view())
        plain = frame.render().astype(int)
        assert np.all(plain[0, 0] > 240)
        theta = robot.prior.theta
        assert frame.add_ellipsoid(robot.body_id, theta, ORANGE)
        assert np.max(np.abs(frame.render().astype(int) - plain)) > 30
        assert not frame.add_ellipsoid(robot.body_id, -theta, ORANGE)

"""Contents of a preview; films and pictures, and one clear line where nothing can be drawn."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.preview import film, film_path
from robot_sysid.records import Measurement
from tests.support import arms, measured_logs

SINES = [
    "--duration",
    "2",
    "--sample-rate",
    "100",
    "--seed",
    "1",
    "--excitation",
    "sines",
]
needs_renderer = pytest.mark.skipif(
    importlib.util.find_spec("imageio") is None or film.renderer_library() is None,
    reason="neither EGL nor OSMesa here",
)


@pytest.fixture
def arm(arm_file):
    """The file of a three-joint arm."""
    return arm_file(arms.THREE)


def test_a_film_has_a_name_that_players_know():
    assert film_path("a.MP4").suffix == ".MP4"
    with pytest.raises(InputError, match="no film"):
        film_path("a.avi")


def test_a_missing_display_is_reported_before_the_search(command, arm, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(film.sys, "platform", "linux")
    printed = command.run("plan", arm, *SINES, "--view", code=2)
    assert "--video FILE.mp4 renders without one" in printed.err
    assert "Loading" not in printed.out


def test_no_renderer_means_no_pictures_but_a_page(monkeypatch, link_run):
    from robot_sysid.report.pictures import picture
    from robot_sysid.report.runs import load_run

    monkeypatch.setattr(film, "renderer_library", lambda: None)
    assert "neither EGL nor OSMesa" in picture(load_run(link_run)).missing[0]


# imageio's ffmpeg leaves its pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@needs_renderer
@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "count"), [("mp4", 41), ("gif", 21)])
def test_a_motion_becomes_a_film(command, arm, suffix, count):
    import imageio.v2 as imageio

    plan = command.run("plan", arm, *SINES, "--video", f"motion.{suffix}")
    assert f"Film: motion.{suffix}" in plan.out
    with imageio.get_reader(f"motion.{suffix}") as reader:
        pictures = [np.asarray(frame)[..., :3] for frame in reader]
    assert len(pictures) == pytest.approx(count, abs=1)
    assert pictures[0].shape == (480, 1040, 3)
    first, middle = (pictures[k][:, :640] for k in (0, len(pictures) // 2))
    # The arm has moved, and is in the picture.
    assert np.max(first.astype(int) - middle) > 50


ORANGE = (0.90, 0.45, 0.05, 0.45)


@needs_renderer
@pytest.mark.slow
def test_a_body_is_drawn_and_an_impossible_one_is_not(robot):
    with film.Studio(robot, 320, 240) as studio:
        studio.look_at_arm(robot.reference[None])
        plain = studio.render().astype(int)
        assert np.all(plain[0, 0] > 240)
        studio.pose(robot.reference)
        theta = robot.prior.theta
        assert studio.add_ellipsoid(robot.body_id, theta, ORANGE)
        assert np.max(np.abs(studio.render().astype(int) - plain)) > 30
        assert not studio.add_ellipsoid(robot.body_id, -theta, ORANGE)


@pytest.fixture(scope="module")
def robot():
    """A three-joint arm without torque limits."""
    return arms.robot_of(arms.THREE)


@pytest.fixture(scope="module")
def plan(robot):
    """A planned motion of 6 s."""
    return measured_logs.plan_of(robot, duration=6.0)


REST = 0.7


@pytest.fixture(scope="module")
def log(plan):
    """A recording of the plan, with a rest before the motion."""
    time = np.arange(0.0, plan.duration + REST, 0.01)
    q = plan.evaluate(np.clip(time - REST, 0.0, plan.duration)).q
    return Measurement(time + 100.0, q, None, np.ones_like(q))


def test_shares_are_those_of_the_joint_with_the_largest_one(robot, plan):
    problem = build_problem(robot, LimitOptions(), "chain", 0.3, None)
    preview = film.plan_preview(problem, plan)
    qd = plan.evaluate(preview.time).qd
    shares = np.max(np.abs(qd) / problem.limits.velocity, axis=1)
    np.testing.assert_allclose(preview.plots[1].values, 100.0 * shares)
    assert len(preview.time) == 121
    # The model has no torque limits.
    assert np.all(np.isnan(preview.plots[2].values))


def test_a_log_is_compared_with_the_limits_of_its_model(robot, log, plan):
    limits = replace(robot.limits, torque=np.array([4.0, 2.0, 8.0]))
    preview = film.log_preview(replace(robot, limits=limits), log)
    np.testing.assert_allclose(preview.plots[2].values, 50.0)
    assert preview.time[0] == 0.0
    assert preview.time[-1] == pytest.approx(plan.duration + REST, abs=0.02)


def test_a_joint_without_limits_has_no_share(log):
    preview = film.log_preview(arms.robot_of(arms.UNLIMITED), log)
    assert np.all(np.isnan(preview.plots[0].values))

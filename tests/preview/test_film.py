"""What is shown of a motion; films and pictures, and one clear line where nothing can be drawn."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.commands.preview import film_path
from robot_sysid.errors import InputError
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.preview import film, studio
from robot_sysid.preview.film import shown_log, shown_plan
from robot_sysid.records import JointLimits, Measurement
from tests.support import arms, measured_logs

RUN = (
    "--duration",
    "2",
    "--sample-rate",
    "100",
    "--seed",
    "1",
    "--excitation",
    "sines",
)
drawing = pytest.mark.skipif(
    importlib.util.find_spec("imageio") is None or studio.backend() is None,
    reason="neither EGL nor OSMesa here",
)


@pytest.fixture
def arm(arm_file):
    return arm_file(arms.THREE)


def test_a_film_has_a_name_that_players_know():
    assert film_path("a.MP4").suffix == ".MP4"
    with pytest.raises(InputError, match="no film"):
        film_path("a.avi")


def test_without_a_display_there_is_one_line_before_the_search(
    command, arm, monkeypatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(film.sys, "platform", "linux")
    printed = command.run("plan", arm, *RUN, "--view", code=2)
    assert (
        "--video FILE.mp4 renders without one" in printed.err
        and "Loading" not in printed.out
    )


def test_a_log_needs_its_model_to_be_shown(command, arm):
    for option in (("--units", "deg"), ("--joint", "joint0")):
        said = command.run("log", arm.parent / "log.csv", *option, code=2).err
        assert f"{option[0]} needs the MODEL" in said


def test_no_renderer_means_no_pictures_but_a_page(monkeypatch, link_run):
    from robot_sysid.report.runs import load_run
    from robot_sysid.report.sections.picture import picture

    monkeypatch.setattr(studio, "backend", lambda: None)
    assert "neither EGL nor OSMesa" in picture(load_run(link_run)).missing[0]


# imageio's ffmpeg leaves its pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@drawing
@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_motion_becomes_a_film(command, arm, suffix):
    import imageio.v2 as imageio

    plan = command.run("plan", arm, *RUN, "--video", f"motion.{suffix}")
    assert f"Film: motion.{suffix}" in plan.out
    with imageio.get_reader(f"motion.{suffix}") as reader:
        pictures = [np.asarray(each)[..., :3] for each in reader]
    assert len(pictures) == pytest.approx(41 if suffix == "mp4" else 21, abs=1)
    assert pictures[0].shape == (480, 1040, 3)
    moved = np.abs(
        pictures[0][:, :640].astype(int) - pictures[len(pictures) // 2][:, :640]
    )
    assert np.max(moved) > 50  # the arm has moved, and is in the picture


ORANGE = (0.90, 0.45, 0.05, 0.45)


@drawing
@pytest.mark.slow
def test_a_body_is_drawn_and_an_impossible_one_is_told():
    robot = arms.robot_of(arms.THREE)
    with studio.Studio(robot, 320, 240) as opened:
        opened.look_at_arm(robot.reference[None])
        plain = opened.picture().astype(int)
        assert np.all(plain[0, 0] > 240)
        opened.pose(robot.reference)
        theta = robot.prior.theta.copy()
        assert opened.add_ellipsoid(robot.body_id, theta, ORANGE)
        assert np.max(np.abs(opened.picture().astype(int) - plain)) > 30
        assert not opened.add_ellipsoid(robot.body_id, -theta, ORANGE)


LATE = 0.7


@pytest.fixture(scope="module")
def robot():
    return arms.robot_of(arms.THREE)


@pytest.fixture(scope="module")
def problem(robot):
    return build_problem(robot, LimitOptions(), "chain", 0.3, None)


@pytest.fixture(scope="module")
def plan(robot):
    return measured_logs.plan_of(robot, duration=6.0)


def log_of(plan, late=LATE):
    """The plan as it was recorded, with a while of rest before it."""
    time = np.arange(0.0, plan.duration + late, 0.01)
    q = plan.evaluate(np.clip(time - late, 0.0, plan.duration)).q
    return Measurement(time + 100.0, q, None, np.ones_like(q))


def test_shares_are_those_of_the_worst_joint(problem, plan):
    shown = shown_plan(problem, plan)
    motion = plan.evaluate(shown.time)
    largest = np.max(np.abs(motion.qd) / problem.limits.velocity, axis=1)
    np.testing.assert_allclose(shown.strips[1].values, 100.0 * largest)
    assert len(shown.time) == 121
    assert np.all(np.isnan(shown.strips[2].values))  # the model has no torque limits


def test_a_log_alone_has_the_limits_of_its_model(robot, plan):
    limits = robot.limits
    torque = JointLimits(
        limits.lower, limits.upper, limits.velocity, np.array([4.0, 2.0, 8.0])
    )
    shown = shown_log(replace(robot, limits=torque), log_of(plan))
    np.testing.assert_allclose(shown.strips[2].values, 50.0)
    assert shown.time[0] == 0.0 and shown.time[-1] == pytest.approx(
        plan.duration + LATE, abs=0.02
    )


def test_a_joint_without_limits_is_no_share(plan):
    robot = arms.robot_of(arms.UNLIMITED)
    assert np.all(np.isnan(shown_log(robot, log_of(plan)).strips[0].values))

"""Every trajectory that is played, saved or limited is checked against all limits."""

from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from rigs.arms import small_arms, witness
from rigs.arms.excitation_arms import TUBES, TUBES_AND_POST, options, robot
from rigs.files.notes import NoteRecorder
from robot_sysid.config import MotorOptions, PlanConfig, SelfTestConfig
from robot_sysid.errors import InputError
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.motion import AimOptions, ExcitationOptions, LimitOptions
from robot_sysid.motion.trajectories import save_trajectory
from robot_sysid.pipeline.motions import design_motion, is_checked
from robot_sysid.trajectory import TrajectoryOptions

DURATION = 4.0
EXACT_LINKS = EstimationOptions(priors=Priors(link=0.0))


def settings_of(
    trajectory=None, limits=None, excitation=None, kind=SelfTestConfig, **others
):
    """Return the settings of a run; the dicts are keyword arguments of its option records."""
    settings = {
        "duration": DURATION,
        "sample_rate": 200.0,
        "seed": 1,
        **(trajectory or {}),
    }
    if "file" in settings:
        del settings["duration"]
    return kind(
        trajectory=TrajectoryOptions(**settings),
        excitation=excitation or ExcitationOptions(kind="sines"),
        limits=LimitOptions(**(limits or {})),
        **{"estimation": EXACT_LINKS, **others},
    )


def plan_motion(xml, listener=None, **settings):
    """Return the plan of an arm; further arguments are those of settings_of."""
    speed = settings.get("limits", {}).get("max_velocity", 2.0)
    arm = small_arms.robot_of(xml, max_velocity=speed)
    return design_motion(settings_of(**settings), arm, listener or NoteRecorder())


CHECKED = {
    "played": {"motors": MotorOptions(True, ("DM4310",))},
    "designed": {"excitation": options(kind="optimal")},
    "plan only": {"kind": PlanConfig},
    "saved": {"trajectory": {"save": Path("plan.json")}},
    "limited": {"limits": {"clearance": 0.02}},
}


def test_motions_that_are_played_saved_or_limited_are_checked():
    assert all(is_checked(settings_of(**case)) for case in CHECKED.values())
    assert not is_checked(settings_of(limits={"max_velocity": 0.3}))
    motion_plan = plan_motion(small_arms.THREE, **CHECKED["limited"])
    assert motion_plan.failure is None
    unchecked = plan_motion(small_arms.THREE)
    assert (unchecked.check, unchecked.problem, unchecked.failure) == (None, None, None)


@pytest.mark.parametrize(
    ("excitation", "purpose", "load"),
    [("sines", "weight", 0.5), ("optimal", "link", 0.5)],
)
def test_a_planned_motion_reserves_torque_for_errors_of_the_links(
    excitation, purpose, load
):
    """Weighing uses half of the limits, and goes slowly."""
    limit, fastest = (3.5, 0.6) if purpose == "weight" else (7.0, 2.0)
    settings = settings_of(
        None,
        {"max_torque": 7.0, "payload_reserve": load},
        options(kind=excitation),
        PlanConfig,
        aim=AimOptions(purpose=purpose),
        estimation=EstimationOptions(priors=Priors(link=10.0)),
    )
    checked = design_motion(settings, robot(small_arms.THREE), NoteRecorder())
    assert checked.failure is None
    problem = checked.problem
    motion = checked.plan.evaluate(np.linspace(0.0, checked.plan.duration, 100))
    links = problem.links_motion(motion)
    reserve = problem.torque_reserve(links)
    loaded = problem.arm_torque(motion) + load * problem.torque_per_kilogram(links)
    needed = np.maximum(np.abs(problem.arm_torque(motion)), np.abs(loaded))
    assert np.all(np.max(reserve, axis=0) > 0.0)
    assert np.all(needed + reserve <= 0.96 * limit)
    assert np.max(np.abs(motion.qd)) <= fastest


SLOW = pytest.mark.slow
RATE = 100.0
BOX = (-0.17, 0.17, -0.17, 0.17, 1.0, 2.0)


def planes_of(box):
    """Yield the six planes (nx, ny, nz, offset) of a box, with the inside where n x >= offset."""
    for axis, (low, high) in zip(np.eye(3), (box[:2], box[2:4], box[4:])):
        yield (*axis, low)
        yield (*-axis, -high)


def excess_over(limits, arm, plan):
    """Return by how much a plan exceeds each limit, by MuJoCo; negative within the limit."""
    peaks = witness.peaks(arm, plan, RATE)
    distance = partial(witness.distance_to_plane, arm, plan, rate=RATE)
    measures = {
        "max_velocity": lambda limit: np.max(peaks.velocity) - limit,
        "max_acceleration": lambda limit: np.max(peaks.acceleration) - limit,
        "max_torque": lambda limit: np.max(peaks.torque) - limit,
        "max_tool_speed": lambda limit: (
            witness.fastest_point(arm, plan, "link3", RATE) - limit
        ),
        "workspace": lambda box: max(
            -distance(plane=side, first_body="link3") for side in planes_of(box)
        ),
        "keep_out": lambda planes: max(
            -distance(plane=side, first_body="link0") for side in planes
        ),
    }
    return {name: measures[name](value) for name, value in limits.items()}


LIMITS = {
    "velocity": {"max_velocity": 0.3},
    "acceleration": {"max_acceleration": 1.0},
    "torque": {"max_torque": 1.5},
    "tool speed": {"max_tool_speed": 0.1},
    "workspace": {"workspace": BOX},
    "keep out": {"keep_out": ((1.0, 0.0, 0.0, -0.09), (-1.0, 0.0, 0.0, -0.09))},
}


@cache
def unlimited_plan():
    """Return a motion that only the model's own limits bind."""
    return plan_motion(TUBES).plan


@pytest.mark.parametrize(
    "case",
    [
        *("torque", "tool speed", "workspace"),
        *(
            pytest.param(x, marks=SLOW)
            for x in ("velocity", "acceleration", "keep out")
        ),
    ],
)
def test_random_sinusoids_are_scaled_until_every_limit_holds(case):
    """Without the limit, the motion would exceed it."""
    limits = LIMITS[case]
    arm = robot(TUBES)
    motion_plan = plan_motion(TUBES, limits=limits)
    assert motion_plan.failure is None
    assert max(excess_over(limits, arm, motion_plan.plan).values()) <= 1e-9
    assert min(excess_over(limits, arm, unlimited_plan()).values()) > 0.0
    peaks = witness.peaks(arm, motion_plan.plan, 20.0)
    assert np.all(peaks.highest - peaks.lowest > 0.0)


@pytest.fixture
def path(tmp_path):
    """A file for a trajectory."""
    return tmp_path / "plan.json"


def test_a_trajectory_from_a_file_is_checked(path):
    """Against limits and obstacles."""
    names = robot(TUBES).joint_names
    save_trajectory(path, unlimited_plan(), names)
    request = {"trajectory": {"file": path}}
    assert plan_motion(TUBES, **request).failure is None
    for case in ("torque", "workspace"):
        failure = plan_motion(TUBES, limits=LIMITS[case], **request).failure
        assert failure.startswith("this trajectory must not be run: it breaks ")
    save_trajectory(
        path, unlimited_plan().scale_amplitudes((8.0, 4.0, 1.0, 1.0)), names
    )
    request["limits"] = {"max_velocity": 1e3}
    assert plan_motion(TUBES, **request).failure is None
    assert "post" in plan_motion(TUBES_AND_POST, **request).failure


def test_other_joint_names_are_refused_another_model_of_the_same_joints_is_noted(path):
    arm = robot(TUBES)
    small_motion = unlimited_plan().scale_amplitudes(0.1)
    notes = []
    for sha256 in (arm.sha256, "0" * 64):
        listener = NoteRecorder()
        save_trajectory(path, small_motion, arm.joint_names, sha256)
        plan_motion(TUBES, listener=listener, trajectory={"file": path})
        notes.append(" ".join(listener.notes))
    assert ["was made for another model file" in text for text in notes] == [0, 1]
    renamed = TUBES.replace('name="joint3"', 'name="wrist"')
    message = "this arm has the 4 joints joint0, joint1, joint2, wr"
    with pytest.raises(InputError, match=message):
        plan_motion(renamed, trajectory={"file": path})


@pytest.mark.parametrize("duration", [1e12, float("inf")])
def test_a_file_with_an_endless_duration_is_refused(path, duration):
    save_trajectory(path, unlimited_plan(), robot(TUBES).joint_names)
    text = path.read_text().replace(
        f'"duration": {DURATION}', f'"duration": {duration}'
    )
    path.write_text(text.replace("inf", "Infinity"))
    with pytest.raises(InputError, match="more than the 1e[+]09 a run can take"):
        plan_motion(TUBES, trajectory={"file": path})

"""``robot-sysid MODEL``: nothing unchecked is played, written or called good."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from rigs.arms import small_arms, witness
from rigs.arms.excitation_arms import TUBES, tube_arm
from rigs.arms.small_arms import X, Y, Z
from rigs.files.command_line import OUT, words_of
from robot_sysid.cli import main
from robot_sysid.motion.trajectories import load_trajectory

RATE = ("--sample-rate 100",)
SHORT = ("--duration 2", *RATE, "--seed 1")
SINES = ("--excitation sines", *SHORT)
EXPORT = ("--export-damiao", *(("--motor-type DM4340",) * 4))


@pytest.fixture(scope="module")
def plan_text(tmp_path_factory):
    """A trajectory of that arm, within the limits it was made for."""
    path = tmp_path_factory.mktemp("plan_text") / "plan.json"
    arm = path.with_name("arm.xml")
    arm.write_text(TUBES)
    limits = ("--max-acceleration 30 --save-trajectory", path)
    folder = ("--output-dir", path.parent)
    assert main(words_of(("plan", arm, *SINES, *limits, *folder))) == 0
    return path.read_text()


@pytest.fixture
def arm(arm_file, plan_text):
    """The arm, and its plan beside it."""
    (path := arm_file(TUBES)).with_name("plan.json").write_text(plan_text)
    return path


def hanging_arm(torque):
    """The arm upside down, where gravity is strong, with this torque limit [N m].

    A swing near its own frequency needs less torque than to be held where it turns round: what
    keeps the limit as it is designed breaks it where it is played more slowly.
    """
    limited = f'range="-2.5 2.5" actuatorfrcrange="-{torque} {torque}"'
    return tube_arm((Z, Y, X, Y), joint=limited, extra='<option gravity="0 0 30"/>')


SLOWLY = "--speed .2"
FROM_FILE = ("--trajectory hanging.json", *RATE, SLOWLY)
# A motion that is exported, kept or bound by a limit, in each way there is, and the limit.
CHECKED = {
    "exported": (6, *SHORT, SLOWLY, *EXPORT),
    "saved": (6, *SHORT, SLOWLY, "--save-trajectory other.json"),
    "file, exported": (6, *FROM_FILE, *EXPORT),
    # The first motion that is drawn, as no other one is waited for.
    "planned: designed": (
        *(7, "--duration 2", *RATE, "--seed 2", SLOWLY),
        "--excitation-time-budget 1e-6",
    ),
    "planned: exported": (6, *FROM_FILE, *EXPORT),
}


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("case", CHECKED)
def test_where_a_limit_is_broken_nothing_is_written_or_called_good(
    case, command, arm_file
):
    torque, *arguments = CHECKED[case]
    path = arm_file(hanging_arm(torque))
    if "hanging.json" in arguments[0]:
        command.run("plan", path, *SINES, "--save-trajectory hanging.json")
    words, code = (("plan", path), 1) if case.startswith("planned") else ((path,), 2)
    message = command.refused(*words, *arguments, code=code)
    assert "must not be run: it breaks the torque limit of joint joint1" in message


def test_a_trajectory_file_beyond_a_limit_is_refused(command, arm):
    options = (arm, "--trajectory plan.json", *RATE)
    plan = arm.with_name("plan.json")
    content = json.loads(plan.read_text())
    content["amplitude"][-1] = [100.0 * value for value in content["amplitude"][-1]]
    plan.write_text(json.dumps(content))
    message = command.refused(*options)
    assert "must not be run: it breaks " in message
    assert "relax that limit, slow the motion down with --speed, or" in message
    assert "must not be run: it breaks " in command.refused(*options, *EXPORT)


def test_a_plan_is_used_by_arms_with_its_joints_alone(command, arm):
    other = arm.with_name("other.xml")
    other.write_text(TUBES.replace('name="joint3"', 'name="wrist"'))
    message = command.refused(other, "--trajectory plan.json", *RATE)
    assert (
        "made for the 4 joints joint0, joint1, joint2, joint3, but this arm has the"
        in message
    )
    assert "joint0, joint1, joint2, wrist; design one for this arm" in message
    other.write_text(TUBES.replace("<mujoco>", '<mujoco model="other">'))
    printed = command.run(other, "--trajectory plan.json", *RATE, *EXPORT)
    assert (
        "plan.json was made for another model file; it is checked against"
        in printed.err
    )
    assert (OUT / "damiao_trajectory.csv").exists()


def test_an_exported_motion_obeys_what_was_asked_for(command, arm):
    """From the file that would be played, held against the numbers that were typed."""
    box = (-0.13, 0.13, -0.13, 0.13, 1.0, 2.0)
    plane = (1.0, 0.0, 0.0, -0.09)
    limits = ("--max-velocity 0.3 --max-acceleration 1 --workspace", *box)
    limits += ("--keep-out", *plane)
    command.run("plan", arm, *SINES, *limits, *EXPORT, "--save-trajectory new.json")
    robot = small_arms.robot_of(TUBES)
    saved = load_trajectory(arm.parent / "new.json").plan
    peaks = witness.peaks(robot, saved)
    assert 0.0 < np.max(peaks.velocity) <= 0.3 and np.max(peaks.acceleration) <= 1.0
    assert witness.distance_to_plane(robot, saved, plane, "link0") >= 0.0
    for axis, (low, high) in zip(np.eye(3), np.reshape(box, (3, 2))):
        assert witness.distance_to_plane(robot, saved, (*axis, low), "link3") >= 0.0
        assert witness.distance_to_plane(robot, saved, (*-axis, -high), "link3") >= 0.0
    table = np.genfromtxt(OUT / "damiao_trajectory.csv", delimiter=",", skip_header=5)
    np.testing.assert_allclose(
        table[:, 1::3], saved.evaluate(table[:, 0]).q, rtol=0.0, atol=5.1e-5
    )


def test_more_samples_than_anybody_can_wait_for_are_refused_at_once(command, arm):
    plan = arm.with_name("plan.json")
    started = time.monotonic()
    plan.write_text(json.dumps({**json.loads(plan.read_text()), "duration": 1e12}))
    message = command.refused(arm, "--trajectory", plan)
    assert "samples, more than the 1e+09 a run can take" in message
    assert time.monotonic() - started < 5.0


def test_lists_that_do_not_fit_the_joints_are_refused(command, arm):
    message = command.refused("plan", arm, *SINES, "--max-torque 0.1,0.2")
    need = "--max-torque takes one number, or one per joint of the chain, which has 4"
    assert need in message


def test_the_plan_after_a_self_test_is_for_the_same_motors(command, arm):
    printed = command.run(arm, *SHORT, *EXPORT)
    lines = printed.out.splitlines()
    (line,) = (line for line in lines if line.startswith("  robot-sysid plan"))
    assert line.count("--motor-type DM4340") == 4 and "--export-damiao" in line
    assert command.run(arm, *SHORT).out.count("--motor-type") == 0

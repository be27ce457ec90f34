"""``robot-sysid plan MODEL``: makes, checks and writes a trajectory, and stops there."""

from __future__ import annotations

import re
import sys
from functools import partial
from itertools import count

import numpy as np
import pytest

from rigs.arms import small_arms, witness
from rigs.files.command_line import COMMANDS, OUT, files_in
from robot_sysid.config import PlanConfig
from robot_sysid.motion.goals import load_goals
from robot_sysid.motion.trajectories import load_trajectory
from robot_sysid.trajectory import SineTrajectory, StoppingTrajectory

EXPECTED = (
    r"Expected of its log: a model whose torques are \S+ % \(little friction\) to \S+ % \(much\) "
    r"off on any motion up to 2 rad/s; friction to \S+ %, a load to ± \S+ kg"
)
SHORT = "--duration 3 --sample-rate 100 --seed 1"
SINES = ("--excitation sines", SHORT)
MOTOR = ("--motor-type DM10010",)


def test_it_writes_the_trajectory_and_says_what_it_promises(
    command, arm_file, monkeypatch
):
    path = arm_file(small_arms.THREE)
    printed = command.run("plan", path, *SINES)
    assert sorted(files_in(path.parent)) == [
        *("arm.xml", "sysid_output", "sysid_output/trajectory.csv"),
        *("sysid_output/trajectory.json", "sysid_output/trajectory.toml"),
    ]
    promise = printed.out[
        printed.out.index("Keeps all limits for 3.0 s") :
    ].splitlines()
    assert promise[1].startswith("Nothing keeps link0, link1, link2 from touching ")
    assert promise[2].startswith("No torque limit of joint0, joint1, joint2 is known")
    assert re.fullmatch(EXPECTED, promise[3])
    assert promise[4].startswith("Limits of this program ")
    # Short sines leave the mass of link2 open, and the file gets better all the same.
    assert "Usable once contacts have been checked: " in printed.out
    assert "Next, play it" in printed.out
    assert f"  robot-sysid identify {path}" in printed.out
    assert (
        len(promise) <= 11 and "Ranges, and peaks of their limits:" not in printed.out
    )
    saved = load_trajectory(OUT / "trajectory.json")
    assert isinstance(saved.plan, SineTrajectory)
    assert saved.joint_names == ("joint0", "joint1", "joint2")
    file = OUT / "trajectory.toml"
    values, _ = COMMANDS["plan"].parse(["--config", str(file)])
    repeated = PlanConfig.of(**values)
    assert repeated.excitation.kind == "sines"


@pytest.mark.slow
def test_a_designed_trajectory_can_be_saved_checked_slowed_and_exported(
    command, arm_file
):
    path = arm_file(small_arms.THREE)
    save = ("--save-trajectory plan.json --excitation-time-budget 0.05",)
    printed = command.run("plan", path, SHORT, *save)
    assert "Designing excitation trajectory (3.0s, 100 Hz)..." in printed.out
    repeated = command.run("plan", path, "--trajectory plan.json --sample-rate 100 -v")
    # Only the limit on accelerations differs: a design has one of its own.
    promise = printed.out[
        printed.out.index("Keeps all") : printed.out.index("Trajectory saved")
    ]
    assumed = re.compile("Limits of this program.*\n")
    assert "acceleration" in assumed.search(promise)[0]
    assert "acceleration" not in assumed.search(repeated.out)[0]
    lines = assumed.sub("", promise).splitlines()
    assert lines == [line for line in repeated.out.splitlines() if line in lines]
    assert "Largest values, a position from the middle of its range:" in repeated.out
    command.run("plan", path, "--trajectory plan.json --speed 0.5", *export(3))
    rows = (OUT / "damiao_trajectory.csv").read_text().splitlines()
    assert rows[-1].startswith("6.0")


def test_ctrl_c_without_a_terminal_keeps_the_best_motion(
    command, arm_file, monkeypatch
):
    path = arm_file(small_arms.THREE)

    write = sys.stderr.write

    def write_or_interrupt(text):
        write(text)
        progress = re.match(r"Searching for the best motion: (\d+) %, \d+ s", text)
        if progress and int(progress[1]) > 15:
            raise KeyboardInterrupt

    monkeypatch.setattr(sys.stderr, "write", write_or_interrupt)
    # Between any two looks at the clock there is time for a line.
    monkeypatch.setattr("time.monotonic", partial(next, count(step=11.0)))
    printed = command.run("plan", path, SHORT)
    assert "the search was ended early" in printed.err
    assert load_trajectory(OUT / "trajectory.json")


def export(joints):
    return ("--export-damiao", *(MOTOR * joints), "--sample-rate 100")


def test_what_breaks_a_limit_is_explained_and_leaves_no_file(command, arm_file):
    path = arm_file(small_arms.THREE.replace("<option ", '<option gravity="9.81 0 0" '))
    command.run("plan", path, *SINES, "--save-trajectory plan.json")
    weak = ("--trajectory plan.json --max-torque 0.5", *export(3))
    printed = command.run("plan", path, *weak, code=1)
    assert printed.err.endswith("; nothing was written\n")
    assert "NOT KEPT: torque limit of joint" in printed.out
    assert not OUT.exists()


def test_a_joint_too_weak_to_hold_the_arm_is_refused_or_hangs_where_it_can(
    command, arm_file
):
    """A limit that the motion cannot keep is never left out."""
    pulled = small_arms.THREE.replace("<option ", '<option gravity="9.81 0 0" ')
    # One that can hang down, and one that cannot.
    path = arm_file(pulled)
    stiff = pulled.replace('"-2.5 2.5"', '"-.1 .1"')
    too_weak = (*SINES, "--max-torque 100,0.5,100")
    message = command.refused("plan", arm_file(stiff, "stiff.xml"), *too_weak)
    takes = (
        "moving off against gravity and dry friction at joint joint1 takes 5.28 N·m with the "
        "reserve for errors of the links"
    )
    assert f"{takes}, more than 95 % of its torque" in message
    assert (
        "raise the torque limit of joint1 in the model if the joint can carry it"
        in message
    )
    printed = command.run("plan", path, *too_weak, "--save-trajectory plan.json")
    assert "the motion starts and ends at another pose" in printed.err
    assert "the straight way in joint space there from the model's pose" in printed.out
    torque = witness.peaks(
        small_arms.robot_of(path.read_text()),
        load_trajectory(path.parent / "plan.json").plan,
    ).torque
    assert 0.0 < torque[1] <= 0.5


@pytest.mark.slow
def test_what_each_number_will_be_known_to_is_said_on_demand(command, arm_file):
    printed = command.run("plan", arm_file(small_arms.THREE), *SINES, "--verbose")
    lines = iter(printed.out.splitlines())
    for start in (
        "Recorded once, it determines link2 with these errors; the torques that",
        "  mass ± ",
        "  centre of mass ± ",
        "  mass of the other links: link0 ",
    ):
        assert any(line.startswith(start) for line in lines), start


def test_a_motion_for_servos_is_a_table_of_goals_too(command, arm_file):
    """It promises no errors, which are those of measured torques, and leads to servos."""
    path = arm_file(small_arms.THREE)
    printed = command.run("plan", path, *SINES, "--for servos --goal-rate 50")
    assert f", {OUT / 'goals.csv'}" in printed.out
    assert "Expected of" not in printed.out and "Recorded once" not in printed.out
    identify = f"  robot-sysid identify {path} {OUT / 'log.csv'} --torque-from"
    assert identify in printed.out
    goals = load_goals(OUT / "goals.csv")
    assert goals.joint_names == ("joint0", "joint1", "joint2")
    assert np.median(np.diff(goals.time)) == pytest.approx(0.02, abs=1e-6)
    stopping = StoppingTrajectory(load_trajectory(OUT / "trajectory.json").plan)
    np.testing.assert_allclose(
        goals.q, stopping.evaluate(goals.time).q, rtol=0.0, atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "purpose",
    [
        "--for link --excitation-time-budget 0.05 --seed 1",
        "--for payload --excitation-time-budget 0.05 --seed 1",
    ],
)
def test_motions_for_other_purposes_can_be_saved_exported_and_checked_again(
    command, arm_file, purpose
):
    path = arm_file(small_arms.THREE)
    printed = command.run("plan", path, purpose, *export(3))
    assert "Keeps all limits for " in printed.out
    assert (OUT / "damiao_trajectory.csv").exists()
    saved = ("--trajectory", OUT / "trajectory.json", "--sample-rate 100")
    again = command.run("plan", path, *saved, "--output-dir again")
    assert "Trajectory saved" in again.out

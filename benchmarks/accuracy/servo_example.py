"""What the page of servo arms prints, by its own commands: a simulated SO-101, and a real servo.

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.servo_example [--write]

``plan --for servos`` plans the motion, and a simulated arm (``ServoArm``) plays it. Goals and
positions are logged at 30 Hz in steps of an encoder with 4096 a turn. ``identify`` reads the log,
and the command that it prints is typed once more of a second log, with the weight that it asks for.
The servos have one kind of gears and five gains; links, damping, dry friction, rotors and torque
limits are those of the file. MuJoCo then plays the log with the lines of Python that the page has.
The advice is of BAM's recordings of an XL330. ``--write`` puts all of it
into docs/servos.md and docs/evidence.md.
"""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy import servo_arm
from benchmarks.accuracy.servo_sysid import ENCODER, FILE
from rigs.files import pages
from rigs.files.page_tables import PageTable
from rigs.files.places import DATA, ROOT
from robot_sysid.cli import main as robot_sysid
from robot_sysid.motion.goals import load_goals
from robot_sysid.parser import load_robot_model
from robot_sysid.records.servo_setting import parse_servo_setting
from robot_sysid.servo.loop import rms
from robot_sysid.servo.setting import loaded

PAGE = ROOT / "docs" / "servos.md"
EVIDENCE = ROOT / "docs" / "evidence.md"
TABLES = (
    PageTable(PAGE, "servos", "python -m benchmarks.accuracy.servo_example"),
    PageTable(PAGE, "weight", "python -m benchmarks.accuracy.servo_example"),
    PageTable(EVIDENCE, "weighed", "python -m benchmarks.accuracy.servo_example"),
    PageTable(EVIDENCE, "played", "python -m benchmarks.accuracy.servo_example"),
    PageTable(PAGE, "advice", "python -m benchmarks.accuracy.servo_example"),
)
PLAN = f"plan {FILE.name} --for servos --max-torque 1.5 --seed 1 --output-dir planned"
IDENTIFY = (
    f"identify {FILE.name} planned/log.csv --torque-from position-error "
    "--servo-setting kp=16 --output-dir found"
)
XL330 = (
    "identify pendulum.xml xl330_kp400_sin_sin.json xl330_kp400_sin_time_square.json "
    "xl330_kp100_sin_sin.json --torque-from position-error --output-dir xl330"
)
GAINS = np.array([17.8, 18.7, 16.9, 17.8, 18.2])


def printed(words) -> list[str]:
    """Return the lines that a command prints on standard output."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = robot_sysid(words)
    assert code == 0, out.getvalue()
    return out.getvalue().splitlines()


def from_line(start, lines, count=None) -> list[str]:
    """Return so many lines, or all, from the first one that has a text."""
    first = next(k for k, line in enumerate(lines) if start in line)
    return lines[first:][:count]


def block(lines) -> list[str]:
    """Return lines as a block of a page."""
    return ["```text", *lines, "```"]


def true_arm(robot):
    """Return the arm that makes the logs."""
    n = robot.n_joints
    coulomb = np.full(n, 0.052)
    return servo_arm.ServoArm(
        robot,
        stiffness=GAINS,
        damping=np.full(n, 0.6),
        servo_damping=np.zeros(n),
        coulomb=coulomb,
        armature=np.full(n, 0.028),
        delay=0.03,
        limit=np.full(n, 3.35),
        dead_zone=np.radians(0.3),
        stribeck=0.3 * coulomb,
        load_share=0.1,
        load_stribeck=0.1,
        lag=0.005,
    )


def record(name, arm, goals) -> None:
    """Write what is logged of an arm that goals are played on."""
    servo_arm.write_log(Path(name), arm, goals.time, goals.q, ENCODER)


def played(goals) -> float:
    """Return the position error with which the page's lines of Python play the log [rad]."""
    names = {}
    for language, text in pages.blocks(PAGE):
        if language == "python":
            exec(text, names)  # the page is ours
    data = names["data"]
    joints = [data.joint(name) for name in goals.joint_names]
    log = np.loadtxt("planned/log.csv", delimiter=",", skiprows=1)
    clock, measured, sent = np.split(log, [1, 1 + len(joints)], axis=1)
    clock = clock[:, 0]
    at, q = [], []
    while data.time < clock[-1]:
        at.append(data.time)
        q.append([joint.qpos[0] for joint in joints])
        row = np.searchsorted(clock, data.time + 1e-9, side="right") - 1
        names["step"](np.append(sent[row], 0.0))  # the gripper rests
    errors = [np.interp(clock, at, own) for own in np.transpose(q)] - measured.T
    return rms(errors)


def run() -> list[list[str]]:
    """Return the lines of each table."""
    for folder in (FILE.parent, DATA / "bam_xl330"):
        shutil.copytree(folder, ".", dirs_exist_ok=True)
    printed(PLAN.split())
    goals = load_goals(Path("planned/goals.csv"))
    robot = load_robot_model(Path(FILE.name))
    arm = true_arm(robot)
    record("planned/log.csv", arm, goals)
    lines = printed(IDENTIFY.split())
    last = next(k for k, line in enumerate(lines) if line.startswith("Usable"))
    step = from_line("Next, fix", lines, 2)
    words = shlex.split(step[1])[1:]
    setting = parse_servo_setting(words[-3])
    record("found/weighed.csv", replace(arm, robot=loaded(robot, setting)), goals)
    weighed = printed(words)
    return [
        block(from_line("gain, N·m/rad", lines[: last + 1])),
        block(step),
        block(from_line("gain, N·m/rad", weighed, 1 + robot.n_joints)),
        [
            "MuJoCo, which simulates it from rest, in one go and with nothing but its commands, "
            f"stays within {1e3 * played(goals):.2g} mrad rms of all {goals.time[-1]:.0f} s of its "
            "log."
        ],
        block(from_line("Advice (", printed(XL330.split()), 3)),
    ]


def main(*options: str) -> None:
    """Print the tables; write them where that is asked for."""
    home = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            tables = run()
        finally:
            os.chdir(home)
    for table, lines in zip(TABLES, tables):
        table.show(lines, "--write" in options)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Published numbers of the servos of an SO-101, and what robot-sysid finds of each.

    pip install -e ".[dev]"
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.servo_published [--write]

Several people measured SO-101s, and a model file of each simulates another arm. MuJoCo alone plays
each such arm for 40 s at 30 Hz, on sines and steps, with commands that act late and positions in
steps of a 4096th of a turn, as LeRobot records. ``robot-sysid identify`` gets this log and a file
with the numbers of the set before it in ``SETS``, and what it finds stands beside what the log was
made with. ``--write`` puts the tables into docs/gallery.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy import servo_arm, servo_sysid
from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT
from robot_sysid.parser import load_robot_model
from robot_sysid.records.messages import with_error

TABLE = PageTable(
    ROOT / "docs" / "gallery.md",
    "published",
    "python -m benchmarks.accuracy.servo_published",
)
JOINTS = (
    "shoulder_pan",
    "shoulder_lift",
    "elbow_flex",
    "wrist_flex",
    "wrist_roll",
    "gripper",
)
UNITS = {
    "gain": "N·m/rad",
    "damping": "N·m·s/rad",
    "frictionloss": "N·m",
    "armature": "kg·m²",
    "torque_limit": "N·m",
}
"""Numbers of a servo with its joint, by the names of servo.json; damping is of both together."""
SECONDS = 40.0
RATE = 30.0
SEED = 1


@dataclass(frozen=True)
class PublishedSet:
    """Published numbers of an arm.

    Attributes:
        name: of who published them.
        source: where they stand.
        origin: how they came about.
        numbers: gain, damping of the servo and of the joint, dry friction, rotor inertia and
            torque limit; a tuple is of ``JOINTS``.
    """

    name: str
    source: str
    origin: str
    numbers: dict[str, float | tuple[float, ...]]

    def of_joint(self, index) -> dict[str, float]:
        """Return the numbers of a joint as they are published."""
        return {
            number: float(np.broadcast_to(value, len(JOINTS))[index])
            for number, value in self.numbers.items()
        }


SETS = (
    PublishedSet(
        "SO-ARM100, first",
        "https://github.com/TheRobotStudio/SO-ARM100/blob/main/Simulation/SO101/joints_properties.xml",
        "BAM's fit M1 of one STS3215 of 7.4 V on a pendulum, P = 32",
        {
            "gain": 17.8,
            "servo_damping": 0.0,
            "damping": 0.60,
            "frictionloss": 0.052,
            "armature": 0.028,
            "torque_limit": 3.35,
        },
    ),
    PublishedSet(
        "NVIDIA, typing",
        "https://github.com/NVIDIA/so101-typing-task",
        "a fit to the motion of one arm, as its actuator_sys_id_result says; it states no limit, "
        "that of SO-ARM100 stands in",
        {
            "gain": (48.94, 51.34, 18.57, 43.03, 47.14, 50.83),
            "servo_damping": (2.3097, 2.7830, 0.5347, 2.7191, 1.7895, 2.3451),
            "damping": (1.0733, 0.8774, 0.4926, 0.5175, 0.4502, 1.1390),
            "frictionloss": (0.2155, 0.3181, 0.4019, 0.2965, 0.2828, 0.3115),
            "armature": (0.05823, 0.04425, 0.05451, 0.05110, 0.05138, 0.04338),
            "torque_limit": 3.35,
        },
    ),
    PublishedSet(
        "MuJoCo Menagerie",
        "https://github.com/google-deepmind/mujoco_menagerie/tree/main/robotstudio_so101",
        "gain and limit worked out from the data sheet for P = 16, with what SO-ARM100 had",
        {
            "gain": 998.22,
            "servo_damping": 2.731,
            "damping": 0.60,
            "frictionloss": 0.052,
            "armature": 0.028,
            "torque_limit": 2.94,
        },
    ),
)


def spec_of(published):
    """Return the arm with published numbers."""
    spec = servo_sysid.bare_spec()
    for index, name in enumerate(JOINTS):
        numbers = published.of_joint(index)
        joint = spec.joint(name)
        servo = spec.actuator(name)
        # Damping is a polynomial from MuJoCo 3.7 on.
        polynomial = np.zeros(np.size(joint.damping))
        polynomial[0] = numbers["damping"]
        joint.damping = polynomial if np.ndim(joint.damping) else polynomial[0]
        joint.frictionloss = numbers["frictionloss"]
        joint.armature = numbers["armature"]
        servo.gainprm[0] = numbers["gain"]
        servo.biasprm[1:3] = -numbers["gain"], -numbers["servo_damping"]
        servo.forcerange = [-numbers["torque_limit"], numbers["torque_limit"]]
    return spec


def write_log(path, published, robot) -> None:
    """Write what LeRobot would record of the arm: positions and the commands that it got."""
    spec = spec_of(published)
    spec.option.timestep = servo_sysid.TRUE_STEP
    model = spec.compile()
    ids = [model.actuator(name).id for name in JOINTS]
    rng = np.random.default_rng(SEED)
    clock, command = servo_arm.commands(robot, rng, SECONDS, RATE)
    step = servo_sysid.ENCODER
    command = step * np.round(command / step)
    played = servo_sysid.play(model, clock, command, ids)
    q = step * np.round(servo_sysid.late(*played, clock, servo_sysid.DELAY) / step)
    titles = [
        "timestamp",
        *(f"{n}.pos" for n in JOINTS),
        *(f"action_{n}" for n in JOINTS),
    ]
    rows = np.column_stack((clock, q, command))
    np.savetxt(path, rows, "%.9g", ",", header=",".join(titles), comments="")


def found_of(published, file_numbers) -> tuple[dict, float, bool]:
    """Return what is found, by joint and number, processor time [s], whether a file was written."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        model = folder / "so101.xml"
        model.write_text(spec_of(file_numbers).to_xml(), encoding="utf-8")
        robot = load_robot_model(model, joint=JOINTS[-1])
        write_log(folder / "log.csv", published, robot)
        words = f"identify {model} {folder}/log.csv --torque-from position-error"
        options = f"--joint {JOINTS[-1]} --output-dir {folder}/out"
        before = servo_sysid.children_seconds()
        subprocess.run(
            [sys.executable, "-m", "robot_sysid", *words.split(), *options.split()],
            stdout=sys.stderr,
        )
        seconds = servo_sysid.children_seconds() - before
        result = folder / "out" / "servo.json"
        is_written = any((folder / "out").glob("*.xml"))
        if not result.exists():
            return {}, seconds, is_written
        rows = json.loads(result.read_text(encoding="utf-8"))["quantities"]
        own = [row for row in rows if row["source"] != "file"]
        return {(row["of"], row["name"]): row for row in own}, seconds, is_written


def lines_of(published, file_numbers):
    """Yield the section of a set: its source, and a row for each joint."""
    found, seconds, is_written = found_of(published, file_numbers)
    verdict = "" if is_written else ", and called not usable"
    yield f"### {published.name}"
    yield ""
    yield (
        f"[Source]({published.source}): {published.origin}. Found in {seconds:.0f} s from a file "
        f"with the numbers of *{file_numbers.name}*{verdict}."
    )
    yield ""
    heads = [f"{number}, {unit} | found" for number, unit in UNITS.items()]
    yield f"| Joint | {' | '.join(heads)} |"
    yield f"| --- |{' --- | --- |' * len(UNITS)}"
    for index, joint in enumerate(JOINTS):
        numbers = published.of_joint(index)
        numbers["damping"] += numbers["servo_damping"]
        cells = [joint]
        for number in UNITS:
            row = found.get((joint, number))
            cells.append(f"{numbers[number]:.4g}")
            cells.append(with_error(row["value"], row["error"]) if row else "–")
        yield f"| {' | '.join(cells)} |"
    yield ""


def main(*options: str) -> None:
    """Print the tables; write them where that is asked for."""
    lines = []
    for published, file_numbers in zip(SETS, (SETS[-1], *SETS)):
        lines += lines_of(published, file_numbers)
    TABLE.show(lines[:-1], "--write" in options)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""How fast an OpenArm drifts in a float test, with a wrong model and with the one identified.

Run from the checkout:

    OMP_NUM_THREADS=1 python -m benchmarks.motors.float_drift [--poses 20] [--seed 0]

The arm is that of the model file with friction as its owners have it. Its user's model has links
that are 10 % off and the file's friction. The user's arm plays a planned motion on simulated motors
and is identified from the recording. In each pose it floats by ``motors hold --float --simulate``,
with the user's model, then with the identified one: without friction compensation.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigs.arms.walk import run_here
from rigs.motors.rehearsals import ARMS
from robot_sysid.commands.motors import commands_with
from robot_sysid.damiao.execution import Equipment
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array

WRONG = 0.1
"""Standard deviation of masses, centres of mass and moments of inertia, relative to them."""
OWNERS = {
    "DM8009": (0.31, 0.06),
    "DM4340": (0.30, 0.70),
    "DM4310": (0.10, 0.05),
    "DM3507": (0.05, 0.03),
}
"""Dry and viscous friction of the joints [N m, N m s/rad], as teleoperation of OpenArms uses it."""
LEVELS = {"as owners have it": 1.0, "a fifth of that": 0.2}
_OPENARM = ARMS["openarm"]
_JOINT = _OPENARM.joint
_MOTORS = " ".join(f"--motor-type {name}" for name in _OPENARM.motors)
# With physics as fine as needed, and fast.
_COMMANDS = commands_with(Equipment(physics_step=1e-3))
# The speed of a joint, or nothing where it stands.
_DRIFT = re.compile(r"^\S+ (?:stands|drifts at (\S+) deg/s)[^:]*: ", re.MULTILINE)


def write_arm(path: Path, friction: float | None, wrong: float, seed: int) -> Path:
    """Write the left arm with a share of the owners' friction, or the file's, and wrong links."""
    rng = np.random.default_rng(seed)
    tree = ET.parse(_OPENARM.model)
    root = tree.getroot()
    folder = _OPENARM.model.parent
    compiler = root.find("compiler")
    compiler.set("meshdir", str(folder / compiler.get("meshdir", "")))
    for body in root.iter("body"):
        if "openarm_left" not in body.get("name", ""):
            continue
        inertial = body.find("inertial")
        for key in ("mass", "pos", "diaginertia") if inertial is not None else ():
            values = np.array(inertial.get(key).split(), float)
            # One factor for the moments of inertia keeps them those of a body.
            size = 1 if key == "diaginertia" else len(values)
            values *= 1.0 + wrong * rng.normal(size=size)
            inertial.set(key, " ".join(f"{value:.12g}" for value in values))
    joints = [e for e in root.iter("joint") if "left_joint" in e.get("name", "")]
    for joint, motor in zip(joints, _OPENARM.motors):
        if friction is not None:
            dry, viscous = friction * np.array(OWNERS[motor])
            joint.set("frictionloss", f"{dry:.12g}")
            joint.set("damping", f"{viscous:.12g}")
    tree.write(path)
    return path


def run(line: str) -> tuple[int, str]:
    """Run a command of robot-sysid; return exit code and output."""
    return run_here(f"robot-sysid {line}", _COMMANDS)


def drift(model: Path, truth: Path, pose: Array) -> tuple[str, Array] | None:
    """Return how a pose's float test ended, and the drift (n,) of the joints [deg/s].

    None where the pose is refused.
    """
    angles = " ".join(f"{angle:.4f}" for angle in pose)
    code, output = run(
        f"motors hold --model {model} {_JOINT} --simulate --plant-model {truth} {_MOTORS} "
        f"--float --for 3 --rate 125 --pose {angles}"
    )
    if "not played: " in output:
        return None
    speeds = [float(speed or 0.0) for speed in _DRIFT.findall(output)]
    assert len(speeds) == len(_OPENARM.motors), output
    caught = re.search(r"joint (\S+)\) is not carried", output)
    assert (code == 3) == bool(caught), output
    return f"caught: {caught[1]}" if caught else "floated", np.array(speeds)


def identified(model: Path, truth: Path, folder: Path) -> Path:
    """Return the model that is identified from a recording of a simulated run."""
    motion = "--for arm --excitation sines --duration 20 --seed 0"
    record = folder / "measured.csv"
    lines = (
        f"plan {model} {_JOINT} {motion} --export-damiao {_MOTORS} --output-dir {folder}",
        f"motors simulate {folder}/damiao_trajectory.csv --model {model} {_JOINT} "
        f"--plant-model {truth} --record {record}",
        f"identify {model} {record} {_JOINT} --links --output-dir {folder}/identified",
    )
    for line in lines:
        code, output = run(line)
        if code:
            raise SystemExit(f"{line}\n{output}")
    return folder / "identified" / "updated_model.xml"


def print_table(title: str, rows: Sequence[tuple[int, str, str, Array, Array]]) -> None:
    """Print the drift of the fastest joint in each pose, before and after."""
    print(f"\n{title}\n\n| pose | before: fastest joint | | after: fastest joint | |")
    print("|---|---|---|---|---|")
    for number, ending_before, ending_after, before, after in rows:
        print(
            f"| {number} | {before.max():.2f} deg/s (joint {before.argmax() + 1}) "
            f"| {ending_before} | {after.max():.2f} deg/s (joint {after.argmax() + 1}) "
            f"| {ending_after} |"
        )
    before, after = (np.array([row[k].max() for row in rows]) for k in (3, 4))
    print(
        f"\nfastest joint, median and worst of {len(rows)} poses: before "
        f"{np.median(before):.2f}, {before.max():.2f} deg/s; after {np.median(after):.2f}, "
        f"{after.max():.2f} deg/s; at most 0.5 deg/s after: {np.sum(after <= 0.5)}",
        flush=True,
    )


def main() -> None:
    """Print a table for each level of friction."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    robot = load_robot_model(_OPENARM.model, joint=_JOINT.split()[1])
    middle = 0.5 * (robot.limits.lower + robot.limits.upper)
    half = 0.5 * (robot.limits.upper - robot.limits.lower)
    for level, share in LEVELS.items():
        rng = np.random.default_rng(arguments.seed)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            truth = write_arm(folder / "truth.xml", share, 0.0, 0)
            wrong = write_arm(folder / "wrong.xml", None, WRONG, arguments.seed + 1)
            better = identified(wrong, truth, folder)
            rows = []
            while len(rows) < arguments.poses:
                pose = middle + 0.8 * half * rng.uniform(-1.0, 1.0, len(middle))
                before = drift(wrong, truth, pose)
                if before is None:
                    continue
                after = drift(better, truth, pose)
                assert after is not None
                rows.append((len(rows) + 1, before[0], after[0], before[1], after[1]))
            print_table(f"Friction {level}", rows)


if __name__ == "__main__":
    main()

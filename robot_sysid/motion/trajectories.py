"""Motions along straight lines, and trajectories at any speed and as files.

A JSON file holds what a trajectory is made of, so it is small, its derivatives are exact, and
loading it gives back every bit. A CSV file of samples is for other programs and is not read back.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, MotionPlan
from robot_sysid.records.file_access import atomic_file, read_json
from robot_sysid.trajectory import SineTrajectory, motion_chunks, smooth_step
from robot_sysid.wording import option_name

FORMAT = "robot-sysid trajectory"
"""Name of the file format of trajectories, in each file."""
VERSION = 2
"""Version of that format in written files, and the only one that is read."""


@dataclass(frozen=True)
class LineTrajectory:
    """The motion along a straight line between two poses, at rest at both ends.

    Attributes:
        begin, end: (n,) joint positions [rad or m].
        speed: highest mean speed of a joint [rad/s or m/s].
    """

    begin: Array
    end: Array
    speed: float = 1.0

    @property
    def duration(self) -> float:
        """Length [s]: 1 s, or more where a joint's mean speed would be higher than ``speed``."""
        return max(1.0, float(np.max(np.abs(self.end - self.begin))) / self.speed)

    def evaluate(self, time: Array) -> Motion:
        """Return position, velocity and acceleration of all joints at times (N,) [s]; velocities
        and accelerations are exact derivatives.
        """
        length = self.duration
        w, dw, ddw = smooth_step(np.clip(time / length, 0.0, 1.0))
        way = self.end - self.begin
        return Motion(
            time,
            self.begin + np.outer(w, way),
            np.outer(dw / length, way),
            np.outer(ddw / length**2, way),
        )


def at_speed(plan: SineTrajectory, speed: float) -> SineTrajectory:
    """Return the trajectory scaled in time by s = ``speed``: q(s t), s q'(s t), s^2 q''(s t).

    The option makes s at most 1: a faster motion would break the limits it was made for.
    """
    return replace(
        plan,
        frequency_hz=speed * plan.frequency_hz,
        duration=plan.duration / speed,
        fade=plan.fade / speed,
    )


class SavedTrajectory(NamedTuple):
    """A trajectory from a file.

    Attributes:
        plan: the trajectory.
        joint_names: names of the joints that it was made for, in the order of its columns.
        sha256: checksum of the model file that it was made for; "" if unknown.
    """

    plan: SineTrajectory
    joint_names: tuple[str, ...]
    sha256: str


def save_trajectory(
    path: Path | TextIO, plan: MotionPlan, joint_names: Sequence[str], sha256: str = ""
) -> None:
    """Write a trajectory's coefficients as JSON; the file appears whole or not at all.

    Args:
        path: of the file, or an open text file.
        plan: a sum of sinusoids.
        joint_names: names of its joints, in the order of its columns.
        sha256: checksum of the model file that it was made for; "" is not written.
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "joints": list(joint_names),
    }
    if sha256:
        content["model_sha256"] = sha256
    coefficients: Any = plan
    # The repr of a float is exact.
    for name, number in {"kind": "sines", **asdict(coefficients)}.items():
        content[name] = np.asarray(number).tolist()
    with atomic_file(path) as file:
        json.dump(content, file, indent=1)
        file.write("\n")


def load_trajectory(path: Path) -> SavedTrajectory:
    """Return the trajectory that ``save_trajectory`` has written to a file.

    Raises:
        InputError: the file cannot be read, is of another format or version, lacks an entry, or
            holds numbers that define no trajectory; every trajectory starts and ends at rest.
    """
    content = read_json(
        Path(path),
        f"{option_name('trajectory')} takes the .json file that robot-sysid plan writes",
    )
    is_known = isinstance(content, dict) and content.get("format") == FORMAT
    if not is_known or content.get("version") != VERSION:
        raise InputError(
            f"{path} is not a trajectory of version {VERSION} of this program; plan the motion "
            "again"
        )
    try:
        # Indexing with () makes a number of an array without axes.
        numbers: dict[str, Any] = {
            entry.name: np.array(content[entry.name], float)[()]
            for entry in fields(SineTrajectory)
        }

        plan = SineTrajectory(**numbers)
        names = tuple(str(name) for name in content["joints"])
    except KeyError as error:
        raise InputError(f"{path}: the trajectory lacks the entry {error}") from None
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: not a usable trajectory ({error})") from None
    n_joints = len(plan.center)
    if n_joints != len(names):
        raise InputError(
            f"a trajectory of {n_joints} joints names {len(names)}: {', '.join(names)}"
        )
    return SavedTrajectory(plan, names, str(content.get("model_sha256", "")))


def save_samples(
    path: Path | TextIO,
    plan: MotionPlan,
    joint_names: Sequence[str],
    sample_rate: float,
) -> None:
    """Write a trajectory's samples as CSV: time, then q, qd and qdd of each joint, SI units.

    The file appears whole or not at all; it has ``sample_rate`` rows per second.
    """
    titles = ["time"]
    for quantity in ("q", "qd", "qdd"):
        titles += [f"{quantity}_{name}" for name in joint_names]
    with atomic_file(path) as file:
        file.write(",".join(titles) + "\n")
        for motion in motion_chunks(plan, sample_rate):
            table = np.hstack((motion.time[:, None], motion.q, motion.qd, motion.qdd))
            file.writelines(",".join(map(repr, row)) + "\n" for row in table.tolist())

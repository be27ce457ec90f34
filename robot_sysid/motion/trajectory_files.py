"""Trajectories as files: coefficients as JSON, and samples as CSV to look at.

The JSON file holds what the trajectory is made of, so it is small, its derivatives are exact, and
loading it gives back every bit. The CSV file is for other programs; it is not read back.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TextIO, TypeVar

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.motion.trajectories import FourierBasis, FourierTrajectory, LineTrajectory
from robot_sysid.records import MotionPlan
from robot_sysid.records.atomic_files import whole_file
from robot_sysid.trajectory import SineTrajectory, motion_chunks

FORMAT = "robot-sysid trajectory"
VERSION = 1
_KINDS: Mapping[str, tuple[Any, tuple[str, ...]]] = {
    "sines": (SineTrajectory, ("duration", "fade", "center", "amplitude", "frequency_hz", "phase")),
    "fourier": (FourierTrajectory, ("rest", "coefficients")),
    "poses": (LineTrajectory, ("points", "moves", "dwells")),
    "sweeps": (LineTrajectory, ("points", "moves", "ramps")),
}
"""Each kind of trajectory, and what makes it; that of a Fourier series is its basis too."""
_BASIS = ("duration", "base_frequency_hz", "harmonics", "fade")
_TIMES = ("duration", "fade", "moves", "dwells", "ramps")
"""What takes longer where a trajectory is slowed down; frequencies fall."""
_Plan = TypeVar("_Plan", bound=MotionPlan)


def at_speed(plan: _Plan, speed: float) -> _Plan:
    """Return the trajectory scaled in time: q(s t), s q'(s t), s^2 q''(s t); 0 < s <= 1.

    Raises:
        InputError: it would be faster, and leave the limits it was made for.
    """
    if not 0.0 < speed <= 1.0:
        raise InputError(
            f"--speed must be above 0 and at most 1 (got {speed:g}): the trajectory was made for "
            "full speed and can only be slowed down"
        )
    return plan if speed == 1.0 else _slowed(plan, speed)


def _slowed(part: Any, speed: float) -> Any:
    changed = {}
    for name, value in vars(part).items():
        if name == "basis":
            changed[name] = _slowed(value, speed)
        elif name in _TIMES and value is not None:
            changed[name] = value / speed
        elif name.endswith("frequency_hz"):
            changed[name] = value * speed
    return replace(part, **changed)


@dataclass(frozen=True)
class SavedTrajectory:
    """A trajectory from a file; the joints, and model file (its sha256 or ""), it was made for."""

    plan: MotionPlan
    joint_names: tuple[str, ...]
    sha256: str = ""

    def __post_init__(self) -> None:
        if not 0.0 < self.plan.duration < np.inf:
            raise InputError(
                f"a trajectory needs a finite duration above 0, not {self.plan.duration:g} s"
            )
        moved = self.plan.evaluate(np.zeros(1)).q.shape[1]
        if moved != len(self.joint_names):
            raise InputError(
                f"a trajectory of {moved} joints names {len(self.joint_names)}: "
                f"{_listed(self.joint_names)}"
            )

    def require_fits(self, joint_names: Sequence[str]) -> None:
        """Raise InputError unless it was made for joints of these names, in this order."""
        if self.joint_names != tuple(joint_names):
            raise InputError(
                f"--trajectory: made for the {len(self.joint_names)} joints "
                f"{_listed(self.joint_names)}, but this arm has the {len(joint_names)} joints "
                f"{_listed(joint_names)}; design one for this arm with --excitation optimal"
            )


def save_trajectory(
    path: Path | TextIO, plan: MotionPlan, joint_names: Sequence[str], sha256: str = ""
) -> None:
    """Write a trajectory's coefficients as JSON; the file appears whole or not at all.

    Args:
        path: file, or an open one.
        plan: a sum of sinusoids, a Fourier series, poses, or sweeps.
        joint_names: one per joint.
        sha256: of the model file it was made for.

    Raises:
        InputError: this kind of trajectory has no coefficients, or the file cannot be written.
    """
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION, "joints": list(joint_names)}
    if sha256:
        content["model_sha256"] = sha256
    with whole_file(path) as file:
        json.dump({**content, **_described(plan)}, file, indent=1)
        file.write("\n")


def _described(plan: MotionPlan) -> dict[str, Any]:
    """Return a trajectory as plain numbers; repr of a float is exact."""
    for kind, (made, names) in reversed(list(_KINDS.items())):
        if isinstance(plan, made) and getattr(plan, names[-1]) is not None:
            basis = asdict(plan.basis) if isinstance(plan, FourierTrajectory) else {}
            listed = {name: np.asarray(getattr(plan, name)).tolist() for name in names}
            return {"kind": kind, **basis, **listed}
    raise InputError(f"a {type(plan).__name__} has no coefficients to save")


def load_trajectory(path: Path) -> SavedTrajectory:
    """Read a trajectory that ``save_trajectory`` has written.

    Raises:
        InputError: the file cannot be read, or is something else; says what.
    """
    content = _read(path)
    try:
        kind = content["kind"]
        if kind not in _KINDS:
            raise InputError(
                f"{path}: unknown kind of trajectory {kind!r}; valid: {', '.join(_KINDS)}"
            )
        plan = at_speed(_built(kind, content), float(content.get("speed", 1.0)))
        names = tuple(str(name) for name in content["joints"])
        return SavedTrajectory(plan, names, str(content.get("model_sha256", "")))
    except KeyError as error:
        raise InputError(f"{path}: the trajectory lacks the entry {error}") from None
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: not a usable trajectory ({error})") from None


def _read(path: Path) -> Mapping[str, Any]:
    content = read_json(Path(path), "--trajectory takes the .json file of --save-trajectory")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(
            f"{path} is not a trajectory of this program; --save-trajectory writes one"
        )
    if content.get("version") != VERSION:
        raise InputError(
            f"{path} has version {content.get('version')!r} of the format, this program reads "
            f"version {VERSION}; save it again with the program it came from"
        )
    return content


def _built(kind: str, content: Mapping[str, Any]) -> MotionPlan:
    made, names = _KINDS[kind]
    given: dict[str, Any] = {name: np.array(content[name], dtype=float) for name in names}
    if kind == "sweeps":
        given["dwells"] = np.zeros(len(given["points"]))
    if kind == "sines":
        given |= {name: float(content[name]) for name in ("duration", "fade")}
    if kind == "fourier":
        duration, base, harmonics, fade = (float(content[name]) for name in _BASIS)
        given["basis"] = FourierBasis(duration, base, int(harmonics), fade)
    plan: MotionPlan = made(**given)
    return plan


def save_samples(
    path: Path | TextIO, plan: MotionPlan, joint_names: Sequence[str], sample_rate: float
) -> None:
    """Write a trajectory's samples as CSV: time, then q, qd and qdd of each joint, SI units.

    The file appears whole or not at all; it has ``sample_rate`` rows per second.
    """
    titles = [f"{quantity}_{name}" for quantity in ("q", "qd", "qdd") for name in joint_names]
    with whole_file(path) as file:
        file.write(",".join(["time", *titles]) + "\n")
        for motion in motion_chunks(plan, sample_rate):
            table = np.hstack((motion.time[:, None], motion.q, motion.qd, motion.qdd))
            file.writelines(",".join(map(repr, row)) + "\n" for row in table.tolist())


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)

"""A motion that was designed or checked: arrays to play, and what it promises."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.api.threads import one_thread
from robot_sysid.config import SysidConfig
from robot_sysid.errors import SysidError
from robot_sysid.excitation.plan import CheckedPlan
from robot_sysid.excitation.trajectory_files import save_samples, save_trajectory
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.atomic_files import whole_files
from robot_sysid.trajectory import sample_count


@dataclass(frozen=True, repr=False)
class PlanResult:
    """A planned motion, from ``plan``.

    Attributes:
        config: what was asked for.
        robot: the arm.
        checked: the motion with its limit check.
        promised: what the command prints, line by line.
        notes: one sentence each.
    """

    config: SysidConfig
    robot: RobotModel
    checked: CheckedPlan
    promised: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def failure(self) -> str | None:
        """Why the motion must not be played, or None."""
        return self.checked.failure

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.checked.plan.duration)

    def motion(self, time: Array) -> Motion:
        """Return q, qd, qdd (N, n) [rad, rad/s, rad/s^2] at times (N,) [s]."""
        return self.checked.plan.evaluate(np.asarray(time, dtype=float))

    def sampled(self, rate: float | None = None) -> Motion:
        """Return the whole motion at a rate [Hz]; None takes that of the options."""
        chosen = rate or self.config.trajectory.sample_rate
        return self.motion(np.arange(sample_count(self.duration, chosen)) / chosen)

    def to_dict(self) -> dict[str, Any]:
        """Return joint names, duration [s] and what is promised, as plain values."""
        return {
            "joint_names": list(self.robot.joint_names),
            "duration": self.duration,
            "failure": self.failure,
            "promised": list(self.promised),
            "notes": list(self.notes),
        }

    def save(self, path: str | Path) -> tuple[Path, Path]:
        """Write the trajectory (.json) and its samples (.csv) and return both paths.

        Raises:
            SysidError: the motion must not be played; says why.
            InputError: a file cannot be written.
        """
        if self.failure:
            raise SysidError(f"{self.failure}; nothing was written")
        plan, names = self.checked.plan, self.robot.joint_names
        place = Path(path), Path(path).with_suffix(".csv")
        with one_thread(), whole_files() as files:
            with files.open(place[0]) as file:
                save_trajectory(file, plan, names, self.robot.sha256)
            with files.open(place[1]) as file:
                save_samples(file, plan, names, self.config.trajectory.sample_rate)
        return place

    def __str__(self) -> str:
        return "\n".join(self.promised)

    def _repr_html_(self) -> str:
        """Return what is promised, for a notebook."""
        return f"<pre>{escape(str(self))}</pre>"

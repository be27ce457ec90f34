"""A trajectory with the check of its limits. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from robot_sysid.records import MotionPlan

if TYPE_CHECKING:
    from robot_sysid.motion.limit_check import LimitCheck
    from robot_sysid.motion.problem import ExcitationProblem


@dataclass(frozen=True)
class CheckedPlan:
    """A trajectory and the check of its limits.

    Attributes:
        plan: the trajectory.
        problem: the arm and the limits that it has to keep; None where nothing plays it.
        check: of the limits; None where nothing plays it.
    """

    plan: MotionPlan
    problem: ExcitationProblem | None = None
    check: LimitCheck | None = None

    @property
    def failure(self) -> str | None:
        """Why the trajectory must not be run, or None."""
        return None if self.check is None else self.check.failure

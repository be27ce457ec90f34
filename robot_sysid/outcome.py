"""What data led to, and what was made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robot_sysid.config import OutputOptions, SysidConfig
from robot_sysid.export import Saved
from robot_sysid.motion.plan import CheckedPlan
from robot_sysid.records import Motion, MotionPlan
from robot_sysid.records.data import Traces
from robot_sysid.results.console import block_lines, clamping_lines, folder_text, more_lines
from robot_sysid.results.record import Result
from robot_sysid.results.verdict import plan_verdict, verdict_lines

if TYPE_CHECKING:
    from robot_sysid.estimation.answer import Answer
    from robot_sysid.estimation.dataset import Dataset


@dataclass(frozen=True)
class PlanOutcome:
    """What planning a motion produced.

    Attributes:
        lines: what it promises, and what exporting it to motors had to say.
        failure: why it must not be run, or None; nothing is written then.
        files: what was written.
        config, checked: what was asked for, and the motion itself.
    """

    lines: tuple[str, ...]
    failure: str | None
    config: SysidConfig
    files: tuple[Path, ...] = ()
    checked: CheckedPlan | None = None

    @property
    def verdict(self) -> tuple[str, ...]:
        """Whether to use it and what to do next, in two lines, which come last."""
        arm, limits = self.config.words
        return plan_verdict(arm, self.files, self.failure, self.config.poses.purpose, limits)

    def report_lines(self) -> list[str]:
        """Return what the command line prints at the end."""
        return [*self.lines, *(f"Trajectory saved to {path}" for path in self.files)]


@dataclass(frozen=True)
class Analysis:
    """What data led to.

    Attributes:
        result: everything that is said of it.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: makes what a report draws.
        answer: the estimate behind it; None of the model's own simulation.
        tests: recordings that only test it.
        plan: the motion that a simulation followed; None of logs.
    """

    result: Result
    checkpoints: Motion
    traces: Callable[[], Traces]
    answer: Answer | None = None
    tests: tuple[Dataset, ...] = ()
    plan: MotionPlan | None = None


@dataclass(frozen=True)
class Outcome:
    """What a run produced, what was written, and what was asked of it."""

    result: Result
    traces: Callable[[], Traces]
    saved: Saved
    output: OutputOptions

    @property
    def files(self) -> tuple[Path, ...]:
        """What was written."""
        return self.saved.files

    @property
    def failure(self) -> str | None:
        """Why there is nothing to use, or None."""
        return self.saved.failure

    @property
    def verdict(self) -> tuple[str, ...]:
        """Whether to use it and what to do next, in at most two lines, which come last."""
        return verdict_lines(self.result, self.saved.failure)

    def report_lines(self) -> list[str]:
        """Return what the command line prints at the end."""
        saved = f"Results saved to {folder_text(self.output.output_dir)}"
        more = more_lines(self.result, self.output.links)
        clamping = clamping_lines(self.saved.damiao, self.result.joint_names)
        return [*block_lines(self.result), saved, *more, *clamping]

"""What data led to, and what was made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_sysid.records import Motion, MotionPlan, Traces
from robot_sysid.results.record import Result

if TYPE_CHECKING:
    from robot_sysid.estimation.answer import Answer
    from robot_sysid.estimation.dataset import Dataset
    from robot_sysid.motion.plan import CheckedPlan


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
    """What a run produced and wrote, whatever was asked, and what is printed of it.

    Attributes:
        lines: what is printed at the end.
        verdict: whether to use it and what to do next, in at most two lines, which come last.
        failure: why there is nothing to use, or None.
        files: what was written.
        result: what was found, a ``Result`` or servos; None of a plan.
        traces, result_hash: what a report draws of it, and the hash of its file; none of servos.
        checked: the motion that was planned.
    """

    lines: tuple[str, ...]
    verdict: tuple[str, ...]
    failure: str | None
    files: tuple[Path, ...]
    result: Any = None
    traces: Callable[[], Traces] | None = None
    result_hash: str = ""
    checked: CheckedPlan | None = None

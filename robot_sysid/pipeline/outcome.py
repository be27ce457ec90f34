"""Records that the stages of a run pass on: an identification, and the outcome of a command."""

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
class Identification:
    """A result with all that is needed to write it, draw it and test it.

    Attributes:
        result: all identified numbers, with errors and verdict.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: computes the measured and predicted torques that a report draws.
        answer: the estimate behind the result; None of the model's own simulation.
        tests: recordings that only test the result.
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
    """The files that a command wrote, and the lines that it prints.

    Attributes:
        lines: printed lines, in order.
        verdict: whether to use the result and the next step, in at most two lines, printed last.
        failure: why there is nothing to use, or None.
        files: the written files.
        result: a ``Result``, or identified servos; None of a plan.
        traces: computes the torques that a report draws; None of servos and plans.
        result_hash: SHA-256 of the written params.json; "" where none was written.
        checked: the planned motion with its limit check; None where nothing was planned.
    """

    lines: tuple[str, ...]
    verdict: tuple[str, ...]
    failure: str | None
    files: tuple[Path, ...]
    result: Any = None
    traces: Callable[[], Traces] | None = None
    result_hash: str = ""
    checked: CheckedPlan | None = None

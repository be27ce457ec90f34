"""The stages of a run in order: load the model, plan or read, identify, write.

Every identification, whatever it started from, ends in one record: ``Identification``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robot_sysid.config import Config
from robot_sysid.records import Motion, MotionPlan, Traces
from robot_sysid.results.record import Result

if TYPE_CHECKING:
    from robot_sysid.estimate.rows import Recording


@dataclass(frozen=True)
class Identification:
    """A result with all that is needed to write it, draw it and test it.

    Attributes:
        config: the options of the run, with the errors that a file of torque scales states.
        result: all identified numbers, with errors and verdict.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: computes the measured and predicted torques that a report draws.
        tests: recordings that only test the result.
        plan: the motion that a simulation followed; None of logs.
    """

    config: Config
    result: Result
    checkpoints: Motion
    traces: Callable[[], Traces]
    tests: tuple[Recording, ...] = ()
    plan: MotionPlan | None = None

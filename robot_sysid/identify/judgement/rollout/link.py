"""Does the arm with its identified terminal link move more like the real one than before?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.fit import fit_measured
from robot_sysid.identify.judgement.rollout.candidate import as_written, played_or_reason
from robot_sysid.identify.judgement.rollout.compare import compare, split_time
from robot_sysid.output.model_writing import ModelTarget
from robot_sysid.records import Identification, Measurement, Motion, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import RolloutTest
from robot_sysid.signals.pieces import part_of
from robot_sysid.signals.process import ProcessedSignals, process
from robot_sysid.simulation.rollout.playback import pieces_of_signals

Writer = Callable[[Identification, ModelTarget], object]


@dataclass(frozen=True)
class LinkRollouts:
    """What the models of one arm are played on.

    Attributes:
        robot: the arm as its model describes it.
        logs: what is fitted.
        others: logs that only test the result; where there are none, the last fifth of each log is
            left out of a fit of its own.
        options: how the link is estimated.
    """

    robot: RobotModel
    logs: tuple[Measurement, ...]
    others: tuple[Measurement, ...]
    options: EstimationOptions

    def test(
        self, found: Identification, checkpoints: Motion, write: Writer, mesh_dir: Path | None
    ) -> RolloutTest:
        """Return how the model before and the one that ``write`` writes move beside the arm."""
        robot, cutoff = self.robot, found.cutoff

        def signals(logs: Sequence[Measurement]) -> list[ProcessedSignals]:
            return [process(log, robot.joint_names, cutoff) for log in logs]

        def played() -> RolloutTest:
            if self.others:
                words, result = "the validation log", found
                pieces = [p for log in signals(self.others) for p in pieces_of_signals(log)]
            else:
                words = "the last fifth of every log, which was not fitted for it"
                logs = signals(self.logs)
                result = self._without_the_end(found, [split_time(log) for log in logs])
                pieces = [p for log in logs for p in pieces_of_signals(log, split_time(log))]
            after = as_written(robot, lambda t: write(result, t), checkpoints, mesh_dir)
            return compare(robot, after, pieces, words)

        return played_or_reason(robot, played)

    def _without_the_end(self, found: Identification, ends: Sequence[float]) -> Identification:
        """Return the result of a fit to what each log holds up to a time [s]."""
        stops = [int(np.searchsorted(log.time, end)) for log, end in zip(self.logs, ends)]
        logs = [part_of(log, 0, stop) for log, stop in zip(self.logs, stops)]
        options = replace(self.options, cutoff=found.cutoff)
        fit = fit_measured(self.robot, logs, options, Progress())
        return replace(found, estimate=fit.estimate, friction_model=fit.friction.name)

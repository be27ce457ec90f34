"""The result of measurements of an arm, as the benchmarks compare it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from rigs.arms.core_fits import ORIGIN
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.records import Recording, RobotModel
from robot_sysid.results.identification import link_result
from robot_sysid.results.record import Identification
from robot_sysid.signals.process import low_pass_recordings
from robot_sysid.signals.resampling import split_at_gaps


def result_of_logs(
    robot: RobotModel, logs: Iterable[Recording], options: EstimationOptions
) -> Identification:
    """Return the result of measurements of the arm alone, cut where they have gaps."""
    pieces = []
    for number, log in enumerate(logs):
        pieces += [replace(piece, name=f"log{number}") for piece in split_at_gaps(log)]
    recordings, _ = low_pass_recordings(robot, pieces, options.cutoff)
    fitted = solve_question(robot, recordings, Question(options))
    return link_result(fitted, fit_file(fitted), (), ORIGIN)

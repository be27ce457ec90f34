"""Fits of small arms whose truth is known, for tests of the core."""

from dataclasses import replace

import numpy as np

from rigs.logs.measured_logs import CUTOFF
from robot_sysid import spatial
from robot_sysid.estimate.choose import answer_of, solve_question
from robot_sysid.estimate.options import DEFAULT_FRICTION, EstimationOptions, Priors
from robot_sysid.estimate.questions import Question
from robot_sysid.records import DataOrigin
from robot_sysid.signals.process import low_pass_recordings

BASIC = DEFAULT_FRICTION
"""The friction terms that are estimated of every joint."""
NO_PRIORS = Priors(link=0.0, scale=0.0, zero=0.0, gravity=0.0, delay=0.0, friction=0.0)
"""Priors with which torque noise is the only source of error."""
NOISE_ONLY = {"priors": NO_PRIORS}
"""Options with which torque noise is the only source of error."""
ORIGIN = DataOrigin("log a log", 10.0, 200.0)


def fit_recordings(robot, recordings, options=None, beside=None, **question):
    """Return the fit of recordings as commands have it; ``question`` are more fields of that."""
    question = Question(options or EstimationOptions(), **question)
    return answer_of(solve_question(robot, recordings, question, beside=beside))


def filter_logs(robot, *logs, cutoff=CUTOFF):
    """Return the low-passed recordings of measurements."""
    pieces = [replace(log, name=f"log{number}") for number, log in enumerate(logs)]
    return low_pass_recordings(robot, pieces, cutoff)[0]


def fit_logs(robot, *logs, **options):
    """Return the fit of measurements of the arm alone."""
    return fit_recordings(
        robot, filter_logs(robot, *logs), EstimationOptions(**options)
    )


def body_error(theta, true_theta):
    """Return the largest error of a body (10,), relative to its true mass and size."""
    length = spatial.characteristic_length(true_theta)
    scale = spatial.parameter_scale(true_theta[0], length)
    return float(np.max(np.abs(theta - true_theta) / scale))

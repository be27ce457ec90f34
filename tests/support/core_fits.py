"""Fits of small arms whose truth is known, for tests of the core."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.estimation.build_result import result_of
from robot_sysid.estimation.choices import CANDIDATES
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import rms_torque
from robot_sysid.estimation.fit import Fitter
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.question import Choice, EstimationOptions, Priors, Question
from robot_sysid.records import DataOrigin, Source
from robot_sysid.records.messages import Progress
from robot_sysid.signals.resampling import split_at_gaps
from tests.support.measured_logs import CUTOFF

BASIC = CANDIDATES[0]
"""The friction model with the fewest terms among which recordings choose."""
NO_PRIORS = Priors(link=0.0, scale=0.0, zero=0.0, gravity=0.0, friction=0.0)
"""Priors with which torque noise is the only source of error."""
NOISE_ONLY = {"priors": NO_PRIORS}
"""Options with which torque noise is the only source of error."""
EXACT_SENSORS = EstimationOptions(priors=Priors(zero=0.0, gravity=0.0))
"""Options with exact encoders and a level base, so that no prior allows a body to turn."""
ORIGIN = DataOrigin(Source.LOG, "a log", 10.0, 200.0)


def fitter_of(robot, recordings, torques="chain", couplings=()):
    """Return a fitter of recordings."""
    columns = Columns(robot, recordings, torques, couplings)
    return Fitter(columns, rms_torque(recordings))


def choice_of(robot, friction=BASIC, couplings=()):
    """Return the choice of one friction model, by name, for all joints."""
    return Choice((friction_model(friction),) * robot.n_joints, tuple(couplings))


def fit_recordings(
    robot, recordings, options=None, friction=BASIC, couplings=(), **question
):
    """Return the fit of recordings with a given friction model.

    ``question`` are the further fields of ``Question``.
    """
    question = Question(options or EstimationOptions(), **question)
    fitter = fitter_of(robot, recordings, question.options.torques, couplings)
    return fitter.fit(question, choice_of(robot, friction, couplings))


def filter_logs(robot, *logs, **options):
    """Return (the low-passed datasets of measurements, the options of their fit)."""
    options = EstimationOptions(**{"cutoff": CUTOFF, **options})
    pieces = [Piece(f"log{number}", log) for number, log in enumerate(logs)]
    return low_pass_recordings(robot, pieces, options)[0], options


def fit_logs(robot, *logs, friction=BASIC, **options):
    """Return the fit of measurements of the arm alone with a given friction model."""
    return fit_recordings(robot, *filter_logs(robot, *logs, **options), friction)


def result_of_logs(robot, logs, options, kept=None):
    """Return the result of measurements of the arm alone, cut where they have gaps.

    ``kept`` are the parts of the model file that stay as they are; None fits no file.
    """
    pieces = []
    for number, log in enumerate(logs):
        pieces += [Piece(f"log{number}", piece) for piece in split_at_gaps(log)]
    datasets, _ = low_pass_recordings(robot, pieces, options)
    return result_of(answer_link(robot, datasets, options, Progress(), kept), ORIGIN)


def body_error(theta, true_theta):
    """Return the largest error of a body (10,), relative to its true mass and size."""
    length = spatial.characteristic_length(true_theta)
    scale = spatial.parameter_scale(true_theta[0], length)
    return float(np.max(np.abs(theta - true_theta) / scale))

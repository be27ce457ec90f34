"""Fits of small arms whose truth is known, for tests of the core."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.choices import CANDIDATES
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import mean_torque
from robot_sysid.estimation.fit import Fitter
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.result import result_of
from robot_sysid.estimation.unknowns import Choice, Question
from robot_sysid.records import DataOrigin, Source
from robot_sysid.records.progress import Progress
from robot_sysid.signals.repetition import visits
from robot_sysid.signals.resampling import pieces_of
from tests.support.measured_logs import CUTOFF

BASIC = CANDIDATES[0]
KNOWN = {
    f"{cause}_uncertainty": 0.0
    for cause in ("link", "scale", "zero", "gravity", "friction")
}
"""Noise is all that is not known."""
SURE = EstimationOptions(zero_uncertainty=0.0, gravity_uncertainty=0.0)
"""Encoders and level are exact, so that nothing can turn a body."""
ORIGIN = DataOrigin(Source.LOG, "a log", 10.0, 200.0)


def fitter_of(robot, recordings, torques="chain", couplings=()):
    """A fitter of recordings that tells motion that repeats."""
    columns = Columns(robot, recordings, torques, couplings)
    again = visits([each.motion for each in recordings])
    return Fitter(columns, mean_torque(recordings), again)


def choice_of(robot, friction=BASIC, couplings=()):
    """The same friction in all joints."""
    return Choice((friction_model(friction),) * robot.n_joints, tuple(couplings))


def fitted(robot, recordings, options=None, friction=BASIC, couplings=(), **question):
    """The fit of recordings, nothing chosen by them; ``question`` as in ``Question``."""
    asked = Question(options or EstimationOptions(), **question)
    fitter = fitter_of(robot, recordings, asked.options.torques, couplings)
    return fitter.fit(asked, choice_of(robot, friction, couplings))


def result_of_logs(robot, logs, options, kept=None):
    """The result of logs of an arm alone, cut where they have gaps; without a file unless some
    parts of it are kept.
    """
    pieces = []
    for number, log in enumerate(logs):
        pieces += [Piece(f"log{number}", piece) for piece in pieces_of(log)]
    datasets, _ = low_pass_recordings(robot, pieces, options)
    return result_of(answer_link(robot, datasets, options, Progress(), kept), ORIGIN)


def datasets_of(robot, *logs, **options):
    """(logs filtered, the options)."""
    chosen = EstimationOptions(**{"cutoff": CUTOFF, **options})
    pieces = [Piece(f"log{number}", log) for number, log in enumerate(logs)]
    return low_pass_recordings(robot, pieces, chosen)[0], chosen


def off_by(found, truth):
    """Largest error of a body (10,), relative to its mass and size."""
    scale = spatial.parameter_scale(truth[0], spatial.characteristic_length(truth))
    return float(np.max(np.abs(found - truth) / scale))

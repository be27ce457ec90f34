"""How far a fit may be trusted, in numbers: what it leaves unexplained, which friction it misses,
which links of the model it contradicts, and where a file is worse than the model.

"Independent samples" are those that count after the autocorrelation of residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import is_clearly_lower, validation
from robot_sysid.estimate.questions import NEGLIGIBLE
from robot_sysid.records import ModelErrors, Validation
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.quantities import BodyEstimate

WHITE = 0.5
"""Share of independent samples from which a residual is noise: of white noise 0.6 to 1 of the
samples are independent, of torque with another cause 0.1."""
ODD_SHARE = 0.3
"""Least share of a joint's torque that is unexplained, to be odd, however little of the others'
is."""
ODD_RATIO = 10.0
"""Least ratio of that share to the median of the other joints', to be odd."""
WRONG_MOMENT = 0.1
"""Least share by which a link's first moment is off the model's, to be named: what is nearer makes
little torque, however clearly it shows."""


def misfit_ratio(fitted: Fit, test: Validation) -> float:
    """Return how many times larger than the noise of a fit the errors of a test are.

    It is zero where the test says nothing, as its errors are small beside the torque, or the fit
    does not know the torque of such a motion. A joint without data has no noise and is left out.
    """
    if not test.is_informative or (test.relative_error or 0.0) <= LITTLE:
        return 0.0
    noise = fitted.noise_per_joint
    errors = test.rmse_per_joint
    ratios = [errors[joint] / noise[joint] for joint in errors if joint in noise]
    return float(np.sqrt(np.mean(np.square(ratios or [0.0]))))


class OddJoint(NamedTuple):
    """A joint whose unexplained torque no sensor's error makes.

    Attributes:
        joint: its name.
        share: of its torque that is unexplained.
        median: of these shares of the other joints.
    """

    joint: str
    share: float
    median: float


def odd_joints(
    noise: Mapping[str, float],
    torque: Mapping[str, float],
    independent: Mapping[str, float],
) -> Iterator[OddJoint]:
    """Yield the joints of which far more torque is unexplained than of the others.

    A joint without torque has no ratio of noise to torque and is left out.

    Args:
        noise: joint to the standard deviation of its residual [N m].
        torque: joint to the root mean square of its torque [N m].
        independent: joint to the share of its samples that are independent.
    """
    shares = {joint: noise[joint] / torque[joint] for joint in noise if torque[joint]}
    for joint, share in shares.items():
        others = shares.keys() - {joint}
        if not others or independent[joint] >= WHITE:
            continue
        median = float(np.median([shares[other] for other in others]))
        # Of a wrist that carries nearly nothing, sensors show little but their own slow errors.
        # Only a torque that is not there makes a residual larger than what is measured.
        sensor = max(noise[other] for other in others)
        is_odd = share > 1.0 or noise[joint] > sensor
        if is_odd and share > max(ODD_SHARE, ODD_RATIO * median):
            yield OddJoint(joint, share, median)


class MissedFriction(NamedTuple):
    """Friction terms that the user left out and the torques clearly show.

    Attributes:
        joints: names of those that show it.
        terms: names of the terms.
        error: held-out torque error of the fit, over the torque.
        error_with_terms: the one with the terms.
    """

    joints: tuple[str, ...]
    terms: tuple[str, ...]
    error: float
    error_with_terms: float


def missed_friction(fitted: Fit) -> MissedFriction | None:
    """Return the friction terms that were left out but clearly show; None where none do.

    Links and other terms take up the torque of such terms, which no standard error allows for.
    None are missed where no joint's held-out error is clearly lower with the terms.
    """
    left_out = fitted.question.options.left_out_terms
    if not left_out:
        return None
    terms = {term.key: term for term in fitted.equations.terms}
    terms |= {name: fitted.arm.terms[name] for name in left_out}
    complete = fitted.refit([*terms.values()], possible=True)
    joints = []
    torques = np.sum(fitted.sums.squared_torque, axis=0)
    rows = zip(fitted.arm.joints, torques, fitted.held_out.T, complete.held_out.T)
    for joint, torque, given, better in rows:
        is_large = np.sum(given) > NEGLIGIBLE**2 * torque
        if is_large and is_clearly_lower(better, given):
            joints.append(joint)
    if not joints:
        return None
    error, error_with_terms = (
        validation(each).relative_error or 0.0 for each in (fitted, complete)
    )
    return MissedFriction(tuple(joints), tuple(left_out), error, error_with_terms)


class WrongMoment(NamedTuple):
    """A link whose first moment in the model the recordings contradict.

    Attributes:
        link: its name.
        moment: first moment along the model's centre of mass [kg m].
        error: its standard error.
        expected: the model's.
    """

    link: str
    moment: float
    error: float
    expected: float


def wrong_moment(link: BodyEstimate) -> WrongMoment | None:
    """Return what contradicts a link of the model, its ``prior``; None where nothing does.

    Mass and centre of mass of a link are confounded with each other and with those of neighbouring
    links; the first moment along the model's centre of mass, which makes the torque of the link's
    weight, is identified better.
    """
    if link.prior is None:
        return None
    expected = float(np.linalg.norm(link.prior.first_moment))
    moment, error = link.moment_along(link.prior.first_moment)
    if abs(moment - expected) <= max(INTERVAL * error, WRONG_MOMENT * expected):
        return None
    return WrongMoment(link.name, moment, error, expected)


def worse_joints(errors: ModelErrors) -> Iterator[tuple[str, float, float]]:
    """Yield the joints whose torque a file predicts clearly worse than the given model.

    Each comes with its relative errors of the model and of the file. An error that is small beside
    the joint's torque does not count.
    """
    model = errors.before
    file = errors.after
    relative_errors = file.relative_error_per_joint.items()
    for (joint, new), before, after in zip(
        relative_errors, model.blocks.T, file.blocks.T
    ):
        old = model.relative_error_per_joint[joint]
        if old is None or new is None or new <= LITTLE:
            continue
        if is_clearly_lower(before, after):
            yield joint, old, new

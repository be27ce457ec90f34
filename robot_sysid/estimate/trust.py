"""How far a fit may be trusted, in numbers: what it leaves unexplained, which friction it misses,
which links of the model it contradicts, where a file is worse than the model, and how far noise of
positions makes what accelerations show too small.

"Independent samples" are those that count after the autocorrelation of residuals.

Accelerations of positions with noise have noise of their own, so that the columns A of what has
inertia have noise D. It adds to A'W A and not to A'W b, so that least squares divides by too much
(errors in variables; Fuller, "Measurement Error Models", 1987, ch. 1):

    E[x] - x = -(A'W A + P - E[D'W D])^-1 E[D'W t],    t = D x of all inertia, what is held too.

These products follow from the noise of each joint's acceleration and from the inertia that it
moves, in the poses of the rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robot_sysid.dynamics.friction import ROTOR
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import is_clearly_lower, validation
from robot_sysid.estimate.identifiability import ROUNDING
from robot_sysid.estimate.questions import NEGLIGIBLE
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import FRICTION, LAST_LINK, LINKS, MOTORS, PAYLOAD, Term
from robot_sysid.records import Array, ModelErrors, Motion, Validation
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.parameters import Parameter
from robot_sysid.records.quantities import BodyEstimate
from robot_sysid.signals.filters import LowPass
from robot_sysid.signals.process import FilteredRecording

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
INSTANTS = 100
"""Most rows of a recording at which inertias are computed: they change with the pose alone."""
LEAST_REST = 0.5
"""Least share of a direction's products that counts as motion: of one that noise alone shows, the
bias is as large as what is found."""


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
        moved: the number that the terms move most, in its standard errors.
        change: by which it is off without them, and the change's standard error.
    """

    joints: tuple[str, ...]
    terms: tuple[str, ...]
    error: float
    error_with_terms: float
    moved: Parameter
    change: tuple[float, float]


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
    of_result = [
        parameter
        for term in fitted.equations.terms
        if term.cause in (LAST_LINK, FRICTION)
        for parameter in term.parameters
    ]
    moved, change = most_moved(of_result, fitted, complete)
    return MissedFriction(
        tuple(joints), tuple(left_out), error, error_with_terms, moved, change
    )


def most_moved(
    parameters: Iterable[Parameter], before: Fit, after: Fit
) -> tuple[Parameter, tuple[float, float]]:
    """Return the number that is most off in a fit beside another one of the same rows.

    What counts is its change in standard errors, which is returned with it: by how much it is too
    large before, and its standard error after.

    Args:
        parameters: one at least, estimated in both fits.
        before: the fit that lacks something.
        after: the fit that has it.
    """
    moves = []
    for parameter in parameters:
        name = parameter.key
        change = before.by_name[name] - after.by_name[name]
        error = after.error_of(name)
        moves.append((abs(change) / max(error, 1e-300), parameter, (change, error)))
    _, parameter, moved = max(moves, key=lambda move: move[0])
    return parameter, moved


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


def acceleration_bias(fitted: Fit) -> Array:
    """Return by how much noise of accelerations shifts the estimate (k,).

    It is zero of recordings whose cut-off was given, of which the noise is not estimated, and of
    what is held at a bound or does not show.
    """
    size = len(fitted.names)
    products = np.zeros((size, size))
    gradient = np.zeros(size)
    for recording in fitted.recordings:
        if np.any(recording.acceleration_noise):
            for columns, torque in _noise_rows(fitted, recording):
                products += columns.T @ columns
                gradient += torque @ columns
    bias = np.zeros(size)
    at = np.flatnonzero(fitted.is_free & ~fitted.is_hidden)
    normal = fitted.normal[np.ix_(at, at)]
    # In the directions in which all rows have a product of one.
    scale = 1.0 / np.sqrt(np.diag(normal))
    squares, directions = np.linalg.eigh(scale[:, None] * normal * scale)
    is_seen = squares > ROUNDING * squares[-1]
    whitened = directions[:, is_seen] / np.sqrt(squares[is_seen]) * scale[:, None]
    shares, turned = np.linalg.eigh(whitened.T @ products[np.ix_(at, at)] @ whitened)
    whitened = whitened @ turned
    rest = np.maximum(1.0 - shares, LEAST_REST)
    bias[at] = -whitened @ (whitened.T @ gradient[at] / rest)
    return bias


def _noise_rows(
    fitted: Fit, recording: FilteredRecording
) -> Iterator[tuple[Array, Array]]:
    """Yield weighted rows (m, k) of noise of each joint's acceleration, and its torque (m,)."""
    is_used = recording.is_used[:, fitted.arm.indices]
    every = max(1, len(recording) // INSTANTS)
    chosen = is_used[::every]
    q = recording.motion.q[::every]
    time = recording.motion.time[::every]
    # Each instant stands for rows of the joint around it.
    counts = np.sum(is_used, axis=0) / np.maximum(np.sum(chosen, axis=0), 1)
    weights: Array = np.ravel(fitted.weights * np.sqrt(counts) * chosen)
    still = np.zeros_like(q)
    for joint, deviation in enumerate(recording.acceleration_noise):
        accelerations = still.copy()
        accelerations[:, joint] = deviation
        motion = Motion(time, q, still, accelerations)
        columns, torque = _inertial_rows(fitted, motion, recording.is_loaded)
        yield (
            weights[:, None] * columns.reshape(-1, columns.shape[-1]),
            weights * np.ravel(torque),
        )


def _inertial_rows(fitted: Fit, motion: Motion, is_loaded: bool) -> tuple[Array, Array]:
    """Return the columns (m, J, k), and the torque (m, J), of all inertia in a motion."""
    unfiltered = LowPass(np.inf, np.inf, np.ones(1), 1)
    tau = np.zeros_like(motion.q)
    exact = FilteredRecording.exact(motion, tau, unfiltered, is_loaded=is_loaded)
    rows = Rows(exact, slice(None))
    point = replace(fitted.point, gravity=np.zeros(3))
    joints = len(fitted.arm.indices)
    columns = np.zeros((len(motion.time), joints, len(fitted.names)))
    torque = np.zeros(columns.shape[:2])
    places = {name: place for place, name in enumerate(fitted.names)}
    for term in fitted.arm.terms.values():
        if term.cause in (LAST_LINK, LINKS, PAYLOAD, MOTORS) or is_rotor(term):
            of_term = term.columns(rows, point)
            torque += of_term @ np.array([fitted.by_name[n] for n in term.names])
            kept = [k for k, name in enumerate(term.names) if name in places]
            at = [places[term.names[k]] for k in kept]
            columns[..., at] = of_term[..., kept]
    return columns, torque


def is_rotor(term: Term) -> bool:
    """Return whether a term is that of the joints' rotors."""
    return term.cause == FRICTION and term.parameters[0].name == ROTOR.name


def rotor_biases(fitted: Fit) -> Iterator[tuple[Parameter, float, float]]:
    """Yield each joint's rotor, its bias by noise of accelerations, and its standard error."""
    bias = acceleration_bias(fitted)
    for term, span in fitted.equations.spans:
        if is_rotor(term):
            of_term = zip(term.parameters, bias[span], fitted.errors[span])
            for parameter, shift, error in of_term:
                yield parameter, float(shift), float(error)

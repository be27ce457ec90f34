"""Mistaken columns of a log: signs, exchanged joints, degrees, units of torque.

Mistakes in signs, order and degrees can be listed; torque scales are one factor per joint. A
mistake is corrected and the log's equations are made again; the gain in log marginal likelihood is
comparable with that of an explanation (``contest``). Corrections of torques alone need no new rows
and are tried for every log; those of positions and scales where the model does not fit.

Throughout, N is the number of samples of a piece, K that of rows per joint, n that of joints. A
torque scale is the ratio of recorded to true torque. The model's torque is the rms inverse dynamics
of the model's links. The base model is the model of a log without faults (``LogModel``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import nlargest
from itertools import combinations
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import COLUMNS_ADVICE, ColumnCorrection, Finding, Level
from robot_sysid.diagnosis.log_model import LogModel, Posterior
from robot_sysid.diagnosis.log_rows import (
    LEAST_TORQUE,
    LogRows,
    log_rows,
    rigid_torque,
    weight_torque,
)
from robot_sysid.diagnosis.torque_units import SMALL, WEIGHING, typical_scale
from robot_sysid.dynamics.inverse_dynamics import gravity_vector, with_gravity
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

REFUSED = 1.6
"""Torque scale, or its inverse, above which a log is refused."""
WARNED = 1.3
"""Torque scale, or its inverse, above which a log gets a warning."""
UNITS = {
    1e3: "mN·m",
    100.0: "N·cm",
    10.197: "kgf·cm",
    8.851: "lbf·in",
    0.7376: "lbf·ft",
    141.6: "ozf·in",
    1e-3: "kN·m",
}
"""One newton metre in other units of torque, to the unit's name."""
SHORT = 6.0
"""Length of the stretch of a log on which relabelled motions are tried first [s]."""
MOUNTING = (
    "gravity acts in another direction than in the model: the base is mounted otherwise, on a wall "
    "or a ceiling; turn it in the model (MJCF: gravity of <option>, or euler of the base's body; "
    "URDF: rpy of the first joint's origin)"
)
"""Text of the finding that the arm is mounted otherwise than the model says."""
# Cosine of the angle to the model's gravity from which another direction counts as the same.
_SAME_WAY = 0.9
# Ratio between the largest and smallest torque scale below which they have one common cause.
_SAME = 1.35
# Largest ratio between a torque scale and the factor of a unit that explains it.
_CLOSE = 1.25
# Prior standard deviation of the logarithm of a scale that all joints share.
_COMMON_RANGE = 4.0
# Prior standard deviation of the logarithm of a joint's scale over the common one.
_OWN_RANGE = 0.4
# Rounds of Gauss-Newton for the scales.
_ROUNDS = 5
# Prior standard deviation of a scale's relative change in one round of Gauss-Newton.
_FAR = 0.7
# Smallest torque scale of any unit and gear.
_LEAST = 1e-4
# Largest torque scale of any unit and gear.
_MOST = 1e5
# Relative standard error from which a joint's scale is not identified.
_KNOWN = 0.3
# Largest factor between a scale and the torque ratio of a joint that links load.
_FARTHEST = 3.0
# Largest factor between a scale and the torque ratio of a joint whose torque is mostly friction.
_FRICTION = 10.0
# Number of the best corrections of a first comparison that are fitted to the whole log.
_FINALISTS = 3


@dataclass(frozen=True)
class Relabelling:
    """A mistake in the columns of a log, and its correction.

    Attributes:
        finding: the mistake, and what puts the log right.
        motion: function of recorded positions, velocities or accelerations (N, n) that returns the
            corrected ones; None where they are right.
        torque: function of recorded torques (N, n) that returns the corrected ones; None where
            they are right.
        gravity: (3,) that acted on the arm, in the model's world frame [m/s^2]; None where the
            model's is right.
    """

    finding: Finding
    motion: Callable[[Array], Array] | None = None
    torque: Callable[[Array], Array] | None = None
    gravity: Array | None = None

    def correct(self, signals: Sequence[ProcessedSignals]) -> list[ProcessedSignals]:
        """Return the signals of all pieces with the mistake corrected."""
        corrected = []
        for piece in signals:
            arrays: dict[str, Any] = {}
            if self.motion is not None:
                for name in ("q", "qd", "qdd"):
                    arrays[name] = self.motion(getattr(piece, name))
            if self.torque is not None:
                arrays["tau"] = self.torque(piece.tau)
            corrected.append(replace(piece, **arrays))
        return corrected


def relabellings(robot: RobotModel) -> Iterator[Relabelling]:
    """Yield every mistake in signs, order, units of angles and mounting that is tried.

    Mistakes in torques alone come first, then those in positions alone, then those in both; last
    are positions in degrees, or in radians that were taken for degrees, and other directions of
    gravity.
    """
    names = robot.joint_names
    for quantities in (("torque",), ("position",), ("position", "torque")):
        yield from _sign_mistakes(names, quantities)
        yield from _order_mistakes(names, quantities)
    # The method __mul__ of an array (n,) multiplies values (N, n) by the array.
    to_radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    text = "positions look like degrees; pass --units deg"
    finding = Finding("angle-unit", Level.REFUSE, text, options=("--units", "deg"))
    yield Relabelling(finding, to_radians.__mul__)
    text = "positions look like radians that were taken for degrees; say rad where degrees are "
    text += "said: in --units, the file of --columns, a column's title or the recorder"
    yield Relabelling(
        Finding("angle-unit", Level.REFUSE, text), (1.0 / to_radians).__mul__
    )
    gravity = gravity_vector(robot)
    size = float(np.linalg.norm(gravity))
    for direction in (*np.eye(3), *-np.eye(3)) if size > 0.0 else ():
        if direction @ gravity < _SAME_WAY * size:
            finding = Finding("tilt", Level.REFUSE, MOUNTING)
            yield Relabelling(finding, gravity=size * direction)


def _column_mistake(name: str, text: str, columns: ColumnCorrection) -> Relabelling:
    """Return the mistake that columns are wrong.

    Args:
        name: name of the check that reports it.
        text: the mistake.
        columns: its correction.
    """
    advice = f"{text}{COLUMNS_ADVICE}"
    finding = Finding(name, Level.REFUSE, advice, correction=columns)
    motion = columns.apply if "position" in columns.quantities else None
    torque = columns.apply if "torque" in columns.quantities else None
    return Relabelling(finding, motion, torque)


def _sign_mistakes(
    names: Sequence[str], quantities: tuple[str, ...]
) -> Iterator[Relabelling]:
    """Yield the mistakes that signs are wrong in all quantities: each joint's, then all joints'.

    Turned positions of all joints are left out: they look like turned torques.

    Args:
        names: names of the n joints.
        quantities: "position", "torque" or both.
    """
    subject = " and ".join(quantities)
    verb = "has" if len(quantities) == 1 else "have"
    owners = [f"joint {name}" for name in names]
    signs_of_owners = [*(1.0 - 2.0 * np.eye(len(names)))]
    if len(names) > 1 and quantities == ("torque",):
        owners.append("every joint")
        signs_of_owners.append(-np.ones(len(names)))
    for owner, signs in zip(owners, signs_of_owners):
        text = f"the {subject} of {owner} {verb} the opposite sign of the model's"
        columns = ColumnCorrection.of_factors(quantities, names, signs)
        yield _column_mistake("sign", text, columns)


def _order_mistakes(
    names: Sequence[str], quantities: tuple[str, ...]
) -> Iterator[Relabelling]:
    """Yield each exchange of two joints, then the reverse order, in all given quantities.

    Args:
        names: names of the n joints; the reverse order of two is their exchange.
        quantities: "position", "torque" or both.
    """
    scope = "" if len(quantities) == 2 else f" in the {quantities[0]}s"
    joints = list(range(len(names)))
    factors = (1.0,) * len(names)
    mistakes = []
    for first, second in combinations(joints, 2):
        order = joints.copy()
        order[first] = second
        order[second] = first
        text = f"joints {names[first]} and {names[second]} are exchanged"
        mistakes.append((text, order))
    if len(names) > 2:
        mistakes.append(("the order of the joints is reversed", joints[::-1]))
    for text, order in mistakes:
        columns = ColumnCorrection(quantities, tuple(names), tuple(order), factors)
        yield _column_mistake("order", f"{text}{scope}", columns)


@dataclass(frozen=True)
class Correction:
    """A corrected mistake and the log after its correction.

    Attributes:
        finding: the mistake, and what puts the log right.
        gain: increase of the log marginal likelihood by the correction [nats].
        posterior: posterior of the base model of the corrected log.
    """

    finding: Finding
    gain: float
    posterior: Posterior

    @classmethod
    def of(cls, finding: Finding, posterior: Posterior, base: Posterior) -> Correction:
        """Return the correction of a mistake; ``base`` is the posterior of the log as it is."""
        gain = float(posterior.log_evidence - base.log_evidence)
        return cls(finding, gain, posterior)


def find_wrong_torques(
    base: Posterior, signals: Sequence[ProcessedSignals]
) -> list[Correction]:
    """Return the best corrections of wrong torques, best first by a comparison at fixed noise.

    They are corrections of signs and order that keep the positions, and with them the rows of the
    log; where the torque is small, also additions of missing gravity. All are compared at the noise
    of the log as it is; up to ``_FINALISTS`` of those that gain are fitted with noise estimated
    anew.

    Args:
        base: posterior of the base model of the log.
        signals: low-passed signals of the log's pieces.
    """
    model = base.model
    mistakes = [
        m for m in relabellings(model.log.robot) if m.motion is None and m.torque
    ]
    if typical_scale(model.log) < SMALL:
        mistakes += _without_links(model.log, signals)
    candidates = []
    for mistake in mistakes:
        assert mistake.torque is not None
        log = model.log.with_torque(mistake.torque(model.log.torque))
        corrected = model.with_torque_of(log)
        evidence = corrected.at_noise(base.noise).log_evidence
        if evidence > base.log_evidence:
            candidates.append((evidence, mistake, corrected))
    corrections = []
    for _, mistake, corrected in nlargest(_FINALISTS, candidates, key=itemgetter(0)):
        posterior = corrected.posterior(base.noise)
        corrections.append(Correction.of(mistake.finding, posterior, base))
    return corrections


def _without_links(
    log: LogRows, signals: Sequence[ProcessedSignals]
) -> Iterator[Relabelling]:
    """Yield the mistakes that the recorded torque lacks the links' weight, or all their torque.

    The corrections add the missing torque (K, n), so they apply to ``log.torque`` only.

    Args:
        log: equations of the log.
        signals: low-passed signals of the log's pieces.
    """
    robot = log.robot

    def torques(motion: Motion) -> tuple[Array, Array]:
        """Return (weight, inverse dynamics) of the model's links, (N, n) each [N m]."""
        return weight_torque(robot, motion), rigid_torque(robot, motion)

    # Low-passed like the torque: the part that the low-pass removes may exceed the noise.
    filtered = [piece.filter_columns(torques, smooth=True) for piece in signals]
    weight, links = map(np.concatenate, zip(*filtered))
    missing_torques = {
        "the torque fits the model without gravity: gravity is compensated in it already; record "
        "the measured joint torque, not the command": weight,
        "the torque has nothing of its motion but friction: this is an external torque, what is "
        "left after the controller's model; record the measured joint torque": links,
    }
    for text, missing in missing_torques.items():
        finding = Finding("gravity", Level.REFUSE, text)
        yield Relabelling(finding, torque=missing.__add__)


def find_wrong_columns(
    base: Posterior, signals: Sequence[ProcessedSignals], options: EstimationOptions
) -> list[Correction]:
    """Return the ``_FINALISTS`` corrections of columns that explain a short stretch best.

    All ``relabellings`` of positions, torques or both are tried on this stretch; those with the
    largest evidence are then fitted to the whole log, which gives their gain. Samples are used
    where the uncorrected log uses them, so that all corrections are judged on the same rows.

    Args:
        base: posterior of the base model of the log, which has no correction.
        signals: low-passed signals of the log's pieces.
        options: prior uncertainties of the estimate.
    """
    robot = base.model.log.robot

    def correct(
        mistake: Relabelling,
        pieces: Sequence[ProcessedSignals],
        used: NDArray[np.bool_],
    ) -> Posterior:
        """Return the posterior of pieces after a mistake's correction.

        ``used`` (K, n) are the rows that count.
        """
        arm = robot
        if mistake.gravity is not None:
            arm = with_gravity(robot, mistake.gravity)
        rows = log_rows(arm, mistake.correct(pieces), used)
        return LogModel(rows, options).posterior()

    stretch = [_busiest(signals)]
    used = log_rows(robot, stretch).used
    mistakes = list(relabellings(robot))
    evidences = [correct(mistake, stretch, used).log_evidence for mistake in mistakes]
    candidates = zip(evidences, mistakes)
    corrections = []
    for _, mistake in nlargest(_FINALISTS, candidates, key=itemgetter(0)):
        posterior = correct(mistake, signals, base.model.log.used)
        corrections.append(Correction.of(mistake.finding, posterior, base))
    return corrections


def _busiest(signals: Sequence[ProcessedSignals]) -> ProcessedSignals:
    """Return the ``SHORT`` seconds of the longest piece in which the joints move most.

    Each joint's speed counts relative to its largest. A shorter piece is returned as it is.
    """
    best = max(signals, key=len)
    count = round(SHORT * best.rate)
    if len(best) <= count:
        return best
    relative = np.abs(best.qd) / np.maximum(np.max(np.abs(best.qd), axis=0), 1e-9)
    travelled = np.append(0.0, np.cumsum(np.sum(relative, axis=1)))
    start = int(np.argmax(travelled[count:] - travelled[:-count]))
    stretch = slice(start, start + count)
    names = ("time", "q", "qd", "qdd", "tau", "bridged", "turning")
    return replace(best, **{name: getattr(best, name)[stretch] for name in names})


@dataclass(frozen=True)
class TorqueScales:
    """Torque scales: recorded torque over true torque of each joint.

    Properties need at least one identified scale.

    Attributes:
        scale: (n,) scale of each joint; the median of the identified scales where a joint's is not
            identified. Without any identified one, the last iterates of the search.
        identified: (k,) indices of the joints whose scale is identified.
        covariance: (k, k) covariance of the logarithms of these joints' scales.
    """

    scale: Array
    identified: NDArray[np.int64]
    covariance: Array

    @cached_property
    def common(self) -> tuple[float, float]:
        """The mean of the identified scales, and the standard error of its logarithm.

        Its logarithm is the generalised least-squares mean of the logarithms of the scales.
        """
        precision = np.linalg.inv(self.covariance)
        total = np.sum(precision)
        weight = np.sum(precision, axis=0) / total
        mean = float(weight @ np.log(self.scale[self.identified]))
        return float(np.exp(mean)), float(total**-0.5)

    @property
    def spread(self) -> float:
        """Ratio of the largest to the smallest identified scale."""
        scale = self.scale[self.identified]
        return float(np.max(scale) / np.min(scale))

    @property
    def penalty(self) -> float:
        """Loss of log evidence for scales that fit the data instead of being 1 [nats].

        It is the Occam factor of a normal prior P of the log scales s with posterior covariance C,
        (log det P - log det C + s^T P^-1 s) / 2. P has a wide standard deviation for a scale that
        all joints share and a narrow one for each joint's own. Nearly equal scales count as one.
        """
        logarithm = np.log(self.scale[self.identified])
        covariance = self.covariance
        if self.spread < _SAME:
            typical, error = self.common
            logarithm = np.log([typical])
            covariance = np.array([[error**2]])
        prior = _COMMON_RANGE**2 + _OWN_RANGE**2 * np.eye(len(logarithm))
        narrowed = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(covariance)[1]
        return float(0.5 * (narrowed + logarithm @ np.linalg.solve(prior, logarithm)))


def find_wrong_scales(
    base: Posterior, options: EstimationOptions, divided: Array
) -> list[Correction]:
    """Return the correction of torque scales: a unit, a common scale or a scale per joint.

    The finding's level depends on the scale farthest from 1 (``REFUSED``, ``WARNED``).

    Args:
        base: posterior of the base model of the log.
        options: prior uncertainties of the estimate.
        divided: (n,) torque scales by which the torques were divided already, as the user gave
            them.

    Returns:
        One correction, none where no scale is identified.
    """
    log = base.model.log
    scales = torque_scales(log, options)
    if not len(scales.identified):
        return []
    typical, common_error = scales.common
    scale = scales.scale
    scale_option: tuple[str, ...] = ()
    if scales.spread < _SAME:
        unit = _unit_near(typical, common_error)
        scale = np.full(len(scale), unit or typical)
        if unit is not None:
            scale_option = ("--torque-scale", _scale_text(unit, divided))
    undone = log.with_torque(log.torque / scale)
    posterior = LogModel(undone, options).posterior()
    # The density of recorded torques is that of the divided ones over the scale of each row.
    density = float(np.sum(base.model.count * np.log(scale)))
    gain = posterior.log_evidence - density - base.log_evidence - scales.penalty
    names = log.robot.joint_names
    listed = ", ".join(f"{names[k]} {scale[k]:.3g}" for k in scales.identified)
    meaning = _meaning(typical, scales.spread, common_error, divided)
    text = (
        f"torque reads {typical:.3g} times what the model takes ({listed}): {meaning}"
    )
    # The farthest scale from one, in either direction.
    off = float(np.max(np.abs(np.log(scale[scales.identified]))))
    level = Level.WARN if off > np.log(WARNED) else Level.NOTE
    level = Level.REFUSE if off > np.log(REFUSED) else level
    start = ",".join(format(value, ".4g") for value in scale * divided)
    payload_options = ("--torque-scale", start) if scales.spread > _SAME else ()
    finding = Finding("torque-scale", level, text, payload_options, scale_option)
    return [Correction(finding, gain, posterior)]


def torque_scales(log: LogRows, options: EstimationOptions) -> TorqueScales:
    """Return the torque scale of each joint, by Gauss-Newton from the ratio of rms torques.

    In each round the torques are divided by the scales of the last round, and the torque of the
    estimated links is one more column of each joint's equations; its coefficient is the relative
    change of the scale. No scale counts as identified unless those of all joints that links load
    have a relative standard error below ``_KNOWN``.

    Args:
        log: equations of the log.
        options: prior uncertainties of the estimate.
    """
    is_loaded = log.is_loaded
    ratio = np.clip(log.torque_ratio(1e-6), _LEAST, _MOST)
    typical_ratio = float(np.median(ratio[is_loaded]))
    # Friction makes the torque of a joint that links hardly load.
    is_odd = np.abs(np.log(ratio / typical_ratio)) > np.log(_FRICTION)
    is_moved = log.model_torque > LEAST_TORQUE * np.max(log.model_torque)
    is_of_links = is_loaded | (is_odd & is_moved)
    scale = np.where(is_of_links, ratio, typical_ratio)
    farthest = np.where(is_loaded, _FARTHEST, _FRICTION)
    lower = scale / farthest
    upper = scale * farthest
    covariance = np.eye(len(scale))
    values: Array | None = None
    for _ in range(_ROUNDS):
        undone = log.with_torque(log.torque / scale)
        base = LogModel(undone, options)
        rigid = undone.links_torque(base.prior.mean if values is None else values)
        columns = []
        for joint, unit in enumerate(np.eye(len(scale))):
            # (K, n): column j is that of joint j's scale, which acts at joint j only.
            scale_columns = _FAR * rigid[:, joint, None] * unit
            columns.append(base.transform(joint, scale_columns))
        posterior = base.with_columns(columns).posterior()
        # The scales' coefficients come last.
        first = len(base.prior.estimated)
        # A linear step is not trusted beyond a factor of five.
        change = np.clip(1.0 + _FAR * posterior.coefficients[first:], 0.2, 5.0)
        covariance = _FAR**2 * posterior.covariance[first:, first:]
        covariance = covariance / np.outer(change, change)
        scale = np.clip(scale * change, lower, upper)
        values = posterior.values
    is_sure = np.sqrt(np.diag(covariance)) < _KNOWN
    # Where a loaded joint's torque does not follow its links, units do not explain it.
    sure = np.flatnonzero(is_sure & np.all(is_sure[is_loaded]))
    if len(sure):
        scale = np.where(is_sure, scale, np.median(scale[sure]))
    return TorqueScales(scale, sure, covariance[np.ix_(sure, sure)])


def _unit_near(typical: float, error: float) -> float | None:
    """Return the factor in ``UNITS`` that agrees with the scale ``typical``, or None.

    A factor within e of one, as of lbf·ft, counts as no unit: the scale may have other causes.
    ``error`` is the relative standard error of the scale.
    """
    nearest = min(UNITS, key=lambda factor: abs(np.log(typical / factor)))
    is_close = abs(np.log(typical / nearest)) < max(np.log(_CLOSE), 3.0 * error)
    is_far_from_one = abs(np.log(nearest)) > 1
    return nearest if is_close and is_far_from_one else None


def _meaning(typical: float, spread: float, error: float, divided: Array) -> str:
    """Return in words the probable cause of torque scales, and what to do.

    Args:
        typical: the common scale.
        spread: ratio of the largest to the smallest scale; above ``_SAME``, joints differ.
        error: relative standard error of the common scale.
        divided: (n,) torque scales by which the torques were divided already.
    """
    if spread > _SAME:
        return (
            "a factor of its own for every joint, as motor currents or per cent of rated torque "
            f"have, or the model of another arm; {WEIGHING}"
        )
    unit = _unit_near(typical, error)
    cause = "motor currents, torques before the gear, or the model of another arm"
    if unit is not None:
        cause = UNITS[unit]
    value = _scale_text(unit or typical, divided)
    return f"as in {cause}; if the model is this arm's, pass --torque-scale {value}"


def _scale_text(scale: float, divided: Array) -> str:
    """Return the value of --torque-scale: a further scale times those in use already.

    ``divided`` (n,) are the scales in use; the value is one number where all joints have the same.
    """
    scales = divided[:1] if np.ptp(divided) == 0.0 else divided
    return ",".join(format(value, ".4g") for value in (scale * scales).tolist())

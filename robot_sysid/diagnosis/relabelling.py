"""Mistaken columns of a log: signs, exchanged joints, degrees, units of torque, another mounting.

Each mistake can be listed, but for torque scales, one factor per joint. A mistake is corrected and
the log is fitted again; the gain in log marginal likelihood competes with those of explanations
(``contest``). Corrections of torques alone change only right-hand sides and are tried for every
log; all others where the model does not fit.

Throughout, K is the number of rows of all recordings, n that of joints. A torque scale is the ratio
of recorded to true torque.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import COLUMNS_ADVICE, ColumnCorrection, Finding, Level
from robot_sysid.diagnosis.causes import mounting_text
from robot_sysid.diagnosis.log_fit import (
    LogFit,
    LogRows,
    coulomb_indices,
    evidence,
    gain_of,
    log_rows,
    with_term,
)
from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimate.choose import CLEAR
from robot_sysid.estimate.fit import Equations, fit
from robot_sysid.estimate.links import AS_STATED
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import arm_question
from robot_sysid.estimate.rows import Recording
from robot_sysid.estimate.terms import SCALES, ArmTerms, Term, independent
from robot_sysid.records import Array, RobotModel
from robot_sysid.signals.process import ProcessedSignals

LITTLE = 0.02
"""Share of unexplained torque that a correction may always leave."""
GROSS = 0.05
"""Share of unexplained torque above which relabellings of columns are tried."""
GROSS_JOINT = 0.5
"""Share of one joint's torque that is unexplained above which relabellings are tried."""
ODD = 1.3
"""Ratio of measured torque to the model's, or its inverse, above which torque scales are tried."""
REFUSED = 1.6
"""Torque scale, or its inverse, above which a log is refused."""
WARNED = 1.3
"""Torque scale, or its inverse, above which a log gets a warning."""
SMALLER = 1.0 / 3.0
"""Torque scale below which all joints' torques are in another unit, whatever the links: arms whose
links are off by 20 %, one of them by 40 %, measure at least 0.53 of the weight."""
LARGER = 5.0
"""Torque scale above which they are: the heaviest tool that an arm may carry, which its model
lacks, makes at least one joint's weight no larger than 3.4 times."""
WIDE = 0.7
"""Prior standard deviation of a scale's relative change in one round."""
KNOWN = 0.4
"""Relative standard error from which a joint's scale is not identified."""
SAME = 1.35
"""Ratio between the largest and smallest torque scale below which they have one common cause."""
CLOSE = 1.25
"""Largest ratio between a torque scale and the factor of a unit that explains it."""
COMMON_RANGE = 4.0
"""Prior standard deviation of the logarithm of a scale that all joints share."""
OWN_RANGE = 0.4
"""Prior standard deviation of the logarithm of a joint's scale over the common one."""
UNITS = {
    1e3: "mN·m",
    100.0: "N·cm",
    10.197: "kgf·cm",
    8.851: "lbf·in",
    141.6: "ozf·in",
    1e-3: "kN·m",
}
"""One newton metre in other units of torque, to the unit's name."""
WEIGHING = (
    "give the torque per ampere with --torque-constants, or determine it with a weight: bolt on "
    "1 kg (of another mass, state it), record a motion called weight, and compare"
)
"""What to do where torques are motor currents; the command that compares follows the message."""
_ROUNDS = 4
SHORT = 6.0
"""Length of the stretch of a log on which relabelled motions are tried first [s]."""
FINALISTS = 3
"""Number of the best corrections of a first comparison that are fitted to the whole log."""
WIDE_TILT = 15.0
"""Prior standard deviation of a base's tilt where it is mounted otherwise [degrees]."""
_TURNS = 3
ODD_UNIT = 20.0
"""Ratio of one joint's torque to the model's, over that of the other joints, above which the joint
has a unit of its own."""
_LEAST_LOAD = 0.03
"""Model torque below which friction makes most of a joint's torque, over the strongest joint's."""


@dataclass(frozen=True)
class Relabelling:
    """A mistake in the columns of a log, or in the model's mounting, and its correction.

    Attributes:
        finding: the mistake, and what puts the log right.
        columns: correction of columns of the log; None for none.
        gravity: (3,) that acted on the arm, in the model's world frame [m/s^2]; None for the
            model's.
    """

    finding: Finding
    columns: ColumnCorrection | None = None
    gravity: Array | None = None

    @property
    def is_of_torques(self) -> bool:
        """Whether only torques are corrected."""
        return self.columns is not None and self.columns.quantities == ("torque",)

    def arm(self, robot: RobotModel) -> RobotModel:
        """Return the arm under the gravity that acted on it."""
        return robot if self.gravity is None else with_gravity(robot, self.gravity)

    def correct(self, recording: Recording) -> Recording:
        """Return a recording with the mistake corrected, in which the same rows are used."""
        arrays: dict[str, Any] = {}
        signals = recording.source
        assert isinstance(signals, ProcessedSignals)
        columns = self.columns
        if columns is not None and "position" in columns.quantities:
            for name in ("q", "qd", "qdd"):
                arrays[name] = columns.apply(getattr(signals, name))
        if columns is not None and "torque" in columns.quantities:
            arrays["tau"] = columns.apply(signals.tau)
        corrected = Recording(recording.name, replace(signals, **arrays))
        corrected.__dict__["used"] = recording.used
        return corrected


def relabellings(
    robot: RobotModel, moving: Sequence[int] | None = None
) -> Iterator[Relabelling]:
    """Yield every mistake in signs, order, units of angles and mounting that is tried.

    ``moving`` are the numbers of the joints that move, all by default: columns of a joint that
    stands still say nothing of whose they are.
    """
    names = robot.joint_names
    n = len(names)
    moving = range(n) if moving is None else moving
    for quantities in (("torque",), ("position",), ("position", "torque")):
        subject = " and ".join(quantities)
        verb = "has" if len(quantities) == 1 else "have"
        scope = "" if len(quantities) == 2 else f" in the {subject}s"
        for joint, name in enumerate(names):
            signs = np.where(np.arange(n) == joint, -1.0, 1.0)
            text = (
                f"the {subject} of joint {name} {verb} the opposite sign of the model's"
            )
            yield _mistake("sign", text, quantities, names, factors=signs)
        if n > 1 and quantities == ("torque",):
            text = "the torque of every joint has the opposite sign of the model's"
            yield _mistake("sign", text, quantities, names, factors=-np.ones(n))
        for first, second in combinations(moving, 2):
            order = list(range(n))
            order[first], order[second] = second, first
            text = f"joints {names[first]} and {names[second]} are exchanged{scope}"
            yield _mistake("order", text, quantities, names, order)
        if n > 2 and len(moving) == n:
            text = f"the order of the joints is reversed{scope}"
            yield _mistake("order", text, quantities, names, range(n)[::-1])
    to_radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    text = "positions look like degrees; pass --units deg"
    degrees = _mistake("angle-unit", text, ("position",), names, factors=to_radians)
    finding = Finding("angle-unit", Level.REFUSE, text, options=("--units", "deg"))
    yield replace(degrees, finding=finding)
    text = "positions look like radians that were taken for degrees; say rad where degrees are "
    text += "said: in --units, the file of --columns, a column's title or the recorder"
    finding = Finding("angle-unit", Level.REFUSE, text)
    radians = _mistake(
        "angle-unit", text, ("position",), names, factors=1.0 / to_radians
    )
    yield replace(radians, finding=finding)


def _mistake(
    check: str,
    text: str,
    quantities: tuple[str, ...],
    names: Sequence[str],
    order: Sequence[int] = (),
    factors: Array | None = None,
) -> Relabelling:
    """Return the mistake that joints have the columns of others, or columns times a factor."""
    ones = np.ones(len(names)) if factors is None else factors
    order = order or range(len(names))
    columns = ColumnCorrection(
        quantities, tuple(names), tuple(order), tuple(ones.tolist())
    )
    finding = Finding(
        check, Level.REFUSE, f"{text}{COLUMNS_ADVICE}", correction=columns
    )
    return Relabelling(finding, columns)


@dataclass(frozen=True)
class Correction:
    """A corrected mistake, its gain in log marginal likelihood [nats], and the corrected log."""

    finding: Finding
    gain: float
    log: LogFit


def wrong_torques(log: LogFit) -> Iterator[Correction]:
    """Yield the best corrections of torques' signs and order, which keep the columns of the log."""
    rows = log.rows
    terms = log.fit.equations.terms
    candidates: list[tuple[float, int, Relabelling, LogRows]] = []
    for mistake in relabellings(rows.arm.robot, rows.moving):
        if mistake.columns is not None and mistake.is_of_torques:
            corrected = rows.with_torque(mistake.columns.apply(rows.torque))
            candidates.append(
                (_promise(log, corrected), len(candidates), mistake, corrected)
            )
    candidates.sort(reverse=True)
    least = _promise(log, rows)
    for promise, _, mistake, corrected in candidates[:FINALISTS]:
        if promise > least:
            fitted = corrected.fit(terms, log.fit)
            after = LogFit(fitted, corrected)
            gain = gain_of(log, after) - float(np.log(len(candidates)))
            yield Correction(mistake.finding, gain, after)


def _promise(log: LogFit, rows: LogRows) -> float:
    """Return roughly the log likelihood of rows with other torques, at the weights of a fit."""
    old = log.fit.equations
    equations = Equations(rows.sums, old.terms, old.held)
    normal = equations.data(log.fit.weights) + equations.prior
    gradient = normal[:-1, -1] - normal[:-1, :-1] @ equations.usual
    values = equations.usual + log.fit.inverse @ gradient
    squares = rows.sums.squared_residuals(equations.full(values))
    counts = np.maximum(np.sum(rows.sums.counts, axis=0), 1.0)
    dry = coulomb_indices(log.fit)
    errors = np.sqrt(np.diag(log.fit.inverse)[dry])
    driving = np.minimum(values[dry] / errors, 0.0)
    noise = np.log(np.maximum(squares / counts, log.fit.noise**2 * 1e-6))
    return float(-0.5 * counts @ noise - 0.5 * np.sum(driving**2))


def wrong_columns(
    log: LogFit,
    options: EstimationOptions,
    mistakes: Iterable[Relabelling],
    finalists: int = FINALISTS,
) -> Iterator[Correction]:
    """Yield the corrections of mistakes that explain a short stretch best."""
    robot = log.fit.arm.robot
    stretch = [_busiest(log.fit.recordings)]
    question = log.fit.question
    promises: list[tuple[float, int, Relabelling]] = []
    for mistake in mistakes:
        corrected = [mistake.correct(recording) for recording in stretch]
        arm = ArmTerms(mistake.arm(robot), friction=log.fit.arm.friction)
        rows = log_rows(arm, corrected, arm.start())
        torque = rows.sums.rms_torque
        fitted = fit(
            arm,
            corrected,
            rows.point,
            rows.sums,
            arm_question(arm, replace(question, motors=()), torque),
            possible=False,
            question=question,
        )
        promises.append((evidence(fitted), len(promises), mistake))
    promises.sort(reverse=True)
    for _, _, mistake in promises[:finalists]:
        if mistake.gravity is not None:
            yield mounted(log, options, mistake.gravity)
            continue
        corrected = [mistake.correct(r) for r in log.fit.recordings]
        after = LogFit.of(robot, corrected, options)
        gain = gain_of(log, after) - float(np.log(len(promises)))
        yield Correction(mistake.finding, gain, after)


def _busiest(recordings: Sequence[Recording]) -> Recording:
    """Return the ``SHORT`` seconds of the longest recording in which the joints move most."""
    best = max(recordings, key=len)
    signals = best.source
    assert isinstance(signals, ProcessedSignals)
    count = round(SHORT * signals.rate)
    if len(signals) <= count:
        return best
    relative = np.abs(signals.qd) / np.maximum(np.max(np.abs(signals.qd), axis=0), 1e-9)
    total = np.cumsum(np.sum(relative, axis=1))
    start = int(np.argmax(total[count:] - total[:-count]))
    names = ("time", "q", "qd", "qdd", "tau", "bridged")
    cut = {name: getattr(signals, name)[start : start + count] for name in names}
    return Recording(best.name, replace(signals, **cut))


def mounted(log: LogFit, options: EstimationOptions, direction: Array) -> Correction:
    """Return the correction of a model whose base is mounted otherwise.

    Gravity is turned until the fit, which allows it a wide tilt, agrees with it.

    Args:
        log: the fit of the log.
        options: prior uncertainties of the estimate.
        direction: (3,) of gravity to begin with.
    """
    robot = log.fit.arm.robot
    level = gravity_vector(robot)
    gravity = np.linalg.norm(level) * direction / np.linalg.norm(direction)
    wide = replace(options, priors=replace(options.priors, gravity=WIDE_TILT))
    for _ in range(_TURNS):
        turned = with_gravity(robot, gravity)
        after = LogFit.of(turned, log.fit.recordings, wide)
        at = after.fit.at(TILT_NAMES)
        gravity = turn_gravity(gravity, after.fit.free[at])
    error = float(np.max(np.sqrt(np.diag(after.fit.inverse)[at])))
    finding = Finding("tilt", Level.REFUSE, mounting_text(level, gravity, error))
    return Correction(finding, gain_of(log, after), after)


def other_axes(robot: RobotModel) -> Iterator[Relabelling]:
    """Yield gravity along the world's axes that are not the model's direction."""
    gravity = gravity_vector(robot)
    size = float(np.linalg.norm(gravity))
    for direction in (*np.eye(3), *-np.eye(3)) if size > 0.0 else ():
        if direction @ gravity < 0.9 * size:
            finding = Finding("tilt", Level.REFUSE, "")
            yield Relabelling(finding, gravity=size * direction)


def corrections(
    log: LogFit,
    best: LogFit,
    options: EstimationOptions,
    divided: Array,
    is_of_gravity: bool = False,
) -> list[Correction]:
    """Return the plausible corrections of mistakes, the largest gain first.

    A correction is plausible if its links are, and it leaves clearly less unexplained than the log,
    or little.

    Those of torques' signs and order are always tried. All others are tried where the fit with the
    best explanation leaves gross misfit or implausible links, where torques are off by ``ODD`` at
    typical joints, or other torques fit better.

    Args:
        log: the fit of the log.
        best: the fit with the best explanation.
        options: prior uncertainties of the estimate.
        divided: (n,) torque scales by which the torques were divided already.
        is_of_gravity: whether gravity in another direction may explain the log.
    """
    tried = [*wrong_torques(log)]
    robot = log.fit.arm.robot
    scaled: list[Correction] = []
    is_far = (
        best.misfit > GROSS
        or float(np.max(best.misfit_by_joint)) > GROSS_JOINT
        or not best.is_plausible
    )
    ratio = np.median(log.torque_ratio[log.loaded])
    if is_far or abs(np.log(ratio)) > np.log(ODD):
        scaled = [*wrong_scales(log, options, divided)]
        is_far &= all(each.log.misfit > GROSS for each in scaled)
        tried += scaled
    # Another torque column may only make up for a position of the same joint.
    if is_far or any(each.gain > CLEAR for each in tried if each not in scaled):
        # Those of torques alone were tried on the whole log.
        columns = [
            m for m in relabellings(robot, log.rows.moving) if not m.is_of_torques
        ]
        tried += wrong_columns(log, options, columns)
    if is_far or is_of_gravity:
        tried += wrong_columns(log, options, other_axes(robot), 1)
    plausible = [
        each
        for each in tried
        if each.log.is_plausible and each.log.misfit < max(0.7 * log.misfit, LITTLE)
    ]
    return sorted(plausible, key=lambda correction: -correction.gain)


# ---- torque scales


def wrong_scales(
    log: LogFit, options: EstimationOptions, divided: Array
) -> Iterator[Correction]:
    """Yield the correction of torque scales: one for all joints, or one per joint.

    Found by Gauss-Newton from the ratios of root mean square torques: torques are divided by the
    scales, and the fit of what results allows them wide errors. None where some loaded joint's
    torque does not follow its links.
    """
    robot = log.fit.arm.robot
    names = robot.joint_names
    scale = log.torque_ratio.copy()
    scale[~log.loaded] = np.median(scale[log.loaded])
    widened = names_of("scale", log.fit.arm.joints)
    term = Term(SCALES, widened, log.fit.arm.terms[SCALES].columns)
    wide = replace(term, prior=independent(np.full(len(names), WIDE)))
    arm = log.fit.arm
    # Links that explain the scales as they are would leave none to find.
    question = replace(log.fit.question, link_scales=AS_STATED)
    point = arm.start()
    fitted = log.fit
    for _ in range(_ROUNDS):
        undone = _divided(log, scale)
        rows = log_rows(arm, undone, point)
        terms = arm_question(arm, question, rows.sums.rms_torque)
        fitted = rows.fit(with_term(terms, wide), log.fit, is_alike=False)
        at = fitted.at(widened)
        change = np.clip(1.0 + fitted.free[at], 0.2, 5.0)
        scale = scale * change
        point = fitted.next_point()
    covariance = fitted.inverse[np.ix_(at, at)] / np.outer(change, change)
    is_sure = np.sqrt(np.diag(covariance)) < KNOWN
    sure = np.flatnonzero(is_sure)
    if not np.all(is_sure[log.loaded]):
        return
    covariance = covariance[np.ix_(sure, sure)]
    precision = np.linalg.inv(covariance)
    own = np.log(scale[sure])
    typical = float(np.exp(np.sum(precision @ own) / np.sum(precision)))
    scale[~is_sure] = typical
    # Loss for scales that fit the data instead of being one: the prior's volume over that left.
    if np.ptp(own) < np.log(SAME):
        error = float(np.sum(precision)) ** -0.5
        unit = min(UNITS, key=lambda factor: abs(np.log(typical / factor)))
        is_close = abs(np.log(typical / unit)) < max(np.log(CLOSE), 3.0 * error)
        scale[:] = unit if is_close else typical
        own = np.log([typical])
        covariance = np.array([[1.0 / np.sum(precision)]])
    prior = COMMON_RANGE**2 + OWN_RANGE**2 * np.eye(len(own))
    penalty = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(covariance)[1]
    penalty = 0.5 * (penalty + own @ np.linalg.solve(prior, own))
    after = LogFit.of(robot, _divided(log, scale), options)
    gain = gain_of(log, after, np.log(scale)) - float(penalty)
    yield Correction(scale_finding(log, scale, sure, divided), gain, after)


def odd_unit_finding(log: LogFit) -> Finding | None:
    """Return the finding that one joint's torque has another unit than that of the other joints."""
    least = _LEAST_LOAD * np.max(log.model_torque)
    ratio = log.torque_ratio * log.model_torque / np.maximum(log.model_torque, least)
    if len(ratio) < 3:
        return None
    joint = int(np.argmax(ratio))
    typical = float(np.median(log.torque_ratio[log.loaded]))
    factor = float(ratio[joint] / np.median(np.delete(ratio, joint)))
    # A torque without gravity has a share of the model's at joints that carry weight.
    if factor < ODD_UNIT or typical < 0.6:
        return None
    name = log.fit.arm.joints[joint]
    text = (
        f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in mN·m or "
        f"N·cm; put it right with --columns FILE: torque.{name} = 0.001 * TITLE"
    )
    return Finding("torque-scale", Level.REFUSE, text)


def _divided(log: LogFit, scale: Array) -> list[Recording]:
    """Return the recordings with torques divided by scales (n,)."""
    names = log.fit.arm.robot.joint_names
    columns = ColumnCorrection.of_factors(("torque",), names, 1.0 / scale)
    division = Relabelling(Finding("torque-scale", Level.NOTE, ""), columns)
    return [division.correct(recording) for recording in log.fit.recordings]


def scale_finding(
    log: LogFit, scale: Array, sure: NDArray[np.int64], divided: Array
) -> Finding:
    """Return the finding on torque scales (n,), of which those with indices ``sure`` are found."""
    names = log.fit.arm.robot.joint_names
    known = scale[sure]
    typical = float(np.median(known))
    listed = ", ".join(f"{names[k]} {scale[k]:.3g}" for k in sure)
    start = ",".join(format(value, ".4g") for value in scale * divided)
    text = f"torque reads {typical:.3g} times what the model takes ({listed}): "
    off = float(np.max(np.abs(np.log(known))))
    level = Level.WARN if off > np.log(WARNED) else Level.NOTE
    level = Level.REFUSE if off > np.log(REFUSED) else level
    # No links, and no tool that an arm may carry, make all torques that small or large.
    is_foreign = bool(np.all(known < SMALLER) or np.all(known > LARGER))
    check = "torque-unit" if is_foreign else "torque-scale"
    if np.max(known) / np.min(known) > SAME:
        text += "a factor of its own for every joint, as motor currents or per cent of rated "
        text += f"torque have, or all masses of the model are wrong; {WEIGHING}"
        return Finding(check, level, text, ("--torque-scale", start))
    torques = UNITS.get(typical, "motor currents, torques before the gear")
    if np.ptp(divided) == 0.0:
        start = start.partition(",")[0]
    # Masses in another unit are refused where models are read.
    if is_foreign and typical in UNITS:
        text += f"as in {torques}; pass --torque-scale {start}"
        return Finding(check, level, text, options=("--torque-scale", start))
    text += f"either torques are in another unit ({torques}), or all masses of the model are wrong "
    text += "by as much, or it is the model of another arm; torques cannot tell these apart: "
    text += f"weigh a link or a known mass; if the model is right, pass --torque-scale {start}"
    return Finding(check, level, text)

"""Mistaken columns of a log: signs, exchanged joints, degrees, units of torque, another mounting.

Each mistake can be listed, but for torque scales, one factor per joint, and the direction of
gravity. A mistake is corrected and the log is fitted again; the gain in log marginal likelihood
competes with those of explanations (``contest``). Which mistakes are worth a fit is decided by how
well the torque of the model's links, and friction, follow the corrected columns.

Throughout, K is the number of rows of all recordings, n that of joints. A torque scale is the ratio
of recorded to true torque.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, compress, product

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import ColumnCorrection, Finding
from robot_sysid.diagnosis.log_fit import LogFit, compare, log_rows, root_mean_square
from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinkDynamics,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimate.choose import CLEAR, common_factor
from robot_sysid.estimate.links import AS_STATED
from robot_sysid.estimate.questions import arm_question
from robot_sysid.estimate.rows import Recording
from robot_sysid.model.units import mass_unit, with_mass_scale
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import Level, torque_unit, with_error

LITTLE = 0.02
"""Share of unexplained torque that a correction may always leave."""
GROSS = 0.05
"""Share of unexplained torque above which scales and mountings are tried."""
ODD = 1.3
"""Ratio of measured torque to the model's, or its inverse, above which torque scales are tried."""
SURE = 2.0
"""Standard errors that count as sure."""
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
WIDE = 70.0
"""Prior standard deviation of a scale's relative change in one round [%]."""
KNOWN = 0.4
"""Relative standard error from which a joint's scale is not identified."""
SAME = 1.35
"""Ratio between the largest and smallest torque scale below which they have one common cause."""
CLOSE = 1.25
"""Largest ratio between a torque scale and the factor of a unit that explains it."""
FARTHEST = 5.0
"""Largest factor by which all masses of a model may be off; beyond it torques are no N m."""
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
UNCHANGED = ColumnCorrection((), (), ())
"""The correction of columns that are right."""
_ROUNDS = 4
FINALISTS = 2
"""Number of mistakes that are corrected in a fit: those that the model's links follow best."""
COMPARED = 250
"""Number of instants at which they are compared."""
LEAST_MISFIT = 0.01
"""Least difference between torque and the model's links that counts, as a share of the torque."""
LEAST_TURN = 5.0
"""Angle between gravity and the model's above which a base is mounted otherwise [degrees]."""
WIDE_TILT = 15.0
"""Prior standard deviation of a base's tilt where it is mounted otherwise [degrees]."""
_TURNS = 2
ODD_UNIT = 20.0
"""Ratio of one joint's torque to the model's, over that of the other joints, above which the joint
has a unit of its own."""
# Model torque below which friction makes most of a joint's torque, over the strongest joint's.
_LEAST_LOAD = 0.03


@dataclass(frozen=True)
class Correction:
    """A corrected mistake, its gain in log marginal likelihood [nats], and the corrected log."""

    finding: Finding
    gain: float
    log: LogFit


def corrected(
    recordings: Sequence[Recording], columns: ColumnCorrection
) -> list[Recording]:
    """Return recordings with their columns put right, in which the same rows are used."""
    right = []
    for recording in recordings:
        signals = recording.signals
        signals = replace(
            signals,
            q=columns.apply("position", signals.q),
            qd=columns.apply("position", signals.qd),
            qdd=columns.apply("position", signals.qdd),
            tau=columns.apply("torque", signals.tau),
        )
        right.append(Recording(recording.name, signals))
        right[-1].__dict__["used"] = recording.used
    return right


def mistakes(robot: RobotModel, moving: NDArray[np.int64]) -> Iterator[Finding]:
    """Yield every mistake in signs, order and units of angles that is tried, with its correction.

    ``moving`` are the numbers of the joints that move: columns of a joint that stands still say
    nothing of whose they are.
    """
    names = robot.joint_names
    n = len(names)
    of_factors = ColumnCorrection.of_factors

    def mistake(
        check: str,
        text: str,
        columns: ColumnCorrection,
        remedy: str = "put the columns right with --columns FILE",
    ) -> Finding:
        """Return the finding on columns that a correction puts right."""
        return Finding(Level.REFUSES, check, text, remedy, correction=columns)

    for quantities in (("torque",), ("position",), ("position", "torque")):
        subject = " and ".join(quantities)
        verb = "has" if len(quantities) == 1 else "have"
        scope = "" if len(quantities) == 2 else f" in the {subject}s"
        signs = dict(zip((f"joint {name}" for name in names), 1.0 - 2.0 * np.eye(n)))
        if n > 1 and quantities == ("torque",):
            signs["every joint"] = -np.ones(n)
        for owner, factors in signs.items():
            text = f"the {subject} of {owner} {verb} the opposite sign of the model's"
            yield mistake("sign", text, of_factors(factors, *quantities))
        orders = {}
        for first, second in combinations(moving, 2):
            order = list(range(n))
            order[first], order[second] = second, first
            orders[f"joints {names[first]} and {names[second]} are exchanged"] = order
        if n > 2 and len(moving) == n:
            orders["the order of the joints is reversed"] = list(range(n)[::-1])
        for text, order in orders.items():
            columns = ColumnCorrection(quantities, tuple(order), (1.0,) * n)
            yield mistake("order", f"{text}{scope}", columns)
    radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    columns = of_factors(radians, "position")
    text = "positions look like degrees"
    degrees = mistake("angle-unit", text, columns, "pass --units deg")
    yield replace(degrees, options=(("--units", "deg"),))
    yield mistake(
        "angle-unit",
        "positions look like radians that were taken for degrees",
        of_factors(1.0 / radians, "position"),
        "say rad where degrees are said: in --units, the file of --columns, a column's title or "
        "the recorder",
    )


def corrections(
    log: LogFit,
    best: LogFit,
    divided: Array,
    is_of_gravity: bool,
    advance: Callable[[], object],
) -> list[Correction]:
    """Return the plausible corrections of mistakes, the largest gain first.

    A correction is plausible if its links are, and it leaves clearly less unexplained than the log,
    or little. Scales and mountings are tried where the fit with the best explanation leaves gross
    misfit or implausible links; scales also where torques are off by ``ODD``.

    Args:
        log: the fit of the log.
        best: the fit with the best explanation.
        divided: (n,) torque scales by which the torques were divided already.
        is_of_gravity: whether gravity in another direction may explain the log.
        advance: is called after each correction.
    """
    tried = [wrong_columns(log)]
    is_far = best.misfit > GROSS or not best.is_plausible
    ratio = np.median(log.torque_ratio[log.loaded])
    if is_far or abs(np.log(ratio)) > np.log(ODD):
        tried += [common_scale(log, divided), wrong_scales(log, divided)]
    if is_of_gravity or (is_far and log.fit.arm.has_gravity):
        tried.append(mounted(log))
    plausible = []
    for each in chain(*tried):
        advance()
        if each.log.is_plausible and each.log.misfit < max(0.7 * log.misfit, LITTLE):
            plausible.append(each)
    return sorted(plausible, key=lambda correction: -correction.gain)


def wrong_columns(log: LogFit) -> Iterator[Correction]:
    """Yield the corrections of mistakes that the arm follows better than the log as it is."""
    robot = log.fit.arm.robot
    counts = np.sum(log.rows.sums.counts, axis=0)
    tried = [*mistakes(robot, log.fit.arm.indices[counts > 0])]
    level = gravity_vector(robot)
    columns = [each.correction or UNCHANGED for each in tried]
    as_is = agreement(log, UNCHANGED, level)
    scores = [agreement(log, each, level) for each in columns]
    for number in np.argsort(scores)[::-1][:FINALISTS].tolist():
        if scores[number] > as_is + CLEAR:
            right = corrected(log.fit.recordings, columns[number])
            after = LogFit.of(robot, right, log.options, log.found)
            gain, after = compare(log, after)
            yield Correction(tried[number], gain - np.log(len(tried)), after)


def agreement(log: LogFit, correction: ColumnCorrection, gravity: Array) -> float:
    """Return how well torques follow the model's links, with corrected columns and gravity.

    It is a log likelihood: each joint's torque is a factor times that of the links but the last, a
    last link of any parameters, Coulomb and viscous friction, a rotor and an offset; the factor,
    friction and rotor are not negative.

    Args:
        log: the fit of the log.
        correction: of the columns.
        gravity: (3,) [m/s^2].
    """
    from scipy.optimize import nnls

    arm = log.fit.arm
    robot = arm.robot
    names = [name for term in log.found for name in term.names]
    explained = log.rows.torque_of(names, log.fit.free[log.fit.at(names)])
    every = max(1, len(explained) // COMPARED)
    torque = np.zeros((len(explained), robot.n_joints))
    torque[:, arm.indices] = log.rows.right_sides - explained
    torque = torque[::every]
    least = LEAST_MISFIT * np.sqrt(np.mean(torque**2))
    motions = [recording.motion for recording in log.fit.recordings]
    q, qd, qdd = (
        correction.apply(
            "position", np.concatenate([vars(motion)[name] for motion in motions])
        )[::every]
        for name in ("q", "qd", "qdd")
    )
    torque = correction.apply("torque", torque)
    links = LinkDynamics(robot, gravity).motion(q, qd, qdd)
    others = robot.thetas
    others[-1] = 0.0
    signed = np.stack((links.torque(others), np.sign(qd), qd, qdd, torque), axis=-1)
    last_link = links.columns([robot.n_joints - 1])
    score = 0.0
    for joint in arm.indices:
        free = np.column_stack((last_link[:, joint], np.ones(len(torque))))
        basis = np.linalg.qr(free + 1e-9)[0]
        columns = signed[:, joint] - basis @ (basis.T @ signed[:, joint])
        size = root_mean_square(columns[:, :-1]) + 1e-12
        left = nnls(columns[:, :-1] / size, columns[:, -1])[1] / np.sqrt(len(torque))
        score -= len(torque) * np.log(max(left, least))
    return score


def mounted(log: LogFit) -> Iterator[Correction]:
    """Yield the correction of a model whose base is mounted otherwise, if that is likely.

    From the likeliest of 26 directions, gravity is turned until the fit, which allows it a wide
    tilt, agrees with it.
    """
    robot = log.fit.arm.robot
    level = gravity_vector(robot)
    size = np.linalg.norm(level)
    axes = np.array([axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if any(axis)])
    directions = size * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    gravities = (level, *directions)
    gravity = max(gravities, key=lambda gravity: agreement(log, UNCHANGED, gravity))
    priors = replace(log.options.priors, gravity=WIDE_TILT)
    wide = replace(log.options, priors=priors)
    for _ in range(_TURNS):
        turned = with_gravity(robot, gravity)
        after = LogFit.of(turned, log.fit.recordings, wide, log.found)
        at = after.fit.at(TILT_NAMES)
        gravity = turn_gravity(gravity, after.fit.free[at])
        cosine = np.clip(level @ gravity / size**2, -1.0, 1.0)
        angle = float(np.degrees(np.arccos(cosine)))
        if angle < LEAST_TURN:
            return
    error = np.degrees(np.sqrt(np.max(np.diag(after.fit.inverse)[at])))
    numbers = " ".join(f"{value:.2f}" for value in gravity + 0.0)
    text = f"gravity acts {with_error(angle, error, 'degrees')} from the model's: the base is "
    text += "mounted otherwise, on a wall or a ceiling"
    remedy = (
        f'turn it in the model (MJCF: gravity="{numbers}" of <option>, or euler of the base\'s '
        "body; URDF: rpy of the first joint's origin)"
    )
    finding = Finding(Level.REFUSES, "tilt", text, remedy)
    gain, after = compare(log, after)
    yield Correction(finding, gain, replace(after, options=log.options))


# ---- torque scales


def common_scale(log: LogFit, divided: Array) -> Iterator[Correction]:
    """Yield the correction of all masses by one factor, if they are clearly ``ODD`` times off.

    Torques do not tell it from torques that are all scaled. Arguments are as in ``corrections``.
    """
    robot = log.fit.arm.robot
    factor = 1.0
    after = log
    for _ in range(_ROUNDS):
        estimate, error = common_factor(after.fit)
        factor *= estimate
        relative = error / estimate
        if abs(np.log(factor)) < max(np.log(ODD), SURE * relative):
            return
        scaled = with_mass_scale(robot, factor)
        after = LogFit.of(scaled, log.fit.recordings, log.options, log.found)
        if abs(np.log(estimate)) < np.log(ODD):
            break
    gain, after = compare(log, after)
    gain -= np.log(COMMON_RANGE / relative)
    yield Correction(common_finding(robot, factor, relative, divided), gain, after)


def common_finding(
    robot: RobotModel, factor: float, relative_error: float, divided: Array
) -> Finding:
    """Return the finding on torques that are a factor times those of the model's masses.

    Where there may be an arm with all masses so many times as large, the user decides.
    """
    number = with_error(factor, factor * relative_error)
    text = f"the torques are {number} times those of the model's masses, at all joints alike"
    unit = min(UNITS, key=lambda size: abs(np.log(factor / size)))
    is_close = abs(np.log(factor / unit)) < max(np.log(CLOSE), SURE * relative_error)
    unit_text = f" (as in {UNITS[unit]})" if is_close else ""
    texts = [f"{value:.4g}" for value in (unit if is_close else factor) * divided]
    numbers = texts if len({*texts}) > 1 else texts[:1]
    torque_scale = ("--torque-scale", ",".join(numbers))
    if mass_unit(robot, factor) != 1.0:
        remedy = f"they are in another unit{unit_text}: divide them"
        return Finding(Level.REFUSES, "torque-unit", text, remedy, (torque_scale,))
    if not is_close and abs(np.log(factor)) > np.log(FARTHEST):
        text += ": they may be motor currents"
        return Finding(
            Level.REFUSES, "torque-unit", text, WEIGHING, (torque_scale,), "payload"
        )
    remedy = (
        "torques cannot tell what is wrong by that much, the masses or the torques: if the torques "
        f"are N·m, multiply the masses; if the model is right{unit_text}, divide the torques"
    )
    mass_scale = ("--mass-scale", f"{factor * robot.mass_scale:.4g}")
    return Finding(
        Level.REFUSES, "torque-scale", text, remedy, (mass_scale, torque_scale)
    )


def wrong_scales(log: LogFit, divided: Array) -> Iterator[Correction]:
    """Yield the correction of torque scales of one per joint.

    Found by Gauss-Newton from the ratios of root mean square torques: torques are divided by the
    scales, and the fit of what results allows them wide errors. None where some loaded joint's
    torque does not follow its links, or all have one scale (``common_scale``).
    """
    arm = log.fit.arm
    scale = log.torque_ratio
    scale[~log.loaded] = np.median(scale[log.loaded])
    if not SMALLER < np.median(scale) < LARGER:
        scale *= signs_of(log)
    wide = replace(log.options, priors=replace(log.options.priors, scale=WIDE))
    # Links that explain the scales as they are would leave none to find.
    question = replace(log.fit.question, options=wide, link_scales=AS_STATED)
    point = arm.start()
    for _ in range(_ROUNDS):
        division = ColumnCorrection.of_factors(1.0 / scale, "torque")
        undone = corrected(log.fit.recordings, division)
        rows = log_rows(arm, undone, point, log.found)
        torque = rows.sums.rms_torque
        terms = [*arm_question(arm, question, torque), *log.found]
        ones = np.ones(len(scale))
        fitted = rows.fit(terms, replace(log.fit, noise=0.05 * torque), ones)
        at = fitted.at(names_of("scale", arm.joints))
        change = np.clip(1.0 + fitted.free[at], 0.2, 5.0)
        scale = scale * change
        point = fitted.next_point()
    covariance = fitted.inverse[np.ix_(at, at)] / np.outer(change, change)
    is_sure = np.sqrt(np.diag(covariance)) < KNOWN
    # The torque of the last joint is that of the last link alone, which is not known.
    is_sure[-1] &= log.loaded[-1]
    if not np.all(is_sure[log.loaded]):
        return
    sure = np.flatnonzero(is_sure)
    covariance = covariance[np.ix_(sure, sure)]
    precision = np.linalg.inv(covariance)
    own = np.log(np.abs(scale[sure]))
    scale[~is_sure] = np.exp(np.sum(precision @ own) / np.sum(precision))
    if np.ptp(own) < np.log(SAME) and np.all(scale > 0.0):
        return
    # Loss for scales that fit the data instead of being one: the prior's volume over that left.
    prior_covariance = COMMON_RANGE**2 + OWN_RANGE**2 * np.eye(len(own))
    penalty = np.linalg.slogdet(prior_covariance)[1] - np.linalg.slogdet(covariance)[1]
    penalty = 0.5 * (penalty + own @ np.linalg.solve(prior_covariance, own))
    division = ColumnCorrection.of_factors(1.0 / scale, "torque")
    undone = corrected(log.fit.recordings, division)
    after = LogFit.of(arm.robot, undone, log.options, log.found)
    gain, after = compare(log, after, np.log(np.abs(scale)))
    finding = scale_finding(log, scale, sure, divided)
    yield Correction(finding, gain - penalty, after)


def signs_of(log: LogFit) -> Array:
    """Return the sign (n,) with which torques follow their links: -1 where they clearly oppose.

    The last link may be any other one than the model's.
    """
    model = log.links_torque - np.mean(log.links_torque, axis=0)
    torque = log.rows.right_sides
    size = np.linalg.norm(model, axis=0) * np.linalg.norm(torque, axis=0)
    is_turned = log.loaded & (np.sum(model * torque, axis=0) < -0.5 * size)
    is_turned[-1] = False
    return np.where(is_turned, -1.0, 1.0)


def odd_unit_finding(log: LogFit) -> Finding | None:
    """Return the finding that one joint's torque has another unit than that of the other joints."""
    least = _LEAST_LOAD * np.max(log.model_torque)
    ratio = log.torque_ratio * log.model_torque / np.maximum(log.model_torque, least)
    if len(ratio) < 3:
        return None
    joint = np.argmax(ratio)
    typical = np.median(log.torque_ratio[log.loaded])
    factor = ratio[joint] / np.median(np.delete(ratio, joint))
    # A torque without gravity has a share of the model's at joints that carry weight.
    if factor < ODD_UNIT or typical < 0.6:
        return None
    name = log.fit.arm.joints[joint]
    unit = torque_unit(name in log.fit.arm.robot.slides)
    text = f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in m{unit}"
    remedy = f"put it right with --columns FILE: torque.{name} = 0.001 * TITLE"
    return Finding(Level.REFUSES, "torque-scale", text, remedy)


def scale_finding(
    log: LogFit, scale: Array, sure: NDArray[np.int64], divided: Array
) -> Finding:
    """Return the finding on torque scales (n,), of which those with indices ``sure`` are found."""
    names = log.fit.arm.robot.joint_names
    known = np.abs(scale[sure])
    typical = np.median(known)
    listed = ", ".join(f"{names[k]} {scale[k]:.3g}" for k in sure)
    text = f"torque reads {typical:.3g} times what the model takes ({listed}): "
    off = np.max(np.abs(np.log(known)))
    level = Level.DOUBTS if off > np.log(WARNED) else Level.SAYS
    level = Level.REFUSES if off > np.log(REFUSED) else level
    # No links, and no tool that an arm may carry, make all torques that small or large.
    is_foreign = np.all(known < SMALLER) or np.all(known > LARGER)
    check = "torque-unit" if is_foreign else "torque-scale"
    correction = None
    if np.any(scale < 0.0):
        correction = ColumnCorrection.of_factors(np.sign(scale), "torque")
        opposite = ", ".join(compress(names, scale < 0.0))
        text += f"of {opposite} with the opposite sign; "
    start = [f"{value:.4g}" for value in np.abs(scale) * divided]
    options = ("--torque-scale", ",".join(start))
    text += (
        "a factor of its own for every joint, as motor currents or per cent of rated "
    )
    text += "torque have, or all masses of the model are wrong"
    return Finding(level, check, text, WEIGHING, (options,), "payload", correction)

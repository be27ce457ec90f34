"""Discrete mistakes of a log: signs, exchanged joints, turned zeros, degrees, another mounting.

Each mistake is one step. Logs with steps undone are fitted to the model's links and friction on a
part of the same rows; the step that fits best is taken, and others are tried beside it, so that
signs of several joints are found one after the other. The log that results is solved whole.

Friction that drives a joint is a turned sign, of its position or of its torque, whatever the model.

Throughout, K is the number of rows, n that of joints. A torque scale is the ratio of recorded to
true torque.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, compress, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import ColumnCorrection, Finding
from robot_sysid.diagnosis.causes import beside
from robot_sysid.dynamics.friction import COULOMB
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimate.choose import common_factor, solved
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Equations, Fit, Problem, equations_of, solve
from robot_sysid.estimate.links import AS_STATED
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import LINKS, MOTORS, SCALES, ArmTerms
from robot_sysid.model.units import mass_unit, with_mass_scale
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE
from robot_sysid.records.messages import Level, torque_unit, with_error
from robot_sysid.records.usual_errors import GRAVITY_IN_FILE
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.wording import option_name, with_option_names

ODD = 1.3
"""Factor on all masses, or its inverse, above which it is refused."""
SMALLER = 1.0 / 3.0
"""Torque scale below which all joints' torques are in another unit, whatever the links: arms whose
links are off by 20 %, one of them by 40 %, measure at least 0.53 of the weight."""
LARGER = 5.0
"""Torque scale above which they are: the heaviest tool that an arm may carry, which its model
lacks, makes at least one joint's weight no larger than 3.4 times."""
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
    "give the torque per ampere with {torque_constants}, or determine it with a weight: bolt on "
    "1 kg (of another mass, state it), record a motion called weight, and compare"
)
"""What to do where torques are motor currents; the command that compares follows the message."""
# Quantities whose columns a mistake changes: as subject, with its verb, and as scope.
_QUANTITIES = (
    (("torque",), "torque", "has", " in the torques"),
    (("position",), "position", "has", " in the positions"),
    (("position", "torque"), "position and torque", "have", ""),
)
COLUMNS = "put the columns right with {columns FILE}"


@dataclass(frozen=True)
class Relabelling:
    """How a log has to be read otherwise: right columns are matrices, with one number per row and
    column, times recorded ones, plus angles.

    Attributes:
        position: (n, n) of positions.
        torque: (n, n) of torques.
        zeros: (n,) added to positions [rad].
        gravity: (3,) [m/s^2]; None for the model's.
    """

    position: Array
    torque: Array
    zeros: Array
    gravity: Array | None = None

    @classmethod
    def of(cls, n: int, steps: Sequence[Step] = ()) -> Relabelling:
        """Return the reading of the log of n joints with steps, one after the other."""
        reading = cls(np.eye(n), np.eye(n), np.zeros(n))
        for step in steps:
            right = step.reading
            reading = cls(
                right.position @ reading.position,
                right.torque @ reading.torque,
                right.position @ reading.zeros + right.zeros,
                reading.gravity if right.gravity is None else right.gravity,
            )
        return reading

    def apply(self, recording: FilteredRecording) -> FilteredRecording:
        """Return a recording read so, of which as many rows are used."""
        position = self.position.T
        rows = Rows(recording, slice(None))
        dry = rows.low_passed("coulomb", lambda motion: np.sign(motion.qd))
        # A joint's rows are those in which it moves.
        return recording.using(
            recording.used @ (position != 0.0),
            q=recording.q @ position + self.zeros,
            qd=recording.qd @ position,
            qdd=recording.qdd @ position,
            tau=recording.tau @ self.torque.T,
            touched=(),
            # The direction of friction is that of the speed.
            columns={"coulomb": dry @ np.sign(position)},
        )

    @property
    def columns(self) -> ColumnCorrection:
        """The correction of a log's columns; zeros and gravity are none."""
        return ColumnCorrection(*map(sources, (self.position, self.torque)))


def sources(matrix: Array) -> tuple[tuple[int, float], ...]:
    """Return (index, factor) of the only number of each row of a matrix (n, n) that is not zero."""
    indices = np.argmax(matrix != 0.0, axis=1)
    return tuple(zip(indices.tolist(), np.sum(matrix, axis=1).tolist()))


@dataclass(frozen=True)
class Step:
    """One mistake: the check that names it, in words, and how the log is read without it."""

    check: str
    text: str
    reading: Relabelling
    remedy: str = COLUMNS
    options: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Evidence:
    """What is known of a log beside its rows.

    Attributes:
        divided: (n,) torque scales by which the torques were divided already.
        time_share: by which time is too long, by recorded velocities; None where there are none.
        advance: is called after each round of a search.
    """

    divided: Array
    time_share: float | None
    advance: Callable[[], object]


@dataclass(frozen=True)
class Correction:
    """What is wrong, the gain of putting it right in log likelihood [nats], and the fit then."""

    findings: tuple[Finding, ...]
    gain: float
    fit: Fit


def steps(robot: RobotModel, moving: Sequence[int]) -> Iterator[Step]:
    """Yield every mistake that is tried.

    ``moving`` are the numbers of the joints that move: columns of a joint that stands still say
    nothing of whose they are.
    """
    names = robot.joint_names
    n = len(names)
    none = Relabelling.of(n)
    every = np.eye(n)

    def mirrored(across: Array) -> Array:
        """Return the matrix (n, n) that mirrors columns: it turns one, or exchanges two."""
        return every - 2.0 * np.outer(across, across) / (across @ across)

    for quantities, subject, verb, scope in _QUANTITIES:
        changes = []
        for joint in moving:
            text = f"the {subject} of joint {names[joint]} {verb} the opposite sign of the model's"
            changes.append(("sign", text, mirrored(every[joint])))
        if n > 1 and scope:
            text = (
                f"the {subject} of every joint {verb} the opposite sign of the model's"
            )
            changes.append(("sign", text, -every))
        for one, two in combinations(moving, 2):
            text = f"joints {names[one]} and {names[two]} are exchanged{scope}"
            changes.append(("order", text, mirrored(every[one] - every[two])))
        if n > 2 and len(moving) == n:
            text = f"the order of the joints is reversed{scope}"
            changes.append(("order", text, every[::-1]))
        for check, text, matrix in changes:
            changed = dict.fromkeys(quantities, matrix)
            yield Step(check, text, replace(none, **changed))
    radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    yield Step(
        "angle-unit",
        "positions look like degrees",
        replace(none, position=np.diag(radians)),
        "pass {units=deg}",
        (("--units", "deg"),),
    )
    yield Step(
        "angle-unit",
        "positions look like radians that were taken for degrees",
        replace(none, position=np.diag(1.0 / radians)),
        "say rad where degrees are said: in {units}, the file of {columns}, a column's title or "
        "the recorder",
    )
    for joint in moving:
        if not robot.is_slide[joint]:
            text = f"the position of joint {names[joint]} looks like degrees"
            scale = np.where(every[joint] == 1.0, np.pi / 180.0, 1.0)
            yield Step("angle-unit", text, replace(none, position=np.diag(scale)))
    for joint, degrees in product(moving, (90.0, -90.0, 180.0)):
        if not robot.is_slide[joint]:
            zeros = np.radians(degrees) * every[joint]
            yield Step("zero", "", replace(none, zeros=zeros))
    # Gravity along axes and diagonals.
    size = np.linalg.norm(gravity_vector(robot))
    for axis in product((-1.0, 0.0, 1.0), repeat=3):
        if size * any(axis):
            gravity = size * np.array(axis) / np.linalg.norm(axis)
            yield Step("tilt", "", replace(none, gravity=gravity))


def with_priors(question: Question, **priors: Any) -> Question:
    """Return a question with other priors."""
    options = question.options
    changed = replace(options, priors=replace(options.priors, **priors))
    return replace(question, options=changed)


class Search:
    """Compares readings of a log on a part of its rows.

    Args:
        fitted: the fit of the log.
    """

    def __init__(self, fitted: Fit) -> None:
        question = with_priors(fitted.question, friction=0.0)
        needed = []
        for key, term in fitted.arm.terms.items():
            if term.bodies or term.cause == MOTORS or key in question.friction:
                needed.append(term)
        self.arm = fitted.arm.of(needed)
        self.terms = arm_question(self.arm, question, fitted.sums.rms_torque)
        # 250 rows tell readings apart.
        every = max(1, sum(map(len, fitted.recordings)) // 250)
        self.recordings = [
            recording.using(recording.used[::every], every=every)
            for recording in fitted.recordings
        ]

    def score(self, steps: Sequence[Step]) -> float:
        """Return the log likelihood of the log with steps, but for a constant."""
        arm = self.arm
        reading = Relabelling.of(arm.robot.n_joints, steps)
        point = arm.start()
        if reading.gravity is not None:
            point = replace(point, gravity=reading.gravity)
        # Likelihoods need no blocks.
        sums = arm.sums([reading.apply(each) for each in self.recordings], point, False)
        torque = sums.rms_torque
        equations = equations_of(arm, sums, self.terms, {})
        # Smaller residuals do not count.
        least = 0.01 * np.sqrt(np.mean(torque**2))
        counts = sums.row_counts
        noise = np.maximum(0.05 * torque, least)
        # Noise that is found to the end follows a joint that other joints' errors were left to.
        for _ in range(2):
            normal = equations.normal(1.0 / noise)
            values, _ = solve(normal, equations.reference)
            crosses = equations.crossing(values)
            if np.any(crosses):
                start = np.where(crosses, equations.inside(values), equations.reference)
                values, _ = solve(normal, start, ~crosses)
            squares = equations.squared_residuals(values)
            noise = np.maximum(np.sqrt(squares / counts), least)
        return likelihood(equations, values, counts, noise)

    def best(self, tried: Sequence[Step], evidence: Evidence) -> list[Step]:
        """Return the steps that fit best together, one after the other; [] for none.

        The likeliest first steps are followed, as one that is wrong may fit as well alone.
        """
        zeros = [step for step in tried if step.check == "zero"]
        pairs = []
        # With another zero wrong as well, a right one alone may fit worse than none.
        for both in combinations(zeros, 2):
            pairs.append(
                Step("zero", "", Relabelling.of(self.arm.robot.n_joints, both))
            )
        before = self.score([])
        firsts = self._longer([], [*tried, *pairs])
        least = before + max(CLEAR, 0.5 * (firsts[0][0] - before))
        followed = 3
        ways = []
        for score, found in firsts[:followed]:
            # Largest number of steps that act together.
            while score > least and len(found) < 8:
                evidence.advance()
                after, longer = self._longer(found, tried)[0]
                if after < score + CLEAR:
                    break
                score = after
                found = longer
            if score > least:
                ways.append((score, found))
        likeliest = max(ways, default=(0.0,), key=lambda way: way[0])[0]
        return next((found for score, found in ways if score > likeliest - 1.0), [])

    def _longer(
        self, found: list[Step], tried: Sequence[Step]
    ) -> list[tuple[float, list[Step]]]:
        """Return (log likelihood, steps) with one more step each, the likeliest first."""
        ways = [[*found, step] for step in tried]
        scores = np.array([self.score(way) for way in ways])
        # Equally likely ones keep their order.
        order = np.argsort((np.max(scores) - scores) // 1.0, kind="stable")
        return [(scores[k], ways[k]) for k in order.tolist()]


# ---- what a fit says by itself


def model_torque(fitted: Fit) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return (root mean square torque (J,) of the model [N m], share (J,), loaded (J,)).

    It is that of the links' masses and first moments, as inertias may be placeholders, and
    of its inertias where there is no gravity. The share is that of it in the measured torque, by a
    regression. Loaded are hinges whose links make more than
    a tenth of the torque of the most loaded one: the force of a slide is in another unit, and
    exceeds the torques of an arm that it carries.
    """
    arm = fitted.arm
    sums = fitted.sums
    of_links = "mh" if arm.has_gravity else "mhI"
    values = [arm.model.get(n, 0.0) * (n[0] in of_links) for n in sums.names]
    model = np.array([*values, 0.0])
    squares = np.maximum(sums.squares_of(model, sums.totals), 1e-24)
    pairs = zip(sums.columns, sums.totals)
    products = np.array([model[at] @ total[:, -1] for at, total in pairs])
    torque = np.sqrt(squares / sums.row_counts)
    is_slide = arm.robot.is_slide[arm.indices]
    is_compared = ~is_slide | np.all(is_slide)
    is_loaded = is_compared & (torque > 0.1 * np.max(torque[is_compared]))
    return torque, products / squares, is_loaded


def typical_ratio(fitted: Fit) -> float:
    """Return the median ratio of measured torque to the model's at joints that links load."""
    torque, _, is_loaded = model_torque(fitted)
    ratio = fitted.sums.rms_torque / torque
    return float(np.median(ratio[is_loaded])) if np.any(is_loaded) else 1.0


def is_foreign(fitted: Fit) -> bool:
    """Return whether torques are so small or large that no links, nor a tool, make them."""
    return not SMALLER < typical_ratio(fitted) < LARGER


def dry_friction(fitted: Fit) -> tuple[Array, Array]:
    """Return Coulomb friction (J,) without its bound and its standard error [N m].

    That of a joint that stands still is zero, its error infinite.
    """
    values, inverse = fitted.unbounded
    known = dict(zip(fitted.names, zip(values, np.diag(inverse))))
    names = map(COULOMB.key_of, fitted.arm.joints)
    dry, variance = np.transpose([known.get(name, (0.0, np.inf)) for name in names])
    return dry, np.sqrt(np.maximum(variance, 0.0))


def fits(fitted: Fit) -> bool:
    """Return whether a log fits its model so well that its columns are right."""
    touched = any(recording.touched for recording in fitted.recordings)
    return bool(
        fitted.unexplained_share < LITTLE
        and not is_foreign(fitted)
        and is_plausible(fitted)
        and not drives(fitted)
        and not touched
    )


def drives(fitted: Fit) -> bool:
    """Return whether friction drives a joint: a turned sign, whatever the model."""
    dry, error = dry_friction(fitted)
    return bool(np.any(dry < -SURE * error))


def last_mass(fitted: Fit) -> tuple[float, float]:
    """Return the last link's mass and its standard error [kg]."""
    return fitted.free[fitted.names.index("m")], fitted.error_of("m")


def is_plausible(fitted: Fit) -> bool:
    """Return whether the last link's mass is that of a link, and the others are near the model's.

    The mass has to lie, within ``SURE`` standard errors, between zero and the larger of two limits:
    60 % of the arm's mass, and the model's mass plus 30 % of the arm's.
    """
    robot = fitted.arm.robot
    largest = max(0.6 * robot.mass, robot.prior.mass + 0.3 * robot.mass)
    mass, error = last_mass(fitted)
    is_possible = -SURE * error < mass < largest + SURE * error
    for term, span in fitted.equations.spans:
        if term.cause == LINKS and term.prior is not None:
            values = np.append(fitted.free[span], -1.0)
            count = len(term.names)
            # Four deviations of chi-square beyond its mean: no log of the right model is there.
            largest = count + 4.0 * np.sqrt(2.0 * count)
            is_possible &= np.sum((term.prior.rows @ values) ** 2) < largest
    return bool(is_possible)


# ---- corrections


def likelihood(
    equations: Equations, values: Array, independent: Array, noise: Array
) -> float:
    """Return the log likelihood of values and of their priors, but for a constant.

    Args:
        equations: of the values.
        values: (k,) that solve them.
        independent: (J,) number of independent rows.
        noise: (J,) of the residuals [N m].
    """
    change = np.append(values, -1.0)
    pull = change @ equations.prior @ change
    return -float(independent @ np.log(noise) + 0.5 * pull)


def likelier(before: Fit, after: Fit, factors: Array | float = 1.0) -> float:
    """Return by how much the second of two fits of one log, read otherwise, is likelier [nats].

    Both have the noise of their own residuals and the memory of the second's. ``factors`` (J,) are
    those by which its torques were multiplied.
    """
    counts = np.minimum(
        np.sum(before.sums.counts, axis=0), np.sum(after.sums.counts, axis=0)
    )
    independent = counts / np.minimum(before.correlation, after.correlation)
    least = 1e-3 * np.sqrt(np.mean(before.sums.rms_torque**2))
    noise = np.maximum(before.noise, least)
    earlier = likelihood(before.equations, before.free, independent, noise)
    noise = np.maximum(after.noise / np.abs(factors), least)
    return likelihood(after.equations, after.free, independent, noise) - earlier


def read(fitted: Fit, reading: Relabelling, **priors: float) -> Fit:
    """Return the fit of a log that is read otherwise, some priors of its question changed."""
    robot = fitted.arm.robot
    if reading.gravity is not None:
        robot = with_gravity(robot, reading.gravity)
    recordings = [reading.apply(recording) for recording in fitted.recordings]
    question = with_priors(fitted.question, **priors)
    return solved(robot, recordings, question, beside=beside)


def discrete(fitted: Fit, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of the mistakes that fit best together, if there are any.

    They are the first ones with which the whole log fits.
    """
    robot = fitted.arm.robot
    moves = np.any(fitted.sums.counts, axis=0)
    moving = fitted.arm.indices[moves].tolist()
    found = Search(fitted).best([*steps(robot, moving)], evidence)
    after = fitted
    findings: list[Finding] = []
    for number in range(1, len(found) + 1):
        reading = Relabelling.of(robot.n_joints, found[:number])
        findings = [*of_columns(robot, found[:number], reading)]
        if reading.gravity is None:
            after = read(fitted, reading)
        else:
            after, turned = mounted(fitted, reading, reading.gravity)
            findings += turned
        if fits(after):
            break
    if findings:
        yield Correction(tuple(findings), likelier(fitted, after), after)


def of_columns(
    robot: RobotModel, found: Sequence[Step], reading: Relabelling
) -> Iterator[Finding]:
    """Yield the findings on columns, which one reading puts right, and on zeros."""
    wrong = [step for step in found if step.text]
    if wrong:
        first = wrong[0]
        yield Finding(
            Level.REFUSES,
            first.check,
            "; ".join(dict.fromkeys(step.text for step in wrong)),
            with_option_names(first.remedy),
            first.options if len(wrong) == 1 else (),
            correction=reading.columns,
        )
    turned = np.rint(np.degrees(reading.zeros)) % 360.0
    for name, degrees in zip(robot.joint_names, turned):
        if degrees:
            way = "little" if degrees <= 180.0 else "much"
            size = min(degrees, 360.0 - degrees)
            text = f"the position of joint {name} reads {size:.0f} degrees too {way}"
            remedy = "correct the joint's zero"
            if name == robot.joint_names[0] and robot.gravity is not None:
                # About an upright axis, a base that is turned is the same.
                remedy += f", or the direction of {option_name('gravity')}"
            yield Finding(Level.REFUSES, "zero", text, remedy)


def mounted(
    fitted: Fit, reading: Relabelling, gravity: Array
) -> tuple[Fit, list[Finding]]:
    """Return the fit of an arm whose base is mounted otherwise, and the finding, if it is.

    From one direction on, gravity (3,) is turned until the fit, which allows it a wide tilt, agrees
    with it.
    """
    for _ in range(2):
        # The 26 directions are at most some 27 degrees from the true one, usually half as much.
        after = read(fitted, replace(reading, gravity=gravity), gravity=15.0)
        at = after.at(TILT_NAMES)
        gravity = turn_gravity(gravity, after.free[at])
    level = gravity_vector(fitted.arm.robot)
    cosine = np.clip(level @ gravity / (level @ level), -1.0, 1.0)
    angle = float(np.degrees(np.arccos(cosine)))
    error = np.degrees(np.sqrt(np.max(np.diag(after.inverse)[at])))
    direction = gravity / np.linalg.norm(gravity)
    largest = np.argmax(np.abs(direction))
    axis = np.eye(3)[largest] * np.sign(direction[largest])
    off = np.degrees(np.arccos(min(direction @ axis, 1.0)))
    # Arms are mounted along an axis, but for what the fit of a file turns gravity by.
    if off < max(INTERVAL * error, GRAVITY_IN_FILE):
        direction = axis
    numbers = [f"{value:.4g}" for value in np.round(direction, 3) + 0.0]
    finding = Finding(
        Level.REFUSES,
        "tilt",
        f"gravity acts {with_error(angle, error, 'degrees')} from the model's: the base is mounted "
        "otherwise, on a wall or a ceiling",
        f"state the direction of gravity ({', '.join(numbers)}) with {option_name('gravity')}",
        (("--gravity", *numbers),),
    )
    # A base that is less tilted is mounted as the model says.
    return after, [finding] if angle > 5.0 else []


# ---- torque scales


def common_scale(fitted: Fit, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of all masses by one factor, if they are clearly ``ODD`` times off.

    Torques do not tell it from torques that are all scaled.
    """
    robot = fitted.arm.robot
    factor = 1.0
    after = fitted
    for _ in range(4):
        found = clear_factor(after, factor)
        if found is None:
            return
        estimate, relative = found
        factor *= estimate
        scaled = with_mass_scale(robot, factor)
        after = solved(scaled, fitted.recordings, fitted.question, beside=beside)
        if abs(np.log(estimate)) < np.log(ODD):
            break
    finding = common_finding(robot, factor, relative, evidence)
    yield Correction((finding,), likelier(fitted, after), after)


def torque_scale(scales: Array) -> tuple[str, str]:
    """Return the option that divides torques by scales (n,), one number where they are alike."""
    texts = [f"{value:.4g}" for value in scales]
    return "--torque-scale", ",".join(texts if len({*texts}) > 1 else texts[:1])


def clear_factor(fitted: Fit, before: float = 1.0) -> tuple[float, float] | None:
    """Return (factor on all masses, its relative error); None if it is not clearly ``ODD``.

    ``before`` is that by which the model's masses were multiplied already.
    """
    estimate, error = common_factor(fitted)
    # Coarse or seldom positions make all columns wrong by the share of their accelerations.
    coarse = max(each.acceleration_error for each in fitted.recordings)
    relative = float(np.hypot(error / estimate, coarse))
    size = abs(np.log(before * estimate))
    if size < max(np.log(ODD), INTERVAL * relative):
        return None
    # What single blocks show may be something else.
    blocks = fitted.sums.blocks
    alone = [np.log(common_factor(fitted, [block])[0]) for block in blocks]
    relative = max(relative, float(np.sqrt((len(blocks) - 1.0) * np.var(alone))))
    return None if size < INTERVAL * relative else (estimate, relative)


def common_finding(
    robot: RobotModel, factor: float, relative_error: float, evidence: Evidence
) -> Finding:
    """Return the finding on torques that are a factor times those of the model's masses.

    Where there may be an arm with all masses so many times as large, the user decides.
    """
    number = with_error(factor, factor * relative_error)
    text = f"the torques are {number} times those of the model's masses, at all joints alike"
    unit = min(UNITS, key=lambda size: abs(np.log(factor / size)))
    # Masses that are a little off stand between the factor and that of its unit.
    is_close = abs(np.log(factor / unit)) < max(np.log(1.25), INTERVAL * relative_error)
    unit_text = f" (as in {UNITS[unit]})" if is_close else ""
    options: tuple[tuple[str, str], ...]
    options = (torque_scale((unit if is_close else factor) * evidence.divided),)
    check = "torque-unit"
    command = ""
    if mass_unit(robot, factor) != 1.0:
        remedy = f"they are in another unit{unit_text}: divide them"
    # No arm has all masses off by more.
    elif not is_close and abs(np.log(factor)) > np.log(5.0):
        text += ": they may be motor currents"
        remedy = with_option_names(WEIGHING)
        command = "payload"
    else:
        check = "torque-scale"
        remedy = (
            "torques cannot tell what is wrong by that much, the masses or the torques: if the "
            f"torques are N·m, multiply the masses; if the model is right{unit_text}, divide the "
            "torques"
        )
        options = (("--mass-scale", f"{factor * robot.mass_scale:.4g}"), *options)
    return Finding(Level.REFUSES, check, text, remedy, options, command)


def own_scales(fitted: Fit, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of torque scales of one per joint.

    Found by Gauss-Newton from the ratios of root mean square torques: torques are divided by the
    scales, and the fit of what results allows them wide errors. Signs are found with them in
    torques of another unit, in which a turned one alone explains nothing. None where some loaded
    joint's torque does not follow its links, or all have one scale (``common_scale``).
    """
    arm = fitted.arm
    torque, share, is_loaded = model_torque(fitted)
    scale = fitted.sums.rms_torque / torque
    scale[~is_loaded] = np.median(scale[is_loaded])
    opposes = is_loaded & (share * torque < -0.5 * fitted.sums.rms_torque)
    signs = np.where(opposes & is_foreign(fitted), -1.0, 1.0)
    # In one round, a scale may change by 70 %.
    # Links that explain the scales as they are would leave none to find.
    question = with_priors(replace(fitted.question, link_scales=AS_STATED), scale=70.0)
    sums = arm.sums(fitted.recordings, arm.start())
    for _ in range(4):
        scaled = sums.with_torque_times(signs / scale)
        problem = Problem(arm, fitted.recordings, arm.start(), scaled, question)
        terms = arm_question(arm, question, scaled.rms_torque)
        after = problem.fit(terms, possible=False)
        at = after.at(arm.terms[SCALES].names)
        change = np.clip(1.0 + after.free[at], 0.2, 5.0)
        scale = scale * change
    relative = np.sqrt(np.diag(after.inverse)[at]) / change
    # Others are not identified.
    is_sure = relative < 0.4
    # The torque of the last joint is that of the last link alone, which is not known.
    is_sure[-1] &= is_loaded[-1]
    if not np.all(is_sure[is_loaded]):
        return
    own = np.log(scale[is_sure])
    scale[~is_sure] = np.exp(np.average(own, weights=relative[is_sure] ** -2.0))
    # Scales that are so alike have one common cause.
    if np.ptp(own) < np.log(1.35):
        return
    after = read(fitted, with_factors(arm, signs / scale))
    # Loss for scales that fit the data instead of being one: the prior's volume over that left. The
    # logarithm of a joint's scale over the common one has a standard deviation of 0.4.
    penalty = np.sum(np.log(0.4 / relative[is_sure]))
    finding = scale_finding(fitted, signs * scale, np.flatnonzero(is_sure), evidence)
    gain = likelier(fitted, after, 1.0 / scale) - penalty
    yield Correction((finding,), float(gain), after)


def with_factors(arm: ArmTerms, factors: Array) -> Relabelling:
    """Return the reading in which torques (J,) are multiplied by factors."""
    torque = np.ones(arm.robot.n_joints)
    torque[arm.indices] = factors
    return replace(Relabelling.of(len(torque)), torque=np.diag(torque))


def scale_finding(
    fitted: Fit, scale: Array, sure: NDArray[np.int64], evidence: Evidence
) -> Finding:
    """Return the finding on torque scales (J,), of which those with indices ``sure`` are found.

    A scale is negative where the torque has the opposite sign of the model's.
    """
    names = fitted.arm.joints
    known = np.abs(scale[sure])
    listed = ", ".join(f"{names[k]} {scale[k]:.3g}" for k in sure)
    # No sensor is that far off.
    is_sensor = np.max(np.abs(np.log(known))) <= np.log(1.6)
    # No links, and no tool that an arm may carry, make all torques that small or large.
    is_unit = np.all(known < SMALLER) or np.all(known > LARGER)
    opposite = ", ".join(compress(names, scale < 0.0))
    signs = f"of {opposite} with the opposite sign; " if opposite else ""
    return Finding(
        Level.DOUBTS if is_sensor else Level.REFUSES,
        "torque-unit" if is_unit else "torque-scale",
        f"torque reads {np.median(known):.3g} times what the model takes ({listed}): {signs}a "
        "factor of its own for every joint, as motor currents or per cent of rated torque have, or "
        "all masses of the model are wrong",
        with_option_names(WEIGHING),
        (torque_scale(np.abs(scale) * evidence.divided),),
        "payload",
        with_factors(fitted.arm, np.sign(scale)).columns if opposite else None,
    )


def odd_unit(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that one joint's torque has another unit than that of the other joints.

    Dry friction counts beside the torque: links hardly load some joints, but no joint has so much
    more friction than the others.
    """
    torque, *_ = model_torque(fitted)
    if len(torque) < 3:
        return
    # Friction makes most of the torque of a joint that has less than this of the model's.
    least = 0.03 * np.max(torque)
    ratio = fitted.sums.rms_torque / np.maximum(torque, least)
    joint = int(np.argmax(ratio))
    factor = ratio[joint] / max(np.median(np.delete(ratio, joint)), 1e-9)
    dry, _ = dry_friction(fitted)
    friction = dry / np.median(np.maximum(np.delete(dry, joint), 1e-9))
    # Neither links nor gears make one joint so different from the others.
    if min(factor, friction[joint]) > 10.0:
        scales = np.ones(fitted.arm.robot.n_joints)
        scales[fitted.arm.indices[joint]] = 1e-3
        reading = replace(Relabelling.of(len(scales)), torque=np.diag(scales))
        after = read(fitted, reading).unexplained_share
        if after > 0.7 * fitted.unexplained_share:
            return
        name = fitted.arm.joints[joint]
        unit = torque_unit(name in fitted.arm.robot.slides)
        text = f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in "
        text += f"m{unit}"
        columns = option_name("columns", "FILE")
        remedy = f"put it right with {columns}: torque.{name} = 0.001 * TITLE"
        yield Finding(Level.REFUSES, "torque-scale", text, remedy)

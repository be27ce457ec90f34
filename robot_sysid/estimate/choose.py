"""What the data decides about a question: motors that turn several joints, and links' priors.

Both are decided by the marginal likelihood: held-out torques show neither confounded links nor, in
a short log, a coupled motor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import (
    POLYNOMIAL,
    VISCOUS,
    Coupling,
    stated_top,
    top_speeds,
)
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.estimate.contacts import without_contacts, without_turns
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.equations.memory import free_memory, refuse_too_much
from robot_sysid.estimate.fit import Fit, LeftOut, Problem, correlation_times
from robot_sysid.estimate.links import (
    AS_STATED,
    CENTRE,
    FAR_OFF_CENTRE,
    MASS,
    ODD,
    CentreOff,
    LinkEvidence,
    OddNumber,
    average_scales,
    centre_off,
    common_error,
    common_scale,
    is_odd_alone,
    likely_mistakes,
    link_directions,
    log_evidence,
    odd_mass,
    reference_links,
    stated_kinds,
)
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.questions import LEAST_DRY, PER_CENT, Question, arm_question
from robot_sysid.estimate.rows import BLOCKS, row_chunks
from robot_sysid.estimate.terms import (
    LINKS,
    ZEROS,
    ArmTerms,
    Point,
    Term,
    independent,
    stated_speeds,
)
from robot_sysid.model.chain import shared_motors
from robot_sysid.model.mistakes import (
    MISTAKEN,
    Mistake,
    least_gains,
    mistake_shifts,
    without_mistakes,
)
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.levels import CLEAR, SURE, UNEXPLAINED
from robot_sysid.records.messages import Progress
from robot_sysid.records.parameters import ZERO
from robot_sysid.signals.process import FilteredRecording

MOST_OF_ZERO = SURE * 1e-3 * usual_errors.WRONG_ZERO
"""Zero from which on it stands for something else, such as wrong links: one that is really so far
off leaves torque that centres of mass do not take up [rad]."""
ODD_ZERO = 2.5
"""Least gain in the log evidence at which a joint's zero is taken to be far more off than usual, as
for a link's mass (``links.ODD``): right logs gain far less, and a wrong zero of a shoulder, of
which centres of mass hide most, more."""
SUMS_AT_ONCE = 4.0
"""Memory that a question takes over that of its sums, some of which stand beside new ones."""
# Shows nothing.
_SILENT = Progress()
# What is shown of the way to an answer.
_LABEL = "Solving the equations"


@dataclass(frozen=True)
class Start:
    """What a fit begins with, and sizes the priors of its terms by.

    Attributes:
        torque: (J,) root mean square of each joint's torque [N m].
        noise, correlation: (J,) of its rows, as ``Problem.fit`` takes them; None for none.
    """

    torque: Array
    noise: Array | None = None
    correlation: Array | None = None

    def fit(self, problem: Problem) -> Fit:
        """Return the fit of a problem's question, whose bodies need not be possible ones."""
        terms = arm_question(problem.arm, problem.question, self.torque)
        return problem.fit(terms, None, self.noise, self.correlation, possible=False)


def solve_question(
    robot: RobotModel,
    recordings: Sequence[FilteredRecording],
    question: Question,
    progress: Progress = _SILENT,
    beside: Callable[[Fit], Sequence[Term]] | None = None,
) -> Fit:
    """Return the fit of a question with all that the data decides about it.

    Each round solves the question with what the residuals of the fit before say of noise and dry
    friction, then linearises the torque anew at what was found.

    Args:
        robot: the arm with its model.
        recordings: the recordings.
        question: what is asked of them.
        progress: is advanced after every pass over the rows and every fit.
        beside: returns terms whose columns stand beside those of the question, to judge its logs:
            bodies may then be impossible; None for none.

    Raises:
        InputError: no joint moves fast enough for its equations to be used.
    """
    speeds = speeds_in(recordings)
    stated, offered = motors_of(robot, question.options.torques, speeds)
    # Torque scales multiply a payload: it takes one round more. Each round has a pass for residuals
    # and one for sums, which begin with a pass.
    n_rounds = 3 if question.loaded else 2
    n_steps = 1 + 2 * n_rounds
    progress.advance(_LABEL, 0, n_steps, "")
    arm = arm_of(robot, question, speeds, stated, offered)
    start, current = first_fit(arm, recordings, question)
    # The first fit knows no friction whose drift it could tell from what sticks at turns.
    n_unjudged = 1 if question.loaded else 0
    chosen: list[Coupling] = []
    further: Sequence[Term] = ()
    for number in range(n_rounds):
        progress.advance(_LABEL, 2 * number + 1, n_steps, "")
        start = replace(
            start,
            noise=current.noise,
            correlation=correlation_times(current.split(current.residuals)),
        )
        current = start.fit(
            problem_from_residuals(replace(current, arm=arm), number == n_unjudged)
        )
        progress.advance(_LABEL, 2 * number + 2, n_steps, "")
        is_last = number + 1 == n_rounds
        if beside is not None and is_last:
            further = beside(current)
            arm = arm.beside(further)
        point = current.next_point()
        kept = current.recordings, current.question
        # Sums of a long arm are large: the old ones go before the new ones come.
        del current
        current = start.fit(problem_at(arm, point, *kept, in_blocks=is_last))
        if number == n_unjudged and offered:
            # Dry friction that turns round reads as a motor in sums of the rows near turns.
            chosen = choose_motors(current, offered)
            arm = arm_of(robot, question, speeds, (*stated, *chosen))
            current = start.fit(replace(current, arm=arm)) if chosen else current
    while chosen:
        # What the fits before did not know yet may have looked like a motor.
        asked = arm_of(robot, question, speeds, stated, chosen).beside(further)
        shown = choose_motors(start.fit(replace(current, arm=asked)), chosen)
        if len(shown) == len(chosen):
            break
        chosen = shown
        arm = arm_of(robot, question, speeds, (*stated, *chosen)).beside(further)
        current = start.fit(replace(current, arm=arm))
    # A log is judged by what is free: bodies are possible in its answer.
    current = with_links_of(current, start.torque, possible=beside is None)
    progress.advance(_LABEL, n_steps, n_steps, "")
    return current


def arm_of(
    robot: RobotModel,
    question: Question,
    speeds: Array,
    motors: Sequence[Coupling],
    offered: Sequence[Coupling] = (),
) -> ArmTerms:
    """Return all terms of the arm with some motors, and with columns of others.

    ``speeds`` (K, n) are the joints' velocities in the recordings.
    """
    return ArmTerms(
        robot,
        question.options.torques,
        motors,
        question.options.friction,
        question.loaded,
        fastest_of(speeds, np.eye(robot.n_joints)),
        offered,
    )


def problem_at(
    arm: ArmTerms,
    point: Point,
    recordings: Sequence[FilteredRecording],
    question: Question,
    in_blocks: bool,
) -> Problem:
    """Return a question to recordings, linearised at a point."""
    sums = arm.sums(recordings, point, in_blocks)
    return Problem(arm, tuple(recordings), point, sums, question)


def first_fit(
    arm: ArmTerms, recordings: Sequence[FilteredRecording], question: Question
) -> tuple[Start, Fit]:
    """Return what all fits of a question start from, and its fit without contacts at the model."""
    refuse_too_much(memory_of(arm, recordings[0]), free_memory(), len(arm.joints))
    first = replace(question, is_first=True)
    problem = problem_at(arm, arm.start(), recordings, first, in_blocks=True)
    start = Start(problem.sums.rms_torque)
    return start, without_contacts(start.fit(problem))


def memory_of(arm: ArmTerms, recording: FilteredRecording) -> float:
    """Return the memory that a question to an arm takes [bytes], of which sums are nearly all.

    A joint's sums are of the columns that its first rows have.
    """
    width = (len(arm.names) + 1) * len(arm.joints)
    rows, _ = arm.equations(next(row_chunks(recording, width)), arm.start())
    columns = np.sum(np.any(rows, axis=0), axis=1)
    return SUMS_AT_ONCE * rows.itemsize * 2.0 * BLOCKS * float(np.sum(columns**2))


def problem_from_residuals(fitted: Fit, judges_turns: bool) -> Problem:
    """Return the question of a fit with the dry friction that it found.

    Rows are left out in which a joint sticks at its turn, once, by a fit that ``judges_turns``.
    """
    question = replace(fitted.question, dry=dry_friction(fitted), is_first=False)
    recordings = tuple(without_turns(fitted)) if judges_turns else fitted.recordings
    return Problem(fitted.arm, recordings, fitted.point, fitted.sums, question)


def answer_of(fitted: Fit) -> Fit:
    """Return the fit of a question from that by which its logs were judged.

    Offsets of torque sensors are then as small as they usually are, and what the data decides of
    the links follows from that; one of them may be far more off than the others, or all torques by
    one factor. (A log is judged without that: a link that is far off would take up what is wrong
    with a joint's torque.)
    """
    question = replace(
        fitted.question,
        usual_offsets=True,
        link_scales=AS_STATED,
        common_scale=0.0,
        mistakes=(),
        doubtful=(),
    )
    plain = answer = answer_to(fitted, question)
    while (zero := odd_zero(answer)) is not None:
        question = replace(question, odd_zeros=(*question.odd_zeros, zero))
        answer = answer_to(fitted, question)
    off = [abs(answer.by_name[zero]) for zero in question.odd_zeros]
    return plain if max(off, default=0.0) > MOST_OF_ZERO else answer


def answer_to(fitted: Fit, question: Question) -> Fit:
    """Return the fit of another question, with what the data decides of the links."""
    torque = fitted.sums.rms_torque
    terms = arm_question(fitted.arm, question, torque)
    answer = replace(fitted, question=question).refit(terms)
    mistakes, doubtful = shown_mistakes(answer)
    while mistakes:
        question = replace(question, mistakes=(*question.mistakes, *mistakes))
        terms = arm_question(fitted.arm, question, torque)
        answer = replace(answer, question=question).refit(terms)
        mistakes, doubtful = shown_mistakes(answer)
    answer = replace(answer, question=replace(question, doubtful=doubtful))
    odd = odd_link(answer)
    answer = with_links_of(answer, torque, odd)
    if odd is None and (odd := odd_centre(answer)) is not None:
        answer = with_links_of(answer, torque, odd)
    return answer


def odd_zero(fitted: Fit) -> str | None:
    """Return the name of the zero that is far more off than usual, beside known ones; or None.

    Centres of mass of the links that a joint carries take up most of a wrong zero, so that no
    torque is left that would name it; held at the usual zero, they are many of their errors off. A
    tilt of the base is the simpler cause where it explains as much. A log that does not fit shows
    nothing of that, nor one of an arm whose model states no centres of mass.
    """
    question = fitted.question
    spans = [s for t, s in fitted.equations.spans if t.cause == ZEROS]
    if is_weighed_or_compared(question) or not spans or not fitted.arm.others:
        return None
    if fitted.unexplained_share > UNEXPLAINED or fitted.arm.robot.lacks_masses:
        return None
    offers = Offers(fitted)
    size = 1e-3 * np.array([[usual_errors.WRONG_ZERO]])
    slides = map(ZERO.key_of, fitted.arm.robot.slides)
    names = {*fitted.arm.terms[ZEROS].names} - {*slides, *question.odd_zeros}
    every = [offers.offer(Effect((name,), size)) for name in sorted(names)]
    best = max(every, default=None, key=lambda each: each.gain)
    if best is None or best.gain < ODD_ZERO:
        return None
    tilt = np.radians(usual_errors.WRONG_GRAVITY) * np.eye(len(TILT_NAMES))
    simpler = (
        offers.offer(Effect(TILT_NAMES, tilt)).gain
        if TILT_NAMES[0] in fitted.names
        else 0.0
    )
    weighed = offers.weigh(best.effect)
    is_odd = min(best.gain - max(simpler, 0.0), weighed.gain) > ODD_ZERO
    return best.effect.names[0] if is_odd and weighed.distance > SURE else None


def shown_mistakes(fitted: Fit) -> tuple[tuple[Mistake, ...], tuple[Mistake, ...]]:
    """Return the mistakes of the model in its links, beside known ones, that a log shows.

    They are (those that are there, one or two that are found at once; those that may be there). The
    former explain more than the mass of one link that is far off, or an error that all masses
    share, less what each has to gain at least to be taken for there. A log that does not fit shows
    none.
    """
    question = fitted.question
    information = (
        None if is_weighed_or_compared(question) else links_information(fitted)
    )
    if information is None or fitted.unexplained_share > UNEXPLAINED:
        return (), ()
    robot = without_mistakes(fitted.arm.robot, question.mistakes)
    known = {number for mistake in question.mistakes for number in mistake.links}
    likely = [
        mistakes
        for mistakes in likely_mistakes(
            robot, fitted.arm.others, link_share(fitted), *information
        )
        if all(known.isdisjoint(mistake.links) for mistake in mistakes)
    ]
    if not likely:
        return (), ()
    before = evidence_of(fitted, robot, information)
    stated = log_evidence(before)
    gains = []
    for mistakes in likely:
        mended = without_mistakes(robot, mistakes)
        gains.append(log_evidence(evidence_of(fitted, mended, information)) - stated)
    counts = np.array([len(mistakes) for mistakes in likely])
    # By one level for all kinds: a rare one that is not sure stands for no common one either.
    best = int(np.argmax(gains - MISTAKEN * counts))
    least = np.array([least_gains(mistakes) for mistakes in likely])
    simpler = [log_evidence(each) - stated for each in before.with_simple_errors()]
    if gains[best] - least[best, 1] > max(0.0, max(simpler) - ODD):
        return likely[best], ()
    is_doubtful = gains - least[:, 0] > max(0.0, *simpler)
    doubtful = [likely[place] for place in np.flatnonzero(is_doubtful)]
    return (), tuple(dict.fromkeys(chain.from_iterable(doubtful)))


def is_weighed_or_compared(question: Question) -> bool:
    """Return whether a payload or a change is asked for, and no link of the model."""
    is_compared = question.changed is not None or question.differing is not None
    return question.loaded or is_compared


def odd_link(fitted: Fit) -> OddNumber | None:
    """Return the mass of a link that is far more off than others'; or None."""
    evidence = link_evidence(fitted)
    number = None if evidence is None else odd_mass(evidence)
    return None if number is None else OddNumber(fitted.arm.others[number], MASS)


def centre_off_model(fitted: Fit, link: int) -> CentreOff:
    """Return how far a fit has the centre of mass of a link, by its number in the arm, off."""
    places = fitted.at(fitted.arm.links[link])
    covariance = fitted.covariance[np.ix_(places, places)]
    robot = without_mistakes(fitted.arm.robot, fitted.question.mistakes)
    reference = robot.links[link].reference
    return centre_off(fitted.values[places], covariance, reference[1:4] / reference[0])


def odd_centre(fitted: Fit) -> OddNumber | None:
    """Return the centre of mass that is far more off than those of links are; or None.

    A log that does not fit shows none, and a zero that is far off moves those of all links behind
    it.
    """
    question = fitted.question
    if is_weighed_or_compared(question) or question.odd_zeros:
        return None
    is_estimated = any(term.cause == LINKS for term in fitted.equations.terms)
    if fitted.unexplained_share > UNEXPLAINED or not is_estimated:
        return None
    shares: dict[int, float] = {}
    for number in fitted.arm.others:
        link = fitted.arm.robot.links[number]
        if CENTRE not in link.placeholders:
            shares[number] = centre_off_model(fitted, number).sure / link.size
    most = max(shares, key=lambda number: shares[number], default=None)
    if most is None or shares[most] < FAR_OFF_CENTRE:
        return None
    return OddNumber(most, CENTRE)


def has_odd_link_alone(fitted: Fit) -> bool:
    """Return whether one link's mass explains clearly more than a factor on all torques."""
    evidence = link_evidence(fitted)
    return evidence is not None and is_odd_alone(evidence)


def with_links_of(
    fitted: Fit, torque: Array, odd: OddNumber | None = None, possible: bool = True
) -> Fit:
    """Return the fit with the priors of links that the data asks for.

    Args:
        fitted: the fit.
        torque: (J,) root mean square of each joint's torque that sizes the priors [N m].
        odd: number of the model that is far more off than others; None for none.
        possible: whether bodies have to be possible ones.
    """
    question = replace(fitted.question, odd_number=odd)
    evidence = link_evidence(fitted, odd)
    if evidence is not None:
        # A log that does not fit shows nothing of all masses.
        is_shown = fitted.unexplained_share < UNEXPLAINED
        if is_shown and question.usual_offsets and question.asks_common_scale:
            common = common_scale(evidence)
            question = replace(question, common_scale=common)
            evidence = evidence.with_common(common)
        question = replace(question, link_scales=average_scales(evidence))
    terms = arm_question(fitted.arm, question, torque)
    after = replace(fitted, question=question).refit(terms, possible=possible)
    return replace(after, left_out=LeftOut.EACH)


def speeds_in(recordings: Sequence[FilteredRecording]) -> Array:
    """Return the velocities (K of all recordings, n) of rows that any joint uses."""
    speeds = (each.motion.qd[np.any(each.is_used, axis=1)] for each in recordings)
    return np.concatenate([*speeds])


def fastest_of(speeds: Array, ratios: Array) -> Array:
    """Return the highest speeds (m,) of joints or motors in velocities (K, n) of joints.

    ``ratios`` (m, n): motor speed per joint speed.
    """
    return np.max(np.abs(speeds @ ratios.T), axis=0, initial=0.0)


def dry_friction(fitted: Fit) -> tuple[float, ...]:
    """Return the dry friction (J,) of a fit [N m]: root of the sum of squares of its dry torques.

    Without those that fade with speed it would be nothing where they take all of Coulomb friction,
    and the next round would allow for none of them.
    """
    squares = np.zeros(len(fitted.arm.joints))
    for name in fitted.arm.friction:
        term = fitted.arm.terms[name]
        if term.parameters[0].is_dry_torque:
            squares += np.square([fitted.by_name[each] for each in term.names])
    return tuple(np.sqrt(squares).tolist())


def choose_motors(fitted: Fit, offered: Sequence[Coupling]) -> list[Coupling]:
    """Return those of the offered motors that torques clearly show.

    A missing motor makes slow residuals, in which it would hide: each is judged with the noise that
    it leaves, as the fit without it is.
    """
    chosen: list[Coupling] = []
    others = list(offered)
    current = fitted
    while others:
        offers = Offers(current)
        terms = [_motor_term(current, motor) for motor in others]
        gains = [offers.offer(Effect.of(term)).gain for term in terms]
        shown = []
        for number in np.argsort(gains)[-2:].tolist():
            offer = offers.weigh(Effect.of(terms[number]))
            # Evidence knows no bounds: negative friction or rotors, which no motor has, add to it.
            is_there = np.any(offer.values > SURE * offer.errors)
            if is_there and offer.gain > CLEAR:
                shown.append((offer.gain, number, offer))
        if not shown:
            break
        _, number, offer = max(shown, key=lambda entry: entry[0])
        chosen.append(others.pop(number))
        correlation = offers.correlation(offer.squares, offer.successive)
        current = replace(current, correlation=correlation)
        current = current.refit([*current.equations.terms, terms[number]])
    return chosen


def _motor_term(fitted: Fit, motor: Coupling) -> Term:
    """Return the term of a motor, its prior as large as the parameters of the joints that it turns.

    They make at least a share ``LEAST_DRY`` of a joint's root mean square torque.
    """
    arm = fitted.arm
    sums = fitted.sums
    squares = sums.squares
    torques = np.sum(sums.squared_torque, axis=0)
    sizes = []
    term = arm.terms[motor.name]
    for parameter in term.parameters:
        index = sums.names.index(parameter.key)
        size = 1e-9
        for joint in np.flatnonzero(motor.ratios):
            own = parameter.key_of(arm.robot.joint_names[joint])
            size = max(size, abs(fitted.by_name.get(own, 0.0)))
            square = squares[joint, index]
            if square > 0.0:
                size = max(size, LEAST_DRY * np.sqrt(torques[joint] / square))
        sizes.append(size)
    return replace(term, prior=independent(sizes))


def link_evidence(fitted: Fit, odd: OddNumber | None = None) -> LinkEvidence | None:
    """Return the evidence of a fit on how far the links before the last are off the model.

    None where they are not estimated. An odd number counts as not stated.
    """
    information = links_information(fitted)
    if information is None:
        return None
    robot = without_mistakes(fitted.arm.robot, fitted.question.mistakes)
    return evidence_of(fitted, robot, information, odd)


def evidence_of(
    fitted: Fit,
    robot: RobotModel,
    information: tuple[Array, Array],
    odd: OddNumber | None = None,
) -> LinkEvidence:
    """Return the evidence on how far links are off the reference bodies of an arm.

    Args:
        fitted: the fit.
        robot: its arm, with the reference bodies that are compared.
        information: ``links_information`` of the fit.
        odd: number that counts as not stated; None for none.
    """
    curvature, gradient = information
    others = fitted.arm.others
    further = mistake_shifts(robot, others, fitted.question.doubtful)
    directions = np.hstack((link_directions(robot, others, odd), further))
    share = link_share(fitted)
    reference = reference_links(robot, others)
    off = gradient - curvature @ reference
    return LinkEvidence(
        stated_kinds(robot, others, odd),
        share,
        directions.T @ curvature @ directions,
        directions.T @ off,
        common_error(robot, share),
        float(0.5 * (gradient + off) @ reference),
    )


def link_share(fitted: Fit) -> float:
    """Return the relative standard deviation of links that the user states."""
    return PER_CENT * fitted.question.options.priors.link


def links_information(
    fitted: Fit, left_out: Sequence[int] = ()
) -> tuple[Array, Array] | None:
    """Return what data and all other priors say of the links before the last, L of them.

    It is (curvature (10 L, 10 L), gradient (10 L,) at zero), all other parameters eliminated: the
    links' posterior without their prior. None where the links are not estimated. Some blocks may
    be left out.
    """
    equations = fitted.equations
    for term, span in equations.spans:
        if term.cause == LINKS and term.prior is not None:
            normal = fitted.normal_without(left_out)
            values, inverse = solve(normal, equations.reference)
            posterior = np.linalg.inv(inverse[span[:, None], span])
            rows = term.prior.rows[:, :-1]
            curvature = posterior - rows.T @ rows
            gradient = posterior @ values[span] - rows.T @ term.prior.rows[:, -1]
            return 0.5 * (curvature + curvature.T), gradient
    return None


def coupling(
    robot: RobotModel,
    ratios: Array,
    speeds: Array | None = None,
    tendon: int | None = None,
) -> Coupling:
    """Return the motor that turns several joints, named after them ("joint_5+joint_6").

    Args:
        ratios: (n,) motor speed per joint speed, zero for joints it does not turn with.
        speeds: (K, n) velocities of the joints in the recordings [rad/s]; None for none.
        tendon: MuJoCo id of the model's fixed tendon that is this motor; or None.
    """
    fastest = np.zeros(1) if speeds is None else fastest_of(speeds, ratios[None])
    # Joints that it does not turn with may be without a limit.
    turned = ratios != 0.0
    limit = np.abs(ratios[turned]) @ stated_speeds(robot)[turned]
    (top,) = top_speeds(fastest, np.array([limit]))
    text = ""
    for joint, ratio in zip(robot.joint_names, ratios):
        if ratio:
            text += "-" if ratio < 0.0 else "+"
            text += joint if abs(ratio) == 1.0 else f"{abs(ratio):g}*{joint}"
    motor = Coupling(ratios, text.removeprefix("+"), top=float(top))
    if tendon is None:
        return motor
    motor = replace(motor, tendon=tendon)
    of_model = [motor.stated_value(term, robot.mj_model) for term in Coupling.terms]
    damping = (VISCOUS, *POLYNOMIAL)
    stated = (np.array([motor.stated_value(term, robot.mj_model)]) for term in damping)
    own = float(stated_top(*stated)[0])
    top = max(motor.top, own)
    return replace(motor, model=np.array(of_model), top=top, stated_top=own)


def motors_of(
    robot: RobotModel, torques: str, speeds: Array | None = None
) -> tuple[tuple[Coupling, ...], tuple[Coupling, ...]]:
    """Return (motors of the model that turn several joints, those that an arm may have beside).

    The model's are fixed tendons with friction or rotor inertia. Others are those of each joint
    with the next one; torques of the last joint alone show none. ``speeds`` (K, n) are the joints'
    velocities in the recordings, None for none.
    """
    if torques != "chain":
        return (), ()
    tendons = shared_motors(robot.mj_model, robot.dof_index)
    motors = (
        coupling(robot, ratios, speeds, tendon) for tendon, ratios in tendons.items()
    )
    stated = tuple(motor for motor in motors if np.any(motor.model))
    offered = []
    for motor in neighbours(robot, speeds):
        pairs = [(motor.ratios, other.ratios) for other in stated]
        if all(np.linalg.matrix_rank(pair) == 2 for pair in pairs):
            offered.append(motor)
    return stated, tuple(offered)


def neighbours(robot: RobotModel, speeds: Array | None = None) -> Iterator[Coupling]:
    """Yield the motors that turn each joint with the next one, with ratios (1, 1) and (1, -1).

    ``speeds`` (K, n) are the joints' velocities in the recordings, None for none.
    """
    for joint in range(robot.n_joints - 1):
        for sign in (1.0, -1.0):
            ratios = np.zeros(robot.n_joints)
            ratios[joint : joint + 2] = 1.0, sign
            yield coupling(robot, ratios, speeds)

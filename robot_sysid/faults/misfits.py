"""What is said of a log as a whole, where no single fault of the table explains it: by recorded
velocities, by torque that has no weight or no friction, by links of another arm, or that it does
not fit, with what is missing at which joint.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import compress

import numpy as np

from robot_sysid.dynamics.friction import COULOMB
from robot_sysid.estimate.choose import (
    centre_off_model,
    has_odd_link_alone,
    odd_link,
    solve_question,
)
from robot_sysid.estimate.contacts import DEVIATION_OVER_MEDIAN, LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.links import CENTRE, MASS, OddNumber
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.options import FILE_LINKS
from robot_sysid.estimate.questions import PER_CENT
from robot_sysid.estimate.terms import FRICTION, LAST_LINK, LINKS, ZEROS
from robot_sysid.faults import Finding
from robot_sysid.faults.columns import INERTIAL, WEIGHT
from robot_sysid.faults.judge import bias_text
from robot_sysid.faults.loop import State
from robot_sysid.faults.plausibility import (
    PLAIN_FRICTION,
    SMALLER,
    driven,
    friction_share,
    is_plausible,
    is_sibling,
    last_mass,
    model_misfit,
    model_torque,
    regression,
    structural,
    terms_of,
    typical_ratio,
    typical_torque,
)
from robot_sysid.faults.reading_search import Evidence
from robot_sysid.faults.samples import ODD_VELOCITY
from robot_sysid.faults.scales import ScaleCorrections, little_weight
from robot_sysid.faults.shares import LOST, Shares
from robot_sysid.faults.table import TIME, WHOLE_CLOCK, at_inertia
from robot_sysid.records import Array
from robot_sysid.records.controllers import torque_to_record
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE
from robot_sysid.records.messages import Level, percent, torque_unit, with_error
from robot_sysid.records.parameters import DELAY, ZERO, keys_of
from robot_sysid.records.usual_errors import WRONG_DELAY
from robot_sysid.results.notes import mistake_words
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.wording import option_name

RIGHT_MODEL = "check that the model is of this arm, with all that is fixed to its links"
MEASURED = "record the measured joint torque"
CAUSES_IN_FILE = (LAST_LINK, LINKS, FRICTION)
"""Causes of torque of which a model file has numbers."""
TELLING_APART = (
    "stand the joint where the model has its zero and look at the link with a spirit level, or "
    "record once more with a known mass on the flange, which weighs where the joint really is"
)
"""What tells a wrong zero from wrong centres of mass."""
LATE_JOINT = 5.0
"""Least gain in the log evidence at which the torque of one joint is late: more than right logs
gain, and less than a late shoulder, whose weight that comes late is viscous friction but for a few
tenths of a per cent [nats]."""
FAR_OFF = 0.4
"""Share by which a mass is off the model's for sure, to be named for a log: one link of a right arm
is off by as much."""
NO_WEIGHT = 0.1
"""Share of the links' weight below which a torque has none: with less of it, torque is external, or
less a controller's model."""
MOST_LINKS = 0.5
"""Mass of links that have lost most of theirs, as a share of that of all links but the last, from
which on a result is none."""
FRICTION_DEVIATIONS = 3.0
"""Standard deviations of chi-square beyond its mean up to which joints have no friction."""
OWN_MODEL = 0.02
"""Share of all torque that may be left where the torque is the model's own but for the last link:
as much as noise. Most arms whose links are as wrong as usual leave more."""
OWN_FRICTION = 0.01
"""The same with the model's own friction: torque of models that have some leaves less, noise
included, and right logs more."""
LEAST_FRICTION = 0.008
"""Least friction of arms, as a share of their torque: of sensors behind gears, which see bearings
and cables alone; motors' currents have ten times as much."""
LEAST_MEASURED = 0.032
"""Share of all torque that a fit leaves, noise included, from which on torque without friction was
measured, by sensors behind the gears, as of a Franka Panda; computed torque with noise of its own
leaves less."""
SENSOR_NOISE = 0.01
"""The same of noise from sample to sample: what is computed from positions is smoother."""
EXACT_TORQUE = 0.002
"""The same below which no torque was measured, if it has no noise from sample to sample: logs of
real arms leave several times as much."""
NO_NOISE = 1e-4
"""Noise from sample to sample, as a share of all torque, that is none: 20 mN m of a large arm are
four times as much."""
FAST = 4
"""Order of the differences in which noise from sample to sample is seen."""
FAST_SCALE = DEVIATION_OVER_MEDIAN / math.sqrt(math.comb(2 * FAST, FAST))
"""Standard deviation of white noise over the median size of its differences."""
FRICTION_ERRORS = 5.0
"""Errors of the friction that it would have to be off from none, if there were the least."""


def time_findings(fitted: Fit, evidence: Evidence) -> Iterator[Finding]:
    """Yield the finding that time is too long or too short, by recorded velocities.

    Nothing is yielded where torques rather say that time is right, or hardly anything of an error
    that is no larger than what filters of drives make of velocities.
    """
    share = evidence.time_share
    value, error = weighed_time(fitted) if share else (0.0, 0.0)
    is_clear = abs(share or 0.0) > ODD_VELOCITY or abs(value) >= SURE * error
    if share and is_clear and abs(value - share) <= abs(value):
        way = "long" if share > 0.0 else "short"
        yield Finding(
            Level.REFUSES,
            FaultName.CLOCK,
            f"time in the log is {percent(abs(share))} too {way}, by the recorded velocities",
            "record the controller's own time stamps, or scale these with a line in "
            f"{option_name('columns', 'FILE')}: time = {1.0 / (1.0 + share):.3g} * TITLE",
        )


def delay_findings(fitted: Fit, current: Fit) -> Iterator[Finding]:
    """Yield the finding that torque is later than position by more than it usually is.

    Every fit estimates the delay of all joints; that of one joint hides in its viscous friction,
    which in a motion all over the range is what weight does that comes late. It is a doubt where
    friction, which turns round at other instants then, or links come out otherwise with torques
    that are moved back.

    Args:
        fitted: the fit of the log.
        current: the same with the faults that have joined it, but for a delay.
    """
    name = DELAY.key
    if fitted.question.differing is not None:
        return
    value, error, gain = fitted.by_name[name], fitted.error_of(name), np.inf
    owner, joints = "all joints", fitted.arm.indices
    if not is_late(fitted, value, error):
        joint, value, error, gain = late_joint(current)
        owner, joints = f"joint {fitted.arm.joints[joint]}", joints[[joint]]
    if not is_late(fitted, value, error):
        return
    delays = np.zeros(fitted.arm.robot.n_joints)
    delays[joints] = value
    squares = fitted.sums.squares[:, fitted.sums.at([name])].ravel()
    sizes = np.sqrt(squares / fitted.sums.row_counts)
    # What moved torque makes has to be more than friction leaves.
    is_more = np.any(np.abs(delays[fitted.arm.indices]) * sizes > structural(fitted))
    moved = [earlier(recording, delays) for recording in fitted.recordings]
    after = solve_question(fitted.arm.robot, moved, fitted.question)
    held = [t for t in fitted.equations.terms if t.cause in CAUSES_IN_FILE]
    written = [p for term in held for p in term.parameters if p.key in after.names]
    is_harmful = any(
        abs(after.by_name[name] - fitted.by_name[name])
        > INTERVAL * fitted.error_of(name)
        for name in keys_of(written)
    )
    is_doubt = is_harmful and is_more and gain >= CLEAR
    bias = bias_text(written, fitted, after)
    yield Finding(
        Level.DOUBTS if is_doubt and not fitted.question.loaded else Level.SAYS,
        FaultName.DELAY,
        f"torque of {owner} is {with_error(1e3 * abs(value), 1e3 * error, 'ms')} "
        f"{'later' if value > 0.0 else 'earlier'} than position{bias}",
        "record torques and positions of all joints at the same instant",
    )


def is_late(fitted: Fit, value: float, error: float) -> bool:
    """Return whether a delay and its error [s] are larger than delays usually are."""
    usual = 1e-3 * fitted.question.options.priors.delay
    return abs(value) >= SURE * max(error, usual)


def late_joint(fitted: Fit) -> tuple[int, float, float, float]:
    """Return (joint, delay of its torque alone, its error [s], gain); zero where none is shown."""
    offers = Offers(fitted)
    size = 1e-3 * np.array([[WRONG_DELAY]])
    joints = range(len(fitted.arm.joints))
    every = [offers.offer(Effect((DELAY.key,), size, joint)) for joint in joints]
    joint = max(joints, key=lambda each: every[each].gain)
    found = offers.weigh(every[joint].effect)
    gain = min(every[joint].gain, found.gain)
    delay = float(found.values[0]) * (gain >= LATE_JOINT)
    return joint, delay, float(found.errors[0]), gain


def earlier(recording: FilteredRecording, delays: Array) -> FilteredRecording:
    """Return a recording with torques that are moved back by delays (n,) [s]."""
    time = recording.time
    pairs = zip(delays, recording.tau.T)
    tau = [np.interp(time + delay, time, column) for delay, column in pairs]
    return recording.using(recording.is_used, tau=np.stack(tau, axis=1))


def weighed_time(fitted: Fit) -> tuple[float, float]:
    """Return by which share time is too long, as torques show it, and its error."""
    (clock,) = at_inertia(fitted, WHOLE_CLOCK)
    found = Offers(fitted).weigh(clock.effect)
    return TIME * float(found.values[0]), TIME * float(found.errors[0])


def model_findings(
    state: State, scales: ScaleCorrections, answer: Fit
) -> Iterator[Finding]:
    """Yield what is wrong as a whole, where no fault is named that forbids an estimate.

    Args:
        state: what was found in the log.
        scales: torque scales of the log that was searched.
        answer: to the log with what was found.
    """
    fitted = scales.fitted
    robot = fitted.arm.robot
    current = state.current
    zeros = [] if state.joined else [*odd_zeros(answer)]
    mistaken = [*model_mistakes(answer)]
    wrong = [*mistaken, *wrong_number(answer, current)]
    is_odd = scales.may_be_odd and scales.scales.is_odd
    # Scales follow whatever else is left over.
    is_odd = is_odd and scales.common.fit.unexplained_share < LITTLE
    common = scales.common.findings if is_odd else ()
    if zeros:
        yield from (*zeros, *wrong)
    elif wrong and common and not mistaken and not has_odd_link_alone(current):
        yield from map(either, wrong, common)
    elif wrong:
        yield from wrong
    elif common:
        yield from common
    elif not is_plausible(current):
        yield Finding(
            # What an empty log has wrong as well does not matter to a payload.
            Level.SAYS if fitted.question.loaded else Level.DOUBTS,
            FaultName.MODEL,
            "to fit this log, the terminal link would have "
            f"{with_error(*last_mass(current), 'kg')} on an arm of {robot.mass:.3g} kg, or other "
            "links would be far from the model's",
            f"{RIGHT_MODEL}, and its base mounted as the model says",
        )
    elif is_sibling(fitted):
        off = fitted.question.link_scales
        share = PER_CENT * fitted.question.options.priors.link
        yield Finding(
            Level.SAYS,
            FaultName.MODEL,
            f"the links differ from the model by {percent(off.mass * share)} of their masses, "
            f"and by {percent(off.centre_of_mass * share)} of their size in their centres of "
            "mass: it may be the model of a sibling of this arm; the standard errors of links "
            "before the last may be too small",
            RIGHT_MODEL,
        )


def either(wrong: Finding, common: Finding) -> Finding:
    """Return the finding that one link's mass is wrong, or all torques by a factor.

    Both explain a log, and the user decides: where the doubt is accepted, the link's mass counts as
    not known.
    """
    name = FaultName.MODEL
    return replace(
        common,
        level=Level.DOUBTS,
        about=name,
        text=f"{wrong.text}; or {common.text}",
        remedy=f"{wrong.remedy}; or {common.remedy}",
        options=(("--accept", name), *common.options),
    )


def odd_zeros(answer: Fit) -> Iterator[Finding]:
    """Yield the findings that zeros are far more off than usual, or centres of mass beyond them."""
    for joint in answer.arm.robot.joint_names:
        name = ZERO.key_of(joint)
        if name in answer.question.odd_zeros:
            yield odd_zero(joint, answer.by_name[name], answer.error_of(name))


def odd_zero(joint: str, zero: float, error: float) -> Finding:
    """Return the finding on the zero of a joint and its error [rad].

    No torque tells it from centres of mass, only how far either is usually off: it is no doubt.
    """
    return Finding(
        Level.SAYS,
        FaultName.ZERO,
        f"the position of joint {joint} reads {with_error(abs(zero), error, 'rad')} too "
        f"{'much' if zero > 0.0 else 'little'}; or the centres of mass of the links that it "
        "carries are off the model's by as much: the log tells them hardly apart, and their ± has "
        "both",
        TELLING_APART,
    )


def model_mistakes(answer: Fit) -> Iterator[Finding]:
    """Yield the findings that the model has mistakes in the numbers of links."""
    is_kept = FILE_LINKS in answer.question.options.kept
    remedy = (
        "correct the model" if is_kept else "correct the model, or use the written one"
    )
    for mistake in answer.question.mistakes:
        yield Finding(
            Level.SAYS,
            FaultName.MODEL,
            f"the log contradicts the model: {mistake_words(answer.arm.robot, mistake)}; the "
            "numbers without this mistake are taken in their place",
            remedy,
        )


def wrong_number(answer: Fit, current: Fit) -> Iterator[Finding]:
    """Yield the finding that the log contradicts the mass or centre of one link of the model.

    Args:
        answer: to the log with what was found.
        current: the fit with the faults that have joined it, which may explain a mass.
    """
    odd = answer.question.odd_number
    if odd is not None and odd.kind == CENTRE:
        yield wrong_centre(answer, odd.link)
    elif odd is not None and odd_link(current) is not None:
        yield from wrong_mass(answer, odd.link)


def wrong_mass(answer: Fit, number: int) -> Iterator[Finding]:
    """Yield the finding that the log contradicts the mass of one link of the model by far.

    It has to be farther off than a link of a right model may be, and to be larger than its error:
    no link has no mass, so that something else has taken it up (a gear's ripple). A forearm whose
    mass is ten times too large in the model comes out with twice its error.
    """
    link = answer.arm.robot.links[number]
    name = answer.arm.links[number][0]
    mass = answer.by_name[name]
    error = answer.error_of(name)
    expected = float(link.theta[0])
    is_seen = mass > error
    if is_seen and abs(mass - expected) - INTERVAL * error > FAR_OFF * expected:
        yield Finding(
            Level.SAYS,
            FaultName.MODEL,
            f"the log contradicts the model's mass of {link.body_name}, {expected:.3g} kg: it is "
            f"{with_error(mass, error, 'kg')}, and counts as not known",
            "look whether the number is right, and whether something is fixed to the link that the "
            "model lacks",
        )


def wrong_centre(answer: Fit, number: int) -> Finding:
    """Return the finding that the log contradicts the centre of mass of one link of the model."""
    found = centre_off_model(answer, number)
    link = answer.arm.robot.links[number]
    stated = ", ".join(f"{1e3 * each:.0f}" for each in link.theta[1:4] / link.theta[0])
    way = ", ".join(f"{each:.2f}" for each in found.direction)
    return Finding(
        Level.SAYS,
        FaultName.MODEL,
        f"the log contradicts the model's centre of mass of {link.body_name}, ({stated}) mm: it is "
        f"{with_error(1e3 * found.distance, 1e3 * found.error, 'mm')} from there along ({way}), "
        "and counts as not known, with the link's inertia",
        "look whether the centre of mass has the right sign, and is in the frame of its body",
    )


def misfit(fitted: Fit, current: Fit, least: float) -> Finding:
    """Return the finding that a log does not fit its model, and what is missing at which joints.

    Args:
        fitted: the fit of the log as it came.
        current: the fit with all that was found.
        least: what the nearest single fault leaves unexplained, as a share of all torque.
    """
    joints = fitted.arm.joints
    share = fitted.unexplained_share
    own = fitted.unexplained / typical_torque(fitted)
    worst = np.argsort(-fitted.unexplained)[:3].tolist()
    listed = ", ".join(f"{joints[k]} ({percent(own[k])} of its own)" for k in worst)
    texts = [
        f"the torques do not fit this model: {percent(share)} unexplained, mostly at {listed}"
    ]
    names = ", ".join(compress(joints, driven(current)))
    if names:
        texts.append(
            f"near standstill friction would drive {names}, as where drives add more than it "
            "takes, or where a torque has the wrong sign"
        )
    if least < share:
        texts.append(f"the nearest single cause leaves {percent(least)}")
    texts += [missing_torque(fitted, joint) for joint in worst]
    remedy = f"{RIGHT_MODEL}, and that it carried the same load all the time, with no contact"
    return Finding(Level.DOUBTS, FaultName.UNEXPLAINED, "; ".join(texts), remedy)


def missing_torque(fitted: Fit, joint: int) -> str:
    """Return what a joint's torque has of the model's weight and inertia, by a regression."""
    name = fitted.arm.joints[joint]
    found = regression(fitted, joint)
    unit = torque_unit(name in fitted.arm.robot.slides)
    parts = [
        f"{percent(found[column])} of the model's {column}"
        for column in (WEIGHT, INERTIAL)
        if column in found
    ]
    coulomb = COULOMB.key_of(name)
    if coulomb in found:
        parts.append(f"friction of {found[coulomb]:.2g} {unit}")
    return f"{name} has {', '.join(parts)}"


def external_torque(fitted: Fit, shares: Shares) -> Finding:
    """Return the finding that the links' weight has gone from the torque, which something explains.

    It is asked before masses may move: links without mass would fit it.
    """
    joint = int(np.argmax(shares.torque * shares.is_weighed))
    text = (
        "the torque lacks the weight of the arm's links "
        f"({percent(abs(float(shares.weight[joint])))} of it is left at "
        f"{fitted.arm.joints[joint]}): it is external torque, from which a controller's model was "
        "taken off, and shows friction and what hangs on the flange alone"
    )
    remedy = torque_to_record(fitted.arm.robot)
    return Finding(Level.REFUSES, FaultName.GRAVITY, text, remedy)


def weight_alone() -> Finding:
    """Return the finding that the torque has the links' weight and no inertia."""
    return Finding(
        Level.DOUBTS,
        FaultName.COMPUTED,
        "the torque holds the links' weight and none of their inertia: it is that of a "
        "controller's model, or of an arm that is guided by hand",
        "record the measured joint torque of an arm that its motors move",
    )


def weight_findings(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that torques are small, without weight at the joint that carries most."""
    torque, *_ = model_torque(fitted)
    share = regression(fitted, int(np.argmax(torque))).get(WEIGHT, 1.0)
    is_small = fitted.arm.has_gravity and typical_ratio(fitted) < SMALLER
    if is_small and abs(share) < NO_WEIGHT:
        yield little_weight(fitted.arm.robot)


def lost_links(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that the links before the last have lost most of their mass in a result.

    Nothing may write such a model, whatever else is said of its log. One link alone may be wrong in
    the model, and does not count. Where geometry stands for masses, a single one shows little.
    """
    arm = fitted.arm
    question = fitted.question
    if arm.robot.lacks_masses:
        return
    mistaken = {number for each in question.mistakes for number in each.links}
    odd = question.odd_number
    links = [k for k in arm.others if k not in mistaken and odd != OddNumber(k, MASS)]
    masses = {link: arm.model[arm.links[link][0]] for link in links}
    found = {link: fitted.by_name[arm.links[link][0]] for link in links}
    lost = [link for link, mass in masses.items() if found[link] < LOST * mass]
    share = sum(masses[link] for link in lost) / max(sum(masses.values()), 1e-300)
    if share > MOST_LINKS:
        link = max(lost, key=lambda each: masses[each])
        yield Finding(
            Level.REFUSES,
            FaultName.GRAVITY,
            "to fit this log, links would lose most of their mass: "
            f"{arm.robot.links[link].body_name} would have {max(found[link], 0.0):.3g} kg, and has "
            f"{masses[link]:.3g} kg in the model: the torque lacks their weight, as external "
            "torque does, or it is the model of another arm",
            f"{torque_to_record(arm.robot)}; and {RIGHT_MODEL}",
        )


def computed_findings(fitted: Fit, most: float | None) -> Iterator[Finding]:
    """Yield the finding that the torque was computed or commanded, and not measured.

    It has no friction, and less noise than a sensor behind the gears, which sees none either; or
    the fit leaves less of it than any sensor has noise, so that its friction is a formula, too.

    Args:
        fitted: the fit of the log.
        most: friction that it may hide, as from ``most_friction``.
    """
    left, noise = fitted.residual_share, fast_noise(fitted)
    if most is not None and left < LEAST_MEASURED and noise < SENSOR_NOISE:
        text = (
            "the torque follows rigid-body dynamics and has no friction (less than "
            f"{percent(most)} of the torque): it was computed, or commanded by a controller whose "
            "drives add the friction themselves, not measured; an arm without friction looks the "
            "same"
        )
        of_model = model_misfit(fitted, terms_of(fitted.arm, PLAIN_FRICTION))
        if of_model < OWN_MODEL:
            text += (
                "; this model's links but the last, as they are, leave "
                f"{percent(of_model)} of it"
            )
        yield Finding(Level.DOUBTS, FaultName.COMPUTED, text, MEASURED)
    elif left < EXACT_TORQUE and noise < NO_NOISE:
        yield Finding(
            Level.DOUBTS,
            FaultName.COMPUTED,
            "the torque follows rigid-body dynamics and friction that is a formula, all but for "
            f"{percent(left)} of it, and has no noise: it was computed by a controller, or "
            "simulated, and shows the model that it was computed with, not what the arm is",
            MEASURED,
        )


def most_friction(fitted: Fit) -> float | None:
    """Return the most friction that a log without any may hide, as a share of all torque.

    It is None where friction shows, or would not.
    """
    share, error, distance = friction_share(fitted)
    is_absent = abs(share) < SURE * error and distance < FRICTION_DEVIATIONS
    # The friction of a real arm would show, behind its gears as well.
    is_shown = error < LEAST_FRICTION / FRICTION_ERRORS
    return INTERVAL * error if is_absent and is_shown else None


def fast_noise(fitted: Fit) -> float:
    """Return the noise of torques from sample to sample, as a share of all torque.

    It is that of fourth differences, in which a motion leaves nothing, by their median, which
    friction that turns round does not change.
    """
    left = total = 0.0
    for recording in fitted.recordings:
        tau = recording.tau[:, fitted.arm.indices]
        size = np.median(np.abs(np.diff(tau, FAST, axis=0)), axis=0) * FAST_SCALE
        left += float(len(tau) * np.sum(size**2))
        total += float(np.sum(tau**2))
    return float(np.sqrt(left / max(total, 1e-300)))


def own_findings(fitted: Fit, most: float | None) -> Iterator[Finding]:
    """Yield the finding that the torque is the model's own, its friction as well, or has none.

    Zeros are those of the arm that played the motion. An arm that is simulated with its model looks
    the same, and sensors behind the gears feel no friction, so that it is no doubt.

    Args:
        fitted: the fit of the log that is right.
        most: friction that it may hide, as from ``most_friction``.
    """
    if fitted.question.loaded or fitted.question.differing is not None:
        return
    zeros = [term for term in fitted.equations.terms if term.cause == ZEROS]
    left = model_misfit(fitted, zeros)
    if left < OWN_FRICTION:
        yield Finding(
            Level.SAYS,
            FaultName.COMPUTED,
            f"the torque is that of this model, its friction as well ({percent(left)} is left): it "
            "was simulated with the model, or computed by a controller that has it, and shows what "
            "the model says, not what the arm is",
            MEASURED,
        )
    elif most is not None:
        yield Finding(
            Level.SAYS,
            FaultName.COMPUTED,
            f"the torque has no friction (less than {percent(most)} of it), and neither has what "
            "is identified: sensors behind the gears feel none, and drives may take it off; the "
            "motors have to overcome theirs beside it",
            "for the friction of the motors, record their currents or torques",
        )

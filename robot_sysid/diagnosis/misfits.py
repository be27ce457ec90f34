"""What is said of a log as a whole, where no single fault of the table explains it: by recorded
velocities, by torque that has no weight or no friction, by links of another arm, or that it does
not fit, with what is missing at which joint.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.column_search import Evidence
from robot_sysid.diagnosis.fault_columns import INERTIAL, WEIGHT
from robot_sysid.diagnosis.faults import TIME, WHOLE_CLOCK, at_inertia
from robot_sysid.diagnosis.plausibility import (
    SMALLER,
    dry_friction,
    is_plausible,
    is_sibling,
    last_mass,
    model_torque,
    regression,
    typical_ratio,
    typical_torque,
)
from robot_sysid.diagnosis.scales import ScaleCorrections, torque_scales
from robot_sysid.diagnosis.scores import EXACT
from robot_sysid.diagnosis.search import Search
from robot_sysid.dynamics.friction import COULOMB
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Offers
from robot_sysid.estimate.questions import PER_CENT
from robot_sysid.estimate.terms import FRICTION, LAST_LINK, LINKS
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import INTERVAL, SURE, UNEXPLAINED
from robot_sysid.records.messages import Level, percent, torque_unit, with_error
from robot_sysid.records.parameters import DELAY
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.wording import option_name

RIGHT_MODEL = "check that the model is of this arm, with all that is fixed to its links"
MEASURED = "record the measured joint torque"
CAUSES_IN_FILE = (LAST_LINK, LINKS, FRICTION)
"""Causes of torque of which a model file has numbers."""
OTHER_ARM = 0.3
"""Share of all torque that is unexplained from which on it is another arm's."""
NO_WEIGHT = 0.1
"""Share of the links' weight below which a torque has none: with less of it, torque is external, or
less a controller's model."""
FRICTION_DEVIATIONS = 3.0
"""Standard deviations of chi-square beyond its mean up to which joints have no friction."""


def time_findings(fitted: Fit, evidence: Evidence) -> Iterator[Finding]:
    """Yield the finding that time is too long or too short, by recorded velocities.

    Nothing is yielded where torques rather say that time is right.
    """
    share = evidence.time_share
    value = weighed_time(fitted) if share else 0.0
    if share and abs(value - share) <= abs(value):
        way = "long" if share > 0.0 else "short"
        yield Finding(
            Level.REFUSES,
            FaultName.CLOCK,
            f"time in the log is {percent(abs(share))} too {way}, by the recorded velocities",
            "record the controller's own time stamps, or scale these with a line in "
            f"{option_name('columns', 'FILE')}: time = {1.0 / (1.0 + share):.3g} * TITLE",
        )


def delay_findings(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that torque is later than position by more than it usually is.

    Every fit estimates it. It is a doubt where friction, which turns round at other instants then,
    or links come out otherwise with torques that are moved back.
    """
    options = fitted.question.options
    name = DELAY.key
    if fitted.question.differing is not None or name not in fitted.names:
        return
    value, error = fitted.by_name[name], fitted.error_of(name)
    if abs(value) < SURE * max(error, 1e-3 * options.priors.delay):
        return
    moved = [earlier(recording, value) for recording in fitted.recordings]
    after = solve_question(fitted.arm.robot, moved, fitted.question)
    held = [t for t in fitted.equations.terms if t.cause in CAUSES_IN_FILE]
    names = {name for term in held for name in term.names}
    written = sorted(names & {*after.names})
    change = [after.by_name[each] - fitted.by_name[each] for each in written]
    errors = [fitted.error_of(each) for each in written]
    is_harmful = np.any(np.abs(change) > INTERVAL * np.array(errors))
    yield Finding(
        Level.DOUBTS if is_harmful and not fitted.question.loaded else Level.SAYS,
        FaultName.DELAY,
        f"torque of all joints is {with_error(1e3 * abs(value), 1e3 * error, 'ms')} "
        f"{'later' if value > 0.0 else 'earlier'} than position",
        "record torques and positions of all joints at the same instant",
    )


def earlier(recording: FilteredRecording, delay: float) -> FilteredRecording:
    """Return a recording with torques that are moved back by a delay [s]."""
    time = recording.time
    tau = [np.interp(time + delay, time, column) for column in recording.tau.T]
    return recording.using(recording.is_used, tau=np.stack(tau, axis=1))


def weighed_time(fitted: Fit) -> float:
    """Return by which share time is too long, as torques show it."""
    (clock,) = at_inertia(fitted, WHOLE_CLOCK)
    return TIME * float(Offers(fitted).weigh(clock.effect).values[0])


def model_findings(search: Search, scales: ScaleCorrections) -> Iterator[Finding]:
    """Yield what is wrong as a whole, where no fault is named that forbids an estimate.

    Args:
        search: what was found in the log.
        scales: torque scales of the log that was searched.
    """
    fitted = scales.fitted
    robot = fitted.arm.robot
    current = search.current
    # A fault that was found may explain them.
    is_odd = scales.scales.is_odd and torque_scales(current, search.effects).is_odd
    if is_odd and scales.common.fit.unexplained_share < UNEXPLAINED:
        yield from scales.common.findings
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


def misfit(fitted: Fit, least: float) -> Finding:
    """Return the finding that a log does not fit its model, and what is missing at which joints.

    Args:
        fitted: the fit of the log.
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
    if least < share:
        texts.append(f"the nearest single cause leaves {percent(least)}")
    texts += [missing_torque(fitted, joint) for joint in worst]
    name = FaultName.MODEL if share > OTHER_ARM else FaultName.UNEXPLAINED
    remedy = f"{RIGHT_MODEL}, and that it carried the same load all the time, with no contact"
    return Finding(Level.DOUBTS, name, "; ".join(texts), remedy)


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


def weight_findings(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that torques are small, without weight at the joint that carries most."""
    torque, *_ = model_torque(fitted)
    share = regression(fitted, int(np.argmax(torque))).get(WEIGHT, 1.0)
    is_small = fitted.arm.has_gravity and typical_ratio(fitted) < SMALLER
    if is_small and abs(share) < NO_WEIGHT:
        yield Finding(
            Level.REFUSES,
            FaultName.GRAVITY,
            "the torque has little of the links' weight: it may be external torque, left after a "
            "controller's model, or motor current",
            f"{MEASURED}, or give {option_name('torque_constants')} for a current",
        )


def friction_findings(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that the torque was computed from a model: no joint has friction.

    It has to be so well known that friction of a real arm would show.
    """
    torque = typical_torque(fitted)
    dry, error = dry_friction(fitted)
    *_, is_loaded = model_torque(fitted)
    size = float(np.linalg.norm(torque[is_loaded]))
    known = np.linalg.norm(error[is_loaded]) / max(size, 1e-300)
    distance = np.sum((dry / np.hypot(error, EXACT * torque)) ** 2)
    limit = len(dry) + FRICTION_DEVIATIONS * np.sqrt(2.0 * len(dry))
    # With a larger error, none can be told.
    if size > 0.0 and known < 2.0 * EXACT and distance < limit:
        text = "the torque follows rigid-body dynamics and has no friction: it was computed, or "
        text += "commanded, not measured"
        yield Finding(Level.DOUBTS, FaultName.COMPUTED, text, MEASURED)

"""Torque scales: whether the torques are a factor times those of the model, or one for each joint.

Torques alone do not tell a factor on all of them from one on all masses. A unit is the name of a
factor. Throughout, J is the number of joints with equations, n that of the chain's. A torque scale
is the ratio of recorded to true torque.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.column_search import (
    Correction,
    Evidence,
    gain_between,
    refit,
    with_priors,
)
from robot_sysid.diagnosis.columns import Reading
from robot_sysid.diagnosis.fault_columns import fault_columns
from robot_sysid.diagnosis.plausibility import (
    LARGER,
    SMALLER,
    dry_friction,
    is_foreign,
    model_torque,
)
from robot_sysid.estimate.choose import common_factor, solve_question
from robot_sysid.estimate.fit import Fit, Problem
from robot_sysid.estimate.links import AS_STATED
from robot_sysid.estimate.questions import arm_question
from robot_sysid.estimate.terms import SCALES, ArmTerms
from robot_sysid.model.units import mass_unit, with_mass_scale
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.messages import Level, torque_unit, with_error
from robot_sysid.wording import option_name, with_option_names

ODD = 1.3
"""Factor on all masses, or its inverse, above which it is refused."""
UNITS = {
    1e3: "mN·m",
    100.0: "N·cm",
    10.197: "kgf·cm",
    8.851: "lbf·in",
    141.6: "ozf·in",
    1e-3: "kN·m",
}
"""One newton metre in other units of torque, to the unit's name."""
NEAR_UNIT = 1.25
"""Factor between a scale and that of its unit which masses that are a little off make."""
MOST_MASSES = 5.0
"""Factor on all masses, or its inverse, above which no arm is."""
COMMON_ROUNDS = 4
"""Rounds in which a factor on all masses is found: each changes the links that it is found by."""
OWN_ROUNDS = 4
"""Rounds in which scales of single joints are found."""
SCALE_PRIOR = 70.0
"""Prior of a joint's scale in a round [%]: by so much it may change in one."""
STEP = (0.2, 5.0)
"""Least and largest factor by which a scale changes in one round."""
SURE_SCALE = 0.4
"""Relative error of a joint's scale above which it is not identified."""
SPREAD = 0.4
"""Standard deviation of the logarithm of a joint's scale over the common one: gains of motor
currents of one arm differ by a factor of two."""
COMMON = 1.35
"""Ratio of the largest to the least scale of joints below which they have one common cause."""
SENSOR = 1.6
"""Scale, or its inverse, above which it is no sensor's."""
OPPOSING = 0.5
"""Torque of the links with the opposite sign, as a share of a joint's torque, from which on its
sign is turned."""
LEAST_OF_LINKS = 0.03
"""Torque by the model's links, as a share of that of the most loaded joint, below which friction
makes most of a joint's torque."""
OTHER_UNIT = 10.0
"""Torque and friction of one joint over those of the others that neither links nor gears make."""
LEAST_BETTER = 0.7
"""What a joint's other unit leaves unexplained, over what is without it, that says that it is."""
WEIGHING = (
    "give the torque per ampere with {torque_constants}, or determine it with a weight: bolt on "
    "1 kg (of another mass, state it), record a motion called weight, and compare"
)
"""What to do where torques are motor currents; the command that compares follows the message."""


def common_scale(fitted: Fit, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of all masses by one factor, if they are clearly ``ODD`` times off.

    Torques do not tell it from torques that are all scaled.
    """
    robot = fitted.arm.robot
    factor = 1.0
    after = fitted
    for _ in range(COMMON_ROUNDS):
        found = clear_factor(after, factor)
        if found is None:
            return
        estimate, relative = found
        factor *= estimate
        scaled = with_mass_scale(robot, factor)
        after = solve_question(
            scaled, fitted.recordings, fitted.question, beside=fault_columns
        )
        if abs(np.log(estimate)) < np.log(ODD):
            break
    finding = common_finding(robot, factor, relative, evidence)
    yield Correction((finding,), gain_between(fitted, after), after)


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
    is_close = abs(np.log(factor / unit)) < max(
        np.log(NEAR_UNIT), INTERVAL * relative_error
    )
    unit_text = f" (as in {UNITS[unit]})" if is_close else ""
    options: tuple[tuple[str, str], ...]
    options = (torque_scale((unit if is_close else factor) * evidence.divided),)
    name = FaultName.TORQUE_UNIT
    command = ""
    if mass_unit(robot, factor) != 1.0:
        remedy = f"they are in another unit{unit_text}: divide them"
    elif not is_close and abs(np.log(factor)) > np.log(MOST_MASSES):
        text += ": they may be motor currents"
        remedy = with_option_names(WEIGHING)
        command = "payload"
    else:
        name = FaultName.TORQUE_SCALE
        remedy = (
            "torques cannot tell what is wrong by that much, the masses or the torques: if the "
            f"torques are N·m, multiply the masses; if the model is right{unit_text}, divide the "
            "torques"
        )
        options = (("--mass-scale", f"{factor * robot.mass_scale:.4g}"), *options)
    # Where the user has to choose between masses and torques, two logs of one arm share it.
    is_common = name is FaultName.TORQUE_SCALE
    return Finding(
        Level.REFUSES, name, text, remedy, options, command, is_common_factor=is_common
    )


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
    opposes = is_loaded & (share * torque < -OPPOSING * fitted.sums.rms_torque)
    signs = np.where(opposes & is_foreign(fitted), -1.0, 1.0)
    # Links that explain the scales as they are would leave none to find.
    question = with_priors(
        replace(fitted.question, link_scales=AS_STATED), scale=SCALE_PRIOR
    )
    sums = arm.sums(fitted.recordings, arm.start())
    for _ in range(OWN_ROUNDS):
        scaled = sums.with_torque_times(signs / scale)
        problem = Problem(arm, fitted.recordings, arm.start(), scaled, question)
        terms = arm_question(arm, question, scaled.rms_torque)
        after = problem.fit(terms, possible=False)
        at = after.at(arm.terms[SCALES].names)
        change = np.clip(1.0 + after.free[at], *STEP)
        scale = scale * change
    relative = np.sqrt(np.diag(after.inverse)[at]) / change
    is_sure = relative < SURE_SCALE
    # The torque of the last joint is that of the last link alone, which is not known.
    is_sure[-1] &= is_loaded[-1]
    if not np.all(is_sure[is_loaded]):
        return
    own = np.log(scale[is_sure])
    scale[~is_sure] = np.exp(np.average(own, weights=relative[is_sure] ** -2.0))
    if np.ptp(own) < np.log(COMMON):
        return
    after = refit(fitted, torque_reading(arm, signs / scale))
    # Loss for scales that fit the data instead of being one: the prior's volume over that left.
    penalty = np.sum(np.log(SPREAD / relative[is_sure]))
    finding = scale_finding(fitted, signs * scale, np.flatnonzero(is_sure), evidence)
    gain = gain_between(fitted, after, 1.0 / scale) - penalty
    yield Correction((finding,), float(gain), after)


def torque_reading(arm: ArmTerms, factors: Array) -> Reading:
    """Return the reading in which torques (J,) are multiplied by factors."""
    torque = np.ones(arm.robot.n_joints)
    torque[arm.indices] = factors
    return Reading.with_torque_times(torque)


def scale_finding(
    fitted: Fit, scale: Array, sure: NDArray[np.int64], evidence: Evidence
) -> Finding:
    """Return the finding on torque scales (J,), of which those with indices ``sure`` are found.

    A scale is negative where the torque has the opposite sign of the model's.
    """
    names = fitted.arm.joints
    known = np.abs(scale[sure])
    listed = ", ".join(f"{names[k]} {scale[k]:.3g}" for k in sure)
    is_sensor = np.max(np.abs(np.log(known))) <= np.log(SENSOR)
    # No links, and no tool that an arm may carry, make all torques that small or large.
    is_unit = np.all(known < SMALLER) or np.all(known > LARGER)
    opposite = ", ".join(compress(names, scale < 0.0))
    signs = f"of {opposite} with the opposite sign; " if opposite else ""
    return Finding(
        Level.DOUBTS if is_sensor else Level.REFUSES,
        FaultName.TORQUE_UNIT if is_unit else FaultName.TORQUE_SCALE,
        f"torque reads {np.median(known):.3g} times what the model takes ({listed}): {signs}a "
        "factor of its own for every joint, as motor currents or per cent of rated torque have, or "
        "all masses of the model are wrong",
        with_option_names(WEIGHING),
        (torque_scale(np.abs(scale) * evidence.divided),),
        "payload",
        torque_reading(fitted.arm, np.sign(scale)).columns if opposite else None,
    )


def odd_unit(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that one joint's torque has another unit than that of the other joints.

    Dry friction counts beside the torque: links hardly load some joints, but no joint has so much
    more friction than the others.
    """
    torque, *_ = model_torque(fitted)
    if len(torque) < 3:
        return
    least = LEAST_OF_LINKS * np.max(torque)
    ratio = fitted.sums.rms_torque / np.maximum(torque, least)
    joint = int(np.argmax(ratio))
    factor = ratio[joint] / max(np.median(np.delete(ratio, joint)), 1e-9)
    dry, _ = dry_friction(fitted)
    friction = dry / np.median(np.maximum(np.delete(dry, joint), 1e-9))
    if min(factor, friction[joint]) > OTHER_UNIT:
        scales = np.ones(fitted.arm.robot.n_joints)
        scales[fitted.arm.indices[joint]] = 1e-3
        after = refit(fitted, Reading.with_torque_times(scales)).unexplained_share
        if after > LEAST_BETTER * fitted.unexplained_share:
            return
        name = fitted.arm.joints[joint]
        unit = torque_unit(name in fitted.arm.robot.slides)
        text = f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in "
        text += f"m{unit}"
        columns = option_name("columns", "FILE")
        remedy = f"put it right with {columns}: torque.{name} = 0.001 * TITLE"
        yield Finding(Level.REFUSES, FaultName.TORQUE_SCALE, text, remedy)

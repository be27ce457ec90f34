"""Torques in units of their own: of one joint, or of every joint by another factor.

Such torques are compared with those of the model's links as they are, without an estimate: what no
error of links, no tool and no friction makes needs none.

Throughout, n is the number of joints.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import ColumnCorrection, Finding, Level
from robot_sysid.diagnosis.log_rows import LOADED, LogRows, rms
from robot_sysid.records import Array

SMALL = 0.6
"""Ratio of measured torque to the model's below which gravity may be missing from the measured
torque."""
ODD_UNIT = 20.0
"""Ratio of one joint's torque to the model's, over that of the other joints, above which the joint
has a unit of its own."""
SMALLER = 3.0
"""Factor by which the measured weight of all loaded joints has to be smaller than the model's to be
in another unit. Arms whose links are off by 20 %, one of them by 40 %, measure at least 0.53 of it.
"""
LARGER = 5.0
"""Factor by which it has to be larger. The heaviest tool that an arm may carry, which its model
lacks, makes at least one joint's weight no larger than 3.4 times."""
FOLLOWS = 0.5
"""Least correlation of a torque with the model's weight for their ratio to be a scale: where
friction is as large as the weight, it is 0.66."""
WEIGHING = (
    "give the torque per ampere with --torque-constants, or determine it with a weight: bolt on "
    "1 kg (of another mass, state it), record a motion called weight, and compare"
)
"""What to do where torques are motor currents; the command that compares follows the message."""
# Model torque below which a joint's torque is mostly friction, over that of the strongest joint.
_LEAST_LOAD = 0.03
# Least weight of a joint [N m] or [N], far below any that matters.
_NOTHING = 1e-12


def typical_scale(log: LogRows) -> float:
    """Return the median ratio of rms measured to modelled torque, over joints that links load."""
    return float(np.median(log.torque_ratio(LOADED)[log.is_loaded]))


def odd_unit_finding(log: LogRows) -> Finding | None:
    """Return the finding that one joint's torque has another unit than that of the other joints.

    None where no joint has, with fewer than three joints, and where gravity may be missing.
    """
    ratio = log.torque_ratio(_LEAST_LOAD)
    joint = int(np.argmax(ratio))
    if len(ratio) < 3:
        return None
    factor = float(ratio[joint] / np.median(np.delete(ratio, joint)))
    # A torque without gravity has a share of the model's at joints that carry weight.
    if factor < ODD_UNIT or typical_scale(log) < SMALL:
        return None
    name = log.robot.joint_names[joint]
    # Of a joint that the links hardly load, the factor is only a lower bound.
    text = (
        f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in mN·m or "
        f"N·cm; put it right with --columns FILE: torque.{name} = 0.001 * TITLE"
    )
    return Finding("torque-scale", Level.REFUSE, text)


def foreign_unit_finding(log: LogRows, divided: Array) -> Finding | None:
    """Return the finding that the torques of no loaded joint are in newton metres.

    Compared is how much of the model's weight the torque of each joint contains. None where a
    joint that the weight loads has about as much as the model says, or where its torque does not
    follow the weight: gravity may then be missing from the torques.

    Args:
        log: equations of the log.
        divided: (n,) torque scales by which the torques were divided already.
    """
    weight = log.model_weight
    size = np.maximum(rms(weight), _NOTHING)
    # Recorded over modelled weight of each joint, negative where the sign is the opposite one.
    scale = np.mean(log.torque * weight, axis=0) / size**2
    correlation = scale * size / np.maximum(rms(log.torque), _NOTHING)
    load = _relative_load(size, log.robot.is_slide)
    follows = (np.abs(correlation) > FOLLOWS) & (load > _LEAST_LOAD)
    is_loaded = load > LOADED
    factor = np.abs(scale[is_loaded])
    is_smaller = bool(np.all(factor < 1.0 / SMALLER))
    is_larger = bool(np.all(factor > LARGER))
    if not np.all(follows[is_loaded]) or not (is_smaller or is_larger):
        return None

    joint_names = log.robot.joint_names
    names = np.array(joint_names)
    ratio = 1.0 / factor if is_smaller else factor
    pairs = zip(names[is_loaded], ratio)
    joint_ratios = [f"{name} {value:.3g}" for name, value in pairs]
    kind = "smaller" if is_smaller else "larger"
    unit = "motor currents or torques before the gear"
    if is_larger:
        unit = "currents in mA or per cent of the motors' rated torques"
    is_turned = follows & (scale < 0.0)
    sign_text = ""
    correction = None
    if np.any(is_turned):
        signs = np.where(is_turned, -1.0, 1.0)
        correction = ColumnCorrection.of_factors(("torque",), joint_names, signs)
        turned = ", ".join(names[is_turned])
        sign_text = f"of {turned} they have the opposite sign of the model's; "
    text = (
        f"the torques are not in N·m at the joint: they are {np.min(ratio):.3g} to "
        f"{np.max(ratio):.3g} times {kind} than the model's, by another factor in each joint that "
        f"carries weight ({', '.join(joint_ratios)}), as {unit} are, or the "
        f"log is of another arm; {sign_text}{WEIGHING}"
    )
    start = np.where(follows, np.abs(scale), np.median(factor)) * divided
    torque_scale = ",".join(format(value, ".4g") for value in start)
    options = ("--torque-scale", torque_scale)
    return Finding("torque-unit", Level.REFUSE, text, options, correction=correction)


def _relative_load(weight: Array, is_slide: NDArray[np.bool_]) -> Array:
    """Return the weight of each joint (n,) over that of the most loaded slide, or hinge.

    Args:
        weight: (n,) rms torque of the model's weight [N m], of slides force [N].
        is_slide: (n,) whether a joint is a slide.
    """
    largest_force = np.max(weight, where=is_slide, initial=_NOTHING)
    largest_torque = np.max(weight, where=~is_slide, initial=_NOTHING)
    return weight / np.where(is_slide, largest_force, largest_torque)

"""An arm identified from commands and positions alone: the result block, and servo.json."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from robot_sysid.output.params_json import json_text
from robot_sysid.output.printed.rollout import rollout_entry, rollout_lines
from robot_sysid.records.whole_arm import JointServo, ServoIdentification

SERVO_NAME, SERVO_SCHEMA = "servo.json", "robot-sysid servo 1"
WITHOUT_TORQUE = (
    "No torque was measured: all of this follows from commanded and measured positions, and from "
    "the masses of the model, which fix its scale"
)
UNITS = {"gain": "N·m/rad", "damping": "N·m·s/rad", "frictionloss": "N·m", "armature": "kg·m²"}


def servo_lines(found: ServoIdentification, verbose: bool = False) -> list[str]:
    """Return the block line by line; ``verbose`` adds the rollouts of every joint."""
    return [
        "Servos, friction and rotor inertia, before -> after, ± one standard error:",
        f"  {WITHOUT_TORQUE}.",
        f"  delay of the commands: {1e3 * found.delay:.1f} ± {1e3 * found.delay_error:.1g} ms "
        "(--write-delay puts it into the model)",
        *(f"  {joint.joint}: {_joint_text(joint)}" for joint in found.joints),
        *rollout_lines(found.rollout, verbose),
    ]


def _joint_text(joint: JointServo) -> str:
    if not joint.moves:
        return "does not move in these logs; all as in the model"
    return "; ".join(_figures(joint))


def _figures(joint: JointServo) -> Iterator[str]:
    for name, unit in UNITS.items():
        before, after = joint.before[name], joint.after[name]
        old = "" if math.isnan(before) else f"{before:.3g} -> "
        doubt = "" if joint.shares[name] > 0.5 else ", hardly seen"
        yield f"{name} {old}{after:.3g} ± {joint.errors[name]:.1g} {unit}{doubt}"


def servo_json_text(found: ServoIdentification) -> str:
    """Return the text of servo.json."""
    return json_text(
        {
            "schema": SERVO_SCHEMA,
            "torque": "none measured; from position error",
            "meaning": WITHOUT_TORQUE,
            "delay": {"value": found.delay, "standard_error": found.delay_error},
            "joints": {joint.joint: _entry(joint) for joint in found.joints},
            "rollout": rollout_entry(found.rollout),
            "position_errors": dict(found.position_errors),
            "source": found.data.words,
            "duration": found.data.duration,
            "model": {"path": str(found.model_path), "sha256": found.model_sha256},
            "versions": dict(found.versions),
            "notes": list(found.notes),
        }
    )


def _entry(joint: JointServo) -> dict[str, Any]:
    numbers = {
        name: {
            "before": joint.before[name],
            "value": joint.after[name],
            "standard_error": joint.errors[name],
            "data_share": joint.shares[name],
            "unit": unit,
        }
        for name, unit in UNITS.items()
    }
    rest = {k: v for k, v in asdict(joint).items() if k in ("moves", "has_servo", "at_limit")}
    return {**numbers, **rest}

"""The content of params.json: the table of a result behind the keys of the specification.

Console and report are views of it. It is strict JSON in full precision: numbers that are not finite
are null. ``inertia_tensor`` is about the body ORIGIN; the torque that friction takes is the sum of
all terms' values times ``friction_formulas``, with ``qd`` the joint's speed, ``top`` its entry in
``friction_tops``, and ``load`` the torque its gear transmits (that of the links alone).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import ROTOR, TERMS
from robot_sysid.records.file_access import CURVED_NAME, strict_json
from robot_sysid.records.messages import says
from robot_sysid.results.record import Identification
from robot_sysid.results.written_model import can_bend, versions
from robot_sysid.spatial import PARAMETER_NAMES

SCHEMA_VERSION = 7
"""Version of the format of params.json; readers refuse other versions."""
Content = Mapping[str, Any]
"""Key to value of params.json, or column to value of one of its rows."""


def content_of(
    result: Identification,
    card: Content | None = None,
    notes: Sequence[str] = (),
    failure: str | None = None,
    has_curved: bool = True,
) -> dict[str, Any]:
    """Return the content of params.json but for the verdict and the next step.

    Args:
        result: of the identification.
        card: numbers of the payload's card; None where none is written.
        notes: remarks on the written files, one sentence each.
        failure: why a result that is usable in itself must not be used; None for no such reason.
        has_curved: whether a file whose friction bends could be written.
    """
    quality = result.quality
    robot = result.robot
    joint = robot.terminal_joint
    payload = result.payload
    body = result.total
    friction = [result.quantity(term, joint) for term in ("coulomb", "viscous")]
    coulomb, viscous = [row and row.value for row in friction]
    is_identified = not quality.unidentifiable
    if payload is not None:
        is_identified = bool(np.all(payload.is_determined))
    content = {
        "schema_version": SCHEMA_VERSION,
        "joint_name": joint,
        "mass": body.mass,
        "center_of_mass_moment": body.first_moment,
        "inertia_tensor": dict(zip(PARAMETER_NAMES[4:], body.theta[4:])),
        "coulomb_friction": coulomb,
        "viscous_friction": viscous,
        "rmse": quality.rmse,
        "condition_number": quality.condition_number,
        "n_base_params": quality.n_base_params,
        "question": result.question,
        "body_name": robot.body_name,
        "status": result.verdict.name,
        "failure": refusal(result) or failure,
        "valid": {
            "physically_consistent": result.body.is_consistent,
            "all_identified": is_identified,
            "trustworthy": result.verdict.is_trustworthy,
        },
        "verdict": (),
        "next_step": None,
        "remarks": [*result.remarks, *says(notes)],
        "quantities": result.quantities,
        "friction_formulas": {
            name: term.formula for name, term in TERMS.items() if term is not ROTOR
        },
        "friction_tops": result.tops,
        "curves": result.curves,
        "file": result.file and _file_content(result, has_curved),
        "payload": payload
        and {
            "flange": payload.flange,
            "recordings": payload.recordings,
            "known_mass": payload.known_mass,
            "card": card,
        },
        "validation": result.validation,
        "torques": result.torques,
        "friction_model": result.friction_model,
        "cutoff": result.cutoff,
        "link_scales": result.link_scales,
        **vars(quality),
        "source": result.data.description,
        "logs": result.data.files,
        "model": {"path": str(robot.path), "sha256": robot.sha256},
        "joint_names": robot.joint_names,
        "seed": result.data.seed,
        "duration": result.data.duration,
        "sample_rate": result.data.sample_rate,
        "versions": versions(),
    }
    return {key: strict_json(value) for key, value in content.items()}


def _file_content(result: Identification, has_curved: bool) -> dict[str, Any]:
    """Return what is said of the written files; ``has_curved`` as of ``content_of``."""
    content = {"name": result.model_name, **strict_json(result.file)}
    if content["curved"] is not None:
        name = CURVED_NAME if has_curved and can_bend() else None
        content["curved"] = {"name": name, **content["curved"]}
    return content


def refusal(result: Identification) -> str | None:
    """Return why neither a model nor a card is written, or None where the result may be used."""
    if result.failure is None:
        return None
    missing = "no model was"
    if result.payload is not None:
        missing = "no model and no card were"
        if result.payload.known_mass is not None:
            missing = "no torque scales were"
    return f"{missing} written: {result.failure}"

"""params.json of a payload: payload, link and their sum, with errors, causes and cards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.output.cards import Card, card_entries, load_errors
from robot_sysid.output.params_json import SCHEMA_VERSION, inertial_entries, json_text
from robot_sysid.records import Flange
from robot_sysid.records.payload import BodyEstimate, PayloadIdentification


def payload_json_text(
    found: PayloadIdentification, cards: Sequence[Card], notes: tuple[str, ...] = ()
) -> str:
    """Return the text of params.json.

    Args:
        found: the result.
        cards: of the payload; empty where it is not trustworthy.
        notes: beside those of the result, one sentence each.
    """
    return json_text(
        {
            "schema_version": SCHEMA_VERSION,
            "command": "payload",
            "joint_name": found.joint_name,
            "body_name": found.body_name,
            "flange": _flange(found.flange),
            "payload": _body(found.payload),
            "link": _body(found.link),
            "link_with_payload": _body(found.total),
            **_quality(found, notes),
            "cards": card_entries(cards),
            **_origin(found),
        }
    )


def _flange(flange: Flange) -> dict[str, Any]:
    return {
        "name": flange.name,
        "in_body": flange.terminal,
        "translation": flange.translation,
        "rotation": flange.rotation,
    }


def _body(body: BodyEstimate) -> dict[str, Any]:
    return {
        **inertial_entries(body.inertial),
        "standard_errors": {
            **dict(zip(PARAMETER_NAMES, body.errors)),
            **load_errors(body.inertial, body.covariance),
        },
        "standard_errors_noise": dict(zip(PARAMETER_NAMES, body.noise_errors)),
        "error_budget": {
            "noise": dict(zip(PARAMETER_NAMES, body.noise_errors)),
            **{cause: dict(zip(PARAMETER_NAMES, part)) for cause, part in body.budget.items()},
        },
    }


def _quality(found: PayloadIdentification, notes: tuple[str, ...]) -> dict[str, Any]:
    with_errors = {
        name: {"value": value, "standard_error": error}
        for name, (value, error) in found.parameters.items()
    }
    scales = {
        joint: {"scale": scale, "standard_error": error}
        for joint, (scale, error) in found.torque_scale.items()
    }
    return {
        "status": found.status.name,
        "status_text": found.status.value,
        "reasons": found.reasons,
        "valid": {
            "physically_consistent": found.payload.inertial.is_consistent,
            "trustworthy": found.status.is_trustworthy,
        },
        "rmse": found.rmse,
        "validation": None if found.validation is None else asdict(found.validation),
        "scatter": [asdict(one) for one in found.scatter],
        "friction_model": found.friction_model,
        "parameters": with_errors,
        "known_mass": found.known_mass,
        "torque_scale": scales,
        "notes": found.notes + notes,
    }


def _origin(found: PayloadIdentification) -> dict[str, Any]:
    return {
        "recordings": dict(found.recordings),
        "duration": found.duration,
        "cutoff": found.cutoff,
        "model": {"path": str(found.model_path), "sha256": found.model_sha256},
        "joint_names": found.joint_names,
        "versions": dict(found.versions),
    }

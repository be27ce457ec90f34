"""params.json: what was identified and how far to trust it, the same of every question.

Strict JSON in full precision: what is not a finite number becomes null. Inertia is about the body
ORIGIN in ``inertia_tensor`` and about the centre of mass in ``inertia_about_com``, in the frame of
the body; of a payload in the flange frame.

The torque that friction takes is the sum of all terms' values times ``friction_formulas``, with
``qd`` the joint's speed and ``load`` the torque its gear transmits (that of the links alone).
``bam`` holds a joint's numbers under the names of BAM ("better actuator models", Duclusaud,
Passault, Padois, Ly, "Extended friction models for the physics simulation of servo actuators",
ICRA 2025), its models m1 to m4. BAM takes the sum of motor and external torque for the load, which
at rest is twice what the gear transmits, so that its loss per load is half of ours. It also wants
the name of an actuator, which says how voltage makes torque and is not identified here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import InertialParameters, PriorConflict, Validation
from robot_sysid.records.file_access import write_atomically
from robot_sysid.results import record
from robot_sysid.results.cards import ERROR_NAMES, INERTIA, Card, load_errors
from robot_sysid.results.model import versions
from robot_sysid.results.record import (
    BodyEstimate,
    Figure,
    JointEstimate,
    Payload,
    Result,
    RolloutTest,
)
from robot_sysid.results.verdict import PRIOR_SHARE, limitations, verdict_lines

SCHEMA_VERSION = 4
FORMULAS = {
    "coulomb": "sign(qd)",
    "viscous": "qd",
    "offset": "1",
    "sqrt": "sign(qd) * sqrt(abs(qd))",
    "fading_fast": "sign(qd) * exp(-abs(qd) / 0.04)",
    "fading": "sign(qd) * exp(-abs(qd) / 0.13)",
    "fading_slow": "sign(qd) * exp(-abs(qd) / 0.4)",
    "stribeck": "sign(qd) * exp(-(qd / stribeck_speed)**2)",
    "load": "sign(qd) * abs(load)",
    "quadratic": "qd * abs(qd)",
    "cubic": "qd**3",
    "sigmoid": "tanh(qd / sigmoid_speed)",
}
_SURE = 1.96
"""Standard errors on each side of a value that hold 95 % of a bell curve."""
_WHEN = ("before", "after")
_OF_PAYLOAD = ("recordings", "scatter", "known_mass", "torque_scale")
_OF_RUN = ("delay", "tilt", "cutoff", "friction_model")
_IN_BAM = {
    "viscous": ("friction_viscous", 1.0),
    "stribeck": ("friction_stribeck", 1.0),
    "stribeck_speed": ("dtheta_stribeck", 1.0),
    "load": ("load_friction_base", 0.5),
    "armature": ("armature", 1.0),
}


def export_params_json(result: Result, path: Path, notes: Sequence[str] = ()) -> None:
    """Write params.json, or raise InputError; ``notes``, a sentence each, join the result's."""
    write_atomically(path, params_json_text(result, notes=notes))


def params_json_text(
    result: Result,
    cards: Sequence[Card] = (),
    notes: Sequence[str] = (),
    failure: str | None = None,
) -> str:
    """Return the text of params.json, with the payload's cards, notes of one sentence each, and why
    nothing may be used of a result that may be used for itself, or None.
    """
    found = replace(result, notes=(*result.notes, *notes))
    content = {
        "schema_version": SCHEMA_VERSION,
        **_asked(found),
        "verdict": verdict_lines(result, failure),
        "file": _file(found.file),
        "payload": _payload(found.payload, cards),
        "links": [_link(found, body) for body in found.links],
        "joints": {
            name: _joint(found, name, each) for name, each in found.joints.items()
        },
        "couplings": {
            name: {"terms": each.terms, "in_the_file": _written_terms(found, name)}
            for name, each in found.couplings.items()
        },
        "friction_formulas": FORMULAS,
        "sensors": found.sensors,
        **_fit(found),
        **_beside(found),
    }
    return json_text(content)


def json_text(content: Mapping[str, Any]) -> str:
    """Return strict JSON: arrays as lists, numbers that are not finite as null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False) + "\n"


def inertial_entries(inertial: InertialParameters) -> dict[str, Any]:
    """Return the ten parameters and what follows from them as JSON entries."""
    return {
        "mass": inertial.mass,
        "center_of_mass_moment": inertial.first_moment,
        "inertia_tensor": dict(zip(INERTIA, inertial.theta[4:])),
        "center_of_mass": inertial.com,
        "inertia_about_com": dict(
            zip(INERTIA, spatial.six_from_symmetric(inertial.inertia_com))
        ),
        "principal_moments": inertial.principal_moments,
    }


def _asked(result: Result) -> dict[str, Any]:
    estimate = result.estimate
    joint = result.robot.terminal_joint
    payload = result.payload
    entries = inertial_entries(
        (estimate if payload is None else payload.total).inertial
    )
    seen = not estimate.identifiability.unidentifiable
    return {
        "joint_name": joint,
        **{key: entries.pop(key) for key in list(entries)[:3]},
        "coulomb_friction": estimate.value(f"coulomb[{joint}]"),
        "viscous_friction": estimate.value(f"viscous[{joint}]"),
        "rmse": estimate.rmse,
        "condition_number": estimate.identifiability.condition_number,
        "n_base_params": estimate.identifiability.rank,
        "question": result.question,
        "body_name": result.robot.body_name,
        **entries,
        "status": result.verdict.name,
        "status_text": result.verdict.value,
        "reasons": result.reasons,
        "known_to": result.known_to,
        "valid": {
            "physically_consistent": result.body.inertial.is_consistent,
            "all_identified": seen
            if payload is None
            else bool(np.all(payload.body.shown)),
            "trustworthy": result.verdict.is_trustworthy,
        },
    }


def _file(file: record.ModelFile | None) -> dict[str, Any] | None:
    if file is None:
        return None
    pairs = [
        dict(zip(_WHEN, tests)) for tests in ((file.before, file.after), *file.others)
    ]
    return {
        "torque_error": {
            when: test and test.relative_error for when, test in pairs[0].items()
        },
        **pairs[0],
        "others": pairs[1:],
        "gravity": file.gravity,
        "kept": file.kept,
    }


def _payload(found: Payload | None, cards: Sequence[Card]) -> dict[str, Any] | None:
    if found is None:
        return None
    flange = found.flange
    return {
        "flange": {
            "name": flange.name,
            "in_body": flange.terminal,
            "translation": flange.translation,
            "rotation": flange.rotation,
        },
        **{name: _body(getattr(found, name)) for name in ("body", "link", "total")},
        **{name: getattr(found, name) for name in _OF_PAYLOAD},
        "cards": {
            card.name: {k: v for k, v in vars(card).items() if k != "name"}
            for card in cards
        },
    }


def _body(body: BodyEstimate) -> dict[str, Any]:
    def named(values: Any) -> dict[str, Any]:
        return dict(zip(PARAMETER_NAMES, values))

    from_data = body.shown & (body.data_share >= PRIOR_SHARE)
    return {
        "name": body.name,
        **inertial_entries(body.inertial),
        "model": None if body.before is None else inertial_entries(body.before),
        "standard_errors": {
            **named(body.errors),
            **dict(zip(ERROR_NAMES, load_errors(body))),
        },
        "standard_errors_noise": named(body.noise_errors),
        "error_budget": {
            "noise": named(body.noise_errors),
            **{cause: named(part) for cause, part in body.budget.items()},
        },
        "data_share": named(body.data_share),
        "source": named(np.where(from_data, "identified", "from_model").tolist()),
    }


def _link(result: Result, body: BodyEstimate) -> dict[str, Any]:
    written = None
    if result.file is not None and body.joint is not None:
        theta = result.file.thetas[result.robot.joint_names.index(body.joint)]
        written = inertial_entries(InertialParameters(theta)) if np.any(theta) else None
    return {
        "name": body.name,
        "joint": body.joint,
        **_body(body),
        "in_the_file": written,
    }


def _joint(result: Result, name: str, joint: JointEstimate) -> dict[str, Any]:
    written = _written_terms(result, name)
    ways = joint.two_ways
    return {
        "friction_model": joint.friction_model,
        "terms": joint.terms,
        "model": joint.before,
        "in_the_file": written,
        "held_out_rmse_by_friction_model": joint.candidates,
        "two_ways": ways and dict(zip(("forward", "backward"), ways)),
        "logs": joint.logs,
        "another_day": joint.another_day,
        "torque_noise": joint.noise,
        "bam": _bam(joint, written),
    }


def _written_terms(result: Result, name: str) -> Mapping[str, Figure]:
    """Return what the written model has of a joint's friction, or of a shared motor's."""
    return {} if result.file is None else result.file.joints.get(name, {})


def _bam(joint: JointEstimate, written: Mapping[str, Figure]) -> dict[str, Any] | None:
    """Return what BAM's load_model_from_dict reads, but for the actuator's name."""
    terms = set(joint.friction_model.split("-")) - {"none"}
    figures = joint.terms
    if terms - {"coulomb", "viscous", "offset", "armature", "stribeck", "load"}:
        # BAM has no such curve: the nearest Coulomb and viscous friction, as in the file.
        terms = {"coulomb", "viscous", "armature"}
        figures = written
    if "coulomb" not in figures:
        return None
    number = 1 + ("stribeck" in terms) + 2 * ("load" in terms)
    known = {
        n: share * figures[t].value for t, (n, share) in _IN_BAM.items() if t in figures
    }
    return {
        "model": f"m{number}",
        "friction_base": figures["coulomb"].value,
        "friction_viscous": 0.0,
        **known,
        **({"alpha": 2.0} if "stribeck" in terms else {}),
        **({"load_friction_stribeck": 0.0} if number == 4 else {}),
    }


def _fit(result: Result) -> dict[str, Any]:
    estimate = result.estimate
    errors = result.estimate.standard_errors
    seen = estimate.identifiability
    words = {True: "identified", False: "from_model"}
    return {
        "method": estimate.method,
        "torques": result.torques,
        "parameter_source": {
            n: words[bool(k)] for n, k in zip(estimate.names, seen.identified)
        },
        "unidentifiable_combinations": seen.unidentifiable,
        "rmse_per_joint": estimate.rmse_per_joint,
        "condition_number_scaled": seen.scaled_condition_number,
        "constrained": estimate.constrained,
        "standard_errors": None
        if errors is None
        else dict(zip(estimate.names, errors)),
        "prior_conflicts": [_prior_conflict(conflict) for conflict in result.conflicts],
        "link_scales": result.link_scales,
        "wrong_links": result.wrong_links,
        "noise_per_joint": estimate.noise_per_joint,
        "samples_per_joint": estimate.samples,
        "effective_samples_per_joint": estimate.effective_samples,
    }


def _prior_conflict(conflict: PriorConflict) -> dict[str, Any]:
    return {
        "cause": conflict.cause,
        "members": conflict.members,
        "asked": conflict.deviation,
        "scale": conflict.scale,
    }


def _beside(result: Result) -> dict[str, Any]:
    base = result.base
    data = result.data
    robot = result.robot
    rows = None
    if base is not None:
        names = ("combination", "value", "standard_error", "essential")
        columns = (base.combinations, base.values, base.standard_errors, base.essential)
        rows = [dict(zip(names, row)) for row in zip(*columns)]
    return {
        "base_parameters": rows,
        "structural_rank": None if base is None else base.structural_rank,
        "validation": result.validation,
        "rollout": rollout_entry(result.rollout),
        **{name: getattr(result, name) for name in _OF_RUN},
        "limitations": limitations(result),
        "notes": result.notes,
        "source": data.description,
        "logs": data.files,
        "model": {"path": str(robot.path), "sha256": robot.sha256},
        "joint_names": robot.joint_names,
        **{name: getattr(data, name) for name in ("seed", "duration", "sample_rate")},
        "versions": versions(),
    }


def _strict(value: Any) -> Any:
    """Return what strict JSON can hold: a figure gets its 95 % interval, a record its names."""
    if isinstance(value, Figure):
        found = value.value
        reach = _SURE * value.error
        interval = [found - reach, found + reach]
        return _strict(
            {"value": found, "standard_error": value.error, "interval": interval}
        )
    if isinstance(value, Validation):
        entries = asdict(value)
        entries["told_enough"] = entries.pop("is_informative")
        return _strict(entries)
    if is_dataclass(value) and not isinstance(value, type):
        return _strict(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return _strict(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def rollout_entry(test: RolloutTest | None) -> dict[str, Any] | None:
    """Return the entry of params.json; None where nothing was played."""
    if test is None:
        return None

    def figures(before: float, after: float) -> dict[str, float | None]:
        ratio = after / before if before > 0.0 else None
        return {"before": before, "after": after, "ratio": ratio}

    return {
        "held_out": test.held_out,
        "closed_loop_is": test.servo,
        **{name: getattr(test, name) for name in ("is_better", "score")},
        "errors": [
            {
                **{
                    name: getattr(error, name)
                    for name in ("loop", "horizon", "windows")
                },
                "diverged": dict(zip(("before", "after"), error.diverged)),
                "overall": figures(*error.overall),
                "joints": dict(
                    zip(test.joint_names, map(figures, error.before, error.after))
                ),
            }
            for error in test.errors
        ],
        "notes": list(test.notes),
    }

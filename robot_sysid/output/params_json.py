"""params.json: the identified parameters and how far to trust them, in full precision.

Strict JSON: what is not a finite number becomes null. Inertia is about the body ORIGIN in
``inertia_tensor`` and about the centre of mass in ``inertia_about_com``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.output.limitations import limitations
from robot_sysid.output.printed.rollout import rollout_entry
from robot_sysid.records import Estimate, Identification, InertialParameters
from robot_sysid.records.atomic_files import write_whole

SCHEMA_VERSION = 3
_SIX = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")


def export_params_json(
    identification: Identification, path: Path, notes: tuple[str, ...] = ()
) -> None:
    """Write params.json.

    Args:
        identification: the result.
        path: file to write; its folder is created.
        notes: beside those of the identification, one sentence each.

    Raises:
        InputError: the file cannot be written.
    """
    write_whole(path, params_json_text(identification, notes))


def params_json_text(identification: Identification, notes: tuple[str, ...] = ()) -> str:
    """Return the text of params.json; arguments as in ``export_params_json``."""
    found = replace(identification, notes=identification.notes + notes)
    parts = (_result, _quality, _uncertainty, _measured, _origin)
    content = {key: value for part in parts for key, value in part(found).items()}
    return json_text(content)


def json_text(content: Mapping[str, Any]) -> str:
    """Return strict JSON: arrays as lists, numbers that are not finite as null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False) + "\n"


def inertial_entries(inertial: InertialParameters) -> dict[str, Any]:
    """Return the ten parameters and what follows from them as JSON entries."""
    six = inertial.theta[4:]
    about_com = spatial.six_from_symmetric(inertial.inertia_com)
    return {
        "mass": inertial.mass,
        "center_of_mass_moment": inertial.first_moment,
        "inertia_tensor": dict(zip(_SIX, six)),
        "center_of_mass": inertial.com,
        "inertia_about_com": dict(zip(_SIX, about_com)),
        "principal_moments": inertial.principal_moments,
    }


def _result(identification: Identification) -> dict[str, Any]:
    estimate, joint = identification.estimate, identification.joint_name
    entries = inertial_entries(estimate.inertial)
    derived = {key: entries.pop(key) for key in list(entries)[3:]}
    return {
        "schema_version": SCHEMA_VERSION,
        "joint_name": joint,
        "body_name": identification.body_name,
        **entries,
        "coulomb_friction": estimate.value(f"coulomb[{joint}]"),
        "viscous_friction": estimate.value(f"viscous[{joint}]"),
        "rmse": estimate.rmse,
        "condition_number": estimate.identifiability.condition_number,
        "n_base_params": estimate.identifiability.rank,
        **derived,
    }


def _quality(identification: Identification) -> dict[str, Any]:
    estimate = identification.estimate
    seen = estimate.identifiability
    return {
        "status": estimate.status.name,
        "status_text": estimate.status.value,
        "reasons": identification.reasons,
        "valid": {
            "physically_consistent": estimate.inertial.is_consistent,
            "all_identified": all(seen.identified),
            "trustworthy": estimate.status.is_trustworthy,
        },
        "method": estimate.method,
        "torques": identification.torques,
        "parameter_source": _sources(estimate),
        "unidentifiable_combinations": seen.unidentifiable,
        "rmse_per_joint": dict(estimate.rmse_per_joint),
        "condition_number_scaled": seen.scaled_condition_number,
        "prior": inertial_entries(identification.prior),
        "notes": identification.notes,
    }


def _uncertainty(identification: Identification) -> dict[str, Any]:
    estimate = identification.estimate

    def named(values: Any) -> dict[str, Any] | None:
        return None if values is None else dict(zip(estimate.names[: estimate.n_interest], values))

    return {
        "constrained": estimate.constrained,
        "standard_errors": named(estimate.standard_errors),
        "standard_errors_noise": named(estimate.noise_errors),
        "error_budget": _budget(estimate),
        "relative_standard_errors": named(estimate.relative_errors),
        "data_share": named(estimate.data_share),
        "noise_per_joint": dict(estimate.noise_per_joint),
        "samples_per_joint": dict(estimate.samples),
        "effective_samples_per_joint": dict(estimate.effective_samples),
        "nuisances": dict(
            zip(estimate.names[estimate.n_interest :], estimate.values[estimate.n_interest :])
        ),
        "limitations": limitations(identification),
    }


def _budget(estimate: Estimate) -> dict[str, dict[str, float]]:
    """Return parameter to cause to the standard deviation that this cause explains."""
    parts = {**estimate.error_budget}
    if estimate.noise_errors is not None:
        parts = {"noise": estimate.noise_errors, **parts}
    return {
        name: {cause: float(values[index]) for cause, values in parts.items()}
        for index, name in enumerate(estimate.names[: estimate.n_interest])
    }


def _measured(identification: Identification) -> dict[str, Any]:
    return {
        "source": identification.data.words,
        "logs": identification.data.files,
        "friction_model": identification.friction_model,
        "friction_per_joint": friction_entries(identification),
        "validation": [asdict(test) for test in identification.validation],
        "delay": identification.delay,
        "tilt": identification.tilt,
        "gravity": identification.gravity,
        "cutoff": identification.cutoff,
    }


def friction_entries(identification: Identification) -> dict[str, dict[str, float]]:
    """Return joint name to its estimated friction terms: {"joint6": {"coulomb": 0.4, ...}}."""
    found: dict[str, dict[str, float]] = {}
    estimate = identification.estimate
    for name, value in zip(estimate.names[: estimate.n_interest], estimate.values):
        term, bracket, rest = name.partition("[")
        if bracket:
            found.setdefault(rest[:-1], {})[term] = float(value)
    return found


def _origin(identification: Identification) -> dict[str, Any]:
    return {
        "model": {"path": str(identification.model_path), "sha256": identification.model_sha256},
        "joint_names": identification.joint_names,
        "seed": identification.data.seed,
        "duration": identification.data.duration,
        "sample_rate": identification.data.sample_rate,
        "versions": dict(identification.versions),
        **_rollout(identification),
    }


def _rollout(identification: Identification) -> dict[str, Any]:
    test = identification.rollout
    return {} if test is None else {"rollout": rollout_entry(test)}


def _sources(estimate: Estimate) -> dict[str, str]:
    seen = estimate.identifiability.identified
    words = {True: "identified", False: "from_model"}
    return {name: words[bool(known)] for name, known in zip(estimate.names, seen)}


def _strict(value: Any) -> Any:
    """Return what strict JSON can hold: arrays as lists, non-finite numbers as null."""
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_strict(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value

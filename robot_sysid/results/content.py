"""The content of params.json: a table of its keys and where each comes from.

Console and report are views of it. It is strict JSON in full precision: numbers that are not finite
are null. ``inertia_tensor`` is about the body ORIGIN; the torque that friction takes is the sum of
all terms' values times ``friction_formulas``, with ``qd`` the joint's speed, ``top`` its entry in
``friction_tops``, and ``load`` the torque its gear transmits (that of the links alone).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import COULOMB, ROTOR, TERMS, VISCOUS
from robot_sysid.records import ModelErrors, Validation
from robot_sysid.records.file_access import CURVED_NAME, MODEL_NAMES, strict_json
from robot_sysid.records.messages import says
from robot_sysid.results.record import Identification, ModelFile
from robot_sysid.results.written_model import can_bend, versions
from robot_sysid.spatial import PARAMETER_NAMES

SCHEMA_VERSION = 8
"""Version of the format of params.json; readers refuse other versions."""
Content = Mapping[str, Any]
"""Key to value of params.json, or column to value of one of its rows."""
_ERROR_KEYS = (
    "source",
    "n_samples",
    "rmse",
    "relative_error",
    "rmse_per_joint",
    "relative_error_per_joint",
    "is_informative",
)


@dataclass(frozen=True)
class Params:
    """What params.json is made from: a result, and what became of its files.

    Attributes:
        result: of the identification.
        card: numbers of the payload's card; None where none is written.
        notes: remarks on the written files, one sentence each.
        failure: why a result that is usable in itself must not be used; None for no such reason.
        written: names of the files that could be written; None for all of them.
    """

    result: Identification
    card: Content | None = None
    notes: Sequence[str] = ()
    failure: str | None = None
    written: Collection[str] | None = None

    def is_written(self, name: str) -> bool:
        """Return whether a file of this name could be written."""
        return self.written is None or name in self.written

    def friction(self, term: str) -> float | None:
        """Return the value of a friction term of the terminal joint; None where it has none."""
        row = self.result.quantity(term, self.result.robot.terminal_joint)
        return None if row is None else row.value

    def validity(self) -> dict[str, bool]:
        """Return what holds of the numbers."""
        payload = self.result.payload
        is_identified = not self.result.quality.unidentifiable
        if payload is not None:
            is_identified = bool(np.all(payload.is_determined))
        return {
            "physically_consistent": self.result.body.is_consistent,
            "all_identified": is_identified,
            "trustworthy": self.result.verdict.is_trustworthy,
        }

    def payload(self) -> dict[str, Any] | None:
        """Return what is said of a payload beside its numbers; None of an arm."""
        payload = self.result.payload
        if payload is None:
            return None
        return {
            "flange": payload.flange,
            "recordings": payload.recordings,
            "known_mass": payload.known_mass,
            "card": self.card,
        }

    def file(self) -> dict[str, Any] | None:
        """Return what is said of the written files; None where no file was fitted, or where that
        could not be written which has all fitted numbers.
        """
        file = self.result.file
        model_name = self.result.model_name
        written = [*filter(self.is_written, MODEL_NAMES.values())]
        if written and model_name not in written:
            # An MJCF failed its check; the URDF beside it may lack numbers.
            model_name = written[0]
            file = None if self.result.needs_mjcf else file
        if file is None:
            return None
        curved = None
        if file.curved is not None:
            is_written = self.is_written(CURVED_NAME) and can_bend()
            name = CURVED_NAME if is_written else None
            curved = {
                "name": name,
                **_errors_of_file(file.curved),
                "elsewhere": _elsewhere_of(file.curved),
            }
        return {
            "name": model_name,
            **_errors_of_file(file),
            "gravity": file.gravity,
            "kept": file.kept,
            "curved": curved,
            "elsewhere": _elsewhere_of(file),
        }


def _errors_of_file(file: ModelFile) -> dict[str, Any]:
    """Return the errors of a written model, on held-out data and on other logs."""
    held_out, *others = map(_errors_of_data, file.errors)
    return {**held_out, "others": others}


def _errors_of_data(errors: ModelErrors) -> dict[str, Any]:
    """Return the errors of both models on some data, and those with offsets as errors."""
    return {
        "before": _errors_of(errors.before),
        "after": _errors_of(errors.after),
        "before_as_used": _errors_of(errors.as_used.before),
        "after_as_used": _errors_of(errors.as_used.after),
    }


def _errors_of(validation: Validation) -> dict[str, Any]:
    """Return what params.json says of torque errors on some data."""
    return {key: getattr(validation, key) for key in _ERROR_KEYS}


def _elsewhere_of(file: ModelFile) -> dict[str, Any] | None:
    """Return what is expected of a written model on other motions, the speed of these first."""
    elsewhere = file.elsewhere
    if elsewhere is None:
        return None
    speed = {"speed": elsewhere.speed, "speed_unit": elsewhere.speed_unit}
    return {**speed, **strict_json(elsewhere)}


SOURCES: Mapping[str, Callable[[Params], Any]] = {
    "schema_version": lambda _: SCHEMA_VERSION,
    "joint_name": lambda p: p.result.robot.terminal_joint,
    "mass": lambda p: p.result.total.mass,
    "center_of_mass_moment": lambda p: p.result.total.first_moment,
    "inertia_tensor": lambda p: dict(
        zip(PARAMETER_NAMES[4:], p.result.total.theta[4:])
    ),
    "coulomb_friction": lambda p: p.friction(COULOMB.name),
    "viscous_friction": lambda p: p.friction(VISCOUS.name),
    "rmse": lambda p: p.result.quality.rmse,
    "condition_number": lambda p: p.result.quality.condition_number,
    "n_base_params": lambda p: p.result.quality.n_base_params,
    "question": lambda p: p.result.question,
    "body_name": lambda p: p.result.robot.body_name,
    "status": lambda p: p.result.verdict,
    "failure": lambda p: refusal(p.result) or p.failure,
    "valid": lambda p: p.validity(),
    "verdict": lambda _: (),
    "next_step": lambda _: None,
    "unshown_scales": lambda p: p.result.unshown_scales,
    "remarks": lambda p: [*p.result.remarks, *says(p.notes)],
    "quantities": lambda p: p.result.quantities,
    "friction_formulas": lambda _: {
        name: term.formula for name, term in TERMS.items() if term is not ROTOR
    },
    "friction_tops": lambda p: p.result.tops,
    "curves": lambda p: p.result.curves,
    "file": lambda p: p.file(),
    "payload": lambda p: p.payload(),
    "validation": lambda p: [*map(_errors_of, p.result.validation)],
    "torques": lambda p: p.result.torques,
    "friction_model": lambda p: p.result.friction_model,
    "cutoff": lambda p: p.result.cutoff,
    "link_scales": lambda p: p.result.link_scales,
    "unidentifiable": lambda p: p.result.quality.unidentifiable,
    "rmse_per_joint": lambda p: p.result.quality.rmse_per_joint,
    "noise_per_joint": lambda p: p.result.quality.noise_per_joint,
    "samples_per_joint": lambda p: p.result.quality.samples_per_joint,
    "source": lambda p: p.result.data.description,
    "logs": lambda p: p.result.data.files,
    "model": lambda p: {
        "path": str(p.result.robot.path),
        "sha256": p.result.robot.sha256,
    },
    "joint_names": lambda p: p.result.robot.joint_names,
    "seed": lambda p: p.result.data.seed,
    "duration": lambda p: p.result.data.duration,
    "sample_rate": lambda p: p.result.data.sample_rate,
    "versions": lambda _: versions(),
}
"""Each key of params.json and where its value comes from, in the order of the file."""


def content_of(
    result: Identification,
    card: Content | None = None,
    notes: Sequence[str] = (),
    failure: str | None = None,
    written: Collection[str] | None = None,
) -> dict[str, Any]:
    """Return the content of params.json but for the verdict and the next step.

    See ``Params`` for the arguments.
    """
    params = Params(result, card, notes, failure, written)
    return {key: strict_json(source(params)) for key, source in SOURCES.items()}


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

"""Made-up identifications of a two-joint arm, for tests of what is said about them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES, theta_from_com
from robot_sysid.records import (
    DataOrigin,
    Estimate,
    Identifiability,
    Identification,
    InertialParameters,
    Source,
    Status,
    Validation,
)

JOINTS = ("j5", "j6")
FRICTION = tuple(f"{term}[{joint}]" for joint in JOINTS for term in ("coulomb", "viscous"))
NAMES = (*PARAMETER_NAMES, *FRICTION)
THETA = theta_from_com(2.0, np.array([0.0, 0.01, 0.1]), np.diag([0.01, 0.012, 0.005]))
VALUES = np.array([*THETA, 0.5, 0.2, 0.4, 0.1])


def estimate(**changes) -> Estimate:
    """A result without any fault: white noise, small errors, all from the data."""
    size = len(NAMES)
    seen = Identifiability(12, 12, 50.0, 5.0, (True,) * size, ())
    fields = {
        "names": NAMES,
        "values": VALUES,
        "identifiability": seen,
        "rmse": 0.03,
        "rmse_per_joint": {"j5": 0.03, "j6": 0.03},
        "status": Status.OK,
        "method": "wls",
        "standard_errors": 1e-3 * np.ones(size) * np.maximum(np.abs(VALUES), 1e-2),
        "data_share": np.ones(size),
        "noise_per_joint": {"j5": 0.03, "j6": 0.031},
        "samples": {"j5": 200, "j6": 200},
        "effective_samples": {"j5": 190.0, "j6": 180.0},
    }
    return Estimate(**{**fields, **changes})


def found(result: Estimate | None = None, **changes) -> Identification:
    """Everything around it, of measured data."""
    fields = {
        "model_path": Path("arm.xml"),
        "model_sha256": "ab",
        "joint_name": "j6",
        "body_name": "link6",
        "joint_names": JOINTS,
        "prior": InertialParameters(0.5 * THETA),
        "estimate": result or estimate(),
        "torques": "chain",
        "data": DataOrigin(Source.LOG, "arm.csv", 15.0, 1000.0),
        "versions": {},
        "friction_model": "coulomb-viscous",
    }
    return Identification(**{**fields, **changes})


def own_simulation() -> DataOrigin:
    """Data that a simulation of the model itself made."""
    return DataOrigin(Source.ITSELF, "", 15.0, 1000.0, 1)


def with_value(name: str, value: float, error: float) -> Estimate:
    """The estimate with one parameter changed."""
    values, errors = VALUES.copy(), np.array(estimate().standard_errors)
    values[NAMES.index(name)], errors[NAMES.index(name)] = value, error
    return estimate(values=values, standard_errors=errors)


def without_mass() -> Estimate:
    """The mass does not show in the data."""
    errors = np.array(estimate().standard_errors)
    errors[0] = np.inf
    share = np.ones(len(NAMES))
    share[0] = 0.0
    seen = replace(
        estimate().identifiability,
        rank=11,
        identified=(False,) + (True,) * (len(NAMES) - 1),
        unidentifiable=("mass",),
    )
    return estimate(
        identifiability=seen,
        standard_errors=errors,
        data_share=share,
        status=Status.PARTLY_FROM_MODEL,
    )


def validation_of(rmse: float) -> Validation:
    """A validation with this error."""
    return Validation("other.csv", 100, rmse, 0.02, {"j5": rmse, "j6": rmse}, {"j5": 0.02})


def theta_in(path: Path) -> np.ndarray:
    """The ten parameters (10,) that a params.json holds."""
    content = json.loads(path.read_text(encoding="utf-8"))
    six = [content["inertia_tensor"][name] for name in PARAMETER_NAMES[4:]]
    return np.array([content["mass"], *content["center_of_mass_moment"], *six])

"""A payload result with made-up numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Flange, InertialParameters, Validation
from robot_sysid.records.payload import (
    BodyEstimate,
    OneRecording,
    PayloadIdentification,
    PayloadStatus,
)


def body(mass=1.2, com=(0.03, -0.02, 0.08), shown=True):
    """A body whose mass is known to 0.01 kg, 0.006 of it noise and 0.008 torque scale."""
    inertia = mass * np.diag([0.005, 0.006, 0.004])
    theta = spatial.theta_from_com(mass, np.array(com), inertia)
    covariance = np.diag([1e-4] + [1e-6] * 3 + [1e-8] * 6)
    errors = np.sqrt(np.diag(covariance))
    seen = np.array([True] * 4 + [shown] * 6)
    budget = {"torque scale": 0.8 * errors, "gravity": 1e-6 * errors}
    return BodyEstimate(InertialParameters(theta), covariance, seen, 0.6 * errors, budget)


def result(status=PayloadStatus.OK, **changes):
    """An identification of such a body."""
    values = {
        "model_path": Path("arm.xml"),
        "model_sha256": "0" * 64,
        "joint_name": "joint3",
        "body_name": "link3",
        "joint_names": ("joint0", "joint3"),
        "flange": Flange("site 'flange'", np.eye(3), np.zeros(3), "link3"),
        "payload": body(),
        "link": body(0.8),
        "total": body(2.0),
        "recordings": {"empty": ("a.csv",), "loaded": ("b.csv", "c.csv")},
        "scatter": (OneRecording("b.csv", True, 1.19, np.zeros(3), 0.01, 0.02),),
        "status": status,
        "reasons": () if status is PayloadStatus.OK else ("because",),
        "validation": Validation("fifths", 100, 0.1, 0.02, {"joint0": 0.1}, {"joint0": 0.02}),
        "friction_model": "coulomb-viscous",
        "parameters": {"coulomb[joint0]": (0.5, 0.01), "load[joint0]": (0.0, float("nan"))},
        "torque_scale": {},
        "known_mass": None,
        "rmse": 0.1,
        "duration": 60.0,
        "cutoff": 7.0,
        "versions": {"numpy": "2"},
        "notes": ("a note",),
    }
    return PayloadIdentification(**{**values, **changes})

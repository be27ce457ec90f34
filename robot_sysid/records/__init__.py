"""The frozen records that pass between stages; each checks itself once. SI units and radians.

Legend of shapes: N samples, n chain joints (base to terminal), p parameters.
"""

from __future__ import annotations

from robot_sysid.records.arm import (
    ArmLink,
    Flange,
    InertialParameters,
    JointFriction,
    JointLimits,
    RobotModel,
    SubtreeBody,
)
from robot_sysid.records.arrays import (
    Array,
    checked_array,
)
from robot_sysid.records.data import (
    TORQUE_CHOICES,
    BodyMotion,
    JointInformation,
    Measurement,
    Motion,
    MotionPlan,
    SampleSource,
    SquareRootInformation,
)
from robot_sysid.records.results import (
    DELAY_NAME,
    DataOrigin,
    Estimate,
    Identifiability,
    Identification,
    NuisanceMisfit,
    Source,
    Status,
    Validation,
)

__all__ = [
    "DELAY_NAME",
    "TORQUE_CHOICES",
    "ArmLink",
    "Array",
    "BodyMotion",
    "DataOrigin",
    "Estimate",
    "Flange",
    "Identifiability",
    "Identification",
    "InertialParameters",
    "JointFriction",
    "JointInformation",
    "JointLimits",
    "Measurement",
    "Motion",
    "MotionPlan",
    "NuisanceMisfit",
    "RobotModel",
    "SampleSource",
    "Source",
    "SquareRootInformation",
    "Status",
    "SubtreeBody",
    "Validation",
    "checked_array",
]

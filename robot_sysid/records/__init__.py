"""The frozen records that pass between stages; each checks itself once. SI units and radians.

Legend of shapes: N samples, n chain joints (base to terminal), p parameters.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robot_sysid.records.arm import ArmLink as ArmLink
    from robot_sysid.records.arm import Array as Array
    from robot_sysid.records.arm import Flange as Flange
    from robot_sysid.records.arm import InertialParameters as InertialParameters
    from robot_sysid.records.arm import JointFriction as JointFriction
    from robot_sysid.records.arm import JointLimits as JointLimits
    from robot_sysid.records.arm import RobotModel as RobotModel
    from robot_sysid.records.arm import SubtreeBody as SubtreeBody
    from robot_sysid.records.arm import checked_array as checked_array
    from robot_sysid.records.data import BodyMotion as BodyMotion
    from robot_sysid.records.data import JointInformation as JointInformation
    from robot_sysid.records.data import Measurement as Measurement
    from robot_sysid.records.data import Motion as Motion
    from robot_sysid.records.data import MotionPlan as MotionPlan
    from robot_sysid.records.data import SampleSource as SampleSource
    from robot_sysid.records.data import SquareRootInformation as SquareRootInformation
    from robot_sysid.records.results import DELAY_NAME as DELAY_NAME
    from robot_sysid.records.results import DataOrigin as DataOrigin
    from robot_sysid.records.results import Estimate as Estimate
    from robot_sysid.records.results import Identifiability as Identifiability
    from robot_sysid.records.results import PriorConflict as PriorConflict
    from robot_sysid.records.results import Source as Source
    from robot_sysid.records.results import Validation as Validation


def __getattr__(name: str) -> Any:
    """Load the records when one is first asked for: options and progress do not wait for numpy."""
    for module in ("arm", "data", "results"):
        found = vars(importlib.import_module(f"{__name__}.{module}"))
        if name in found:
            return globals().setdefault(name, found[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

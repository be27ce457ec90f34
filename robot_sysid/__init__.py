"""Identify a robot arm's terminal link: inertial parameters and friction from joint torques.

``import robot_sysid as rs``, then ``rs.identify("arm.xml", "log.csv")``; see docs/python.md. All
names are loaded when they are first used, so that the import itself takes no time.
"""

from importlib import import_module as _import_module

__version__ = "1.0.0"
# Module to the public names that it defines: functions, the types that they take and return, and
# errors. Typed in ``__init__.pyi``.
_NAMES = {
    "api.calls": (
        "Frame",
        "Log",
        "Model",
        "Regressor",
        "check",
        "identify",
        "joint_torque_regressor",
        "payload",
        "plan",
        "read_log",
        "self_test",
    ),
    "api.results": ("PlanResult", "Result"),
    "config": (
        "Config",
        "IdentifyConfig",
        "PayloadConfig",
        "PlanConfig",
        "SelfTestConfig",
    ),
    "errors": (
        "AmbiguousJointError",
        "ColumnsError",
        "ExportError",
        "HardwareAbort",
        "InputError",
        "ModelError",
        "SimulationError",
        "SysidError",
    ),
    "estimate.options": ("Priors",),
    "parser": ("load_robot_model",),
    "pipeline.changes": ("Change",),
    "pipeline.comparison": ("Check",),
    "pipeline.motions": ("CheckedPlan",),
    # What the package for motors adds is found by this module.
    "pipeline.motors": ("PlayReport", "motors"),
    "records.arm": (
        "ArmLink",
        "InertialParameters",
        "JointFriction",
        "RobotModel",
        "StatedBodies",
        "SubtreeBody",
    ),
    "records.data": (
        "ColumnMap",
        "DataOrigin",
        "FitQuality",
        "ModelErrors",
        "Motion",
        "Recording",
        "Traces",
        "Validation",
    ),
    "records.limits": ("Limits",),
    "records.messages": ("Level", "Remark"),
    "records.option_fields": ("RoughFactors",),
    "records.quantities": ("BodyEstimate", "FrictionCurve", "Quantity"),
    "records.servo_setting": ("ServoSetting",),
    "results.record": ("CurvedFile", "ModelFile", "Payload"),
    "results.verdicts": ("Verdict",),
}
# Public name to the module that defines it.
_MODULES = {name: module for module in _NAMES for name in _NAMES[module]}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _import_module(f"robot_sysid.{_MODULES[name]}")
    if name in _NAMES["pipeline.motors"]:
        module = module.motor_package()
    return module if name == "motors" else getattr(module, name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

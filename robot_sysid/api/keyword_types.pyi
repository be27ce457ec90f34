"""Types of the keywords, a stub for type checkers and editors: there is no such module.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
A class holds the keywords of the function in its name; one with an underscore those that the
functions in its name, and what builds on them, have alike.
"""

import os
from collections.abc import Sequence
from typing import Any, Literal, TypedDict

from numpy.typing import NDArray

File = str | os.PathLike[str]
Numbers = Sequence[float] | NDArray[Any]
Accept = Literal[
    "torque-scale", "torque-unit", "gravity", "computed", "sign", "order", "angle-unit",
    "zero", "model", "tilt", "clock", "delay", "saturated", "held", "contact", "force",
    "payload-step", "ripple", "coupling", "crosstalk", "friction", "unexplained",
    "too-little", "rollout"
]  # fmt: skip
Keep = Literal["friction", "rotors", "gravity", "links"]
Cards = Literal[
    "auto", "all", "franka", "ur", "kuka", "kinova", "xarm", "abb", "mecademic", "urdf",
    "mujoco"
]  # fmt: skip
Interface = Literal[
    "socketcan", "slcan", "gs_usb", "pcan", "kvaser", "vector", "ixxat", "canalystii",
    "cantact", "seeedstudio", "damiao", "virtual"
]  # fmt: skip

class _PayloadIdentify(TypedDict, total=False):
    accept: Accept | Sequence[Accept]
    coupling: File | None
    cutoff: float | None
    delay: Literal["off", "auto"]
    friction_model: str | None
    keep: Keep | Sequence[Keep]
    no_friction: bool
    tilt: Literal["off", "auto"]

class _PlayPlan(TypedDict, total=False):
    clearance: float
    keep_out: Numbers | Sequence[Numbers]
    max_acceleration: float | None
    max_torque: float | Numbers | None
    max_velocity: float | Numbers
    workspace: Numbers | None

class _PayloadPlanIdentify(TypedDict, total=False):
    delay_uncertainty: float
    friction_uncertainty: float
    gravity_uncertainty: float
    link_uncertainty: float
    scale_uncertainty: float | Numbers | None
    torques: Literal["chain", "terminal"]
    zero_uncertainty: float

class _PlanIdentify(TypedDict, total=False):
    duration: float
    noise_torque: float | Numbers
    sample_rate: float
    save_trajectory: File | None
    seed: int | None
    trajectory: File | None

class _HoldPlanIdentify(TypedDict, total=False):
    speed: float

class _PayloadPlan(TypedDict, total=False):
    static: bool

class JointTorqueRegressorKeywords(TypedDict, total=False):
    joint: str | None
    keyframe: str | None
    mesh_dir: File | None

class ReadLogKeywords(TypedDict, total=False):
    columns: File | None
    episode: int | Sequence[int]
    topic: str | None
    torque_constants: float | Numbers | File | None
    torque_scale: float | Numbers | File | None
    units: str | None

class HoldKeywords(JointTorqueRegressorKeywords, _HoldPlanIdentify, total=False):
    accept_directions: bool
    accept_register_limits: bool
    approach_speed: float
    bitrate: float
    bus_option: str | Sequence[str]
    channel: str | Sequence[str]
    data_bitrate: float
    fd: bool
    interface: Interface
    kd: float | Sequence[float]
    kp: float | Sequence[float]
    max_speed_error: float
    max_temperature: float
    max_torque_error: float | Sequence[float]
    max_tracking_error: float
    others: Literal["limp", "hold"]
    overwrite: bool
    park: str | None
    rate: float | None
    raw_log: File | None
    record: File | None
    set_watchdog: float | None
    start_tolerance: float

class PayloadKeywords(
    ReadLogKeywords, JointTorqueRegressorKeywords, _PayloadIdentify, _PayloadPlanIdentify,
    _PayloadPlan, total=False
):  # fmt: skip
    as_body: str | None
    cards: Cards
    flange: str | None
    known_mass: float | None
    order: str | None
    save_torque_scale: File | None

class PlayKeywords(HoldKeywords, _PlayPlan, total=False): ...

class PlanKeywords(
    JointTorqueRegressorKeywords, _PlayPlan, _PayloadPlanIdentify, _PlanIdentify,
    _HoldPlanIdentify, _PayloadPlan, total=False
):  # fmt: skip
    below_base: bool
    can_id: int | Sequence[int]
    excitation: Literal["sines", "optimal"]
    excitation_time_budget: float | None
    export_damiao: bool
    for_: Literal["link", "payload", "friction", "arm", "weight"]
    master_id: int | Sequence[int]
    max_tool_speed: float | None
    motor_type: str | Sequence[str]
    payload_reserve: float

class IdentifyKeywords(
    ReadLogKeywords, JointTorqueRegressorKeywords, _PayloadIdentify, _PayloadPlanIdentify,
    _PlanIdentify, _HoldPlanIdentify, total=False
):  # fmt: skip
    encoder_resolution: float
    links: bool
    plant_model: File | None
    save_measurements: File | None
    torque_delay: float

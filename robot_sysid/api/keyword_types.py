"""Types of the keywords, for type checkers and editors; no run imports this.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal, TypedDict, Union

from numpy.typing import NDArray

File = Union[str, "os.PathLike[str]"]
Numbers = Union[Sequence[float], NDArray[Any]]
Accept = Literal[
    "torque-scale", "gravity", "computed", "sign", "order", "angle-unit", "zero", "model",
    "clock", "delay", "saturated", "held", "contact", "too-little", "rollout"
]  # fmt: skip
Keep = Literal[
    "friction", "rotors", "gravity", "links"
]  # fmt: skip
Interface = Literal[
    "socketcan", "slcan", "gs_usb", "pcan", "kvaser", "vector", "ixxat", "canalystii",
    "cantact", "seeedstudio", "damiao", "virtual"
]  # fmt: skip


class ModelOptions(TypedDict, total=False):
    """Of a record."""

    mesh_dir: File | None
    joint: str | None
    keyframe: str | None


class ReadLogLogOptions(TypedDict, total=False):
    """Of a record."""

    columns: File | None
    units: str | None
    torque_scale: float | Numbers | File | None
    torque_constants: float | Numbers | File | None
    topic: str | None
    episode: int | Sequence[int]


class PayloadLogOptions(ReadLogLogOptions, total=False):
    """Of a record."""

    accept: Accept | Sequence[Accept]


class InformationLogOptions(PayloadLogOptions, total=False):
    """Of a record."""


class LogOptions(InformationLogOptions, total=False):
    """Of a record."""

    append: File | None


class PlanEstimationOptions(TypedDict, total=False):
    """Of a record."""

    torques: Literal["chain", "terminal"]
    link_uncertainty: float
    scale_uncertainty: float | Numbers | None
    zero_uncertainty: float
    gravity_uncertainty: float
    delay_uncertainty: float
    friction_uncertainty: float


class EstimationOptions(PlanEstimationOptions, total=False):
    """Of a record."""

    no_friction: bool
    friction_model: str | None
    cutoff: float | None
    velocity_deadband: float | Numbers | None
    delay: Literal["off", "auto"]
    tilt: Literal["off", "auto"]
    coupling: File | None


class PayloadOutputOptions(TypedDict, total=False):
    """Of a record."""

    keep: Keep | Sequence[Keep]


class OutputOptions(PayloadOutputOptions, total=False):
    """Of a record."""

    links: bool


class PayloadTrajectoryOptions(TypedDict, total=False):
    """Of a record."""

    duration: float
    sample_rate: float
    seed: int | None
    speed: float
    trajectory: File | None


class TrajectoryOptions(PayloadTrajectoryOptions, total=False):
    """Of a record."""

    save_trajectory: File | None


class ExcitationOptions(TypedDict, total=False):
    """Of a record."""

    excitation: Literal["sines", "optimal"]
    excitation_time_budget: float | None


class PlayLimitOptions(TypedDict, total=False):
    """Of a record."""

    max_velocity: float | Numbers
    max_acceleration: float | None
    max_torque: float | Numbers | None
    workspace: Numbers | None
    keep_out: Numbers | Sequence[Numbers]
    clearance: float


class LimitOptions(PlayLimitOptions, total=False):
    """Of a record."""

    payload_reserve: float
    max_tool_speed: float | None
    below_base: bool


class PlanSimulatedArmOptions(TypedDict, total=False):
    """Of a record."""

    noise_torque: float | Numbers


class PayloadSimulatedArmOptions(PlanSimulatedArmOptions, total=False):
    """Of a record."""

    simulation: Literal["inverse", "forward"]
    noise_position: float | Numbers
    encoder_resolution: float
    torque_delay: float


class SimulatedArmOptions(PayloadSimulatedArmOptions, total=False):
    """Of a record."""

    plant_model: File | None
    save_measurements: File | None


class MotorOptions(TypedDict, total=False):
    """Of a record."""

    export_damiao: bool
    motor_type: str | Sequence[str]
    can_id: int | Sequence[int]
    master_id: int | Sequence[int]


class PoseOptions(TypedDict, total=False):
    """Of a record."""

    for_: Literal["link", "payload", "friction", "arm"]
    static: bool


class PayloadOptions(TypedDict, total=False):
    """Of a record."""

    empty_model: File | None
    loaded_model: File | None
    order: str | None
    flange: str | None
    as_body: str | None
    known_mass: float | None
    save_torque_scale: File | None
    static: bool


class BusAddress(TypedDict, total=False):
    """Of a record."""

    interface: Interface
    channel: str | Sequence[str]
    bus_option: str | Sequence[str]


class BusTiming(TypedDict, total=False):
    """Of a record."""

    fd: bool
    bitrate: float
    data_bitrate: float


class PlaySettings(TypedDict, total=False):
    """Of a record."""

    kp: float | Sequence[float]
    kd: float | Sequence[float]
    rate: float | None
    speed: float
    approach_speed: float
    start_tolerance: float
    max_tracking_error: float
    max_speed_error: float
    max_torque_error: float | Sequence[float]
    max_temperature: float
    park: str | None
    others: Literal["limp", "hold"]


class Permissions(TypedDict, total=False):
    """Of a record."""

    accept_register_limits: bool
    set_watchdog: float | None
    accept_directions: bool


class RecordingOptions(TypedDict, total=False):
    """Of a record."""

    record: File | None
    raw_log: File | None
    overwrite: bool


class HoldSecondArm(TypedDict, total=False):
    """Of a record."""

    also_joint: str | None


class SecondArm(HoldSecondArm, total=False):
    """Of a record."""

    also: File | None


class IdentifyKeywords(
    ModelOptions, LogOptions, EstimationOptions, OutputOptions, TrajectoryOptions,
    ExcitationOptions, LimitOptions, SimulatedArmOptions, MotorOptions
):  # fmt: skip
    """Of ``identify``."""


class PlanKeywords(
    ModelOptions, PlanEstimationOptions, TrajectoryOptions, ExcitationOptions, LimitOptions,
    PlanSimulatedArmOptions, MotorOptions, PoseOptions
):  # fmt: skip
    """Of ``plan``."""


class PayloadKeywords(
    ModelOptions, PayloadLogOptions, EstimationOptions, PayloadOutputOptions,
    PayloadTrajectoryOptions, ExcitationOptions, LimitOptions, PayloadSimulatedArmOptions,
    PayloadOptions
):  # fmt: skip
    """Of ``payload``."""


class ReadLogKeywords(
    ReadLogLogOptions
):  # fmt: skip
    """Of ``read_log``."""


class InformationKeywords(
    ModelOptions, InformationLogOptions, EstimationOptions
):  # fmt: skip
    """Of ``information``."""


class IdentifyFromKeywords(
    ModelOptions
):  # fmt: skip
    """Of ``identify_from``."""


class RegressorKeywords(
    ModelOptions
):  # fmt: skip
    """Of ``regressor``."""


class PlayKeywords(
    BusAddress, BusTiming, PlaySettings, Permissions, RecordingOptions, ModelOptions,
    SecondArm, PlayLimitOptions
):  # fmt: skip
    """Of ``play``."""


class HoldKeywords(
    BusAddress, BusTiming, PlaySettings, Permissions, RecordingOptions, ModelOptions,
    HoldSecondArm
):  # fmt: skip
    """Of ``hold``."""

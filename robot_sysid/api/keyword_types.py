"""Types of the keywords, for type checkers and editors; no run imports this.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
A class holds the keywords of one record, as far as one function or several take them.
"""
# ruff: noqa: D101

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
Keep = Literal["friction", "rotors", "gravity", "links"]
Interface = Literal[
    "socketcan", "slcan", "gs_usb", "pcan", "kvaser", "vector", "ixxat", "canalystii",
    "cantact", "seeedstudio", "damiao", "virtual"
]  # fmt: skip


class ModelOptions(TypedDict, total=False):
    mesh_dir: File | None
    joint: str | None
    keyframe: str | None


class ReadLogLogOptions(TypedDict, total=False):
    columns: File | None
    units: str | None
    torque_scale: float | Numbers | File | None
    torque_constants: float | Numbers | File | None
    topic: str | None
    episode: int | Sequence[int]


class PayloadLogOptions(ReadLogLogOptions, total=False):
    accept: Accept | Sequence[Accept]


class LogOptions(PayloadLogOptions, total=False):
    append: File | None


class PlanEstimationOptions(TypedDict, total=False):
    torques: Literal["chain", "terminal"]
    link_uncertainty: float
    scale_uncertainty: float | Numbers | None
    zero_uncertainty: float
    gravity_uncertainty: float
    delay_uncertainty: float
    friction_uncertainty: float


class EstimationOptions(PlanEstimationOptions, total=False):
    no_friction: bool
    friction_model: str | None
    cutoff: float | None
    velocity_deadband: float | Numbers | None
    delay: Literal["off", "auto"]
    tilt: Literal["off", "auto"]
    coupling: File | None


class PayloadOutputOptions(TypedDict, total=False):
    keep: Keep | Sequence[Keep]


class OutputOptions(PayloadOutputOptions, total=False):
    links: bool


class PayloadTrajectoryOptions(TypedDict, total=False):
    duration: float
    sample_rate: float
    seed: int | None
    speed: float
    trajectory: File | None


class TrajectoryOptions(PayloadTrajectoryOptions, total=False):
    save_trajectory: File | None


class ExcitationOptions(TypedDict, total=False):
    excitation: Literal["sines", "optimal"]
    excitation_time_budget: float | None


class PlayLimitOptions(TypedDict, total=False):
    max_velocity: float | Numbers
    max_acceleration: float | None
    max_torque: float | Numbers | None
    workspace: Numbers | None
    keep_out: Numbers | Sequence[Numbers]
    clearance: float


class LimitOptions(PlayLimitOptions, total=False):
    payload_reserve: float
    max_tool_speed: float | None
    below_base: bool


class PlanSimulatedArmOptions(TypedDict, total=False):
    noise_torque: float | Numbers


class PayloadSimulatedArmOptions(PlanSimulatedArmOptions, total=False):
    simulation: Literal["inverse", "forward"]
    noise_position: float | Numbers
    encoder_resolution: float
    torque_delay: float


class SimulatedArmOptions(PayloadSimulatedArmOptions, total=False):
    plant_model: File | None
    save_measurements: File | None


class MotorOptions(TypedDict, total=False):
    export_damiao: bool
    motor_type: str | Sequence[str]
    can_id: int | Sequence[int]
    master_id: int | Sequence[int]


class PoseOptions(TypedDict, total=False):
    for_: Literal["link", "payload", "friction", "arm"]
    static: bool


class PayloadOptions(TypedDict, total=False):
    empty_model: File | None
    loaded_model: File | None
    order: str | None
    flange: str | None
    as_body: str | None
    known_mass: float | None
    save_torque_scale: File | None
    static: bool


class BusAddress(TypedDict, total=False):
    interface: Interface
    channel: str | Sequence[str]
    bus_option: str | Sequence[str]


class BusTiming(TypedDict, total=False):
    fd: bool
    bitrate: float
    data_bitrate: float


class PlaySettings(TypedDict, total=False):
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
    accept_register_limits: bool
    set_watchdog: float | None
    accept_directions: bool


class RecordingOptions(TypedDict, total=False):
    record: File | None
    raw_log: File | None
    overwrite: bool


class HoldSecondArm(TypedDict, total=False):
    also_joint: str | None


class SecondArm(HoldSecondArm, total=False):
    also: File | None


class IdentifyKeywords(
    ModelOptions, LogOptions, EstimationOptions, OutputOptions, TrajectoryOptions,
    ExcitationOptions, LimitOptions, SimulatedArmOptions, MotorOptions
): ...  # fmt: skip


class PlanKeywords(
    ModelOptions, PlanEstimationOptions, TrajectoryOptions, ExcitationOptions, LimitOptions,
    PlanSimulatedArmOptions, MotorOptions, PoseOptions
): ...  # fmt: skip


class PayloadKeywords(
    ModelOptions, PayloadLogOptions, EstimationOptions, PayloadOutputOptions,
    PayloadTrajectoryOptions, ExcitationOptions, LimitOptions, PayloadSimulatedArmOptions,
    PayloadOptions
): ...  # fmt: skip


class InformationKeywords(
    ModelOptions, PayloadLogOptions, EstimationOptions
): ...  # fmt: skip


class PlayKeywords(
    BusAddress, BusTiming, PlaySettings, Permissions, RecordingOptions, ModelOptions,
    SecondArm, PlayLimitOptions
): ...  # fmt: skip


class HoldKeywords(
    BusAddress, BusTiming, PlaySettings, Permissions, RecordingOptions, ModelOptions,
    HoldSecondArm
): ...  # fmt: skip


ReadLogKeywords = ReadLogLogOptions
IdentifyFromKeywords = ModelOptions
RegressorKeywords = ModelOptions

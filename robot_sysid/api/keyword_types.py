"""Types of the keywords, for type checkers and editors; no run imports this.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
A class holds the keywords that the functions in its name take, and no others.
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


class _IdentifyPayloadInformation(TypedDict, total=False):
    accept: Accept | Sequence[Accept]
    coupling: File | None
    cutoff: float | None
    delay: Literal["off", "auto"]
    friction_model: str | None
    no_friction: bool
    tilt: Literal["off", "auto"]
    velocity_deadband: float | Numbers | None


class _Identify(TypedDict, total=False):
    append: File | None
    links: bool
    plant_model: File | None
    save_measurements: File | None


class _IdentifyPlanPayload(TypedDict, total=False):
    below_base: bool
    duration: float
    excitation: Literal["sines", "optimal"]
    excitation_time_budget: float | None
    max_tool_speed: float | None
    noise_torque: float | Numbers
    payload_reserve: float
    sample_rate: float
    seed: int | None
    trajectory: File | None


class _IdentifyPlan(TypedDict, total=False):
    can_id: int | Sequence[int]
    export_damiao: bool
    master_id: int | Sequence[int]
    motor_type: str | Sequence[str]
    save_trajectory: File | None


class _IdentifyPlanPayloadPlay(TypedDict, total=False):
    clearance: float
    keep_out: Numbers | Sequence[Numbers]
    max_acceleration: float | None
    max_torque: float | Numbers | None
    max_velocity: float | Numbers
    workspace: Numbers | None


class _IdentifyPayloadReadLogInformation(TypedDict, total=False):
    columns: File | None
    episode: int | Sequence[int]
    topic: str | None
    torque_constants: float | Numbers | File | None
    torque_scale: float | Numbers | File | None
    units: str | None


class _IdentifyPlanPayloadInformation(TypedDict, total=False):
    delay_uncertainty: float
    friction_uncertainty: float
    gravity_uncertainty: float
    link_uncertainty: float
    scale_uncertainty: float | Numbers | None
    torques: Literal["chain", "terminal"]
    zero_uncertainty: float


class _IdentifyPayload(TypedDict, total=False):
    encoder_resolution: float
    keep: Keep | Sequence[Keep]
    noise_position: float | Numbers
    simulation: Literal["inverse", "forward"]
    torque_delay: float


class _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold(TypedDict, total=False):
    joint: str | None
    keyframe: str | None
    mesh_dir: File | None


class _IdentifyPlanPayloadPlayHold(TypedDict, total=False):
    speed: float


class _Plan(TypedDict, total=False):
    for_: Literal["link", "payload", "friction", "arm"]


class _PlanPayload(TypedDict, total=False):
    static: bool


class _Payload(TypedDict, total=False):
    as_body: str | None
    empty_model: File | None
    flange: str | None
    known_mass: float | None
    loaded_model: File | None
    order: str | None
    save_torque_scale: File | None


class _PlayHold(TypedDict, total=False):
    accept_directions: bool
    accept_register_limits: bool
    also_joint: str | None
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


class _Play(TypedDict, total=False):
    also: File | None


class IdentifyKeywords(
    _IdentifyPayloadInformation, _Identify, _IdentifyPlanPayload, _IdentifyPlan,
    _IdentifyPlanPayloadPlay, _IdentifyPayloadReadLogInformation,
    _IdentifyPlanPayloadInformation, _IdentifyPayload,
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold, _IdentifyPlanPayloadPlayHold
): ...  # fmt: skip


class PayloadKeywords(
    _IdentifyPayloadInformation, _IdentifyPlanPayload, _IdentifyPlanPayloadPlay,
    _IdentifyPayloadReadLogInformation, _IdentifyPlanPayloadInformation, _IdentifyPayload,
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold,
    _IdentifyPlanPayloadPlayHold, _PlanPayload, _Payload
): ...  # fmt: skip


class InformationKeywords(
    _IdentifyPayloadInformation, _IdentifyPayloadReadLogInformation,
    _IdentifyPlanPayloadInformation,
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold
): ...  # fmt: skip


class PlanKeywords(
    _IdentifyPlanPayload, _IdentifyPlan, _IdentifyPlanPayloadPlay,
    _IdentifyPlanPayloadInformation,
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold,
    _IdentifyPlanPayloadPlayHold, _Plan, _PlanPayload
): ...  # fmt: skip


class PlayKeywords(
    _IdentifyPlanPayloadPlay, _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold,
    _IdentifyPlanPayloadPlayHold, _PlayHold, _Play
): ...  # fmt: skip


class ReadLogKeywords(
    _IdentifyPayloadReadLogInformation
): ...  # fmt: skip


class IdentifyFromKeywords(
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold
): ...  # fmt: skip


class RegressorKeywords(
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold
): ...  # fmt: skip


class HoldKeywords(
    _IdentifyPlanPayloadInformationIdentifyFromRegressorPlayHold,
    _IdentifyPlanPayloadPlayHold, _PlayHold
): ...  # fmt: skip

# Keywords of the functions and their types, for type checkers and editors.
# Written from the option records by: python -m rigs.files.keyword_types && ruff format
import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

from numpy.typing import NDArray

from robot_sysid.estimate.options import Priors
from robot_sysid.records.option_fields import RoughFactors
from robot_sysid.records.servo_setting import ServoSetting

FilePath = str | os.PathLike[str]
Numbers = Sequence[float] | NDArray[Any]

Accept = Literal[
    "torque-scale",
    "torque-unit",
    "gravity",
    "computed",
    "unsigned",
    "sign",
    "order",
    "angle-unit",
    "zero",
    "model",
    "tilt",
    "clock",
    "delay",
    "saturated",
    "held",
    "contact",
    "force",
    "payload-step",
    "coupling",
    "crosstalk",
    "friction",
    "unexplained",
    "too-little",
    "rollout",
]
Torques = Literal["chain", "terminal"]
Keep = Literal["friction", "rotors", "gravity", "links"]
Cards = Literal[
    "all",
    "isaaclab",
    "mjlab",
    "newton",
    "genesis",
    "drake",
    "pinocchio",
    "bam",
    "i2rt",
    "openarm",
    "axol",
]
PayloadCards = Literal[
    "auto",
    "all",
    "franka",
    "ur",
    "kuka",
    "kinova",
    "xarm",
    "abb",
    "mecademic",
    "urdf",
    "mujoco",
]
Excitation = Literal["sines", "optimal"]
For = Literal["arm", "link", "payload", "weight", "servos"]
Interface = Literal[
    "socketcan",
    "slcan",
    "gs_usb",
    "pcan",
    "kvaser",
    "vector",
    "ixxat",
    "canalystii",
    "cantact",
    "seeedstudio",
    "damiao",
    "virtual",
]
Park = Literal["rest"]

class CheckKeywords(TypedDict, total=False):
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    columns: FilePath | None
    units: str | None
    torque_scale: float | Numbers | FilePath | RoughFactors | None
    torque_constants: float | Numbers | FilePath | RoughFactors | None
    topic: str | None
    episode: int | Sequence[int]
    accept: Accept | Sequence[Accept]

class IdentifyKeywords(TypedDict, total=False):
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    columns: FilePath | None
    units: str | None
    torque_scale: float | Numbers | FilePath | RoughFactors | None
    torque_constants: float | Numbers | FilePath | RoughFactors | None
    topic: str | None
    episode: int | Sequence[int]
    accept: Accept | Sequence[Accept]
    servo_setting: str | ServoSetting | Sequence[str | ServoSetting]
    torques: Torques
    no_friction: bool
    friction_model: str | None
    priors: FilePath | Mapping[str, float | Numbers] | Priors
    keep: Keep | Sequence[Keep]
    cards: Cards | None

class RegressorKeywords(TypedDict, total=False):
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    keyframe: str | None

class PayloadKeywords(TypedDict, total=False):
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    columns: FilePath | None
    units: str | None
    torque_scale: float | Numbers | FilePath | RoughFactors | None
    torque_constants: float | Numbers | FilePath | RoughFactors | None
    topic: str | None
    episode: int | Sequence[int]
    accept: Accept | Sequence[Accept]
    friction_model: str | None
    priors: FilePath | Mapping[str, float | Numbers] | Priors
    keep: Keep | Sequence[Keep]
    order: str | None
    flange: str | None
    as_body: str | None
    cards: PayloadCards
    known_mass: float | None
    save_torque_scale: FilePath | None

class PlanKeywords(TypedDict, total=False):
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    keyframe: str | None
    duration: float
    sample_rate: float
    seed: int | None
    speed: float
    trajectory: FilePath | None
    save_trajectory: FilePath | None
    excitation: Excitation
    thorough: bool
    excitation_time_budget: float | None
    for_: For
    goal_rate: float
    max_velocity: float | Numbers
    max_acceleration: float | None
    max_torque: float | Numbers | None
    payload_reserve: float
    max_tool_speed: float | None
    workspace: Numbers | None
    keep_out: Numbers | Sequence[Numbers]
    below_base: bool
    clearance: float
    torques: Torques
    priors: FilePath | Mapping[str, float | Numbers] | Priors
    export_damiao: bool
    motor_type: str | Sequence[str]
    joint_map: FilePath | None

class ReadLogKeywords(TypedDict, total=False):
    columns: FilePath | None
    units: str | None
    torque_scale: float | Numbers | FilePath | RoughFactors | None
    torque_constants: float | Numbers | FilePath | RoughFactors | None
    topic: str | None
    episode: int | Sequence[int]
    accept: Accept | Sequence[Accept]

class SelfTestKeywords(TypedDict, total=False):
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    duration: float
    sample_rate: float
    seed: int | None
    speed: float
    trajectory: FilePath | None
    save_trajectory: FilePath | None
    torques: Torques
    no_friction: bool
    export_damiao: bool
    motor_type: str | Sequence[str]
    plant_model: FilePath | None
    noise_torque: float | Numbers
    encoder_resolution: float
    save_measurements: FilePath | None

class PlayKeywords(TypedDict, total=False):
    interface: Interface
    channel: str | None
    bus_option: str | Sequence[str]
    fd: bool
    bitrate: float
    data_bitrate: float
    mesh_dir: FilePath | None
    joint: str | None
    first_joint: str | None
    fix_base: bool
    mass_scale: float | str | RoughFactors | None
    total_mass: float | None
    gravity: Numbers | None
    keyframe: str | None
    kp: float | Numbers
    kd: float | Numbers
    rate: float | None
    speed: float
    max_tracking_error: float | None
    park: Park | None
    accept_register_limits: bool
    accept_directions: bool
    record: FilePath | None
    overwrite: bool
    max_velocity: float | Numbers | None
    max_acceleration: float | None
    max_torque: float | Numbers | None
    workspace: Numbers | None
    keep_out: Numbers | Sequence[Numbers] | None
    clearance: float | None
    plant_model: FilePath | None

"""What the functions of the face are given: a model, and options of the commands as keywords.

Which function takes which records of options stands here once: the signature that ``help`` and a
notebook show, what is refused, and the types for checkers (``keyword_types``) come from it.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, Union, get_type_hints

from robot_sysid.config import PREDICTED, PayloadConfig, SysidConfig
from robot_sysid.damiao.bus import BusAddress
from robot_sysid.damiao.protocol.frames import BusTiming
from robot_sysid.damiao.settings import (
    Permissions,
    PlaySettings,
    RecordingOptions,
    SecondArm,
)
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.model.compilation import (
    InMemory,
    compiled_in_memory,
    file_of,
    is_in_memory,
)
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.parser import load_robot_model, robot_from_compiled
from robot_sysid.records import RobotModel
from robot_sysid.records import options as option_records
from robot_sysid.records.options import Option, default_of, keys_of, options_of
from robot_sysid.simulation.options import SimulatedArmOptions

Model = Union[str, "os.PathLike[str]", InMemory]
"""Path of an MJCF or URDF file, or a model of MuJoCo's."""


def path_of(model: Model) -> Path:
    """Return the file of a model; of one in memory a copy that MuJoCo writes.

    Raises:
        InputError: it is no model, or cannot be written.
    """
    if is_in_memory(model):
        return file_of(model)
    if not isinstance(model, (str, os.PathLike)):
        known = "the path of an MJCF or URDF file, a mujoco.MjSpec or a mujoco.MjModel"
        raise InputError(f"a model is {known}, not {type(model).__name__}")
    return Path(model)


def arm_of(model: Model, values: Mapping[str, Any]) -> RobotModel:
    """Return the arm in a model, with the options of ``ModelOptions``; see ``path_of``."""
    chosen = option_records.record_from(ModelOptions, values)
    if is_in_memory(model):
        compiled = compiled_in_memory(model)
        return robot_from_compiled(
            compiled, Path("model"), chosen.joint, keyframe=chosen.keyframe
        )
    return load_robot_model(
        path_of(model), chosen.mesh_dir, chosen.joint, keyframe=chosen.keyframe
    )


Function = TypeVar("Function", bound=Callable[..., Any])
_ARM, _PAYLOAD = (
    tuple(get_type_hints(kind).values()) for kind in (SysidConfig, PayloadConfig)
)
_MOTORS = (
    BusAddress,
    BusTiming,
    PlaySettings,
    Permissions,
    RecordingOptions,
    ModelOptions,
    SecondArm,
)
RECORDS: Mapping[str, Sequence[Any]] = {
    "identify": tuple(each for each in _ARM if each.__name__ != "PoseOptions"),
    "plan": tuple(
        each for each in _ARM if each.__name__ not in ("LogOptions", "OutputOptions")
    ),
    "payload": _PAYLOAD,
    "read_log": (LogOptions,),
    "information": (ModelOptions, LogOptions, EstimationOptions),
    "identify_from": (ModelOptions,),
    "regressor": (ModelOptions,),
    "play": (*_MOTORS, LimitOptions),
    "hold": _MOTORS,
}
"""Function to the records whose options are its keywords; ``play`` and ``hold`` are of motors."""
_COMMAND = "plays models; it needs the command robot-sysid identify"
_SAVE = "is for the command; the result's save(folder) writes files"
ELSEWHERE = {
    "measurements": "is the argument log",
    "validation_measurements": "is the argument validation",
    **dict.fromkeys(("verify_rollout", "torque_from"), _COMMAND),
    **dict.fromkeys(("output_dir", "bundle", "report", "plots"), _SAVE),
    "plan_only": "designs a motion; call plan instead",
    **dict.fromkeys(("empty", "loaded"), "is an argument of its own"),
}
"""Options of the commands that are no keywords, and what there is instead."""
_ESTIMATED = keys_of(EstimationOptions, SimulatedArmOptions) - {*PREDICTED}
_USELESS: Mapping[str, Mapping[str, str]] = {
    "plan": dict.fromkeys(_ESTIMATED, "is about an estimate; a plan stops before it"),
    "payload": {"links": "means nothing for a payload; leave it out"},
    "read_log": {"accept": "is about an estimate; reading makes none"},
    "play": dict.fromkeys(
        keys_of(LimitOptions) - {*LIMITS}, "is for designing a motion; see plan"
    ),
    "hold": {"also": "is a motion; an arm that is held has none"},
}
_NAMED = {"measurements": "log", "validation_measurements": "validation"}


def refused_by(function: str) -> Mapping[str, str]:
    """Return key to why it is no keyword of a function of the face, as the end of a sentence."""
    return {**_USELESS.get(function, {}), **ELSEWHERE}


def with_keywords(**usual: Any) -> Callable[[Function], Function]:
    """Return what gives a function the signature, the check and the words of its keywords.

    ``usual`` are defaults that this function has in place of the records'.
    """

    def decorated(function: Function) -> Function:
        own = inspect.signature(function)
        refused = refused_by(function.__name__)
        known = {
            each.key: usual.get(each.key, default_of(record, name))
            for record in RECORDS[function.__name__]
            for name, each in options_of(record).items()
            if each.key not in refused
        }

        @functools.wraps(function)
        def call(*given: Any, **options: Any) -> Any:
            with in_python():
                asked = [key for key in options if key not in own.parameters]
                for key in asked:
                    if key in refused:
                        raise InputError(f"{key} {refused[key]}")
                option_records.refuse_unknown(
                    asked, {*known, *own.parameters} - {"options"}
                )
                return function(*given, **options)

        shown = [each for each in own.parameters.values() if each.name != "options"]
        shown += [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default)
            for key, default in known.items()
            if key not in own.parameters
        ]
        call.__signature__ = own.replace(parameters=shown)  # type: ignore[attr-defined]
        return call  # type: ignore[return-value]

    return decorated


@contextmanager
def in_python() -> Iterator[None]:
    """Say in Python's words what is wrong in a block."""
    try:
        yield
    except SysidError as error:
        error.args = (python_words(str(error)),)
        raise


@functools.cache
def _options() -> Mapping[str, Option]:
    records = {*_ARM, *_PAYLOAD, *_MOTORS}
    return {
        each.flag: each for record in records for each in options_of(record).values()
    }


_OF_RUNS = ("--model", "--joint-map")
"""Options of the commands of motors that are keywords by their names."""
_FLAG = re.compile(
    r"robot-sysid motors \w+ --[a-z-]+|(--[a-z][a-z-]*[a-z])(?: ([\w.,·/#\"'-]*\w))?"
)
_UNITS = re.compile(r"(deg|rad|s|ms|us|ns)(,(deg|rad|s|ms|us|ns))?")


def python_words(text: str) -> str:
    """Return a sentence with keywords in place of options: ``units="deg"`` for --units deg."""
    return _FLAG.sub(_keyword, text).replace("robot-sysid plan", "robot_sysid.plan")


def _keyword(found: re.Match[str]) -> str:
    flag = found[1]
    word = found[2]
    rest = f" {word}" if word else ""
    if flag in _OF_RUNS:
        return flag[2:].replace("-", "_") + rest
    stated = _options().get(flag)
    if stated is None or stated.key in ("verify_rollout", "torque_from", "output_dir"):
        return found[0]
    key = _NAMED.get(stated.key, stated.key)
    if stated.parse is None:
        return f"{key}=True{rest}"
    if word is None or not _is_value(stated, word):
        return f"{key}{rest}"
    is_text = word in stated.choices or _UNITS.fullmatch(word)
    return f'{key}="{word}"' if is_text else f"{key}={word}"


def _is_value(stated: Option, word: str) -> bool:
    """Tell whether the word behind an option is its value, and not how the sentence goes on."""
    is_number = bool(re.fullmatch(r"-?\d[\d.,e-]*", word))
    is_unit = stated.key == "units" and _UNITS.fullmatch(word) is not None
    return word in stated.choices or word[0].isupper() or is_number or is_unit

"""Arguments of the Python functions: a model, and the commands' options as keywords.

``RECORDS`` says once which function takes which records of options. The signature and the meaning
of each keyword that ``help`` and a notebook show, the refusal of other keywords, and the types for
checkers (``keyword_types``) come from it.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import shlex
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, Union, get_type_hints

from robot_sysid.config import (
    PREDICTED,
    MotorOptions,
    OutputOptions,
    PayloadConfig,
    SysidConfig,
)
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.settings import Permissions, PlaySettings, RecordingOptions
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.model.compilation import (
    InMemory,
    compiled_in_memory,
    file_of,
    is_in_memory,
)
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.parser import load_robot_model, robot_from_compiled
from robot_sysid.records import RobotModel
from robot_sysid.records import option_fields as option_records
from robot_sysid.records.option_fields import (
    Option,
    TrajectoryOptions,
    default_of,
    keys_of,
    options_of,
    value_text,
)
from robot_sysid.simulation import SimulatedArmOptions

Model = Union[str, "os.PathLike[str]", InMemory]
"""Path of an MJCF or URDF file, or a model of MuJoCo's."""


def path_of(model: Model, mesh_dir: Any = None) -> Path:
    """Return the file of a model; a model in memory is first written to a file by MuJoCo.

    ``mesh_dir``: folder of its meshes as the user gave it, or None.

    Raises:
        InputError: it is no model, or cannot be written.
    """
    if is_in_memory(model):
        return file_of(model, has_mesh_folder=mesh_dir is not None)
    if not isinstance(model, (str, os.PathLike)):
        valid = "the path of an MJCF or URDF file, a mujoco.MjSpec or a mujoco.MjModel"
        raise InputError(f"a model is {valid}, not {type(model).__name__}")
    return Path(model)


def arm_of(model: Model, values: Mapping[str, Any]) -> RobotModel:
    """Return the arm in a model; ``values`` are keywords, of which ``ModelOptions`` are used.

    Raises:
        InputError: it is no model, or cannot be read.
    """
    options = option_records.record_from(ModelOptions, values)
    if is_in_memory(model):
        compiled = compiled_in_memory(model)
        return robot_from_compiled(
            compiled, Path("model"), options.joint, keyframe=options.keyframe
        )
    return load_robot_model(
        path_of(model), options.mesh_dir, options.joint, keyframe=options.keyframe
    )


Function = TypeVar("Function", bound=Callable[..., Any])
"""Type of a decorated function, which the decorator keeps."""
_ARM = tuple(get_type_hints(SysidConfig).values())
"""Records of options of the identification of an arm's links."""
_PAYLOAD = tuple(get_type_hints(PayloadConfig).values())
"""Records of options of the identification of a payload."""
_MOTORS = (
    BusAddress,
    BusTiming,
    PlaySettings,
    Permissions,
    RecordingOptions,
    ModelOptions,
)
"""Records of options of the motor commands."""
RECORDS: Mapping[str, Sequence[Any]] = {
    "identify": (
        ModelOptions,
        LogOptions,
        EstimationOptions,
        OutputOptions,
        TrajectoryOptions,
        SimulatedArmOptions,
    ),
    "plan": tuple(
        record for record in _ARM if record not in (LogOptions, OutputOptions)
    ),
    "payload": _PAYLOAD,
    "read_log": (LogOptions,),
    "joint_torque_regressor": (ModelOptions,),
    "play": (*_MOTORS, LimitOptions),
    "hold": _MOTORS,
}
"""Function to the records whose options are its keywords. ``identify`` takes no options of a
design: its own simulation plays random swings, or a trajectory from a file; see ``plan``. ``play``
and ``hold`` are functions of ``robot_sysid.motors``."""
_COMMAND = "it needs the command robot-sysid identify"
"""End of the sentence that refuses options of that command alone."""
_SAVE = "is for the command; the result's save(folder) writes files"
"""End of the sentence that refuses options on written files."""
ELSEWHERE = {
    "measurements": "is the argument log",
    "validation_measurements": "is the argument validation",
    "verify_rollout": f"plays models; {_COMMAND}",
    "torque_from": f"is for logs without torque; {_COMMAND} MODEL LOG --torque-from position-error",
    **dict.fromkeys(("output_dir", "bundle", "report"), _SAVE),
    "plan_only": "designs a motion; call plan instead",
    **dict.fromkeys(("empty", "loaded"), "is an argument of its own"),
}
"""Options of the commands that are keywords of no function, each with the end of a sentence that
says how to get the same."""
_DESIGN = "is for designing a motion; see plan"
"""End of the sentence that refuses options on the design of a motion."""
_ESTIMATED = keys_of(EstimationOptions, SimulatedArmOptions) - {*PREDICTED}
"""Keys of options that act on an estimate alone, and not on the prediction of a plan's errors."""
_USELESS: Mapping[str, Mapping[str, str]] = {
    "identify": dict.fromkeys(
        keys_of(ExcitationOptions, LimitOptions, MotorOptions), _DESIGN
    ),
    "plan": dict.fromkeys(_ESTIMATED, "is about an estimate; a plan stops before it"),
    "payload": {"links": "means nothing for a payload; leave it out"},
    "read_log": {"accept": "is about an estimate; reading makes none"},
    "play": dict.fromkeys(keys_of(LimitOptions) - {*LIMITS}, _DESIGN),
}
"""Function to the options in its ``RECORDS`` that are no keywords of it, each with the reason."""
_HELP_WIDTH = 88
"""Largest number of characters in a line of a keyword's help, as a terminal shows it."""
_NAMED = {"measurements": "log", "validation_measurements": "validation"}
"""Keys of options to arguments that have another name."""


def refused_by(function: str) -> Mapping[str, str]:
    """Return the options that are no keywords of a function, each with the end of a sentence that
    says why."""
    return {**_USELESS.get(function, {}), **ELSEWHERE}


def with_keywords(**defaults: Any) -> Callable[[Function], Function]:
    """Return a decorator that gives a function the options of its ``RECORDS`` as keywords.

    The decorated function shows them in its signature, explains each in its docstring in place of
    the argument ``options``, refuses other keywords before it runs, and raises errors that speak of
    keywords instead of command-line options.

    Args:
        defaults: defaults that the function has in place of the records'.
    """

    def decorate(function: Function) -> Function:
        """Return a function that checks its keywords and then calls the decorated one."""
        signature = inspect.signature(function)
        refused = refused_by(function.__name__)
        default_by_key = {}
        help_by_key = {}
        for record in RECORDS[function.__name__]:
            for field_name, option in options_of(record).items():
                if option.key not in refused:
                    default = default_of(record, field_name)
                    default = defaults.get(option.key, default)
                    default_by_key[option.key] = default
                    help_by_key[option.key] = _keyword_help(option, default)
        valid_keys = {*default_by_key, *signature.parameters} - {"options"}

        @functools.wraps(function)
        def call(*arguments: Any, **keywords: Any) -> Any:
            """Raise InputError for an unknown or refused keyword; else call the function."""
            with in_python():
                option_keys = [
                    key for key in keywords if key not in signature.parameters
                ]
                for key in option_keys:
                    if key in refused:
                        raise InputError(f"{key} {refused[key]}")
                option_records.refuse_unknown(option_keys, valid_keys)
                return function(*arguments, **keywords)

        parameters = dict(signature.parameters)
        parameters.pop("options", None)
        for key, default in default_by_key.items():
            if key not in parameters:
                parameters[key] = inspect.Parameter(
                    key, inspect.Parameter.KEYWORD_ONLY, default=default
                )
        full_signature = signature.replace(parameters=list(parameters.values()))
        call.__signature__ = full_signature  # type: ignore[attr-defined]
        call.__doc__ = _with_keyword_help(function.__doc__ or "", help_by_key.values())
        return call  # type: ignore[return-value]

    return decorate


def _with_keyword_help(docstring: str, helps: Iterable[str]) -> str:
    """Return a docstring with the help of each keyword in place of the argument ``options``.

    Args:
        docstring: its last argument is ``options``.
        helps: one per keyword, as ``_keyword_help`` returns them.
    """
    summary, _, options = inspect.cleandoc(docstring).partition("\n    options: ")
    sections = options.partition("\n\n")[2]
    wrapper = textwrap.TextWrapper(
        width=_HELP_WIDTH,
        initial_indent=4 * " ",
        subsequent_indent=8 * " ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join([summary, *map(wrapper.fill, helps), "", sections]).rstrip()


def _keyword_help(option: Option, default: Any) -> str:
    """Return a keyword with the type, unit and default of its value, and its meaning."""
    default_text = f"default {default}"
    if option.default_text:
        default_text = f"default: {option.default_text}"
    elif isinstance(default, str):
        default_text = f'default "{default}"'
    elif default == ():
        default_text = "default none"
    meaning = python_words(option.help.replace("; may be repeated", ""))
    return f"{option.key} ({value_text(option)}; {default_text}): {meaning}."


@contextmanager
def in_python() -> Iterator[None]:
    """Run a block whose errors speak of keywords instead of command-line options."""
    try:
        yield
    except SysidError as error:
        error.args = (python_words(str(error)),)
        raise


@functools.cache
def _option_by_flag() -> Mapping[str, Option]:
    """Return flag, such as "--no-friction", to option, of all options that a function may take.

    The mapping is cached and shared: callers must not change it.
    """
    options = {}
    for record in {*_ARM, *_PAYLOAD, *_MOTORS}:
        for option in options_of(record).values():
            options[option.flag] = option
    return options


_MOTOR_FLAGS = ("--model", "--joint-map")
"""Options of the motor commands that are arguments of ``play`` and ``hold``, in no record."""
_FLAG = re.compile(
    r"robot-sysid motors \w+ --[a-z-]+|(--[a-z][a-z-]*[a-z])(?: ([\w.,·/#\"'-]*\w))?"
)
"""A motor command with its option, or an option with the word behind it, in a sentence."""
_NUMBER = re.compile(r"-?\d+(\.\d*)?(e-?\d+)?")
_UNITS = re.compile(r"(deg|rad|s|ms|us|ns)(,(deg|rad|s|ms|us|ns))?")
"""Value of the option --units: one unit of angle or time, or two between a comma."""


_COMMAND_LINE = "  robot-sysid "
"""Beginning of a line that is a command and nothing else."""
_PHRASES = {
    "robot-sysid plan": "robot_sysid.plan",
    "robot-sysid payload --": "robot_sysid.payload and --",
    "identify --torque-from position-error": "the command robot-sysid identify MODEL LOG "
    "--torque-from position-error",
}
"""Commands within a sentence, to what a Python program does instead."""
_CALLS = {
    "plan": ("plan", "rs.plan(model"),
    "identify": ("identify", "rs.identify(model, log"),
    "payload": ("payload", "rs.payload(model, empty, loaded"),
    "log": ("read_log", "rs.read_log(log, model"),
}
"""Command to the function that does the same, and to the beginning of its call."""


def python_words(text: str) -> str:
    """Return a message with keywords in place of options: ``units="deg"`` for --units deg.

    A command on a line of its own becomes the call of a function.
    """
    lines = []
    for line in text.split("\n"):
        if line.startswith(_COMMAND_LINE):
            lines.append(_call(line))
        else:
            for command, python in _PHRASES.items():
                line = line.replace(command, python)
            lines.append(_FLAG.sub(_keyword, line))
    return "\n".join(lines)


def _call(line: str) -> str:
    """Return the call that does what a command line does; the line itself where there is none.

    Model and logs are named as such, as those of a program may be in no file. Options that the
    function does not take, such as --output-dir, are left out.
    """
    arguments = shlex.split(line)
    if arguments[1] not in _CALLS:
        return line
    function, call = _CALLS[arguments[1]]
    valid_keys = keys_of(*RECORDS[function]) - set(refused_by(function))
    values_by_key: dict[str, list[str]] = {}
    for word, next_word in zip(arguments, [*arguments[1:], ""]):
        option = _option_by_flag().get(word)
        if option is not None and option.key in valid_keys:
            is_bare = option.parse is None or bool(_NUMBER.fullmatch(next_word))
            value = next_word if is_bare else f'"{next_word}"'
            value = "True" if option.parse is None else value
            values_by_key.setdefault(option.key, []).append(value)
    for key, values in values_by_key.items():
        text = values[0] if len(values) == 1 else f"[{', '.join(values)}]"
        call += f", {key}={text}"
    return f"  {call})"


def _keyword(match: re.Match[str]) -> str:
    """Return a match of ``_FLAG`` with the option written as a keyword; unchanged without one."""
    flag = match[1]
    word = match[2]
    next_word = f" {word}" if word else ""
    if flag in _MOTOR_FLAGS:
        return flag[2:].replace("-", "_") + next_word
    option = _option_by_flag().get(flag)
    # Some options are of commands alone.
    if option is None or option.key in ("verify_rollout", "torque_from", "output_dir"):
        return match[0]
    key = _NAMED.get(option.key, option.key)
    # A switch takes no value.
    if option.parse is None:
        return f"{key}=True{next_word}"
    if word is None or not _is_value(option, word):
        return f"{key}{next_word}"
    is_text = word in option.choices or _UNITS.fullmatch(word)
    return f'{key}="{word}"' if is_text else f"{key}={word}"


def _is_value(option: Option, word: str) -> bool:
    """Return whether the word behind an option is its value, and not the rest of the sentence."""
    is_number = bool(re.fullmatch(r"-?\d[\d.,e-]*", word))
    is_unit = option.key == "units" and _UNITS.fullmatch(word) is not None
    return word in option.choices or word[0].isupper() or is_number or is_unit

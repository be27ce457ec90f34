"""Arguments of the Python functions: a model, and the commands' options as keywords.

A function takes the options of the record of its command, but for those on files and on what is
printed. The signature and the meaning of each keyword that ``help`` and a notebook show, and the
refusal of other keywords, come from it.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar, Union

from robot_sysid.config import Config
from robot_sysid.errors import InputError, SysidError
from robot_sysid.model import ModelOptions
from robot_sysid.model.compilation import InMemory, file_of, is_in_memory
from robot_sysid.parser import load_robot_model
from robot_sysid.records import RobotModel
from robot_sysid.records.option_fields import (
    Option,
    given_values,
    options_of_all,
    record_from,
    refuse_unknown,
    value_text,
)

Model = Union[str, "os.PathLike[str]", InMemory]
"""Path of an MJCF or URDF file, or a model of MuJoCo's."""


def path_of(model: Model) -> Path:
    """Return the file of a model; an MjSpec is first written to a file by MuJoCo.

    Raises:
        InputError: it is no model, or cannot be written.
    """
    if is_in_memory(model):
        return file_of(model)
    if not isinstance(model, (str, os.PathLike)):
        valid = "the path of an MJCF or URDF file, or a mujoco.MjSpec"
        raise InputError(f"a model is {valid}, not {type(model).__name__}")
    return Path(model)


def arm_of(model: Model, values: Mapping[str, Any]) -> RobotModel:
    """Return the arm in a model; ``values`` are keywords, of which ``ModelOptions`` are used.

    Raises:
        InputError: it is no model, or cannot be read.
    """
    options = record_from(ModelOptions, values)
    source = model if is_in_memory(model) else path_of(model)
    return load_robot_model(source, **given_values(options))


Function = TypeVar("Function", bound=Callable[..., Any])
"""Type of a decorated function, which the decorator keeps."""


def with_keywords(
    *records: Any, only: Collection[str] = (), **defaults: Any
) -> Callable[[Function], Function]:
    """Return a decorator that gives a function the options of records as keywords.

    The decorated function shows them in its signature, explains each in its docstring in place of
    the argument ``options``, refuses other keywords before it runs, and raises errors that speak of
    keywords instead of command-line options. Options that are arguments already stay these.

    Args:
        records: classes of option records.
        only: keys of the only options; empty for all.
        defaults: defaults that the function has in place of the records'.
    """

    def decorate(function: Function) -> Function:
        """Return a function that checks its keywords and then calls the decorated one."""
        signature = inspect.signature(function)
        parameters = dict(signature.parameters)
        del parameters["options"]
        for key in parameters:
            flag = "--" + key.replace("_", "-")
            _KEYWORDS.setdefault(flag, Option(flag, ""))
        helps = []
        for option in options_of_all(records, only, **defaults):
            # A log is an argument of its own, which has no flag either.
            if not option.flag.startswith("-"):
                continue
            _KEYWORDS[option.flag] = option
            if option.key in parameters:
                continue
            parameters[option.key] = inspect.Parameter(
                option.key, inspect.Parameter.KEYWORD_ONLY, default=option.default
            )
            helps.append(_keyword_help(option))

        @functools.wraps(function)
        def call(*arguments: Any, **keywords: Any) -> Any:
            """Raise InputError for an unknown keyword; else call the function."""
            with in_python():
                refuse_unknown(keywords, parameters)
                return function(*arguments, **keywords)

        full_signature = signature.replace(parameters=[*parameters.values()])
        call.__signature__ = full_signature  # type: ignore[attr-defined]
        call.__doc__ = _with_keyword_help(function.__doc__ or "", helps)
        return call  # type: ignore[return-value]

    return decorate


def with_options_of(config: type[Config]) -> Callable[[Function], Function]:
    """Return a decorator that gives a function the options of a command as keywords.

    Those of its output are left out: the function prints and writes nothing.
    """
    records = config.records()
    del records["output"]
    return with_keywords(*records.values(), only=config.option_keys())


def _with_keyword_help(docstring: str, helps: Iterable[str]) -> str:
    """Return a docstring with the help of each keyword in place of the argument ``options``.

    Args:
        docstring: its last argument is ``options``.
        helps: one per keyword, as ``_keyword_help`` returns them.
    """
    summary, _, options = inspect.cleandoc(docstring).partition("\n    options: ")
    sections = options.partition("\n\n")[2]
    wrapper = textwrap.TextWrapper(
        width=88,
        initial_indent=4 * " ",
        subsequent_indent=8 * " ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join([summary, *map(wrapper.fill, helps), "", sections]).rstrip()


def _keyword_help(option: Option) -> str:
    """Return a keyword with the type, unit and default of its value, and its meaning."""
    default = option.default
    default_text = f"default {default}"
    if option.default_text:
        default_text = f"default: {option.default_text}"
    elif isinstance(default, str):
        default_text = f'default "{default}"'
    elif default == ():
        default_text = "default none"
    meaning = option.help.replace("; may be repeated", "")
    return python_words(
        f"{option.key} ({value_text(option)}; {default_text}): {meaning}."
    )


@contextmanager
def in_python() -> Iterator[None]:
    """Run a block whose errors speak of keywords instead of command-line options."""
    try:
        yield
    except SysidError as error:
        error.args = (python_words(str(error)),)
        raise


# Flag of the command line to the option that is a keyword of a function.
_KEYWORDS: dict[str, Option] = {}
_WORD = r"'[^']*'|(?!--)(?:[^\s;:()',.]|[,.](?=[^\s;:()',.]))+"
# A command on a line of its own; or an option, and the word behind it without the punctuation that
# ends its clause.
_OPTION = re.compile(
    rf"^  robot-sysid .*|(?<![\w-])(--[a-z][a-z-]*[a-z])(?: ({_WORD}))?", re.MULTILINE
)
_NUMBERS = re.compile(r"[-\d.e+x,]*\d")
# A keyword with a text, and the same keyword with other texts.
_REPEATED = re.compile(r'\b(\w+)=("[^"]*")((?: \1="[^"]*")+)')
# Words that stand for a value in a message.
_PLACEHOLDERS = ("FILE", "FOLDER", "KG", "LOG", "NAME")


def python_words(text: str) -> str:
    """Return a message with keywords in place of options: ``joint="wrist"`` for --joint wrist.

    A command on a line of its own stays one, and so do options that no function here has.
    """
    return _REPEATED.sub(_list_text, _OPTION.sub(_keyword_text, text))


def _keyword_text(match: re.Match[str]) -> str:
    """Return an option as a keyword, with the word behind it as its value if it is one.

    Numbers and choices are known by the option; another text is a value if its clause ends with it.
    A command is returned as it is.
    """
    option = _KEYWORDS.get(match[1])
    if option is None:
        return match[0]
    word = match[2] or ""
    text = word.strip("'")
    is_number = option.types[0] in (Real, Integral)
    if word in _PLACEHOLDERS or (is_number and _NUMBERS.fullmatch(word)):
        value = f"[{word.replace(',', ', ')}]" if "," in word else word
        return f"{option.key}={value}"
    takes_text = option.parse is not None and not is_number and not option.choices
    ends_clause = re.match(r"[^ ]| --|$", match.string[match.end() :])
    is_value = text in option.choices or (takes_text and ends_clause is not None)
    if word and (is_value or word != text):
        return f'{option.key}="{text}"'
    return match[0].replace(match[1], option.key, 1)


def _list_text(match: re.Match[str]) -> str:
    """Return a keyword with the list of all its texts."""
    others = match[3].replace(f" {match[1]}=", ", ")
    return f"{match[1]}=[{match[2]}{others}]"

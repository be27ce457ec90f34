"""The commands' options as keywords of the Python functions.

A function takes the options of the record of its command, but for those on files and on what is
printed. The signature and the meaning of each keyword that ``help`` and a notebook show, and the
refusal of other keywords, come from it.
"""

from __future__ import annotations

import functools
import inspect
import textwrap
from collections.abc import Callable, Iterable
from itertools import chain
from typing import TYPE_CHECKING, Any, TypeVar

from robot_sysid.records.option_fields import (
    Option,
    refuse_unknown,
    value_annotation,
    value_text,
)
from robot_sysid.wording import in_python, with_option_names

if TYPE_CHECKING:
    from robot_sysid.config import Config

Function = TypeVar("Function", bound=Callable[..., Any])
"""Type of a decorated function, which the decorator keeps."""


def with_keywords(options: Iterable[Option]) -> Callable[[Function], Function]:
    """Return a decorator that gives a function some options as keywords.

    The decorated function shows them in its signature, explains each in its docstring in place of
    the argument ``options``, refuses other keywords before it runs, and raises errors that speak of
    keywords instead of command-line options. Options that are arguments already stay these.
    """

    def decorate(function: Function) -> Function:
        """Return a function that checks its keywords and then calls the decorated one."""
        signature = inspect.signature(function)
        parameters = dict(signature.parameters)
        del parameters["options"]
        helps = []
        for option in options:
            # A log is an argument of its own, in Python too.
            if option.is_argument or option.key in parameters:
                continue
            parameters[option.key] = inspect.Parameter(
                option.key,
                inspect.Parameter.KEYWORD_ONLY,
                default=option.default,
                annotation=value_annotation(option),
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
    groups = config.options()
    del groups["output"]
    return with_keywords(chain(*groups.values()))


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
    text = f"{option.key} ({value_text(option)}; {default_text}): {meaning}."
    with in_python():
        return with_option_names(text)

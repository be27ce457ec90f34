"""How a text names an option: ``--max-velocity`` at the command line, ``max_velocity`` in Python.

A text is written once. Where it names an option it asks a function of this module, which knows who
is going to read it: the command line by default, a Python program inside ``in_python``, which the
face for Python enters once for each call. A constant that names an option holds a field in its
place, and becomes a text by ``with_option_names``.

Names are put in when a text is made, not when it is shown. A text leaves the package by too many
doors for that: as the message of an error, which may be a part of another error's, in fields of
records that Python programs read as they are, in files of four kinds and on the console.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

_IS_FOR_PYTHON = ContextVar("is_for_python", default=False)
_NO_WORDS: Mapping[str, str] = {}


@contextmanager
def in_python() -> Iterator[None]:
    """Have the texts that are made in a block name keywords instead of command-line options."""
    token = _IS_FOR_PYTHON.set(True)
    try:
        yield
    finally:
        _IS_FOR_PYTHON.reset(token)


def is_for_python() -> bool:
    """Return whether texts are for readers in Python, where no command to run follows a text."""
    return _IS_FOR_PYTHON.get()


def option_name(key: str, form: str = "") -> str:
    """Return an option's name, and behind it the form of its value if one is given.

    ``option_name("columns", "FILE")`` is "--columns FILE" at the command line, "columns=FILE" in
    Python. ``key`` is the option's name as a keyword; ``form`` is a number or a placeholder.
    """
    if _IS_FOR_PYTHON.get():
        return f"{key}={form}" if form else key
    # The keyword for --for is for_, because "for" is a word of Python's own.
    return f"--{key.rstrip('_').replace('_', '-')} {form}".rstrip()


def option_setting(key: str, *texts: str) -> str:
    """Return an option with a text as its value, or with several texts if it may be repeated.

    ``option_setting("joint", "wrist")`` is "--joint wrist" at the command line, 'joint="wrist"' in
    Python, where several texts are a list.
    """
    if not _IS_FOR_PYTHON.get():
        return " ".join(option_name(key, text) for text in texts)
    quoted = ", ".join('"{}"'.format(text.strip("'")) for text in texts)
    return option_name(key, quoted if len(texts) == 1 else f"[{quoted}]")


class _Names(dict[str, Any]):
    """Fields of a template to the names of options."""

    def __missing__(self, field: str) -> str:
        """Return the name of an option; behind a blank its form, behind "=" a text."""
        key, _, text = field.partition("=")
        if text:
            return option_setting(key, text)
        return option_name(*key.split(" ", 1))


def with_option_names(template: str, words: Mapping[str, str] = _NO_WORDS) -> str:
    """Return a template with words and names of options in the place of its fields in braces.

    It is for texts that are no functions' own: a field that is none of ``words``, such as
    "{joint}", "{columns FILE}" or "{keep=gravity}", is what ``option_name`` and ``option_setting``
    make of it.
    """
    return template.format_map(_Names(words))

"""The types of the Python functions' keywords, made from the records of the command line.

    python -m rigs.files.keyword_types && ruff format

writes ``robot_sysid/api/keyword_types.pyi`` anew. A function says by
``**options: Unpack[PlanKeywords]`` which of its classes has its keywords.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

import robot_sysid as rs
from rigs.files.places import ROOT

FILE = ROOT / "robot_sysid" / "api" / "keyword_types.pyi"
# The names that annotations of options have; see ``value_annotation``.
_HEAD = """\
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
"""
_KEYWORDS = re.compile(r"Unpack\[(\w+)\]")
_CHOICES = re.compile(r"Literal\[.*?\]")


def functions() -> list[Callable[..., Any]]:
    """Return the public functions."""
    public = [getattr(rs, name) for name in rs.__all__]
    return [*filter(inspect.isfunction, public), rs.motors.play]


def text() -> str:
    """Return what the file has to hold, before it is formatted."""
    # The same choices are written once.
    choices: dict[str, str] = {}
    classes = []
    for function in functions():
        arguments = inspect.signature(inspect.unwrap(function)).parameters
        if "options" not in arguments:
            continue
        (name,) = _KEYWORDS.findall(arguments["options"].annotation)
        classes.append(f"class {name}(TypedDict, total=False):")
        for key, parameter in inspect.signature(function).parameters.items():
            if key in arguments:
                continue
            annotation = parameter.annotation
            for literal in {*_CHOICES.findall(annotation)}:
                alias = key.title().replace("_", "")
                if alias in choices.values() and literal not in choices:
                    alias = name.replace("Keywords", alias)
                alias = choices.setdefault(literal, alias)
                annotation = annotation.replace(literal, alias)
            classes.append(f"    {key}: {annotation}")
    named = [f"{alias} = {literal}" for literal, alias in choices.items()]
    return "\n".join([_HEAD, *named, *classes, ""])


def main() -> None:
    """Write the file anew."""
    FILE.write_text(text(), encoding="utf-8")


if __name__ == "__main__":
    main()

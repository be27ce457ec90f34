"""The package's face: all public names, the types of what its functions return, nothing else."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import typing
from pathlib import Path

import pytest

import robot_sysid as rs

FUNCTIONS = [name for name in rs.__all__ if name.islower() and name != "motors"]


def test_names_are_the_public_ones_and_nothing_else():
    assert dir(rs) == sorted([*rs.__all__, "__version__"])
    exec("from robot_sysid import *", star := {})
    assert {*star} - {"__builtins__"} == {*rs.__all__}
    assert dir(rs.motors) == ["Say", "play"]
    with pytest.raises(AttributeError, match="has no attribute 'regressors'"):
        getattr(rs, "regressors")  # noqa: B009


def test_checkers_see_the_same_names():
    stub = Path(rs.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = [
        node for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom)
    ]
    names = {node.names[0].asname: node.module for node in imports}
    # Its module has another name, which is not public.
    assert names.pop(None) == "robot_sysid" and "motors = damiao" in stub
    assert {*names, "motors"} == {*rs.__all__}
    for name in names:
        module = sys.modules[names[name]] if getattr(rs, name) else None
        assert getattr(module, name) is getattr(rs, name)


def classes_in(annotation):
    """Yield the package's classes in a type."""
    if isinstance(annotation, type) and annotation.__module__.startswith("robot_sysid"):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from classes_in(argument)


def types_of(owner):
    """Return the package's classes in the attributes of a class, or in a function's types."""
    bases = inspect.getmro(owner) if isinstance(owner, type) else (owner,)
    namespace = {"ArrayLike": object}
    for base in reversed(bases):
        namespace.update(vars(sys.modules[base.__module__]))
    namespace.update(Answer=object, Dataset=object, Model=rs.Model)
    namespace.update(PlanResult=rs.PlanResult)
    annotated = [inspect.unwrap(owner)]
    if isinstance(owner, type):
        members = [inspect.getattr_static(owner, n) for n in dir(owner) if n[0] != "_"]
        annotated = [member.fget for member in members if isinstance(member, property)]
        annotated += filter(dataclasses.is_dataclass, bases)
    classes = set()
    for part in annotated:
        hints = dict(getattr(part, "__annotations__", {}))
        hints.pop("options", None)
        for hint in hints.values():
            is_text = isinstance(hint, str)
            annotation = eval(hint, namespace) if is_text else hint
            classes.update(classes_in(annotation))
    return classes


@pytest.mark.skipif(sys.version_info < (3, 10), reason="evaluates X | None")
@pytest.mark.parametrize("name", [*FUNCTIONS, "motors.play"])
def test_what_a_function_takes_and_returns_can_be_named(name):
    owner = rs
    for part in name.split("."):
        owner = getattr(owner, part)
    public = {getattr(rs, public_name) for public_name in rs.__all__}
    classes = types_of(owner)
    for returned in [*classes, rs.Result]:
        classes = classes | types_of(returned)
    missing = {cls.__name__ for cls in classes - public}
    assert not missing

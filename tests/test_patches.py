"""Tests use the package by its public face: they patch nothing of it, and use no private name."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.test_architecture import nodes_of

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (ROOT / "tests", ROOT / "rigs")


def from_package(nodes: Iterable[ast.AST]) -> set[str]:
    """The names that a file imports from the package."""
    names = {
        alias.asname or alias.name.split(".")[0]
        for node in nodes
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
        if (getattr(node, "module", None) or alias.name).split(".")[0] == "robot_sysid"
    }
    return names | parameters_from(nodes, names)


def parameters_from(nodes: Iterable[ast.AST], names: set[str]) -> set[str]:
    """The parameters of tests that stand for one of these names, or a part of it, in some case."""
    return {
        parameter
        for node in nodes
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", None) == "parametrize"
        for case in getattr(node.args[1], "elts", ())
        for parameter, value in parameters_of(node.args[0], case)
        if isinstance(value, (ast.Name, ast.Attribute))
        and ast.unparse(value).split(".")[0] in names
    }


def parameters_of(parameters: ast.AST, case: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """The parameters of one case of a test, each with the expression of its value."""
    stated = ast.literal_eval(parameters)
    if isinstance(stated, str):
        stated = stated.split(",")
    if isinstance(case, ast.Call) and ast.unparse(case.func) == "pytest.param":
        values = case.args
    else:
        values = getattr(case, "elts", ()) if len(stated) > 1 else [case]
    return zip(map(str.strip, stated), values)


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


MAY_PATCH = re.compile(
    r"setattr|delattr|\.object\(|(import|,|\()\s*_[A-Za-z]|(?<!\bself)(?<!\bcls)\._[A-Za-z]"
)
"""What no file lacks that patches something or takes a private name of anything but its own."""


def faults(source: str) -> Iterator[str]:
    """Each patch of the package, and each private name that is imported from it."""
    if not MAY_PATCH.search(source):
        return
    nodes = nodes_of(source)
    names = from_package(nodes)
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "robot_sysid"
        ):
            yield from (alias.name for alias in node.names if private(alias.name))
        elif isinstance(node, ast.Attribute) and private(node.attr):
            owner = ast.unparse(node.value).split(".")[0]
            if owner in names and node.attr != "_fields":
                yield ast.unparse(node)
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.args
        ):
            if node.func.attr not in {"setattr", "delattr", "object"}:
                continue
            target = ast.unparse(node.args[0])
            if target.split(".")[0] in names or "robot_sysid" in target:
                named = node.args[1] if len(node.args) > 1 else node.args[0]
                yield f"{target}: {ast.unparse(named)}".replace("lambda :", "lambda:")


BASE_OR_PRIVATE = re.compile(r"class \w+\(|self\._|    def _[a-z]")
"""What no module lacks whose classes have a base or a private name."""
OWN = "self", "super"
"""By what a method reaches its object."""


class ClassOf(NamedTuple):
    """A class: its private names, and its bases, each with the module that it comes from."""

    own: set[str]
    bases: list[tuple[str, str]]


def classes_of(module: str, source: str) -> dict[tuple[str, str], ClassOf]:
    """The classes of a module in which any has a base or a private name, by module and name."""
    if not BASE_OR_PRIVATE.search(source):
        return {}
    nodes = nodes_of(source)
    origins = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }

    def origin(base: ast.expr) -> tuple[str, str]:
        folder, _, name = ast.unparse(base).rpartition(".")
        if not folder:
            return origins.get(name, (module, name))
        return ".".join(origins.get(folder, (folder,))), name

    return {
        (module, node.name): ClassOf(
            {name for name in own_names(node) if private(name)},
            [origin(base) for base in node.bases],
        )
        for node in nodes
        if isinstance(node, ast.ClassDef)
    }


def own_names(class_node: ast.ClassDef) -> Iterator[str]:
    """Names of the methods of a class, and of what its methods take from ``self`` or ``super``."""
    for node in ast.walk(class_node):
        if isinstance(node, ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Attribute):
            owner = node.value.func if isinstance(node.value, ast.Call) else node.value
            if isinstance(owner, ast.Name) and owner.id in OWN:
                yield node.attr


def reached(classes: dict[tuple[str, str], ClassOf]) -> Iterator[str]:
    """Each private name of a class of the package that one outside it, derived from it, uses."""

    def origins(base: tuple[str, str]) -> list[tuple[str, str]]:
        """Where a base is defined, also where its folder hands it on."""
        module, name = base
        if base in classes:
            return [base]
        return [key for key in classes if key[1] == name and key[0].startswith(module)]

    def inherited(key: tuple[str, str]) -> set[str]:
        names = set()
        for base in classes[key].bases if key in classes else ():
            for origin in origins(base):
                if origin[0].startswith("robot_sysid"):
                    names |= classes[origin].own
                if origin != key:
                    names |= inherited(origin)
        return names

    for (module, name), of_class in classes.items():
        if not module.startswith("robot_sysid"):
            for used in sorted(of_class.own & inherited((module, name))):
                yield f"{module}: {name}.{used}"


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def test_tests_patch_nothing_of_the_package():
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {fault}"
        for folder in FOLDERS
        for path in folder.rglob("*.py")
        for fault in faults(path.read_text(encoding="utf-8"))
    }
    assert found == set()


def test_classes_of_tests_use_no_private_name_of_the_class_that_they_derive_from():
    classes = {}
    for folder in (*FOLDERS, ROOT / "benchmarks", ROOT / "robot_sysid"):
        for path in folder.rglob("*.py"):
            source = path.read_text(encoding="utf-8")
            classes.update(classes_of(module_of(path), source))
    assert not list(reached(classes))


@pytest.mark.parametrize(
    "source",
    [
        "from robot_sysid.model import _robot",
        "from robot_sysid import model\nmodel._robot()",
        "from robot_sysid import model\nmonkeypatch.setattr(model, 'robot', None)",
        "monkeypatch.setattr('robot_sysid.model.robot', None)",
        "import robot_sysid.model\nmonkeypatch.delattr(robot_sysid.model, 'robot')",
        """
from robot_sysid import model
@pytest.mark.parametrize(("module", "name"), [(os, "rename"), (model, "robot")])
def test(monkeypatch, module, name):
    monkeypatch.setattr(module, name, None)
""",
    ],
)
def test_a_patch_is_found(source):
    assert len(list(faults(source))) == 1
    assert not list(faults("import os\nmonkeypatch.setattr(os, 'rename', None)"))


BASE = """
class Motor:
    def answer(self):
        return self._pack(self._state)
    def _pack(self, state): ...
"""


@pytest.mark.parametrize(
    ("body", "count"),
    [
        ("def _pack(self, state): ...", 1),
        ("def answer(self): return self._state", 1),
        ("def answer(self): return super()._pack(0)", 1),
        ("def answer(self): return super().answer() + self._own", 0),
    ],
)
@pytest.mark.parametrize(
    "rig",
    [
        "from robot_sysid.motors import Motor as Real\nclass Faulty(Real): ...",
        "from robot_sysid import motors\nclass Faulty(motors.Motor): ...",
        "from robot_sysid import Motor\nclass Faulty(Motor): ...",
    ],
)
def test_a_private_name_of_a_base_is_found(body, count, rig):
    """Also where the base is another rig's that derives from it."""
    use = f"from rigs.motors import Faulty\nclass Worse(Faulty):\n    {body}"
    classes = {
        **classes_of("robot_sysid.motors", BASE),
        **classes_of("rigs.motors", rig),
        **classes_of("tests.test_motors", use),
    }
    assert len(list(reached(classes))) == count

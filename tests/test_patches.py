"""Tests use the package by its public face: they patch no attribute of it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDERS = tuple(
    Path(__file__).resolve().parents[1] / name for name in ("tests", "rigs")
)
# Patches that are still to be mended, by file: what each puts in the place of the real thing. An
# entry goes with its patch; none is added.
LEFT = {
    "rigs/motors/damiao_rig.py: execution: 'SystemClock'",
    "rigs/motors/damiao_rig.py: execution: 'open_bus'",
    "rigs/motors/damiao_rig.py: plant: 'ArmStepper'",
    "tests/api/test_api.py: calls: 'predict_plan'",
    "tests/api/test_motors.py: calls: 'predict_plan'",
    "tests/commands/test_motors.py: SystemClock: 'now'",
    "tests/commands/test_motors.py: SystemClock: 'sleep_until'",
    "tests/commands/test_motors.py: parser: 'load_robot_model'",
    "tests/commands/test_run.py: CheckedPlan: 'failure'",
    "tests/damiao/test_floating.py: Console: 'stage'",
    "tests/damiao/test_floating.py: Floating: 'follow'",
    "tests/damiao/test_floating.py: holding: 'measure_drift'",
}


def from_package(tree: ast.AST) -> set[str]:
    """The names that a file imports from the package."""
    names = {
        alias.asname or alias.name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
        if (getattr(node, "module", None) or alias.name).split(".")[0] == "robot_sysid"
    }
    return names | parameters_from(tree, names)


def parameters_from(tree: ast.AST, names: set[str]) -> set[str]:
    """The parameters of tests that stand for one of these names, or a part of it, in some case."""
    return {
        parameter
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("parametrize")
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


def faults(source: str) -> Iterator[str]:
    """Each patch of the package, and each private name that is imported from it."""
    tree = ast.parse(source)
    names = from_package(tree)
    for node in ast.walk(tree):
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


def test_tests_patch_nothing_of_the_package():
    root = FOLDERS[0].parent
    found = {
        f"{path.relative_to(root).as_posix()}: {fault}"
        for folder in FOLDERS
        for path in folder.rglob("*.py")
        for fault in faults(path.read_text(encoding="utf-8"))
    }
    assert found == set(LEFT)


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

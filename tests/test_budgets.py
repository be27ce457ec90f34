"""The size of the package and of its tests: code tokens per folder, held by a table.

Tokens are counted without comments, docstrings and line breaks, so that no layout changes them. A
figure of the table may be lowered and never raised: what comes in is paid for by what goes.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from rigs.places import ROOT

BUDGETS = {
    "robot_sysid/api": 3457,
    "robot_sysid/commands": 10810,
    "robot_sysid/damiao": 30338,
    "robot_sysid/diagnosis": 16141,
    "robot_sysid/dynamics": 3040,
    "robot_sysid/estimate": 29482,
    "robot_sysid/logs": 24757,
    "robot_sysid/mjcf": 7074,
    "robot_sysid/model": 8673,
    "robot_sysid/motion": 14874,
    "robot_sysid/pipeline": 9722,
    "robot_sysid/records": 10690,
    "robot_sysid/report": 4902,
    "robot_sysid/results": 11013,
    "robot_sysid/servo": 7031,
    "robot_sysid/signals": 5296,
    "robot_sysid/simulation": 3715,
    "robot_sysid": 11124,
    "tests": 233954,
}
"""Most code tokens of each folder; tests count with their arms and rigs."""
SLACK = 0.02
"""How far a budget may lie above the size of its folder, relative to it."""

NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.ENCODING,
}
OWNERS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def docstring_lines(source: str) -> set[int]:
    """Return the numbers of the lines on which docstrings begin."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, OWNERS)]
    return {node.body[0].lineno for node in nodes if ast.get_docstring(node, False)}


def code_tokens(source: str) -> int:
    """Return how many tokens of a module are code."""
    docstrings = docstring_lines(source)
    count = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        is_docstring = token.type == tokenize.STRING and token.start[0] in docstrings
        count += token.type not in NO_CODE and not is_docstring
    return count


def folder_of(path: Path) -> str:
    """Return the row of the table that a module of the checkout counts under."""
    folders = path.parent.parts
    return "/".join(folders[:2]) if folders[:1] == ("robot_sysid",) else "tests"


def sizes() -> Mapping[str, int]:
    """Return the number of code tokens of each folder of the package, and of tests and rigs."""
    tokens: Counter[str] = Counter()
    for pattern in (
        "robot_sysid/**/*.py",
        "tests/**/*.py",
        "rigs/**/*.py",
        "conftest.py",
    ):
        for path in sorted(ROOT.glob(pattern)):
            relative = path.relative_to(ROOT)
            tokens[folder_of(relative)] += code_tokens(path.read_text(encoding="utf-8"))
    return tokens


def budget_faults(counted: Mapping[str, int], budgets: Mapping[str, int]) -> list[str]:
    """Return one line per folder that is above its budget, far below it, or has none."""
    faults = []
    for folder in sorted({*counted, *budgets}):
        tokens = counted.get(folder, 0)
        budget = budgets.get(folder, 0)
        if tokens > budget:
            faults.append(f"{folder} has {tokens} tokens, its budget is {budget}")
        elif budget > tokens * (1.0 + SLACK):
            faults.append(f"{folder} has {tokens} tokens: lower its budget of {budget}")
    return faults


def test_no_folder_is_above_its_budget():
    assert budget_faults(sizes(), BUDGETS) == []


def test_growth_and_slack_are_found():
    counted = {"a": 1001, "b": 900, "c": 1000, "new": 5}
    faults = budget_faults(counted, {"a": 1000, "b": 1000, "c": 1010})
    assert [fault.split()[0] for fault in faults] == ["a", "b", "new"]


def test_layout_and_words_are_no_tokens():
    plain = "def f(x):\n    return x\n"
    told = '"""Text."""\n\n# why\ndef f(\n    x\n):\n    """Text."""\n    return x\n'
    assert code_tokens(plain) == code_tokens(told) == 8

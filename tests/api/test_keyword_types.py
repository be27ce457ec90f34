"""Type checkers know the keywords of every public function, because the option records say them."""

from __future__ import annotations

import ast
import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rigs.files import keyword_types
from rigs.files.places import ROOT

CALLS = Path(__file__).with_name("typed_calls.py")


def test_the_types_are_those_of_the_option_records():
    """``python -m rigs.files.keyword_types`` brings them up to date."""
    written = ast.parse(keyword_types.FILE.read_text(encoding="utf-8"))
    assert ast.unparse(written) == ast.unparse(ast.parse(keyword_types.text()))


@pytest.mark.parametrize("function", keyword_types.functions())
def test_every_argument_and_result_of_a_public_function_has_a_type(function):
    signature = inspect.signature(function)
    empty = inspect.Signature.empty
    assert signature.return_annotation not in (empty, "Any")
    for parameter in signature.parameters.values():
        assert parameter.annotation not in (empty, "Any"), parameter
    calls = ast.parse(CALLS.read_text(encoding="utf-8"))
    called = {
        ast.unparse(node.func) for node in ast.walk(calls) if isinstance(node, ast.Call)
    }
    assert {f"rs.{function.__name__}", f"rs.motors.{function.__name__}"} & called


@pytest.mark.slow
@pytest.mark.parametrize("checker", ["mypy", "pyright"])
def test_checkers_find_wrong_calls_and_admit_right_ones(checker):
    """mypy also checks this file with the package, as pyproject.toml says."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    program = shutil.which(checker, path=path)
    if program is None:
        pytest.skip(f"{checker} is not installed")
    python = {"mypy": "--python-executable", "pyright": "--pythonpath"}[checker]
    command = [program, python, sys.executable, str(CALLS)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr

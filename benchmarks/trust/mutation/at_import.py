"""Mutants of what runs while a module is imported: tables, constants, properties.

mutmut switches its mutants on when a function is called, and leaves these alone. Here cosmic-ray
makes them, in a copy of the project; each is tried on its module's tests in a forked process.

    python -m benchmarks.trust.mutation.at_import [MODULE ...]
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import importlib
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomllib
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).parents[3]
_PATIENCE = 300
_BINARY = "core/ReplaceBinaryOperator_"
_SWAPS = {
    f"{_BINARY}{swap}"
    for swap in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul")
}
"""The most similar of the eleven replacements that cosmic-ray has for a binary operator."""
_HEAVY = ("mujoco", "scipy.linalg", "scipy.spatial.transform", "sympy")
"""Imported once, before the forks."""


def import_time(source: str) -> str:
    """Return the syntax tree of what runs at import, and of what mutmut does not enter."""
    tree = ast.parse(source)
    for function in _for_mutmut(tree):
        function.body = [ast.Pass()]
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
    return ast.dump(tree)


def _for_mutmut(tree: ast.Module) -> list[ast.FunctionDef]:
    """Return the functions without decorators that nothing calls at import."""
    definitions = ast.FunctionDef, ast.ClassDef
    outside = [
        statement for statement in tree.body if not isinstance(statement, definitions)
    ]
    names = {n.id for s in outside for n in ast.walk(s) if isinstance(n, ast.Name)}
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [f for f in functions if not f.decorator_list and f.name not in names]


def mutants(source: str) -> Iterator[str]:
    """Yield the mutants of a source that differ in code that runs at import."""
    known_trees = {import_time(source)}
    inside = [
        range(f.body[0].lineno, f.end_lineno + 1)
        for f in _for_mutmut(ast.parse(source))
    ]
    for name in operator_names():
        if get_operator(name).arguments() or (
            name.startswith(_BINARY) and name not in _SWAPS
        ):
            continue
        operator = get_operator(name)()
        nodes = [
            p
            for n in ast_nodes(get_ast(source))
            for p in operator.mutation_positions(n)
        ]
        for occurrence, (start, _) in enumerate(nodes):
            if any(start[0] in lines for lines in inside):
                continue
            mutant = mutate_code(source, operator, occurrence)
            with contextlib.suppress(SyntaxError):
                tree = import_time(mutant)
                if tree not in known_trees:
                    known_trees.add(tree)
                    yield mutant


def survives(folder: Path, test: str) -> bool:
    """Tell whether the tests of a module pass in a copy of the project."""
    if (child := os.fork()) == 0:
        signal.alarm(_PATIENCE)
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        os.chdir(folder)
        sys.dont_write_bytecode = True
        options = ["-x", "-p", "no:cacheprovider", "--hypothesis-profile=mutants"]
        os._exit(int(pytest.main([*options, test])))
    return os.waitpid(child, 0)[1] == 0


def main() -> None:
    """Print the surviving mutants of the modules that mutmut mutates."""
    for library in _HEAVY:
        importlib.import_module(library)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mutmut"]
    tests = settings["pytest_add_cli_args_test_selection"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "copy"
        for source in ("robot_sysid", "tests", "pyproject.toml"):
            copy = shutil.copytree if (ROOT / source).is_dir() else shutil.copy
            folder.mkdir(exist_ok=True)
            copy(ROOT / source, folder / source)
        for module in sys.argv[1:] or settings["only_mutate"]:
            _try_all(
                folder,
                module,
                next(t for t in tests if t.endswith(f"_{Path(module).name}")),
            )


def _try_all(folder: Path, module: str, test: str) -> None:
    """Print the mutants of a module that its tests do not notice."""
    source = (ROOT / module).read_text()
    if not survives(folder, test):
        sys.exit(f"{test} fails as it is")
    count = 0
    alive = []
    for mutant in mutants(source):
        (folder / module).write_text(mutant)
        count += 1
        if survives(folder, test):
            lines = difflib.unified_diff(
                source.splitlines(), mutant.splitlines(), n=0, lineterm=""
            )
            alive.append("\n".join(list(lines)[2:]))
            print(alive[-1], flush=True)
    (folder / module).write_text(source)
    print(
        f"{module}: {count} mutants, {count - len(alive)} killed, {len(alive)} survived"
    )


if __name__ == "__main__":
    main()

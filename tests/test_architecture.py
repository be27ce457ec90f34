"""The package's shape: who may import whom, and how deep blocks may be nested.

The folders are the architecture: a module's layer is read from its path.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "robot_sysid"

# From the top down; a module may import its own folder and every line below its own, nothing else.
# Modules of the root, the names that the specification gives, are layers of their own.
LAYERS = (
    # What the package works without; FINDER imports it by its name.
    "commands.motors",
    "damiao",
    "__main__",
    "cli",
    "commands",
    "api",
    "pipeline",
    "servo",
    "export",
    "config",
    "faults",
    "solver",
    "motion",
    "report",
    "results",
    "expected",
    "estimate",
    "simulation",
    "logs",
    "simulator",
    "trajectory",
    "signals",
    "parser",
    "model",
    "mjcf",
    "dynamics",
    "regressor",
    "records",
    "spatial",
    "errors",
    "wording",
    # Nothing but the version.
    "",
)
FINDER = "robot_sysid.pipeline.motors"
OPTIONAL_NAMES = re.compile(r"""["'](robot_sysid\.)?(damiao|commands\.motors)[.'"]""")
MAY_PRINT = {"cli", "commands", "commands.motors"}
LIBRARIES = {
    "mujoco": {
        "model",
        "parser",
        "dynamics",
        "simulation",
        "motion",
        "results",
        "report",
    },
    "can": {"damiao"},
    "matplotlib": {"report", "api"},
    "jinja2": {"report", "results"},
    "jsonschema": {"results"},
    "rosbags": {"logs"},
    "pyarrow": {"logs"},
    "h5py": {"logs"},
    "clarabel": {"estimate"},
}
SLOW_TO_IMPORT = {"scipy", "sympy", *LIBRARIES} - {"mujoco"}
MOST_FILES = 16
MOST_NESTING = 3

BLOCKS = (ast.For, ast.While, ast.If, ast.With, ast.Try)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@cache
def package_sources() -> Mapping[str, str]:
    """Return source text by module name."""
    sources = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        module = path.parent if path.stem == "__init__" else path.with_suffix("")
        name = ".".join(module.relative_to(PACKAGE.parent).parts)
        sources[name] = path.read_text(encoding="utf-8")
    return sources


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """Return all parts of a module, the module itself first."""
    return tuple(ast.walk(ast.parse(source)))


def layer_of(module: str) -> str:
    """Return the folder of the package that a module lies in, or its name at the root.

    The commands for motors are a layer of their own.
    """
    _, *names = module.split(".")
    return ".".join(names[: 2 if names[:2] == ["commands", "motors"] else 1])


def imports(
    source: str, modules: Mapping[str, str], top_level: bool = False
) -> Iterator[str]:
    """Yield the full names a module imports; names out of a package's module become that module."""
    module, *inner = nodes_of(source)
    for node in module.body if top_level else inner:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                "relative imports hide who imports whom; write them out"
            )
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules else str(node.module)


def import_faults(sources: Mapping[str, str]) -> Iterator[str]:
    """Yield one line per import that the layers do not allow."""
    for module, source in sources.items():
        layer = layer_of(module)
        if layer not in LAYERS:
            yield f"{module} lies in no layer"
            continue
        for name in set(imports(source, sources)) - {module}:
            library = name.split(".")[0]
            if library == "robot_sysid":
                theirs = layer_of(name)
                if theirs not in LAYERS[LAYERS.index(layer) :]:
                    yield f"{module} ({layer}) imports {name} ({theirs})"
            elif layer not in LIBRARIES.get(library, {layer}):
                yield f"{module} ({layer}) imports {library}"
        for name in imports(source, sources, top_level=True):
            if name.split(".")[0] in SLOW_TO_IMPORT:
                yield f"{module} imports {name} at start-up; do it inside the function"


def folder_faults(sources: Mapping[str, str]) -> Iterator[str]:
    """Yield one line per folder with more modules than a reader can take in."""
    folders = [module.rpartition(".")[0] for module in sources]
    for folder in sorted(set(folders) - {"", "robot_sysid"}):
        count = folders.count(folder)
        if count > MOST_FILES:
            yield f"{folder} has {count} files"


def circles(sources: Mapping[str, str]) -> Iterator[str]:
    """Yield one line per module that imports itself through others."""
    graph = {
        m: {i for i in imports(s, sources) if i in sources} - {m}
        for m, s in sources.items()
    }
    for start in graph:
        reached = set()
        waiting = list(graph[start])
        while waiting:
            module = waiting.pop()
            if module not in reached:
                reached.add(module)
                waiting.extend(graph[module])
        if start in reached:
            yield f"{start} imports itself in a circle"


def nesting(node: ast.AST, level: int = 0) -> int:
    """Return how many blocks stand inside one another; an elif is on the level of its if."""
    depths = [level]
    for child in ast.iter_child_nodes(node):
        is_elif = (
            isinstance(node, ast.If)
            and node.orelse == [child]
            and isinstance(child, ast.If)
        )
        depths.append(
            nesting(child, level + (isinstance(child, BLOCKS) and not is_elif))
        )
    return max(depths)


def nesting_faults(sources: Mapping[str, str]) -> Iterator[str]:
    """Yield one line per function with blocks that are nested too deep."""
    for module, source in sources.items():
        for node in nodes_of(source):
            if isinstance(node, FUNCTIONS) and nesting(node) > MOST_NESTING:
                yield f"{module}.{node.name} is nested {nesting(node)} deep"


def print_faults(sources: Mapping[str, str]) -> Iterator[str]:
    """Yield one line per print outside the command-line modules."""
    for module, source in sources.items():
        if layer_of(module) not in MAY_PRINT and any(
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id == "print"
            for node in nodes_of(source)
        ):
            yield f"{module} prints"


def name_faults(sources: Mapping[str, str]) -> Iterator[str]:
    """Yield one line per module that names what the package works without, to import it."""
    for module, source in sources.items():
        is_free = layer_of(module) in LAYERS[:2] or module == FINDER
        if not is_free and OPTIONAL_NAMES.search(source):
            yield f"{module} names the package for motors; use {FINDER}"


CHECKS = (
    import_faults,
    name_faults,
    folder_faults,
    circles,
    nesting_faults,
    print_faults,
)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_package_keeps_its_shape(check):
    assert list(check(package_sources())) == []


GOOD = {
    "robot_sysid": "",
    "robot_sysid.parser": "x = 1\n",
    "robot_sysid.solver": "x = 1\n",
}
BLOCKS_OF = ("def deep():", "if 1:", "for _ in ():", "with x:", "while 1:", "pass")
DEEP = "\n".join(4 * depth * " " + line for depth, line in enumerate(BLOCKS_OF))


@pytest.mark.parametrize(
    ("module", "source", "check", "fault"),
    [
        ("solver", "import mujoco", import_faults, "(solver) imports mujoco"),
        ("nowhere", "", import_faults, "robot_sysid.nowhere lies in no layer"),
        ("logs.x", "from robot_sysid.motion import x", import_faults, "(logs) imports"),
        (
            "regressor",
            "from robot_sysid.parser import x",
            import_faults,
            "imports robot_sysid.parser",
        ),
        (
            "parser",
            "def f():\n    import matplotlib",
            import_faults,
            "imports matplotlib",
        ),
        ("cli", "import robot_sysid.damiao.player", import_faults, "(cli) imports"),
        ("commands.x", "import robot_sysid.damiao.y", import_faults, "(commands) impo"),
        ("pipeline.x", "import_module('robot_sysid.damiao')", name_faults, "names the"),
        ("solver", "import scipy.linalg", import_faults, "at start-up"),
        (
            "solver",
            "from robot_sysid import solver2",
            circles,
            "robot_sysid.solver imports itself",
        ),
        ("solver", DEEP, nesting_faults, "solver.deep is nested 4 deep"),
        ("solver", "def f():\n    print(1)", print_faults, "robot_sysid.solver prints"),
    ],
)
def test_a_fault_is_found(module, source, check, fault):
    back = {
        "robot_sysid.solver2": "import robot_sysid.solver",
        "robot_sysid.damiao": "",
    }
    back |= {
        "robot_sysid.motion": "",
        "robot_sysid.damiao.player.y": "",
        "robot_sysid.cli": "",
    }
    faulty_sources = {**GOOD, **back, f"robot_sysid.{module}": source}
    assert any(fault in complaint for complaint in check(faulty_sources))


@pytest.mark.parametrize(
    ("folder", "others"),
    [("tests", "benchmarks"), ("benchmarks", "tests"), ("rigs", "tests, benchmarks")],
)
def test_tests_and_benchmarks_share_nothing_but_rigs(folder, others):
    for path in (PACKAGE.parent / folder).rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        names = re.findall(r"^ *(?:from|import) (\w+)", source, re.MULTILINE)
        assert not {*names} & {*others.split(", ")}, path


def test_an_elif_is_not_nested_deeper():
    chain = "def f(x):\n  if x == 1:\n    pass\n"
    chain += "".join(f"  elif x == {k}:\n    pass\n" for k in range(2, 6))
    assert nesting(ast.parse(chain)) == 1

"""Conditions, constants, levels and rows of a package folder, each of which can be taken out alone.

Nothing is listed by hand: modules are parsed, and their functions get the code of a source in which
each condition is also evaluated without each of its operands, and with other values of the
constants. Function objects stay the same, so that whoever imported one has the rewritten one.

A run of them notices, at the first moment at which something would make a difference, that it could
be taken out (``Notes``). A process that forks there goes on without it. Constants that are read at
import only are not noticed.
"""

from __future__ import annotations

import ast
import copy
import dataclasses
import importlib
import pkgutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

TABLE = "FAULTS"
"""Name of the table of which rows are taken out."""
STOPPING = ("REFUSES", "DOUBTS")
"""Levels in whose place a finding only says something."""
LARGER = 10.0
"""Factor on constants, either way."""
MOST_SOURCE = 90
"""Characters of a source text."""
NOTES = "_notes_of_ablations"
"""Name of what rewritten functions note."""
WRAPPED = {
    property: "fget",
    cached_property: "func",
    staticmethod: "__func__",
    classmethod: "__func__",
}
"""Type that wraps a function to the attribute that is it; of all others it is ``__wrapped__``."""
UNTOUCHED = (ast.NamedExpr, ast.Yield, ast.YieldFrom, ast.Await)
"""Expressions that mean something else within a lambda."""


@dataclass(frozen=True)
class Ablation:
    """Something that can be taken out.

    Attributes:
        module: name of its module.
        line: in the module; 0 of a row of a table.
        kind: "operand", "test", "filter", "level", "constant" or "row".
        what: its source text.
        way: how it is taken out.
        site: number of the syntax node, constant or row in the module.
        option: which operand, or which of several ways.
    """

    module: str
    line: int
    kind: str
    what: str
    way: str
    site: int
    option: int

    @property
    def key(self) -> str:
        """Return a key that is unique in the folder."""
        return f"{self.module}:{self.kind}:{self.site}:{self.option}"


def short_source(node: ast.AST) -> str:
    """Return the source of a syntax node, cut."""
    text = " ".join(ast.unparse(node).split())
    return text if len(text) <= MOST_SOURCE else f"{text[:MOST_SOURCE]}..."


def other_values(value: float) -> list[float]:
    """Return values that switch a constant off, either way."""
    if isinstance(value, int):
        return [0, int(LARGER * value)]
    return [0.0, value / LARGER, value * LARGER, float("inf")]


@dataclass(frozen=True)
class Source:
    """A module of the folder with its syntax tree, whose nodes have numbers (``site``).

    Attributes:
        module: as it was imported.
        tree: of its source.
        constants: name of each numeric constant that it defines or imports to the module of the
            folder that defines it.
    """

    module: ModuleType
    tree: ast.Module
    constants: dict[str, str]

    @property
    def name(self) -> str:
        """Return the module's name."""
        return self.module.__name__

    @cached_property
    def functions(self) -> dict[tuple[str, int], FunctionType]:
        """Return functions and methods by name and first line."""
        found = {}
        for function in functions_of(vars(self.module).values(), self.module):
            code = function.__code__
            found[code.co_name, code.co_firstlineno] = function
        return found

    def definitions(self) -> Iterator[ast.FunctionDef]:
        """Yield the definitions of functions and methods, but not of those within them."""
        waiting: list[ast.AST] = [*self.tree.body]
        while waiting:
            node = waiting.pop(0)
            if isinstance(node, ast.FunctionDef):
                yield node
            elif isinstance(node, ast.ClassDef):
                waiting += node.body

    def replace_code(self, tree: ast.Module) -> None:
        """Give the functions the code of another tree."""
        ast.fix_missing_locations(tree)
        module_code = compile(tree, str(self.module.__file__), "exec")
        for code in nested_codes(module_code):
            function = self.functions.get((code.co_name, code.co_firstlineno))
            if function is None:
                continue
            if code.co_freevars == function.__code__.co_freevars:
                function.__code__ = code


def functions_of(values: Any, module: ModuleType) -> Iterator[FunctionType]:
    """Yield the functions of a module among values, and those of its classes."""
    for value in values:
        if isinstance(value, type) and value.__module__ == module.__name__:
            yield from functions_of(vars(value).values(), module)
        inner = getattr(value, WRAPPED.get(type(value), "__wrapped__"), value)
        is_function = isinstance(inner, FunctionType)
        if is_function and inner.__code__.co_filename == module.__file__:
            yield inner


def nested_codes(code: CodeType) -> Iterator[CodeType]:
    """Yield all code objects within another one."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from nested_codes(constant)


def read_folder(package: str) -> list[Source]:
    """Return the modules of a package folder."""
    root = importlib.import_module(package)
    names = [package]
    for found in pkgutil.iter_modules(root.__path__, f"{package}."):
        names.append(found.name)
    modules = [importlib.import_module(name) for name in names]
    trees = []
    for module in modules:
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        for site, node in enumerate(ast.walk(tree)):
            node.site = site  # type: ignore[attr-defined]
        trees.append(tree)
    own = {
        module.__name__: own_constants(module, tree)
        for module, tree in zip(modules, trees)
    }
    sources = []
    for module, tree in zip(modules, trees):
        constants = dict.fromkeys(own[module.__name__], module.__name__)
        constants.update(imported_constants(tree, own))
        sources.append(Source(module, tree, constants))
    return sources


def own_constants(module: ModuleType, tree: ast.Module) -> list[str]:
    """Return the names of the numeric constants that a module defines."""
    names = []
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.AnnAssign):
            targets = [node.target]
        for target in targets:
            if isinstance(target, ast.Name):
                value = getattr(module, target.id, None)
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    names.append(target.id)
    return names


def imported_constants(
    tree: ast.Module, own: dict[str, list[str]]
) -> Iterator[tuple[str, str]]:
    """Yield the name of each constant that a module imports of the folder, and its module."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module in own:
            for alias in node.names:
                if alias.name in own[node.module] and alias.asname is None:
                    yield alias.name, node.module


# ---- what can be taken out


def ablations_of(sources: Sequence[Source]) -> Iterator[Ablation]:
    """Yield all that can be taken out of a folder."""
    for source in sources:
        yield from constants_of(source)
        yield from rows_of(source)
        for definition in source.definitions():
            for statement in definition.body:
                yield from conditions_of(source, statement)


def constants_of(source: Source) -> Iterator[Ablation]:
    """Yield the constants of a module, each with other values."""
    for site, (name, module) in enumerate(source.constants.items()):
        if module != source.name:
            continue
        value = getattr(source.module, name)
        for option, other in enumerate(other_values(value)):
            what = f"{name} = {value:.6g}"
            way = f"{other:.6g}"
            yield Ablation(source.name, 0, "constant", what, way, site, option)


def rows_of(source: Source) -> Iterator[Ablation]:
    """Yield the rows of the table in the module that defines it, and the levels that stop logs."""
    is_own = any(
        isinstance(node, (ast.Assign, ast.AnnAssign))
        and TABLE in (short_source(target) for target in targets_of(node))
        for node in source.tree.body
    )
    for site, row in enumerate(getattr(source.module, TABLE) if is_own else ()):
        texts = [str(value) for value in vars(row).values()]
        what = ": ".join(texts[:2])[:MOST_SOURCE]
        yield Ablation(source.name, 0, "row", what, "dropped", site, 0)
        if getattr(row.level, "name", "") in STOPPING:
            yield Ablation(source.name, 0, "row", what, "only says", site, 1)


def targets_of(node: ast.Assign | ast.AnnAssign) -> list[ast.expr]:
    """Return the targets of an assignment."""
    return node.targets if isinstance(node, ast.Assign) else [node.target]


def conditions_of(source: Source, root: ast.AST) -> Iterator[Ablation]:
    """Yield operands, tests and levels below a statement of a function."""
    in_compares = set()
    for node in ast.walk(root):
        if isinstance(node, ast.Compare):
            in_compares |= {id(inner) for inner in ast.walk(node)}
    for node in ast.walk(root):
        place = (source.name, getattr(node, "lineno", 0))
        site = node.site  # type: ignore[attr-defined]
        if isinstance(node, ast.BoolOp):
            for option, operand in enumerate(node.values):
                word = "and" if isinstance(node.op, ast.And) else "or"
                what = f"{word} {short_source(operand)}"
                yield Ablation(*place, "operand", what, "dropped", site, option)
        elif isinstance(node, (ast.If, ast.IfExp)):
            what = f"if {short_source(node.test)}"
            yield Ablation(*place, "test", what, "always", site, 1)
            yield Ablation(*place, "test", what, "never", site, 0)
        elif isinstance(node, ast.comprehension):
            for option, test in enumerate(node.ifs):
                what = f"if {short_source(test)}"
                line = test.lineno
                yield Ablation(
                    source.name, line, "filter", what, "dropped", site, option
                )
        elif is_stopping(node) and id(node) not in in_compares:
            what = short_source(node)
            yield Ablation(*place, "level", what, "only says", site, 0)


def is_stopping(node: ast.AST) -> bool:
    """Return whether a node is a level that stops a log."""
    return isinstance(node, ast.Attribute) and node.attr in STOPPING


# ---- what a run notices, and what is taken out of it


class Notes:
    """What a run of rewritten functions notices, and what is taken out of the rest of it.

    Attributes:
        noticed: keys of the ablations by which a condition, or a constant, would have been another
            one; of constants outside of comparisons, and of rows, all that were read.
        notice: called with a key when it is noticed first.
        active: key of what is taken out; "" for nothing.
    """

    def __init__(self, notice: Callable[[str], None]) -> None:
        self.noticed: set[str] = set()
        self.notice = notice
        self.active = ""

    def add(self, key: str) -> None:
        """Note an ablation."""
        if key not in self.noticed and not self.active:
            self.noticed.add(key)
            self.notice(key)

    def is_known(self, key: str) -> bool:
        """Return whether nothing more can be noted of an ablation."""
        return bool(self.active) or key in self.noticed

    def operands(self, key: str, is_and: bool, *operands: Callable[[], Any]) -> Any:
        """Return the value of operands, and note which of them make a difference."""
        values: dict[int, Any] = {}

        def value_without(dropped: int) -> Any:
            result: Any = is_and
            for place, operand in enumerate(operands):
                if place == dropped:
                    continue
                if place not in values:
                    values[place] = operand()
                result = values[place]
                if bool(result) != is_and:
                    break
            return result

        result = value_without(-1)
        for dropped in range(len(operands)):
            own_key = f"{key}:{dropped}"
            if not self.is_known(own_key):
                try:
                    is_equal = is_same(result, value_without(dropped))
                except Exception:
                    is_equal = False
                if not is_equal:
                    self.add(own_key)
            if self.active == own_key:
                return value_without(dropped)
        return result

    def test(self, key: str, value: Any) -> Any:
        """Return the value of a test, and note that it would be another one."""
        self.add(f"{key}:{int(not value)}")
        if self.active.startswith(f"{key}:"):
            return self.active.endswith(":1")
        return value

    def filter(self, key: str, value: Any) -> Any:
        """Return the value of a test of a comprehension, and note where it leaves something out."""
        if not value:
            self.add(key)
        return True if self.active == key else value

    def level(self, key: str, value: Any) -> Any:
        """Return a level, and note that it was used."""
        self.add(key)
        return type(value)["SAYS"] if self.active == key else value

    def constant(self, keys: Sequence[str], value: float) -> float:
        """Return a constant, and note that it was read."""
        for key, other in zip(keys, other_values(value)):
            self.add(key)
            if self.active == key:
                return other
        return value

    def table(self, keys: Sequence[tuple[str, int, int]], rows: Sequence[Any]) -> Any:
        """Return a table, and note that it was read.

        Args:
            keys: of each ablation with its row and option: 0 drops it, 1 its level.
            rows: of the table.
        """
        for key, place, option in keys:
            self.add(key)
            if self.active == key:
                left = list(rows)
                row = left.pop(place)
                if option:
                    lower = type(row.level)["SAYS"]
                    left.insert(place, dataclasses.replace(row, level=lower))
                return tuple(left)
        return rows

    def compare(
        self, keys: Sequence[Sequence[str]], compare: Callable[..., Any], *now: float
    ) -> Any:
        """Return a comparison that has constants, and note which other values change it.

        Args:
            keys: of each constant, those of its other values.
            compare: returns the comparison for values of the constants.
            now: their values.
        """
        result = compare(*now)
        for place, own_keys in enumerate(keys):
            for key, other in zip(own_keys, other_values(now[place])):
                if self.active != key and self.is_known(key):
                    continue
                values = [*now]
                values[place] = other
                if self.active == key:
                    return compare(*values)
                try:
                    is_equal = is_same(result, compare(*values))
                except Exception:
                    is_equal = False
                if not is_equal:
                    self.add(key)
                if self.active == key:
                    return compare(*values)
        return result


def is_same(first: Any, second: Any) -> bool:
    """Return whether two values are the same to whoever uses them."""
    if first is second:
        return True
    equal = first == second
    return bool(equal if isinstance(equal, bool) else equal.all())


def rewrite(sources: Sequence[Source], notes: Notes) -> None:
    """Rewrite the functions of this process, for good, so that they note what may be taken out."""
    alternatives: dict[tuple[str, str], list[str]] = {}
    rows = []
    for source in sources:
        for ablation in constants_of(source):
            name = [*source.constants][ablation.site]
            alternatives.setdefault((source.name, name), []).append(ablation.key)
        rows += [(row.key, row.site, row.option) for row in rows_of(source)]
    for source in sources:
        vars(source.module)[NOTES] = notes
        keys = {
            name: alternatives[module, name]
            for name, module in source.constants.items()
        }
        tree = copy.deepcopy(source.tree)
        rewritten = dataclasses.replace(source, tree=tree)
        for definition in rewritten.definitions():
            writer = NoteWriter(source.name, keys, rows)
            definition.body = [writer.visit(node) for node in definition.body]
        source.replace_code(tree)


def has_untouched(node: ast.AST) -> bool:
    """Return whether an expression would mean something else within a lambda."""
    return any(
        isinstance(inner, UNTOUCHED)
        or (isinstance(inner, ast.Name) and inner.id in ("super", "__class__"))
        for inner in ast.walk(node)
    )


def call_of(method: str, *arguments: ast.expr) -> ast.Call:
    """Return a call of a method of the notes."""
    notes = ast.Name(NOTES, ast.Load())
    return ast.Call(ast.Attribute(notes, method, ast.Load()), [*arguments], [])


def lambda_of(body: ast.expr, names: Sequence[str] = ()) -> ast.Lambda:
    """Return a lambda."""
    arguments = ast.arguments(
        [], [ast.arg(name) for name in names], None, [], [], None, []
    )
    return ast.Lambda(arguments, body)


class NoteWriter(ast.NodeTransformer):
    """Rewrites conditions of one module so that they are noted.

    Args:
        module: its name.
        keys: of the other values of each constant.
        rows: key, place and option of each ablation of a row of the table.
    """

    def __init__(
        self,
        module: str,
        keys: dict[str, list[str]],
        rows: Sequence[tuple[str, int, int]],
    ) -> None:
        self._module = module
        self._keys = keys
        self._rows = rows

    def key(self, kind: str, node: ast.AST) -> str:
        """Return the beginning of a node's key."""
        return f"{self._module}:{kind}:{node.site}"  # type: ignore[attr-defined]

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.expr:
        """Note operands; those that would mean something else within a lambda are left alone."""
        key = self.key("operand", node)
        is_untouched = has_untouched(node)
        self.generic_visit(node)
        if is_untouched:
            return node
        is_and = ast.Constant(isinstance(node.op, ast.And))
        operands = [lambda_of(value) for value in node.values]
        return call_of("operands", ast.Constant(key), is_and, *operands)

    def visit_If(self, node: ast.If) -> ast.If:
        """Note the test."""
        key = ast.Constant(self.key("test", node))
        self.generic_visit(node)
        node.test = call_of("test", key, node.test)
        return node

    def visit_IfExp(self, node: ast.IfExp) -> ast.IfExp:
        """Note the test."""
        key = ast.Constant(self.key("test", node))
        self.generic_visit(node)
        node.test = call_of("test", key, node.test)
        return node

    def visit_comprehension(self, node: ast.comprehension) -> ast.comprehension:
        """Note the tests."""
        key = self.key("filter", node)
        self.generic_visit(node)
        node.ifs = [
            call_of("filter", ast.Constant(f"{key}:{option}"), test)
            for option, test in enumerate(node.ifs)
        ]
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        """Note a level that stops a log."""
        if is_stopping(node) and isinstance(node.ctx, ast.Load):
            return call_of("level", ast.Constant(f"{self.key('level', node)}:0"), node)
        self.generic_visit(node)
        return node

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """Note a comparison that has constants, with other values of these.

        What is compared with a level stays a comparison with it.
        """
        if any(is_stopping(inner) for inner in ast.walk(node)):
            return node
        loaded = [inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)]
        names = [*dict.fromkeys(name for name in loaded if name in self._keys)]
        if not names or has_untouched(node):
            self.generic_visit(node)
            return node
        keys = ast.Constant(tuple(tuple(self._keys[name]) for name in names))
        # Conditions within it are noted as well; its constants are the lambda's.
        inner = NoteWriter(self._module, {}, self._rows)
        inner.generic_visit(node)
        now = [ast.Name(name, ast.Load()) for name in names]
        return call_of("compare", keys, lambda_of(node, names), *now)

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Note that a constant, or the table, is read."""
        if not isinstance(node.ctx, ast.Load):
            return node
        if node.id == TABLE:
            return call_of("table", ast.Constant(tuple(self._rows)), node)
        if node.id in self._keys:
            return call_of("constant", ast.Constant(tuple(self._keys[node.id])), node)
        return node

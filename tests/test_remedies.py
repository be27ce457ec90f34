"""Every option that a message names can be given to the command that prints the message.

What a command can print is walked from its module: names lead to functions, classes and constants,
those to the names in them. A text may name an option of another command where it says whose.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module

import pytest

from robot_sysid.commands import COMMANDS as NAMES
from robot_sysid.commands import example, identify, log, motors, report
from robot_sysid.config import Config
from robot_sysid.records.option_fields import OptionRecord
from tests.support import pages
from tests.test_architecture import FUNCTIONS, nodes_of, package_sources

Symbol = tuple[str, str]
"""A module and a name in it."""
MODULES = {"log": log, "report": report, "example": example}
COMMANDS = (
    "run",
    "plan",
    "identify",
    "payload",
    *MODULES,
    *(f"motors {name}" for name in motors.COMMANDS),
)
WHOSE = re.compile(rf"({'|'.join(COMMANDS)})( [^\s;:,()]*[^\s;:,().])*? $")
"""A command's name before an option, within a sentence."""
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")


def symbols_of(module: str, *names: str) -> tuple[Symbol, ...]:
    return tuple((f"robot_sysid.{module}", name) for name in names)


ONLY = {
    "identify": symbols_of("pipeline.recordings", "identify_logs")
    + symbols_of("servo", "run_servo")
}
"""Command to the stage that it takes of those that all questions share."""
UNSAID = {"motors simulate": "; give --yes"}
"""Command to what it does not say of what it shares: a simulated arm is not asked for."""
RUNS = ("run", "identify", "payload")
"""Commands whose options a page speaks of."""
OF_PLANS = symbols_of("pipeline.planning", "write_plan")
CHOSEN = symbols_of(
    "signals.filters", "design_low_pass"
)  # a cut-off that nobody gave fits
USUAL = symbols_of(
    "records.option_fields", "require_countable"
)  # the motion that nobody asked for is short
LIFTED = symbols_of(
    "motion.problem", "_space_above_base"
)  # what was planned below the base may be played
EXPORT = symbols_of("damiao.joints", "damiao_joints")
QUESTIONS = set(symbols_of("commands.identify", "ALONE", "PLAN", "IDENTIFY", "PAYLOAD"))
SHOWN = symbols_of("motion.viewer", "require_display", "play_in_viewer")
CARDS = symbols_of("export", "_write_card")


def other_questions(name: str, *preview: Symbol) -> tuple[Symbol, ...]:
    """Return what stands beside a question in its module and is not of it."""
    return (*(QUESTIONS - set(symbols_of("commands.identify", name))), *preview)


NEVER = {
    "run": symbols_of("pipeline.payload", "identify_payload")
    + (*symbols_of("motion.static", "design_poses"), *other_questions("ALONE", *SHOWN))
    + CARDS,
    "plan": (
        *ONLY["identify"],
        *CHOSEN,
        *symbols_of("pipeline.stages", "identify", "write_results"),
    )
    + other_questions("PLAN"),
    "identify": symbols_of("pipeline.stages", "identify")
    + symbols_of("pipeline.planning", "design_motion", "motor_writer")
    + (*OF_PLANS, *USUAL, *EXPORT, *CARDS)
    + other_questions("IDENTIFY", *SHOWN),
    "payload": (
        *symbols_of("pipeline.stages", "identify"),
        *symbols_of("pipeline.stages", "run_self_test"),
        *symbols_of("pipeline.planning", "design_motion", "motor_writer"),
        *USUAL,
    )
    + (
        *other_questions("PAYLOAD", *SHOWN),
        *OF_PLANS,
        *EXPORT,
        *symbols_of("results.record", "Verdict.PARTLY_FROM_MODEL"),
    ),
    "log": CHOSEN + USUAL + LIFTED,
    # A page names the joint that the run found, and says a verdict in the words of the run.
    "report": symbols_of("model.chain", "_require_end")
    + symbols_of("results.record", "Verdict.PARTLY_FROM_MODEL")
    + (
        *symbols_of("errors", "AmbiguousJointError"),
        *symbols_of("parser", "_notes", "_jaw_notes"),
    ),
    "example": symbols_of("commands.example", "_record_logs"),  # with files of its own
    **dict.fromkeys(
        [f"motors {word}" for word in ("check", "play", "simulate")], LIFTED
    ),
    "motors hold": LIFTED,
    "motors map": symbols_of(
        *(
            "damiao.preflight",
            "plan_checks",
            "bus_checks",
            "direction_checks",
            "limit_checks",
        )
    )
    + symbols_of("damiao.model_check", "model_checks", "torque_checks", "Contacts")
    + symbols_of("damiao.execution", "MotorRun"),  # nothing is played
    # No model.
    **dict.fromkeys(
        ("motors monitor", "motors setup"),
        symbols_of("commands.motors.session", "Session"),
    ),
}
"""Command to what it never comes to: stages of other questions, and what it does not ask."""


@cache
def parser_of(command: str):
    word, _, name = command.partition(" ")
    if word in MODULES:
        return MODULES[word].build_parser()
    return (
        motors.build_parser(name)
        if name
        else identify.build_parser(word.replace("run", ""))
    )


@cache
def options_of(command: str) -> frozenset[str]:
    """Return the options of a command."""
    return frozenset(
        o for action in parser_of(command)._actions for o in action.option_strings
    )


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_options_that_a_page_types_exist(page):
    """A command that is not one of the names is that of a model file, a self-test."""
    for language, block in pages.blocks(page):
        for line in pages.command_lines(block) if language == "bash" else ():
            if line[0] != "robot-sysid" or "[options]" in line:
                continue
            command = "run"
            if line[1] in (*NAMES, "motors"):
                command = " ".join(line[1 : 3 if line[1] == "motors" else 2])
            typed = {word.partition("=")[0] for word in line if word.startswith("--")}
            assert typed <= options_of(command) | {"--help", "--version"}, line


# ---- what a command reaches


@cache
def definitions(module: str) -> dict[str, ast.AST]:
    """Return what stands at the top of a module, and constants of its classes, by name."""
    nodes: dict[str, ast.AST] = {}
    for node in nodes_of(package_sources()[module])[0].body:
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            nodes[node.name] = node
        if isinstance(node, ast.ClassDef):
            for statement in node.body:
                for name in targets(statement):
                    nodes[f"{node.name}.{name}"] = statement
        nodes |= dict.fromkeys(targets(node), node)
    return nodes


def targets(node: ast.AST) -> list[str]:
    """Return the names that a statement assigns to."""
    if not isinstance(node, (ast.Assign, ast.AnnAssign)):
        return []
    names = []
    for target in getattr(node, "targets", None) or [node.target]:
        names += [n.id for n in ast.walk(target) if isinstance(n, ast.Name)]
    return names


@cache
def imported_symbols(module: str) -> dict[str, Symbol]:
    """Return name in a module to what of the package it stands for; "" is a module itself."""
    symbols = {}
    for node in nodes_of(package_sources()[module]):
        is_import = isinstance(node, ast.ImportFrom)
        if is_import and node.module.startswith("robot_sysid"):
            for alias in node.names:
                symbol = node.module, alias.name
                if ".".join(symbol) in package_sources():
                    symbol = ".".join(symbol), ""
                symbols[alias.asname or alias.name] = symbol
    return symbols


def origin_of(module: str, name: str) -> Symbol | None:
    """Return where a name of a module is defined, through those that only pass it on."""
    if name in definitions(module):
        return module, name
    origin = imported_symbols(module).get(name)
    return origin if origin is None or not origin[1] else origin_of(*origin) or origin


def code_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all of a definition but docstrings, a class's constants and bits of a longer text."""
    yield node
    left_out = {
        ast.Expr: (ast.Constant,),
        ast.ClassDef: (ast.Assign, ast.AnnAssign),
        ast.JoinedStr: (ast.Constant,),
    }.get(type(node), ())
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, left_out):
            yield from code_nodes(child)


@cache
def nodes_of_symbol(symbol: Symbol) -> tuple[ast.AST, ...]:
    """Return the parts of a definition."""
    return tuple(code_nodes(definitions(symbol[0])[symbol[1]]))


@cache
def leads_to(source: Symbol) -> frozenset[Symbol]:
    """Return what a definition names."""
    module, name = source
    symbols = set()
    nodes = nodes_of_symbol(source)
    local = set()
    if isinstance(definitions(module)[name], FUNCTIONS):
        local = {node.arg for node in nodes if isinstance(node, ast.arg)}
        for node in nodes:
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                local.add(node.id)
    for node in nodes:
        if isinstance(node, ast.Name) and node.id not in local:
            symbols.add(origin_of(module, node.id))
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            origin = origin_of(module, node.value.id)
            if origin is not None and not origin[1]:
                symbols.add(origin_of(origin[0], node.attr))
            elif origin is not None:
                symbols.add((origin[0], f"{origin[1]}.{node.attr}"))
    return frozenset(s for s in symbols if s and s[1] in definitions(s[0]))


@cache
def reachable(command: str) -> frozenset[Symbol]:
    """Return what a command may run."""
    word, _, name = command.partition(" ")
    never = set(NEVER.get(command, ()))
    if name:
        run = motors.COMMANDS[name].run
        waiting = {(run.__module__, run.__name__)}
    else:
        start = f"robot_sysid.commands.{NAMES.get(word, 'identify')}"
        waiting = {(start, symbol) for symbol in definitions(start)}
        waiting = waiting.union(ONLY.get(word, ())) - never
    reached_symbols = set(waiting)
    while waiting:
        new_symbols = leads_to(waiting.pop()) - reached_symbols - never
        reached_symbols |= new_symbols
        waiting |= new_symbols
    return frozenset(reached_symbols)


def is_record(symbol: Symbol) -> bool:
    """Tell whether it checks options: what it says, it says of one that was given."""
    record = getattr(import_module(symbol[0]), symbol[1], None)
    return isinstance(record, type) and issubclass(record, (OptionRecord, Config))


@cache
def texts(symbol: Symbol) -> tuple[str, ...]:
    """Return the texts with options in a definition, {} for what is filled in."""
    texts_in_code = []
    for node in nodes_of_symbol(symbol):
        if isinstance(node, ast.JoinedStr):
            parts = [getattr(value, "value", "") for value in node.values]
            filled = [part if isinstance(part, str) else "{}" for part in parts]
            texts_in_code.append("".join(filled))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts_in_code.append(node.value)
    return tuple(text for text in texts_in_code if OPTION.search(text))


def faults(command: str, text: str) -> Iterator[str]:
    """Yield the options in a text that neither the command has nor the one that it names.

    What begins with an option is about its value, which somebody gave.
    """
    for match in OPTION.finditer(text):
        named = WHOSE.search(text[: match.start()])
        named_options = options_of(named[1]) if named else frozenset()
        if match[0] not in options_of(command) | named_options and match.start():
            yield match[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_what_a_command_may_say_names_its_own_options(command):
    for symbol in sorted(reachable(command)):
        is_page = symbol[0].startswith("robot_sysid.report.")
        for text in () if is_record(symbol) else texts(symbol):
            for reader in RUNS if is_page else (command,):
                is_unsaid = text == UNSAID.get(command)
                assert is_unsaid or not list(faults(reader, text)), (symbol, text)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_names_its_own_options(command):
    parser = parser_of(command)
    help_texts = [action.help for action in parser._actions]
    for text in (parser._example, parser.description, *help_texts):
        assert not list(faults(command, f"{text or ''}")), text


def test_what_is_left_out_is_there():
    for symbols in (*ONLY.values(), *NEVER.values()):
        for module, name in symbols:
            assert name in definitions(module), (module, name)

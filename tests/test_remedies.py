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
from tests.test_architecture import FUNCTIONS, nodes_of, package_sources

Place = tuple[str, str]
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


def places(module: str, *names: str) -> tuple[Place, ...]:
    return tuple((f"robot_sysid.{module}", name) for name in names)


ONLY = {
    "identify": places("pipeline.recordings", "identify_logs")
    + places("servo", "run_servo")
}
"""Command to the stage that it takes of those that all questions share."""
UNSAID = {
    "motors simulate": "; give --yes",
    "motors hold": "--also-joint is about a second arm; add --also",
}
"""Command to what it does not say of what it shares: a simulated arm is not asked for, and an arm
that is held has no file of its own."""
RUNS = ("run", "identify", "payload")
"""Commands whose options a page speaks of."""
OF_PLANS = places("pipeline.planning", "write_plan")
CHOSEN = places("signals.filters", "design_low_pass")  # a cut-off that nobody gave fits
USUAL = places(
    "records.option_fields", "require_countable"
)  # the motion that nobody asked for is short
SECOND = places("damiao.settings", "SecondArm")  # one arm at a time
LIFTED = places(
    "motion.problem", "_above_base"
)  # what was planned below the base may be played
EXPORT = places("damiao.joints", "damiao_joints")
QUESTIONS = set(places("commands.identify", "ALONE", "PLAN", "IDENTIFY", "PAYLOAD"))
SHOWN = places("preview", "require_preview", "show_plan")


def others(name: str, *shown: Place) -> tuple[Place, ...]:
    """Return what stands beside a question in its module and is not of it."""
    return (*(QUESTIONS - set(places("commands.identify", name))), *shown)


NEVER = {
    "run": places("pipeline.payload", "identify_payload")
    + (*places("motion.static", "design_poses"), *others("ALONE", *SHOWN)),
    "plan": (
        *ONLY["identify"],
        *CHOSEN,
        *places("pipeline.stages", "identify", "write_results"),
    )
    + others("PLAN"),
    "identify": places("pipeline.stages", "identify")
    + places("pipeline.planning", "design_motion", "motor_writer")
    + (*OF_PLANS, *USUAL, *EXPORT, *others("IDENTIFY", *SHOWN)),
    "payload": (
        *places("pipeline.stages", "identify"),
        *places("pipeline.self_test", "run_self_test"),
        *places("pipeline.planning", "design_motion", "motor_writer"),
        *USUAL,
    )
    + (
        *others("PAYLOAD", *SHOWN),
        *OF_PLANS,
        *EXPORT,
        *places("results.record", "Verdict.PARTLY_FROM_MODEL"),
    ),
    "log": CHOSEN + USUAL + LIFTED,
    # A page names the joint that the run found.
    "report": places("model.chain", "_require_end")
    + (*places("errors", "AmbiguousJointError"), *places("parser", "_notes")),
    "example": places("commands.example", "_record_logs"),  # with files of its own
    **dict.fromkeys(
        [f"motors {word}" for word in ("check", "play", "simulate")], LIFTED
    ),
    "motors hold": LIFTED + SECOND,
    "motors map": places(
        *(
            "damiao.preflight",
            "plan_checks",
            "bus_checks",
            "direction_checks",
            "limit_checks",
        )
    )
    + places("damiao.model_check", "model_checks", "torque_checks", "transfer_check")
    + SECOND
    + places("damiao.execution", "MotorRun"),  # nothing is played
    # No model.
    **dict.fromkeys(
        ("motors monitor", "motors setup"), places("commands.motors.session", "Session")
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


# ---- what a command reaches


@cache
def definitions(module: str) -> dict[str, ast.AST]:
    """Return what stands at the top of a module, and constants of its classes, by name."""
    found: dict[str, ast.AST] = {}
    for node in nodes_of(package_sources()[module])[0].body:
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            found[node.name] = node
        if isinstance(node, ast.ClassDef):
            inner = [
                each
                for each in node.body
                if isinstance(each, (ast.Assign, ast.AnnAssign))
            ]
            found |= {
                f"{node.name}.{name}": each for each in inner for name in targets(each)
            }
        found |= dict.fromkeys(targets(node), node)
    return found


def targets(node: ast.AST) -> list[str]:
    """Return the names that a statement assigns to."""
    told = getattr(node, "targets", [getattr(node, "target", None)])
    return [
        n.id for each in told if each for n in ast.walk(each) if isinstance(n, ast.Name)
    ]


@cache
def imported(module: str) -> dict[str, Place]:
    """Return name in a module to what of the package it stands for; "" is a module itself."""
    found = {}
    for node in nodes_of(package_sources()[module]):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "robot_sysid"
        ):
            for each in node.names:
                whole = f"{node.module}.{each.name}"
                known = whole in package_sources()
                found[each.asname or each.name] = (
                    (whole, "") if known else (node.module, each.name)
                )
    return found


def place_of(module: str, name: str) -> Place | None:
    """Return where a name of a module is defined, through those that only pass it on."""
    if name in definitions(module):
        return module, name
    there = imported(module).get(name)
    return there if there is None or not there[1] else place_of(*there) or there


def parts(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all of a definition but docstrings, a class's constants and bits of a longer text."""
    yield node
    left_out = {
        ast.Expr: (ast.Constant,),
        ast.ClassDef: (ast.Assign, ast.AnnAssign),
        ast.JoinedStr: (ast.Constant,),
    }.get(type(node), ())
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, left_out):
            yield from parts(child)


@cache
def parts_of(place: Place) -> tuple[ast.AST, ...]:
    """Return the parts of a definition."""
    return tuple(parts(definitions(place[0])[place[1]]))


@cache
def leads_to(place: Place) -> frozenset[Place]:
    """Return what a definition names."""
    module, name = place
    found = set()
    own = parts_of(place)
    local = {n.arg for n in own if isinstance(n, ast.arg)}
    local |= {
        n.id for n in own if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }
    local = local if isinstance(definitions(module)[name], FUNCTIONS) else set()
    for node in own:
        if isinstance(node, ast.Name) and node.id not in local:
            found.add(place_of(module, node.id))
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            there = place_of(module, node.value.id)
            if there is not None and not there[1]:
                found.add(place_of(there[0], node.attr))
            elif there is not None:
                found.add((there[0], f"{there[1]}.{node.attr}"))
    return frozenset(each for each in found if each and each[1] in definitions(each[0]))


@cache
def reached(command: str) -> frozenset[Place]:
    """Return what a command may run."""
    word, _, name = command.partition(" ")
    if name:
        waiting = [
            (motors.COMMANDS[name].run.__module__, motors.COMMANDS[name].run.__name__)
        ]
    else:
        start = f"robot_sysid.commands.{NAMES.get(word, 'identify')}"
        waiting = [*((start, each) for each in definitions(start)), *ONLY.get(word, ())]
        waiting = [each for each in waiting if each not in NEVER.get(word, ())]
    found = set(waiting)
    while waiting:
        for each in leads_to(waiting.pop()) - found - set(NEVER.get(command, ())):
            found.add(each)
            waiting.append(each)
    return frozenset(found)


def is_record(place: Place) -> bool:
    """Tell whether it checks options: what it says, it says of one that was given."""
    found = getattr(import_module(place[0]), place[1], None)
    return isinstance(found, type) and issubclass(found, (OptionRecord, Config))


@cache
def texts(place: Place) -> tuple[str, ...]:
    """Return the texts with options in a definition, {} for what is filled in."""
    found = []
    for node in parts_of(place):
        if isinstance(node, ast.JoinedStr):
            filled = [
                p.value if isinstance(p, ast.Constant) else "{}" for p in node.values
            ]
            found.append("".join(map(str, filled)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return tuple(text for text in found if OPTION.search(text))


def faults(command: str, text: str) -> Iterator[str]:
    """Yield the options in a text that neither the command has nor the one that it names.

    What begins with an option is about its value, which somebody gave.
    """
    for match in OPTION.finditer(text):
        named = WHOSE.search(text[: match.start()])
        known = options_of(named[1]) if named else frozenset()
        if match[0] not in options_of(command) | known and match.start():
            yield match[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_what_a_command_may_say_names_its_own_options(command):
    wrong = [
        f"{module}.{name}: {option} in {text!r}"
        for module, name in sorted(reached(command))
        if not is_record((module, name))
        for text in texts((module, name))
        if text != UNSAID.get(command)
        for reader in (RUNS if module.startswith("robot_sysid.report.") else (command,))
        for option in faults(reader, text)
    ]
    assert wrong == []


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_names_its_own_options(command):
    parser = parser_of(command)
    told = [
        parser._example,
        parser.description,
        *(each.help for each in parser._actions),
    ]
    assert [
        (text, each) for text in told for each in faults(command, f"{text or ''}")
    ] == []


def test_what_is_left_out_is_there():
    left_out = {place for each in (*ONLY.values(), *NEVER.values()) for place in each}
    assert [place for place in left_out if place[1] not in definitions(place[0])] == []

"""Every option that a page types or a message names exists."""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest

from rigs.files import pages
from rigs.files.command_line import COMMANDS
from robot_sysid.commands import COMMANDS as NAMES
from robot_sysid.commands.arguments import Parser
from tests.test_architecture import nodes_of, package_sources

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")
FREE = {"--help", "--version"}


@cache
def options_of(command: str) -> frozenset[str]:
    """Return the options of a command, such as "motors play"."""
    parser = Parser(COMMANDS[command])
    return frozenset(o for action in parser.actions for o in action.option_strings)


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_options_that_a_page_types_exist(page):
    """A command that is not one of the names is that of a model file, a self-test."""
    for language, block in pages.blocks(page):
        for line in pages.command_lines(block) if language == "bash" else ():
            if line[0] != "robot-sysid" or "[options]" in line:
                continue
            command = ""
            if line[1] in NAMES:
                command = " ".join(line[1 : 3 if line[1] == "motors" else 2])
            typed = {word.partition("=")[0] for word in line if word.startswith("--")}
            assert typed <= options_of(command) | FREE, line


def test_options_that_a_text_of_the_package_names_exist():
    known = frozenset().union(FREE, *map(options_of, COMMANDS))
    for name, source in package_sources().items():
        for node in nodes_of(source):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert set(OPTION.findall(node.value)) <= known, (name, node.value)

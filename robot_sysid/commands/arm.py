"""``robot-sysid arm MODEL LOG...``: ``identify --links``, by the name it had."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.identify import parser_of
from robot_sysid.commands.run import identify


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    return parser_of("arm", "The same as robot-sysid identify --links.", full)


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    console.note("arm is identify --links now; both do the same")
    # Where no torque was measured, links are not sought.
    return identify({**values, "links": "torque_from" not in values}, console)

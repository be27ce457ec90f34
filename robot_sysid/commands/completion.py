"""``robot-sysid completion SHELL``: what completes commands and options in bash, zsh and fish."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator, Mapping, Sequence
from shlex import quote

from robot_sysid.commands.arguments import PROGRAM, Parser, parsed

SHELLS = ("bash", "zsh", "fish")
_BASH = """\
_robot_sysid() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" words=""
    case "${{COMP_WORDS[*]:1}}" in
{commands}
    esac
    [[ $COMP_CWORD == 1 && $current != -* ]] && words="{names}"
    [[ "${{COMP_WORDS[*]:1:2}}" == "motors $current" ]] && words="{motors}"
    case "${{COMP_WORDS[COMP_CWORD-1]}}" in
{choices}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _robot_sysid {program}
"""


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "completion",
        'eval "$(robot-sysid completion bash)"',
        "Print what makes a shell complete commands, options and their values. In ~/.bashrc or "
        "~/.zshrc the line above does it; in fish: robot-sysid completion fish | source.",
        codes=(0, 2, 130),
    )
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=", ".join(SHELLS))
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    lines = _fish() if values["shell"] == "fish" else _bash(values["shell"])
    for line in lines:
        console.stage(line)
    return 0


def _parsers() -> Mapping[str, argparse.ArgumentParser]:
    """Return command ("" for the program itself) to its parser."""
    from robot_sysid.commands import COMMANDS, motors, run

    found: dict[str, argparse.ArgumentParser] = {"": run.build_parser()}
    for name in COMMANDS:
        if name == "motors":
            found.update({f"motors {word}": motors.build_parser(word) for word in motors.COMMANDS})
        else:
            module = "identify" if name == "arm" else name
            found[name] = importlib.import_module(f"robot_sysid.commands.{module}").build_parser()
    return found


def _choices(action: argparse.Action) -> str:
    return " ".join(map(str, action.choices or ()))


def _bash(shell: str) -> Iterator[str]:
    parsers, indent = _parsers(), " " * 8
    commands, choices = list[str](), dict[str, str]()
    for name, parser in sorted(parsers.items(), reverse=True):
        flags = [flag for action in parser._actions for flag in action.option_strings]
        pattern = f'"{name} "*' if name else "*"
        commands.append(f'{indent}{pattern}) words="{" ".join(flags)}" ;;')
        for action in parser._actions:
            if action.choices:
                choices.update(dict.fromkeys(action.option_strings, _choices(action)))
    if shell == "zsh":
        yield "autoload -U +X bashcompinit && bashcompinit"
    text = _BASH.format(
        program=PROGRAM,
        names=" ".join({name.split()[0]: "" for name in parsers if name}),
        motors=" ".join(name.split()[1] for name in parsers if name.startswith("motors ")),
        commands="\n".join(commands),
        choices="\n".join(f'{indent}{flag}) words="{words}" ;;' for flag, words in choices.items()),
    )
    yield from text.splitlines()


def _fish() -> Iterator[str]:
    parsers = _parsers()
    names = " ".join({name.split()[0]: "" for name in parsers if name})
    yield f"complete -c {PROGRAM} -n __fish_use_subcommand -a {quote(names)}"
    for name, parser in parsers.items():
        seen = [f"__fish_seen_subcommand_from {word}" for word in name.split()]
        when = quote("; and ".join(seen) or f"not __fish_seen_subcommand_from {names}")
        for action in parser._actions:
            for flag in action.option_strings:
                kind = f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}"
                takes = f" -xa {quote(_choices(action))}" if action.choices else ""
                takes = takes or (" -r" if action.nargs != 0 else "")
                yield f"complete -c {PROGRAM} -n {when} {kind}{takes}"

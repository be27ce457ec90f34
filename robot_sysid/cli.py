"""The command ``robot-sysid``: arguments in, progress and exit code out."""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from robot_sysid import __version__
from robot_sysid.config import SysidConfig
from robot_sysid.errors import InputError, SysidError

INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports a usage error as one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (robot-sysid --help lists all options)")


class Console:
    """Progress on standard output, notes on standard error.

    Args:
        quiet: say nothing at all.
        verbose: also say what is only of interest when something looks odd.
    """

    def __init__(self, quiet: bool, verbose: bool) -> None:
        self._quiet, self._verbose = quiet, verbose

    def stage(self, message: str) -> None:
        """Print a progress line."""
        if not self._quiet:
            print(message, flush=True)

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Show a bar while items pass, on a terminal; leave one line behind."""
        if sys.stderr.isatty() and not self._quiet:
            from tqdm import tqdm

            items = tqdm(items, desc=label, total=total, leave=False, delay=0.5)
        yield from items
        self.stage(f"{label}: 100%")

    def note(self, message: str) -> None:
        """Print a sentence the user should know."""
        if not self._quiet:
            print(f"note: {message}", file=sys.stderr, flush=True)

    def detail(self, message: str) -> None:
        """Print a sentence that only --verbose shows."""
        if self._verbose and not self._quiet:
            print(message, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    0 done; 1 ran, but the result is not trustworthy; 2 bad input or usage; 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    _tolerant_output()
    try:
        return _run(arguments)
    except SysidError as error:
        return _report(str(error), error.exit_code, debug)
    except KeyboardInterrupt:
        return _report("interrupted; nothing was written", INTERRUPTED, debug)
    except Exception as error:
        hint = "this is a defect in robot-sysid; run again with --debug and report it"
        return _report(f"{type(error).__name__}: {error} ({hint})", 1, debug)


def _run(arguments: list[str]) -> int:
    options = build_parser().parse_args(arguments)
    config = config_from(options)
    console = Console(options.quiet, options.verbose)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline import run

    outcome = run(config, console)
    for line in outcome.report_lines(options.verbose):
        console.stage(line)
    if outcome.failure:
        raise SysidError(outcome.failure)
    return 0


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    one_line = " ".join(message.split())
    print(f"robot-sysid: error: {one_line}", file=sys.stderr, flush=True)
    return code


def _tolerant_output() -> None:
    """Never fail on a terminal that cannot show a middle dot."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = _Parser(
        prog="robot-sysid",
        description="Identify mass, centre of mass, inertia and friction of a robot arm's "
        "terminal link, and write a corrected model.",
        epilog="Exit codes: 0 done, 1 result not trustworthy, 2 bad input, 130 interrupted.",
        allow_abbrev=False,
    )
    parser.add_argument("model", metavar="MODEL", type=Path, help="MuJoCo XML (MJCF) or URDF file")
    _add_main_options(parser)
    _add_model_options(parser.add_argument_group("model"))
    _add_console_options(parser.add_argument_group("console"))
    return parser


def _add_main_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--mesh-dir", type=Path, metavar="MESH_DIR", help="folder of the meshes (default: auto)")
    add("--duration", type=float, default=15.0, help="trajectory duration in seconds (default: 15)")
    add(
        "--sample-rate",
        type=float,
        default=1000.0,
        metavar="RATE",
        help="samples per second in Hz (default: 1000)",
    )
    add("--no-friction", action="store_true", help="identify the 10 inertial parameters only")
    add(
        "--output-dir",
        type=Path,
        default=Path("sysid_output"),
        metavar="DIR",
        help="folder for the results (default: ./sysid_output)",
    )
    add("--export-damiao", action="store_true", help="write a trajectory CSV for Damiao motors")
    add(
        "--motor-type",
        action="append",
        default=[],
        metavar="TYPE",
        help="Damiao motor type, once per joint from the base outwards (e.g. DM4340)",
    )
    add("--seed", type=int, help="random seed of the trajectory (default: a fresh one, printed)")


def _add_model_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--joint", metavar="NAME", help="terminal joint (default: found in the tree)"
    )
    group.add_argument(
        "--torques",
        choices=("chain", "terminal"),
        default="chain",
        help="use the torques of all joints that carry the link, or of the last one only "
        "(default: chain)",
    )
    group.add_argument(
        "--max-velocity",
        type=float,
        default=2.0,
        metavar="V",
        help="speed limit of hinge joints in rad/s (default: 2)",
    )


def _add_console_options(group: argparse._ArgumentGroup) -> None:
    volume = group.add_mutually_exclusive_group()
    volume.add_argument("-v", "--verbose", action="store_true", help="say more")
    volume.add_argument("--quiet", action="store_true", help="print errors only")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    group.add_argument("--version", action="version", version=f"robot-sysid {__version__}")


def config_from(options: argparse.Namespace) -> SysidConfig:
    """Return the run's configuration; raises InputError for values that make no sense."""
    return SysidConfig(
        model=options.model,
        mesh_dir=options.mesh_dir,
        duration=options.duration,
        sample_rate=options.sample_rate,
        friction=not options.no_friction,
        output_dir=options.output_dir,
        export_damiao=options.export_damiao,
        motor_types=tuple(options.motor_type),
        seed=options.seed,
        joint=options.joint,
        torques=options.torques,
        max_velocity=options.max_velocity,
    )


if __name__ == "__main__":
    sys.exit(main())

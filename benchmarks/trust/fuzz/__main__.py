"""``python -m benchmarks.trust.fuzz TARGET``: see the package."""

from __future__ import annotations

import argparse
import faulthandler
import importlib
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import benchmarks.trust.fuzz
from benchmarks.trust.fuzz.harness import Finding, case_of, run

TARGETS = ("models", "logs", "trajectories", "columns", "results", "can_frames")


def main() -> int:
    """Run a target; return 1 if there are findings."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.trust.fuzz", description=benchmarks.trust.fuzz.__doc__
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--inputs", type=int, default=1000, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="S")
    parser.add_argument(
        "--first", type=int, default=0, metavar="NUMBER", help="input to begin with"
    )
    parser.add_argument(
        "--only", type=int, metavar="NUMBER", help="this input, unprotected"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="where inputs with findings go"
    )
    parser.add_argument(
        "--atheris", type=int, metavar="SECONDS", help="guided by coverage"
    )
    options = parser.parse_args()
    if options.atheris:
        from benchmarks.trust.fuzz.guided import fuzz

        return fuzz(options.target, options.atheris, options.seed)
    target = importlib.import_module(f"benchmarks.trust.fuzz.{options.target}")
    if options.only is not None:
        return _once(target, options)
    started = time.time()
    counts = Counter[str]()
    last = ""
    for finding in run(target, options.inputs, options.seed, options.first):
        if isinstance(finding, Finding):
            counts[finding.verdict] += 1
            if counts[finding.verdict] == 1:
                case = f"{options.target} --seed {options.seed} --only {finding.number}"
                print(f"\n{case}: {finding.verdict}")
                print(finding.text, flush=True)
                _keep(
                    options.keep,
                    case_of(target, options.seed, finding.number),
                    finding.number,
                )
        else:
            last = finding
            print(
                f"{time.time() - started:6.0f} s: {last}", file=sys.stderr, flush=True
            )
    took = time.time() - started
    count = f"{sum(counts.values())} findings of {len(counts)} kinds"
    print(f"{options.target}: {last}, {count}, {took:.0f} s")
    for verdict, count in counts.most_common():
        print(f"{count:8} {verdict}")
    return 1 if counts else 0


def _once(target: object, options: argparse.Namespace) -> int:
    """Use one input without any protection, for a debugger's sake."""
    faulthandler.enable()
    case = case_of(target, options.seed, options.only)
    _keep(options.keep, case, options.only)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "out").mkdir()
        target.use(case, Path(folder))
    return 0


def _keep(folder: Path | None, case: dict[str, bytes], number: int) -> None:
    """Write the files of an input to the folder of its number; nothing without a folder."""
    for name, content in case.items() if folder else ():
        path = folder / str(number) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


sys.exit(main())

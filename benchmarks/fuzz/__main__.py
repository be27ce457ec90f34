"""``python -m benchmarks.fuzz TARGET``: see the package."""

from __future__ import annotations

import argparse
import faulthandler
import importlib
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import benchmarks.fuzz
from benchmarks.fuzz.harness import Finding, case_of, run

TARGETS = ("models", "logs", "trajectories", "columns", "results", "can_frames")


def main() -> int:
    """Run a target; the exit code says whether anything was found."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.fuzz", description=benchmarks.fuzz.__doc__
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
    given = parser.parse_args()
    if given.atheris:
        from benchmarks.fuzz.guided import fuzz

        return fuzz(given.target, given.atheris, given.seed)
    target = importlib.import_module(f"benchmarks.fuzz.{given.target}")
    if given.only is not None:
        return _once(target, given)
    started = time.time()
    found = Counter[str]()
    last = ""
    for told in run(target, given.inputs, given.seed, given.first):
        if isinstance(told, Finding):
            found[told.kind] += 1
            if found[told.kind] == 1:
                print(
                    f"\n{given.target} --seed {given.seed} --only {told.number}: {told.kind}"
                )
                print(told.text, flush=True)
                _keep(given.keep, case_of(target, given.seed, told.number), told.number)
        else:
            last = told
            print(
                f"{time.time() - started:6.0f} s: {last}", file=sys.stderr, flush=True
            )
    took = time.time() - started
    count = f"{sum(found.values())} findings of {len(found)} kinds"
    print(f"{given.target}: {last}, {count}, {took:.0f} s")
    for kind, count in found.most_common():
        print(f"{count:8} {kind}")
    return 1 if found else 0


def _once(target: object, given: argparse.Namespace) -> int:
    """Use one input without any protection, for a debugger's sake."""
    faulthandler.enable()
    case = case_of(target, given.seed, given.only)
    _keep(given.keep, case, given.only)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "out").mkdir()
        target.use(case, Path(folder))
    return 0


def _keep(folder: Path | None, case: dict[str, bytes], number: int) -> None:
    for name, content in case.items() if folder else ():
        path = folder / str(number) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


sys.exit(main())

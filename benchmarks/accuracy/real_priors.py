"""What priors and levels of the estimate do to files of real arms: each halved, and doubled.

Run from the checkout, ten minutes on one core; ``--write`` puts the table into docs/evidence.md:

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.real_priors [--write]

A copy of the package with another value makes a file of each log of ``real_gate.py``, which lies
with the public logs in ../shared beside the checkout, and the file is judged on the log that the
gate judges it on, offsets of sensors counted as errors and taken out. Short logs, which the gate
judges on themselves, are left out. A value that was chosen by simulated arms alone shows here what
it does to real ones.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT, SHARED

TABLE = PageTable(
    ROOT / "docs" / "evidence.md",
    "real_priors",
    "python -m benchmarks.accuracy.real_priors",
)
USUAL = "records/usual_errors.py"
VALUES = (
    *((USUAL, name) for name in ("LINK", "MASS_SCALES", "CENTRE_SCALES")),
    *((USUAL, name) for name in ("INERTIA_SCALES", "SCALE", "ZERO", "GRAVITY")),
    *((USUAL, name) for name in ("GRAVITY_IN_FILE", "DELAY", "OFFSET")),
    *((USUAL, name) for name in ("LOAD_LOSS", "CURVATURE", "FADING")),
    ("records/levels.py", "CLEAR"),
    ("estimate/contacts.py", "AT_TURNS"),
    ("estimate/links.py", "FAR_OFF_CENTRE"),
    ("estimate/restricted_fit.py", "WORTH"),
)
"""Module and name of each value that is tried."""
FACTORS = (0.5, 2.0)
"""By which each is tried."""
ONE = "--one"
"""Option of a process that makes and judges all files with its own copy of the package."""


def errors() -> Iterator[tuple[str, float, float]]:
    """Yield each pair of logs with the error of the file on the second, left in and out."""
    sys.path.insert(0, str(SHARED / "tools"))
    import real_gate

    from robot_sysid.estimate.choose import answer_of, solve_question
    from robot_sysid.estimate.fit import Fit
    from robot_sysid.estimate.options import EstimationOptions
    from robot_sysid.estimate.questions import Question
    from robot_sysid.estimate.restricted_fit import errors_on, fit_file
    from robot_sysid.parser import load_robot_model
    from robot_sysid.records import Recording
    from robot_sysid.signals.process import low_pass_recordings

    files: dict[str, Fit] = {}
    for made, of, judge, on in real_gate.PAIRS:
        if (made, of) == (judge, on):
            continue
        model, read, options = real_gate.LOGS[made]
        gravity = tuple(map(float, options[1:])) or None
        robot = load_robot_model(model, gravity=gravity)
        recordings = []
        for name, part in ((made, of), (judge, on)):
            rows = real_gate.part(real_gate.LOGS[name][1](), *part)
            time, q, tau = np.split(rows, (1, 1 + robot.n_joints), axis=1)
            log = Recording(time[:, 0] - time[0, 0], q, None, tau, name=name)
            recordings.append(low_pass_recordings(robot, [log])[0])
        if made not in files:
            question = Question(EstimationOptions())
            fitted = solve_question(robot, recordings[0], question)
            files[made] = fit_file(answer_of(fitted))
        judged = errors_on(files[made], recordings[1], judge)
        as_used = judged.as_used.after.relative_error
        yield f"{made} on {judge}", as_used, judged.after.relative_error


def errors_with(folder: Path, module: str, name: str, factor: float) -> np.ndarray:
    """Return the errors (m, 2) of all pairs with a value of a copy of the package times a factor.

    Tuples are multiplied number by number.
    """
    package = folder / "robot_sysid"
    path = package / module
    text = path.read_text(encoding="utf-8")
    match = re.search(rf"^{name} = (.*)$", text, re.MULTILINE)
    assert match is not None, f"{module} has no value {name}"
    value = match[1]
    other = f"{factor} * ({value})"
    if value.startswith("("):
        other = f"tuple({factor} * each for each in {value})"
    path.write_text(text.replace(match[0], f"{name} = {other}"), encoding="utf-8")
    command = [sys.executable, "-P", "-m", "benchmarks.accuracy.real_priors", ONE]
    paths = os.pathsep.join(map(str, (folder, ROOT)))
    environment = {**os.environ, "PYTHONPATH": paths}
    if sys.version_info < (3, 11):
        command.remove("-P")
    run = subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=folder, check=True
    )
    path.write_text(text, encoding="utf-8")
    return np.array([row[1:] for row in json.loads(run.stdout)])


def table(rows: Sequence[tuple[str, float, np.ndarray]]) -> Iterator[str]:
    """Yield the lines of the table of (name, factor, errors (m, 2) over those of today)."""
    yield "| Value | times | as used: mean | largest | offsets taken out: mean | largest |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, factor, ratios in rows:
        cells = [f"`{name}`", f"{factor:g}"]
        for column in ratios.T:
            mean = float(np.exp(np.mean(np.log(column))))
            cells += [
                f"{100.0 * (share - 1.0):+.1f} %" for share in (mean, max(column))
            ]
        yield f"| {' | '.join(cells)} |"


def main(*options: str) -> int:
    """Print the table; write it where that is asked for."""
    if ONE in options:
        print(json.dumps([*errors()]))
        return 0
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(ROOT / "robot_sysid", folder / "robot_sysid")
        before = errors_with(folder, *VALUES[0], 1.0)
        for module, value in VALUES:
            for factor in FACTORS:
                ratios = errors_with(folder, module, value, factor) / before
                rows.append((value, factor, ratios))
                print(*[*table(rows)][-1:], file=sys.stderr, flush=True)
    TABLE.show([*table(rows)], "--write" in options)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

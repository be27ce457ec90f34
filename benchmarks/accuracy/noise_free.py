"""Errors of a link that is identified without noise, and whether they agree with the stated ones.

    python -m benchmarks.accuracy.noise_free [--cases "1 g link" ...] [--rates 10 100] [--seed 0]

Seven-joint arms with dry and viscous friction, with torques from 1e-4 to 1e3 N m and sample rates
from 10 Hz to 20 kHz. Each is identified from its own simulation of 15 s (``robot-sysid MODEL``).
The simulated log is then identified from a model whose last link is wrong by 30 %, once with noise
as the only unknown cause (all priors 0) and once with default priors. Printed: root
mean square torque of the strongest joint; relative error of the mass; largest error of the ten
parameters over mass times size; the largest stated error; and the largest error over stated error
(nan for its own simulation, of which no errors are stated). Logs of an arm whose masses no arm has
are refused.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.trust.answers import number
from rigs.arms.small_arms import LINK, SEVEN_AXES, TIP, serial_bodies, world
from rigs.files.params import rows
from robot_sysid import spatial
from robot_sysid.cli import main as robot_sysid

UNCERTAIN = ("link", "scale", "zero", "gravity", "delay", "friction")
ACCEPTED = ("--accept", "computed")
WRONG = 0.7
RATES = (10.0, 25.0, 100.0, 1000.0, 20000.0)


@dataclass(frozen=True)
class Case:
    """An arm: what the last link's and the others' numbers are multiplied by, and the friction."""

    tip: float
    others: float
    friction: float = 1.0

    def model(self, tip: float = 1.0) -> str:
        """Return the arm as MJCF, its last link's numbers times ``tip``."""
        friction = self.friction
        joint = f'range="-2.5 2.5" frictionloss="{0.4 * friction}" damping="{0.1 * friction}"'
        bodies = serial_bodies(
            SEVEN_AXES, joint=joint, tip_inertial=times(TIP, self.tip * tip)
        )
        return world(bodies.replace(LINK, times(LINK, self.others)))


CASES = {
    "1 kg link": Case(1.25, 1.0),
    "1 g link": Case(1.25e-3, 1.0),
    "100 kg link": Case(125.0, 50.0, 20.0),
    "torques of 1e-4 N m": Case(1.25e-5, 1e-5, 1e-5),
    "torques of 1e3 N m": Case(125.0, 100.0, 100.0),
    "other links of 1e4 kg": Case(1.25, 1e4),
}


def times(inertial: str, factor: float) -> str:
    """Return an ``<inertial>`` element with mass and inertia times a factor."""
    fields = inertial.split('"')
    for index, word in enumerate(fields[:-1]):
        if word.endswith(("mass=", "fullinertia=")):
            numbers = map(float, fields[index + 1].split())
            fields[index + 1] = " ".join(repr(factor * x) for x in numbers)
    return '"'.join(fields)


def run(folder: Path, *arguments: object) -> dict | None:
    """Return what one command wrote into params.json; None where it refused."""
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        robot_sysid([*map(str, arguments), "--output-dir", str(folder)])
    written = folder / "params.json"
    return json.loads(written.read_text()) if written.exists() else None


def line(params: dict | None, truth: np.ndarray) -> str:
    """Return errors and stated ones of a result."""
    if params is None:
        return f"{'refused':>10}"
    found = rows(params)
    names = ("mass", *spatial.PARAMETER_NAMES[1:])
    link = [found[params["body_name"], name] for name in names]
    theta = np.array([row["value"] for row in link])
    errors = np.array([number(row["error"]) for row in link])
    size = spatial.parameter_scale(truth[0], spatial.characteristic_length(truth))
    off = np.abs(theta - truth)
    over = np.max(off / np.maximum(errors, 1e-300))
    mass = off[0] / truth[0]
    return f"{mass:10.1e}{np.max(off / size):10.1e}{np.max(errors / size):10.1e}{over:8.2f}"


def lines(
    case: Case, rate: float, seed: int, folder: Path
) -> Iterator[tuple[str, str]]:
    """Yield (source of the data, its line) of one arm at one sample rate [Hz]."""
    true = folder / "true.xml"
    guess = folder / "guess.xml"
    log = folder / "log.csv"
    true.write_text(case.model())
    guess.write_text(case.model(WRONG))
    motion = ("--sample-rate", rate, "--seed", seed)
    params = run(folder / "own", true, *motion, "--save-measurements", log)
    truth = truth_of(true)
    yield "own simulation", line(params, truth)
    priors = folder / "priors.json"
    priors.write_text(json.dumps(dict.fromkeys(UNCERTAIN, 0)))
    exact = ("--priors", priors)
    for name, more in (("log, noise only", exact), ("log, defaults", ())):
        # What was computed looks like it.
        arguments = ("identify", guess, log, *ACCEPTED, *more)
        yield name, line(run(folder / name, *arguments), truth)


def truth_of(path: Path) -> np.ndarray:
    """Return the last link's parameters (10,)."""
    from robot_sysid.parser import load_robot_model

    return load_robot_model(path).prior.theta


def torque_of(log: Path) -> float:
    """Return the largest root mean square torque of a joint in a written log [N m]."""
    with log.open() as stream:
        titles = stream.readline().split(",")
        columns = [
            k for k, title in enumerate(titles) if title.strip().endswith("_torque")
        ]
        rows = np.loadtxt(stream, delimiter=",", usecols=columns, max_rows=20000)
    return float(np.max(np.sqrt(np.mean(rows**2, axis=0))))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--rates", nargs="+", type=float, default=list(RATES))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    head = f"{'torque':>9}{'mass':>10}{'all ten':>10}{'stated':>10}{'ratio':>8}"
    print(f"{'arm':<24}{'Hz':>6} {'data':<17}{head}")
    for name in options.cases:
        for rate in options.rates:
            with tempfile.TemporaryDirectory() as folder:
                for source, text in lines(
                    CASES[name], rate, options.seed, Path(folder)
                ):
                    torque = torque_of(Path(folder) / "log.csv")
                    print(
                        f"{name:<24}{rate:>6g} {source:<17}{torque:9.1e}{text}",
                        flush=True,
                    )
    return 0


if __name__ == "__main__":
    sys.exit(main())

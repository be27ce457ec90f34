"""Check the way from a log to a model, as a user walks it: every case runs the command robot-sysid.

The arm that makes the logs is the truth of this example. Where the other links are known, the
terminal link has to come out within stated limits; where they are only guessed, it cannot, and the
last case shows what the tool then says. Exit code 0 when all limits hold.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from validate_damiao_loop import GUESS, TRUTH, known_links_guessed_tool, robot_sysid

from robot_sysid.parser import load_robot_model
from robot_sysid.records import RobotModel

GRAVITY = 9.81
MASS = 0.002
FRICTION = 0.02
"""Largest relative errors with a good encoder and no torque noise."""
KNOWN = dict.fromkeys(("link", "scale", "zero", "gravity", "delay", "friction"), 0)
"""Priors of an arm of which all but noise is known."""


@dataclass(frozen=True)
class Bench:
    """Where the cases run.

    Attributes:
        folder: for files.
        model: the truth's links with the guess's terminal link.
        truth: the arm that makes the logs.
    """

    folder: Path
    model: Path
    truth: RobotModel

    def record(self, name: str, *sensors: object, seed: int = 1) -> Path:
        """Simulate the true arm with the given sensors and return the path of its log."""
        log = self.folder / f"{name}.csv"
        plant = ("--plant-model", TRUTH, *sensors, "--seed", seed)
        output = ("--save-measurements", log, "--output-dir", self.folder / name)
        robot_sysid(self.model, *plant, *output)
        return log

    def identify(
        self, log: Path, *arguments: object, model: Path | None = None
    ) -> dict[str, Any]:
        """Run robot-sysid and return its params.json; all but noise is known of ``model``."""
        output = self.folder / "out"
        priors = self.folder / "priors.json"
        priors.write_text(json.dumps(KNOWN))
        options = () if model else ("--priors", priors)
        # Torque without noise was simulated, which is known here.
        options = (*options, "--accept", "computed")
        arguments = (*arguments, *options, "--output-dir", output)
        robot_sysid("identify", model or self.model, log, *arguments)
        return dict(json.loads((output / "params.json").read_text(encoding="utf-8")))


def main() -> int:
    """Run the cases in a temporary folder and return the exit code."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bench = Bench(folder, known_links_guessed_tool(folder), load_robot_model(TRUTH))
        passed = [good_encoder(bench), other_trajectory(bench)]
        links_only_guessed(bench)
    print("all limits hold" if all(passed) else "NOT ALL LIMITS HOLD")
    return 0 if all(passed) else 1


def good_encoder(bench: Bench) -> bool:
    """Test that positions and torques alone give mass and friction."""
    print("1. friction and armature, encoder step 1e-5 rad")
    params = bench.identify(bench.record("exact", "--encoder-resolution", 1e-5))
    mass = abs(params["mass"] / bench.truth.prior.mass - 1.0)
    coulomb, viscous = friction_errors(params, bench.truth)
    print(
        f"   off by: mass {100 * mass:.3f} %, worst Coulomb {100 * coulomb:.2f} %, worst viscous "
        f"{100 * viscous:.2f} %"
    )
    return mass <= MASS and max(coulomb, viscous) <= FRICTION


def row(params: Mapping[str, Any], of: str, name: str) -> Mapping[str, Any]:
    """Return an identified number of a joint or body."""
    found = (each for each in params["quantities"] if each["source"] != "file")
    return next(each for each in found if (each["of"], each["name"]) == (of, name))


def friction_errors(
    params: Mapping[str, Any], truth: RobotModel
) -> tuple[float, float]:
    """Return the largest relative errors of Coulomb and viscous friction over all joints."""
    worst = []
    for term in ("coulomb", "viscous"):
        values = np.array(
            [row(params, joint, term)["value"] for joint in truth.joint_names]
        )
        worst.append(
            float(np.max(np.abs(values / getattr(truth.friction, term) - 1.0)))
        )
    return worst[0], worst[1]


def other_trajectory(bench: Bench) -> bool:
    """Test that the result predicts torques of another trajectory down to the noise."""
    print("2. --validation-measurements: another trajectory, torque noise 0.1 N m")
    sensors = ("--noise-torque", 0.1, "--encoder-resolution", 1e-4)
    other = bench.record("other", *sensors, seed=2)
    log = bench.record("log", *sensors)
    params = bench.identify(log, "--validation-measurements", other)
    fitted = params["rmse"]
    predicted = params["validation"][-1]["rmse"]
    print(
        f"   torque error on fitted data {fitted:.4f} N m, on the other log {predicted:.4f} N m"
    )
    return bool(predicted < 1.5 * fitted)


def links_only_guessed(bench: Bench) -> None:
    """Test that errors allow for other links that are off, as on a real arm."""
    print(
        "3. the other links only guessed: the interval allows for that, and the verdict says so"
    )
    log = bench.record("fine", "--encoder-resolution", 1e-4)
    params = bench.identify(log, model=GUESS)
    mass = row(params, params["body_name"], "mass")
    print(
        f"   mass {mass['value']:.3f} ± {mass['error']:.3f} kg, truth "
        f"{bench.truth.prior.mass:.3f} kg, limited by {mass['reason']}"
    )
    for remark in params["remarks"]:
        if remark["level"] == "doubts":
            print(f"   {remark['text']}")


if __name__ == "__main__":
    sys.exit(main())

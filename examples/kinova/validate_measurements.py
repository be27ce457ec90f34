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
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation
from validate_damiao_loop import (
    GUESS,
    MODELS,
    TRUTH,
    known_links_guessed_tool,
    robot_sysid,
)

from robot_sysid.parser import load_robot_model
from robot_sysid.records import RobotModel

GRAVITY = 9.81
MASS = 0.002
FRICTION = 0.02
"""Largest relative errors with a good encoder and no torque noise."""
DELAY = 0.1
TILT = 0.02
"""Largest errors of delay [ms] and tilt [degrees] without torque noise."""
KNOWN = tuple(
    f"--{cause}-uncertainty=0"
    for cause in ("link", "scale", "zero", "gravity", "delay", "friction")
)
INJECTED = ((0.0, 0.0), (2.0, 0.25), (5.0, 0.5), (10.0, 1.0))


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

    def identify(self, *arguments: object, model: Path | None = None) -> dict[str, Any]:
        """Run robot-sysid and return its params.json; all but noise is known of ``model``."""
        output = self.folder / "out"
        options = () if model else KNOWN
        arguments = (*arguments, *options, "--seed", 1, "--output-dir", output)
        robot_sysid(model or self.model, *arguments)
        return dict(json.loads((output / "params.json").read_text(encoding="utf-8")))


def main() -> int:
    """Run the cases in a temporary folder and return the exit code."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bench = Bench(folder, known_links_guessed_tool(folder), load_robot_model(TRUTH))
        passed = [
            saved_and_read_again(bench),
            good_encoder(bench),
            delay_and_tilt(bench),
            other_trajectory(bench),
        ]
        links_only_guessed(bench)
    print("all limits hold" if all(passed) else "NOT ALL LIMITS HOLD")
    return 0 if all(passed) else 1


def saved_and_read_again(bench: Bench) -> bool:
    """Test that a log that was written and read again gives the same numbers."""
    print("1. save a simulated log, read it again")
    log = bench.folder / "log.csv"
    sensors = ("--noise-torque", 0.1, "--encoder-resolution", 1e-4)
    first = bench.identify("--plant-model", TRUTH, *sensors, "--save-measurements", log)
    second = bench.identify("--measurements", log)
    same = all(
        first[key] == second[key]
        for key in ("mass", "inertia_tensor", "standard_errors")
    )
    print(f"   mass {second['mass']:.6f} kg; all numbers the same: {same}")
    return same


def good_encoder(bench: Bench) -> bool:
    """Test that positions and torques alone give mass and friction."""
    print("2. friction and armature, encoder step 1e-5 rad")
    params = bench.identify("--plant-model", TRUTH, "--encoder-resolution", 1e-5)
    mass = abs(params["mass"] / bench.truth.prior.mass - 1.0)
    coulomb, viscous = friction_errors(params, bench.truth)
    print(
        f"   off by: mass {100 * mass:.3f} %, worst Coulomb {100 * coulomb:.2f} %, worst viscous "
        f"{100 * viscous:.2f} %"
    )
    return mass <= MASS and max(coulomb, viscous) <= FRICTION


def friction_errors(
    params: Mapping[str, Any], truth: RobotModel
) -> tuple[float, float]:
    """Return the largest relative errors of Coulomb and viscous friction over all joints."""
    worst = []
    for term in ("coulomb", "viscous"):
        terms = [params["joints"][joint]["terms"] for joint in truth.joint_names]
        values = [
            joint_terms[term]["value"] if term in joint_terms else 0.0
            for joint_terms in terms
        ]
        worst.append(
            float(
                np.max(np.abs(np.array(values) / getattr(truth.friction, term) - 1.0))
            )
        )
    return worst[0], worst[1]


def delay_and_tilt(bench: Bench) -> bool:
    """Test that late torques and a tilted base are identified."""
    print("3. late torques and a tilted base, --delay auto --tilt auto")
    print(f"   {'injected':>18}   {'found':>20}")
    passed = True
    for delay, tilt in INJECTED:
        params = bench.identify(
            *(
                "--plant-model",
                tilted_truth(bench.folder, tilt),
                "--torque-delay",
                1e-3 * delay,
            ),
            *("--encoder-resolution", 1e-4, "--delay", "auto", "--tilt", "auto"),
        )
        got = 1e3 * params["delay"]
        angle = np.degrees(params["tilt"])
        print(f"   {delay:6.3f} ms {tilt:6.3f}°    {got:6.3f} ms {angle:8.4f}°")
        passed &= abs(got - delay) <= DELAY and abs(angle - tilt) <= TILT
    return bool(passed)


def tilted_truth(folder: Path, degrees: float) -> Path:
    """Write the truth with gravity turned by an angle, and return its path."""
    tree = ElementTree.parse(TRUTH)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.8, 0.0]))
    down = turn.apply(np.array([0.0, 0.0, -GRAVITY]))
    root = tree.getroot()
    compiler = tree.find("compiler")
    assert compiler is not None
    compiler.set("meshdir", str(MODELS / compiler.get("meshdir", "")))
    ElementTree.SubElement(
        root, "option", gravity=" ".join(map(repr, map(float, down)))
    )
    path = folder / "tilted.xml"
    tree.write(path)
    return path


def other_trajectory(bench: Bench) -> bool:
    """Test that the result predicts torques of another trajectory down to the noise."""
    print("4. --validation-measurements: another trajectory, torque noise 0.1 N m")
    sensors = ("--noise-torque", 0.1, "--encoder-resolution", 1e-4)
    other = bench.folder / "other.csv"
    robot_sysid(
        *(bench.model, "--plant-model", TRUTH, *sensors, "--seed", 2),
        *("--save-measurements", other, "--output-dir", bench.folder / "other"),
    )
    params = bench.identify(
        "--plant-model", TRUTH, *sensors, "--validation-measurements", other
    )
    fitted = params["rmse"]
    predicted = params["validation"][-1]["rmse"]
    print(
        f"   torque error on fitted data {fitted:.4f} N m, on the other log {predicted:.4f} N m"
    )
    return bool(predicted < 1.5 * fitted)


def links_only_guessed(bench: Bench) -> None:
    """Test that errors allow for other links that are off, as on a real arm."""
    print(
        "5. the other links only guessed: the interval allows for that, and the verdict says so"
    )
    params = bench.identify(
        "--plant-model", TRUTH, "--encoder-resolution", 1e-4, model=GUESS
    )
    error = params["standard_errors"]["m"]
    print(
        f"   mass {params['mass']:.3f} ± {error:.3f} kg, truth {bench.truth.prior.mass:.3f} kg"
    )
    for sentence in params["limitations"]:
        print(f"   {sentence}")


if __name__ == "__main__":
    sys.exit(main())

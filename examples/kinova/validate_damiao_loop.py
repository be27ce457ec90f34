"""The whole loop on Damiao motors, without hardware: plan, play, record, identify, compare.

The arm on the other side is the truth of this example, moved by seven simulated motors that pack
their measurements into 12 and 16 bits as real ones do, on a simulated CAN bus. The engineer's model
knows the other links, and a file of priors says so, but guesses the terminal one. Exit code 0 when
the recording gives the true mass within 1 % and the centre of mass within 2 mm.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from robot_sysid import cli
from robot_sysid.parser import load_robot_model

MODELS = Path(__file__).resolve().parent / "model"
TRUTH = MODELS / "kinova_fullinertia.xml"
GUESS = MODELS / "kinova_fullinertia_guess.xml"
MOTORS = ("DM8009",) * 4 + ("DM4340",) * 3
DURATION = 30.0
MASS_TOLERANCE = 0.01
COM_TOLERANCE = 2e-3


def main() -> int:
    """Run the loop in a temporary folder and return the exit code."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = known_links_guessed_tool(folder)
        print("1. plan: robot-sysid plan MODEL --export-damiao --motor-type ...")
        trajectory = planned_trajectory(model, folder)
        print(
            "2. play and record: robot-sysid motors simulate ... --record measured.csv"
        )
        play_and_record(trajectory, folder / "measured.csv")
        print(
            "3. identify: robot-sysid identify MODEL measured.csv --priors priors.toml"
        )
        close = compare(identify_log(model, folder / "measured.csv", folder))
    return 0 if close else 1


def known_links_guessed_tool(folder: Path) -> Path:
    """Write the truth's model with the guess's terminal link, and return its path."""
    tree = ElementTree.parse(TRUTH)
    guessed = ElementTree.parse(GUESS).find(".//body[@name='link6']/inertial")
    inertial = tree.find(".//body[@name='link6']/inertial")
    compiler = tree.find("compiler")
    if inertial is None or guessed is None or compiler is None:
        raise SystemExit("the example's models have no link6 with an inertial")
    inertial.attrib.clear()
    inertial.attrib.update(guessed.attrib)
    compiler.set("meshdir", str(MODELS / compiler.get("meshdir", "")))
    path = folder / "known_links_guessed_tool.xml"
    tree.write(path)
    return path


def robot_sysid(*arguments: object) -> tuple[int, str]:
    """Run the command robot-sysid; return its exit code and what it printed."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        code = cli.main([str(argument) for argument in arguments])
    return code, output.getvalue()


def succeeding(*arguments: object) -> str:
    """Run the command robot-sysid, which has to succeed, and return what it printed."""
    code, output = robot_sysid(*arguments)
    if code != 0:
        print(output)
        raise SystemExit(f"robot-sysid ended with exit code {code}")
    return output


def planned_trajectory(model: Path, folder: Path) -> Path:
    """Design a motion, which shows the link ten times better than random sines; return its path."""
    types = [word for motor in MOTORS for word in ("--motor-type", motor)]
    options = ("--duration", DURATION, "--seed", 0, "--output-dir", folder / "planned")
    succeeding("plan", model, *options, "--export-damiao", *types)
    return folder / "planned" / "damiao_trajectory.csv"


def play_and_record(trajectory: Path, record: Path) -> None:
    """Play on the simulated arm, in simulated time, and print how that went."""
    arm = ("--model", TRUTH, "--plant-model", TRUTH)
    played = ("motors", "simulate", trajectory, *arm, "--record", record)
    for line in succeeding(*played).splitlines():
        if line.startswith(("played ", "largest distance ")):
            print(f"   {line}")


def identify_log(model: Path, log: Path, folder: Path) -> dict[str, object]:
    """Identify the model's terminal link from a log and return params.json."""
    output = folder / "identified"
    priors = folder / "priors.toml"
    priors.write_text("link = 0\n")
    succeeding("identify", model, log, "--priors", priors, "--output-dir", output)
    return dict(json.loads((output / "params.json").read_text()))


def compare(params: dict[str, object]) -> bool:
    """Print identified and true values; return whether they are close enough."""
    truth = load_robot_model(TRUTH).prior
    guess = load_robot_model(GUESS).prior
    mass = float(str(params["mass"]))
    com = np.array(params["center_of_mass_moment"], dtype=float) / mass
    mass_error = mass / truth.mass - 1.0
    com_error = float(np.linalg.norm(com - truth.com))
    print(
        f"   mass [kg]: guess {guess.mass:.4f}, found {mass:.4f}, truth {truth.mass:.4f}"
    )
    print(f"   centre of mass [mm]: found {1e3 * com}, truth {1e3 * truth.com}")
    print(f"   off by {100 * mass_error:+.3f} % and {1e3 * com_error:.3f} mm")
    return abs(mass_error) < MASS_TOLERANCE and com_error < COM_TOLERANCE


if __name__ == "__main__":
    np.set_printoptions(precision=3, suppress=True)
    sys.exit(main())

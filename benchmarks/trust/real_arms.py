"""How often stated 95 % intervals contain the truth, on arms that are off as real ones are.

    python -m benchmarks.trust.real_arms MODELS_FOLDER [--logs 20] [--arms ur5e iiwa14 ...]
        [--deviations real priors exact bent presliding straight] [--durations 8 20 60]
        [--first-seed 0]

Each log is of another arm. Its duration is 8, 20 or 60 s, or what is asked for. Every other log has
white torque noise, the rest noise with a memory of 20 samples.

real    links as real model files have them: masses off by 10 to 20 %, one link 40 % heavier,
        centres of mass by 15 % of the radius of gyration, inertias by 15 %; torque scales off by
        2 %, encoder zeros by 2 mrad, the base by 0.3 degrees; Stribeck friction of 30 % of Coulomb
        friction, and 2 to 6 % of the load lost in the gear
priors  everything drawn from the default priors
exact   nothing off but noise; Coulomb and viscous friction
bent    as real, and friction that rises ever less with speed, as large as Coulomb friction
presliding
        as real, and dry friction that turns round over 1 mrad of travel, read by good encoders
straight
        links as real, Coulomb and viscous friction, and sensors without faults

The last three are drawn where they are asked for. Dry and viscous friction are compared with the
line nearest to the true friction, of all its parts, at the speeds and loads of the log.

Two of the arms have torque sensors behind the gears: a tenth of the friction, no rotor inertia.
Printed per arm and deviation, and of all arms: coverage, root mean square of error over stated
error, root mean square relative error, and median relative stated error; then how many logs are
refused, how many answers may be trusted, and how many of these have a last link's mass that is both
20 % and two stated errors off. Numbers without a finite stated error are left out.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.answers import bare_model_text, identify_logs, number, write_log
from rigs.arms.wrong_arms import ARMS, DEVIATIONS, Truth, draw_arm
from rigs.files.params import rows
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import other_links
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, RobotModel
from robot_sysid.spatial import PARAMETER_NAMES

USUAL_ARMS = ("ur5e", "iiwa14", "panda", "gen3")
SENSOR_ARMS = ("iiwa14", "panda", "fr3")
"""Arms whose torque sensors sit behind the gears."""
USUAL_DEVIATIONS = ("real", "priors", "exact")
DURATIONS = (8.0, 20.0, 60.0)


def draw_arms(
    robot: RobotModel,
    arm_name: str,
    deviation: str,
    seeds: range,
    durations: Sequence[float] = DURATIONS,
) -> Iterator[Truth]:
    """Yield an arm per seed, of all durations and both kinds of noise in turn."""
    for seed in seeds:
        duration = durations[seed % len(durations)]
        has_sensors = arm_name in SENSOR_ARMS
        yield draw_arm(robot, deviation, has_sensors, duration, seed % 2 == 0, seed)


Off = tuple[str, float, float, float]
"""Quantity, its error, its stated error, and the size that errors are divided by."""
TERMS = {"Coulomb": "coulomb", "viscous": "viscous", "rotor": "armature"}
"""Quantity of a joint to its name in params.json."""
Rows = Mapping[tuple[str, str], Mapping[str, Any]]
"""(Body or joint, name) to an identified number of params.json."""


def off(quantity: str, row: Mapping[str, Any], true: float, size: float) -> Off:
    """Return how far a number of params.json is off the true one."""
    return quantity, row["value"] - true, number(row["error"]), size


def last_link_offs(answer: Rows, link: str, true: Array) -> Iterator[Off]:
    """Yield how far the last link's numbers in params.json are off the true link (10,)."""
    mass, com, inertia = spatial.com_from_theta(true)
    size = float(np.sqrt(np.trace(inertia) / mass))
    yield off("last mass", answer[link, "mass"], mass, mass)
    for axis, centre in zip("xyz", com):
        yield off("its centre", answer[link, f"com_{axis}"], centre, size)
    for name, moment in zip(PARAMETER_NAMES[4:], true[4:]):
        yield off("its inertia", answer[link, name], moment, mass * size**2)


def joint_offs(answer: Rows, truth: Truth, joint: int) -> Iterator[Off]:
    """Yield how far a joint's friction and rotor inertia in params.json are off."""
    arm = truth.arm
    true_values = (*arm.friction_line(truth.motion, joint), arm.rotor[joint])
    least_size = float(arm.robot.thetas[-1, 4:].max()) + 1e-3
    for (quantity, name), true in zip(TERMS.items(), map(float, true_values)):
        row = answer.get((arm.robot.joint_names[joint], name))
        # Not every joint has every term.
        if row is not None:
            yield off(quantity, row, true, true or least_size)


def curve_offs(truth: Truth, curve: Mapping[str, Any]) -> Iterator[Off]:
    """Yield how far the whole friction of a joint that bends is off, at each of its speeds.

    The truth is that under the joint's usual load in the log.
    """
    robot = truth.robot
    joint = robot.joint_names.index(curve["of"])
    load = float(np.sqrt(np.mean(truth.rigid[:, joint] ** 2)))
    true = truth.arm.friction_at(joint, np.array(curve["speeds"]), load)
    for found, error, size in zip(curve["torque"], curve["errors"], true.tolist()):
        yield "friction", found - size, error, size


def errors_of(
    truth: Truth, answer: Rows, curves: Sequence[Mapping[str, Any]]
) -> list[Off]:
    """Return how far the numbers of an answer are off, the last link's mass first.

    Where friction bends, that of ``curves`` counts in place of viscous friction, which is a part of
    the bend.
    """
    arm = truth.arm
    robot = arm.robot
    bent = {curve["of"] for curve in curves}
    offs = list(last_link_offs(answer, robot.body_name, arm.thetas[-1]))
    for index in other_links(robot):
        row = answer.get((robot.links[index].body_name, "mass"))
        true_mass = float(arm.thetas[index][0])
        if row is not None:
            offs.append(off("other masses", row, true_mass, true_mass))
    for joint, name in enumerate(robot.joint_names):
        offs += (
            each
            for each in joint_offs(answer, truth, joint)
            if each[0] != "viscous" or name not in bent
        )
    for curve in curves:
        offs += curve_offs(truth, curve)
    return offs


@dataclass
class Tally:
    """Errors by quantity, and counts of answers."""

    offs: dict[str, list[tuple[float, float, float]]]
    answered: int = 0
    refused: int = 0
    trusted: int = 0
    wrong: int = 0

    def add(self, truth: Truth, answer: dict[str, Any] | None) -> None:
        """Count an answer, the content of params.json; None where the log is refused."""
        if answer is None:
            self.refused += 1
            return
        self.answered += 1
        errors = errors_of(truth, rows(answer), answer["curves"])
        for quantity, *numbers in errors:
            self.offs.setdefault(quantity, []).append(tuple(numbers))
        _, error, stated, true_mass = errors[0]
        if answer["valid"]["trustworthy"]:
            self.trusted += 1
            self.wrong += abs(error) > max(0.2 * true_mass, 2.0 * stated)

    def join(self, other: Tally) -> None:
        """Add another tally's errors and counts."""
        for quantity, offs in other.offs.items():
            self.offs.setdefault(quantity, []).extend(offs)
        self.answered += other.answered
        self.refused += other.refused
        self.trusted += other.trusted
        self.wrong += other.wrong

    def lines(self) -> Iterator[str]:
        """Yield one line per quantity, and one of the answers."""
        for quantity, offs in self.offs.items():
            yield interval_line(quantity, np.array(offs))
        yield (
            f"{'answers':<16} trusted {self.trusted} of {self.answered}, of these wrong "
            f"{self.wrong}; refused {self.refused}"
        )


def study(
    path: Path,
    arm_name: str,
    deviation: str,
    seeds: range,
    durations: Sequence[float] = DURATIONS,
) -> Tally:
    """Return the errors and counts of logs of arms that differ from a model file."""
    tally = Tally({})
    robot = load_robot_model(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = folder / "model.xml"
        model.write_text(bare_model_text(path))
        for truth in draw_arms(robot, arm_name, deviation, seeds, durations):
            write_log(folder / "log.csv", robot.joint_names, truth.log)
            answer, _ = identify_logs(folder, model, [folder / "log.csv"])
            tally.add(truth, answer)
    return tally


def interval_line(quantity: str, rows: Array) -> str:
    """Return the words of errors, stated errors and sizes, rows (m, 3)."""
    is_stated = np.isfinite(rows[:, 1]) & (rows[:, 1] > 0.0)
    error, stated, size = rows[is_stated].T
    if not len(error):
        return f"{quantity:<16}    none has a stated error"
    coverage = 100.0 * np.mean(np.abs(error) < 1.96 * stated)
    ratio = float(np.sqrt(np.mean((error / stated) ** 2)))
    rms = 100.0 * float(np.sqrt(np.mean((error / size) ** 2)))
    width = 100.0 * float(np.median(stated / size))
    return f"{quantity:<16}{coverage:6.0f} %{ratio:8.2f}{rms:9.2f} %{width:9.2f} %"


def arms_parser(
    description: str | None,
    default_arms: Iterable[str] = USUAL_ARMS,
    arms: Iterable[str] | None = ARMS,
) -> argparse.ArgumentParser:
    """Return a parser with the options of benchmarks that draw arms of models.

    Args:
        description: of the benchmark.
        default_arms: names of models without ``--arms``.
        arms: names that ``--arms`` takes; None for any.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", type=Path)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--arms",
        nargs="+",
        default=list(default_arms),
        choices=None if arms is None else list(arms),
    )
    return parser


def main() -> int:
    """Print the table."""
    parser = arms_parser(__doc__)
    parser.add_argument("--logs", type=int, default=20)
    parser.add_argument(
        "--deviations", nargs="+", default=list(USUAL_DEVIATIONS), choices=DEVIATIONS
    )
    parser.add_argument(
        "--durations", nargs="+", type=float, default=list(DURATIONS), metavar="S"
    )
    options = parser.parse_args()
    print(f"{'arm':<8}{'kind':<12}{'':<16}coverage  rms/stated    rms  median stated")
    seeds = range(options.first_seed, options.first_seed + options.logs)
    totals = {deviation: Tally({}) for deviation in options.deviations}
    for arm_name in options.arms:
        for deviation in options.deviations:
            path = options.models / ARMS[arm_name]
            tally = study(path, arm_name, deviation, seeds, options.durations)
            totals[deviation].join(tally)
            for line in tally.lines():
                print(f"{arm_name:<8}{deviation:<12}{line}", flush=True)
    for deviation, total in totals.items():
        for line in total.lines():
            print(f"{'all':<8}{deviation:<12}{line}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Whether ``report A B`` finds what has changed between two runs of one arm, and nothing else.

    python -m benchmarks.run_changes MODELS_FOLDER [--pairs 24] [--first-seed 0]
        [--arms ur5e iiwa14 panda gen3]

Each pair is of another arm as it is: links 10 to 20 % off the model, torque scales, encoder zeros,
a tilted base, Stribeck friction and friction that grows with the load (see ``real_arms``). Its two
logs of 20 to 30 s are of different motions. From one to the other, Coulomb and viscous friction of
each joint have changed by 10 % each, independently (one standard deviation).

Of every four pairs one has a change of 0.1 kg at the last link, 5 to 15 cm from its frame, which
comes on or comes off; one a change of 30 % of one joint's friction, up or down; two have none.

A change is found where it is named, the joint too. A pair is falsely accused where anything is
named that has not changed. "separate" is what two separate results say: a difference of mass,
Coulomb or viscous friction of more than two standard errors, the root of the sum of both squared.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.answers import bare_model_text, number, run_command, write_log
from benchmarks.real_arms import SENSOR_ARMS, arms_parser
from rigs.wrong_arms import (
    ARMS,
    NOISE,
    RATE,
    STRIBECK,
    WrongArm,
    noise_samples,
    wrong_links,
)
from robot_sysid import spatial
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.comparison import compare_runs
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.records.usual_errors import FRICTION_CHANGE
from robot_sysid.report.runs import load_run
from robot_sysid.trajectory import generate_excitation_trajectory

MASS = 0.1
FRICTION = 0.3
KINDS = ("mass", "none", "friction", "none")


@dataclass(frozen=True)
class Change:
    """What has changed from a pair's first log to its second.

    Attributes:
        body: (10,) what came on at the last link.
        friction: (2, n) factors of Coulomb and viscous friction.
        name: of what is to be found; "" for nothing.
    """

    body: Array
    friction: Array
    name: str


def draw_change(robot: RobotModel, kind: str, rng: np.random.Generator) -> Change:
    """Return a change of a kind, beside what friction does from day to day."""
    friction = 1.0 + FRICTION_CHANGE * rng.standard_normal((2, robot.n_joints))
    sign = rng.choice([-1.0, 1.0])
    if kind == "mass":
        direction = rng.standard_normal(3)
        place = rng.uniform(0.05, 0.15) * direction / np.linalg.norm(direction)
        body = sign * spatial.theta_from_com(MASS, place, 4e-5 * np.eye(3))
        return Change(body, friction, robot.body_name)
    if kind == "friction":
        joint = int(rng.integers(robot.n_joints))
        friction[:, joint] *= 1.0 + FRICTION * sign
        return Change(np.zeros(10), friction, robot.joint_names[joint])
    return Change(np.zeros(10), friction, "")


def draw_pair(
    robot: RobotModel, has_sensors: bool, change: Change, rng: np.random.Generator
) -> Iterator[Recording]:
    """Yield the two logs of one arm."""
    n = robot.n_joints
    tilt = np.radians(0.3) * rng.standard_normal(2)
    arm = WrongArm(robot, wrong_links(robot, rng), tilt, robot.armature)
    spread = rng.uniform(0.7, 1.4, n)
    viscous_spread = rng.uniform(0.5, 1.5, n)
    rotor_spread = rng.uniform(0.3, 1.5, n)
    visible_share = 0.1 if has_sensors else 1.0
    loss = visible_share * rng.uniform(0.02, 0.06, n)
    scales = 1.0 + 0.02 * rng.standard_normal(n)
    zeros = 2e-3 * rng.standard_normal(n)
    nominal = np.zeros(0)
    for is_second in (False, True):
        duration = float(rng.choice([20.0, 25.0, 30.0]))
        plan = generate_excitation_trajectory(robot, rng, duration)
        motion = plan.evaluate(np.arange(round(RATE * duration)) / RATE)
        if is_second:
            dry_factor, viscous_factor = change.friction
            arm = replace(
                arm,
                coulomb=dry_factor * arm.coulomb,
                stribeck=dry_factor * arm.stribeck,
                loss=dry_factor * arm.loss,
                viscous=viscous_factor * arm.viscous,
            )
        else:
            peak = np.max(np.abs(arm.torques(motion)[0]), axis=0)
            fastest = np.max(np.abs(motion.qd), axis=0)
            nominal = np.maximum(0.04 * peak, 0.004 * np.max(peak)) * spread
            acceleration = np.sqrt(np.mean(motion.qdd**2, axis=0))
            rotor = 0.02 * np.max(peak) / acceleration * rotor_spread
            coulomb = visible_share * nominal
            arm = replace(
                arm,
                rotor=rotor * (not has_sensors),
                coulomb=coulomb,
                stribeck=STRIBECK * coulomb,
                fading=0.1 * fastest,
                loss=loss,
                viscous=coulomb / fastest * viscous_spread,
                scales=scales,
                zeros=zeros,
            )
        white = bool(rng.integers(2))
        noise = NOISE * nominal * noise_samples(rng, motion.q.shape, white)
        yield arm.log(motion, noise, is_second * change.body)


def separate(first: dict[str, Any], second: dict[str, Any]) -> Iterator[str]:
    """Yield the names of what two results, contents of params.json, differ in."""
    numbers = {}
    for row in second["quantities"]:
        numbers[row["source"], row["of"], row["name"]] = row
    for row in first["quantities"]:
        other = numbers.get((row["source"], row["of"], row["name"]))
        is_mass = row["name"] == "mass" and row["of"] == first["body_name"]
        if other is None or not (is_mass or row["name"] in ("coulomb", "viscous")):
            continue
        error = np.hypot(*(number(r["error"]) for r in (row, other)))
        if abs(other["value"] - row["value"]) > 2.0 * error:
            yield row["of"]


def named(folder: Path, path: Path, arm_name: str, seed: int) -> Iterator[set[str]]:
    """Yield what has changed in a pair, what separate results name, and what one fit names."""
    robot = load_robot_model(path)
    rng = np.random.default_rng([seed, 54])
    change = draw_change(robot, KINDS[seed % len(KINDS)], rng)
    model = folder / "model.xml"
    model.write_text(bare_model_text(path))
    logs = draw_pair(robot, arm_name in SENSOR_ARMS, change, rng)
    for name, log in zip("ab", logs):
        write_log(folder / f"{name}.csv", robot.joint_names, log)
        words = (model, folder / f"{name}.csv", "--output-dir", folder / name)
        # Whether masses or torques are off by a common factor is another question.
        words += ("--accept", "torque-scale")
        run_command("identify", *words)
    yield {change.name} - {""}
    runs = [load_run(folder / name) for name in "ab"]
    yield set(separate(*(run.content for run in runs)))
    yield {row.of for row in compare_runs(runs, Progress()) if row.reason}


def main() -> int:
    """Print what each pair's change is and what is named, and the shares of all pairs."""
    parser = arms_parser(__doc__)
    parser.add_argument("--pairs", type=int, default=24)
    options = parser.parse_args()
    counts = {name: np.zeros(3, dtype=int) for name in ("separate", "one fit")}
    changed = 0
    for pair in range(options.pairs):
        seed = options.first_seed + pair
        arm_name = options.arms[pair // len(KINDS) % len(options.arms)]
        with tempfile.TemporaryDirectory() as folder:
            path = options.models / ARMS[arm_name]
            true, *answers = named(Path(folder), path, arm_name, seed)
        changed += bool(true)
        print(f"{seed:>5} {arm_name:<8} changed: {', '.join(true) or '-':<16}", end="")
        for name, answer in zip(counts, answers):
            is_false = bool(answer - true)
            counts[name] += (bool(true & answer), is_false, is_false and not true)
            print(f" {name}: {', '.join(sorted(answer)) or '-'};", end="", flush=True)
        print()
    for name, (found, false, unchanged) in counts.items():
        print(
            f"{name}: found {found} of {changed}, something false in {false} of "
            f"{options.pairs} pairs, in {unchanged} of {options.pairs - changed} without a change"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Whether ``check`` finds what has changed between two logs of one arm, and nothing else.

    python -m benchmarks.trust.run_changes MODELS_FOLDER [--pairs 24] [--first-seed 0]
        [--arms ur5e iiwa14 panda gen3] [--kinds none load friction zero]

Each pair is of another arm as it is: links 10 to 20 % off the model, one 40 %, torque scales,
encoder zeros, a tilted base, Stribeck friction and friction that grows with the load (see
``real_arms``). The earlier log is of a planned motion at 250 Hz, the other of a task with rests at
62 Hz, of 20 to 30 s each. From one to the other, Coulomb and viscous friction of each joint have
changed by 10 % each, independently (one standard deviation).

The kinds follow one another: nothing has changed; 0.3 kg came on or off, 5 to 15 cm from the last
link's frame; one joint's friction is 1.5 times more or less; one joint's zero has moved by 2
degrees. Counted per kind are pairs in which the change is named, those in which the logs do not
show it, those in which anything else is named, and those that are refused or doubted.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.trust.real_arms import SENSOR_ARMS, arms_parser
from rigs.arms.motions import pick_and_place, planned
from rigs.arms.wrong_arms import (
    ARMS,
    NOISE,
    STRIBECK,
    WrongArm,
    noise_samples,
    wrong_links,
)
from robot_sysid import spatial
from robot_sysid.config import IdentifyConfig
from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.changes import DIFFERS, UNKNOWN
from robot_sysid.pipeline.comparison import compare_logs
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.records.usual_errors import FRICTION_CHANGE
from robot_sysid.trajectory import generate_excitation_trajectory

LOAD = 0.3
FRICTION = 1.5
ZERO = np.radians(2.0)
KINDS = ("none", "load", "friction", "zero")
STEP = 4
"""Rows of the motion per row of the second log."""


@dataclass(frozen=True)
class Drawn:
    """What has changed from a pair's first log to its second.

    Attributes:
        body: (10,) what came on at the last link.
        friction: (2, n) factors of Coulomb and viscous friction.
        zeros: (n,) by which encoders read more [rad].
        name: name and owner of what is to be found; None for nothing.
    """

    body: Array
    friction: Array
    zeros: Array
    name: tuple[str, str] | None


def draw_change(robot: RobotModel, kind: str, rng: np.random.Generator) -> Drawn:
    """Return a change of a kind, beside what friction does from day to day."""
    n = robot.n_joints
    friction = 1.0 + FRICTION_CHANGE * rng.standard_normal((2, n))
    nothing = Drawn(np.zeros(10), friction, np.zeros(n), None)
    sign = rng.choice([-1.0, 1.0])
    joint = int(rng.integers(n))
    name = (kind, robot.joint_names[joint])
    if kind == "load":
        direction = rng.standard_normal(3)
        place = rng.uniform(0.05, 0.15) * direction / np.linalg.norm(direction)
        body = sign * spatial.theta_from_com(LOAD, place, 1e-4 * np.eye(3))
        return replace(nothing, body=body, name=("m", robot.body_name))
    if kind == "friction":
        friction[:, joint] *= FRICTION**sign
        return replace(nothing, name=name)
    if kind == "zero":
        return replace(nothing, zeros=sign * ZERO * np.eye(n)[joint], name=name)
    return nothing


def draw_pair(
    robot: RobotModel, has_sensors: bool, change: Drawn, rng: np.random.Generator
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
        motion = (pick_and_place if is_second else planned)(plan, rng)
        if is_second:
            dry_factor, viscous_factor = change.friction
            arm = replace(
                arm,
                coulomb=dry_factor * arm.coulomb,
                stribeck=dry_factor * arm.stribeck,
                loss=dry_factor * arm.loss,
                viscous=viscous_factor * arm.viscous,
                zeros=arm.zeros + change.zeros,
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
        log = arm.log(motion, noise, is_second * change.body)
        step = slice(None, None, STEP if is_second else 1)
        name = "second" if is_second else "first"
        yield Recording(log.time[step], log.q[step], None, log.tau[step], name=name)


def outcome(path: Path, arm_name: str, kind: str, seed: int) -> Iterator[str]:
    """Yield what is said of a pair: "found", "not shown", "false" with what is named, "refused"."""
    robot = load_robot_model(path)
    rng = np.random.default_rng([seed, 54])
    change = draw_change(robot, kind, rng)
    sides = [[log] for log in draw_pair(robot, arm_name in SENSOR_ARMS, change, rng)]
    configs = (IdentifyConfig(), IdentifyConfig())
    try:
        rows = compare_logs(robot, sides, configs, Progress())
    except SysidError as error:
        yield f"refused: {error}"
        return
    for row in rows:
        name = (row.name, row.of)
        # What a load does has other numbers, too.
        if name == change.name and row.reason in (DIFFERS, UNKNOWN):
            yield "found" if row.reason == DIFFERS else "not shown"
        elif row.reason == DIFFERS and (kind != "load" or row.of != robot.body_name):
            yield f"false: {row.name} of {row.of} {row.value:.3g} ± {row.error:.2g} {row.unit}"


def main() -> int:
    """Print what is said of each pair, and the counts of each kind."""
    parser = arms_parser(__doc__)
    parser.add_argument("--pairs", type=int, default=24)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    options = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    for pair in range(options.pairs):
        seed = options.first_seed + pair
        kind = options.kinds[pair % len(options.kinds)]
        arm_name = options.arms[pair // len(options.kinds) % len(options.arms)]
        path = options.models / ARMS[arm_name]
        said = [*outcome(path, arm_name, kind, seed)]
        counts.update(
            (kind, word) for word in {"pairs", *(s.split(":")[0] for s in said)}
        )
        print(f"{seed:>5} {arm_name:<8} {kind:<9} {'; '.join(said)}", flush=True)
    for kind in options.kinds:
        words = (
            f"{word} {n}" for (of, word), n in sorted(counts.items()) if of == kind
        )
        print(f"{kind}: {', '.join(words)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How often stated 95 % intervals contain the truth, on arms that are off as real ones are.

    python -m benchmarks.real_arms MODELS_FOLDER [--logs 20] [--arms ur5e iiwa14 ...]
        [--deviations real priors exact] [--first-seed 0]

Each log is of another arm. Its duration is 8, 20 or 60 s. Every other log has white torque
noise, the rest noise with a memory of 20 samples.

real    links as real model files have them: masses off by 10 to 20 %, one link 40 % heavier,
        centres of mass by 15 % of the radius of gyration, inertias by 15 %; torque scales off by
        2 %, encoder zeros by 2 mrad, the base by 0.3 degrees; Stribeck friction of 30 % of Coulomb
        friction, and 2 to 6 % of the load lost in the gear
priors  everything drawn from the default priors
exact   nothing off but noise; Coulomb and viscous friction

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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.answers import bare_model_text, identify_logs, number, write_log
from rigs.params import rows
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    gravity_vector,
    other_links,
    turn_gravity,
    with_gravity,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Measurement, Motion, MotionPlan, RobotModel
from robot_sysid.simulator import simulate_inverse
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.trajectory import generate_excitation_trajectory

ARMS = {
    "ur5e": "universal_robots_ur5e/ur5e.xml",
    "iiwa14": "kuka_iiwa_14/iiwa14.xml",
    "panda": "franka_panda/panda_nohand.xml",
    "gen3": "kinova_gen3/gen3.xml",
    "xarm7": "ufactory_xarm7/xarm7.xml",
    "fr3": "franka_fr3/FrankaFR3_7DoF.urdf",
}
USUAL_ARMS = ("ur5e", "iiwa14", "panda", "gen3")
SENSOR_ARMS = ("iiwa14", "panda", "fr3")
"""Arms whose torque sensors sit behind the gears."""
DEVIATIONS = ("real", "priors", "exact")
DURATIONS = (8.0, 20.0, 60.0)
RATE = 250.0
STEP = 1e-4
STRIBECK = 0.3
MEMORY = 0.95
NOISE = 0.08


@dataclass(frozen=True)
class RealArm:
    """An arm that differs from its model, and a log of it.

    Attributes:
        robot: the model as the user has it.
        plan: the motion.
        thetas: (n, 10) the true links.
        coulomb, viscous, rotor, stribeck: (n,) true friction and rotor inertia.
        scales: (n,) torque column over true torque.
        motion: exact positions, velocities and accelerations; its torque is that of the model.
        rigid: (N, n) torque of the links and rotors [N m].
        log: the recording.
    """

    robot: RobotModel
    plan: MotionPlan
    thetas: Array
    coulomb: Array
    viscous: Array
    rotor: Array
    stribeck: Array
    scales: Array
    motion: Measurement
    rigid: Array
    log: Measurement


def wrong_links(robot: RobotModel, rng: np.random.Generator) -> Array:
    """Return links (n, 10) as far from the model's as those of real model files are."""
    thetas = robot.thetas
    count = len(thetas)
    shares = rng.uniform(0.1, 0.2, count) * rng.choice([-1.0, 1.0], count)
    movable = other_links(robot)
    shares[movable[int(rng.integers(len(movable)))]] = 0.4
    for index, theta in enumerate(thetas):
        if theta[0] <= 0.0:
            continue
        mass, com, inertia = spatial.com_from_theta(theta)
        gyration = np.sqrt(np.trace(inertia) / (2.0 * mass))
        com = com + 0.15 * gyration * rng.standard_normal(3)
        inertia = inertia * max(1.0 + 0.15 * rng.standard_normal(), 0.3)
        thetas[index] = spatial.theta_from_com(
            mass * (1.0 + shares[index]), com, inertia
        )
    return thetas


def prior_links(robot: RobotModel, rng: np.random.Generator) -> Array:
    """Return links (n, 10) drawn with errors of 5 %, as the priors state them; the last one, too.

    Masses are off by 5 %, centres of mass by 5 % of the link's size, inertias by 10 %, and all
    masses and all distances of centres of mass by 5 % more.
    """
    thetas = robot.thetas
    lengths = [float(np.linalg.norm(link.translation)) for link in robot.links[1:]]
    common = 0.05 * rng.standard_normal(2)
    for index, length in enumerate([*lengths, 0.0]):
        theta = thetas[index]
        if theta[0] <= 0.0:
            continue
        mass, com, inertia = spatial.com_from_theta(theta)
        size = max(spatial.ROD * spatial.characteristic_length(theta), length, 0.02)
        moment = max(np.trace(inertia) / 3.0, mass * (0.1 * size) ** 2)
        outwards = com / max(float(np.linalg.norm(com)), 1e-9)
        com = com + size * (0.05 * rng.standard_normal(3) + common[1] * outwards)
        six = 0.1 * moment * rng.standard_normal(6)
        scale = 1.0 + 0.05 * rng.standard_normal() + common[0]
        inertia = scale * inertia + spatial.symmetric_from_six(six)
        thetas[index] = spatial.theta_from_com(scale * mass, com, inertia)
    return thetas


def draw_arm(
    robot: RobotModel,
    deviation: str,
    has_sensors: bool,
    duration: float,
    white: bool,
    seed: int,
    move: Callable[[MotionPlan, np.random.Generator], Motion] | None = None,
    friction: float = 0.04,
) -> RealArm:
    """Return one arm with one log of it.

    ``move`` returns the motion; None for that of an excitation. ``friction`` is the usual Coulomb
    friction over the torque.
    """
    rng = np.random.default_rng([seed, DEVIATIONS.index(deviation)])
    plan = generate_excitation_trajectory(robot, rng, duration)
    motion = plan.evaluate(np.arange(round(RATE * duration)) / RATE)
    if move is not None:
        motion = move(plan, np.random.default_rng([seed, 9]))
    exact = next(iter(simulate_inverse(robot, iter([motion]))))

    is_off = deviation != "exact"
    angles = np.radians(0.3) * rng.standard_normal(2) * is_off
    arm = with_gravity(robot, turn_gravity(gravity_vector(robot), angles))
    thetas = robot.thetas
    if is_off:
        thetas = (wrong_links if deviation == "real" else prior_links)(robot, rng)
    series = exact.q, exact.qd, exact.qdd
    beyond_links = exact.tau - robot.friction.torque(exact.qd)
    beyond_links -= LinkDynamics(robot).motion(*series).torque(robot.thetas)
    rigid = beyond_links + LinkDynamics(arm).motion(*series).torque(thetas)

    peak = np.max(np.abs(rigid), axis=0)
    fastest = np.maximum(np.max(np.abs(exact.qd), axis=0), 1e-3)
    nominal = np.maximum(friction * peak, 0.1 * friction * np.max(peak))
    nominal = nominal * rng.uniform(0.7, 1.4, len(peak))
    visible_share = 0.1 if has_sensors else 1.0
    coulomb = visible_share * nominal
    viscous = coulomb / fastest * rng.uniform(0.5, 1.5, len(peak))
    rms_acceleration = np.sqrt(np.mean(exact.qdd**2, axis=0))
    rms_acceleration = np.maximum(rms_acceleration, 0.1 * np.max(rms_acceleration))
    rotor = 0.02 * np.max(peak) / rms_acceleration * rng.uniform(0.3, 1.5, len(peak))
    rotor = np.zeros_like(peak) if has_sensors else rotor
    # A rotor sits before the gear: its torque is no load of it.
    load = np.abs(rigid - robot.armature * exact.qdd)
    rigid = rigid + (rotor - robot.armature) * exact.qdd

    speed = np.abs(exact.qd)
    dry = coulomb * np.ones_like(speed)
    if deviation == "real":
        dry += STRIBECK * coulomb * np.exp(-speed / (0.1 * fastest))
        dry += visible_share * rng.uniform(0.02, 0.06, len(peak)) * load
    elif deviation == "priors":
        dry += 0.1 * coulomb * rng.standard_normal(len(peak)) * np.sqrt(speed / fastest)
        dry += 0.02 * rng.standard_normal(len(peak)) * load
    scales = 1.0 + 0.02 * is_off * rng.standard_normal(len(peak))
    tau = scales * rigid + dry * np.sign(exact.qd) + viscous * exact.qd
    tau = tau + NOISE * nominal * noise_samples(rng, tau.shape, white)
    if deviation == "priors":
        lag = 5e-3 * rng.standard_normal()
        late = exact.time - lag
        tau = np.stack([np.interp(late, exact.time, c) for c in tau.T], axis=1)
    q = exact.q + 2e-3 * is_off * rng.standard_normal(len(peak))
    log = Measurement(exact.time, np.round(q / STEP) * STEP, None, tau)
    stribeck = STRIBECK * coulomb * (deviation == "real")
    return RealArm(
        robot,
        plan,
        thetas,
        coulomb,
        viscous,
        rotor,
        stribeck,
        scales,
        exact,
        rigid,
        log,
    )


def noise_samples(
    rng: np.random.Generator, shape: tuple[int, ...], white: bool
) -> Array:
    """Return noise (N, n) of unit variance, white or with a memory of 20 samples."""
    from scipy.signal import lfilter

    drawn = rng.standard_normal((shape[0] + 200, shape[1]))
    if not white:
        drawn = lfilter([np.sqrt(1.0 - MEMORY**2)], [1.0, -MEMORY], drawn, axis=0)
    return np.asarray(drawn[200:])


def draw_arms(
    robot: RobotModel, arm_name: str, deviation: str, seeds: range
) -> Iterator[RealArm]:
    """Yield an arm per seed, of all durations and both kinds of noise in turn."""
    for seed in seeds:
        duration = DURATIONS[seed % len(DURATIONS)]
        has_sensors = arm_name in SENSOR_ARMS
        yield draw_arm(robot, deviation, has_sensors, duration, seed % 2 == 0, seed)


Off = tuple[str, float, float, float]
"""Quantity, its error, its stated error, and the size that errors are divided by."""
TERMS = {"Coulomb": "coulomb", "viscous": "viscous", "rotor": "armature"}
"""Quantity of a joint, its attribute in lower case, to its name in params.json."""
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


def joint_offs(answer: Rows, arm: RealArm, joint: int) -> Iterator[Off]:
    """Yield how far a joint's friction and rotor inertia in params.json are off."""
    least_size = float(arm.robot.thetas[-1, 4:].max()) + 1e-3
    for quantity, name in TERMS.items():
        row = answer.get((arm.robot.joint_names[joint], name))
        # Not every joint has every term.
        if row is not None:
            true = float(getattr(arm, quantity.lower())[joint])
            yield off(quantity, row, true, true or least_size)


def errors_of(arm: RealArm, answer: Rows) -> list[Off]:
    """Return how far the numbers of an answer are off, the last link's mass first."""
    robot = arm.robot
    offs = list(last_link_offs(answer, robot.body_name, arm.thetas[-1]))
    for index in other_links(robot):
        row = answer.get((robot.links[index].body_name, "mass"))
        true_mass = float(arm.thetas[index][0])
        if row is not None:
            offs.append(off("other masses", row, true_mass, true_mass))
    for joint in range(robot.n_joints):
        offs += joint_offs(answer, arm, joint)
    return offs


@dataclass
class Tally:
    """Errors by quantity, and counts of answers."""

    offs: dict[str, list[tuple[float, float, float]]]
    answered: int = 0
    refused: int = 0
    trusted: int = 0
    wrong: int = 0

    def add(self, arm: RealArm, answer: dict[str, Any] | None) -> None:
        """Count an answer, the content of params.json; None where the log is refused."""
        if answer is None:
            self.refused += 1
            return
        self.answered += 1
        errors = errors_of(arm, rows(answer))
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


def study(path: Path, arm_name: str, deviation: str, seeds: range) -> Tally:
    """Return the errors and counts of logs of arms that differ from a model file."""
    tally = Tally({})
    robot = load_robot_model(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = folder / "model.xml"
        model.write_text(bare_model_text(path))
        for arm in draw_arms(robot, arm_name, deviation, seeds):
            write_log(folder / "log.csv", robot.joint_names, arm.log)
            answer, _ = identify_logs(folder, model, [folder / "log.csv"])
            tally.add(arm, answer)
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


def arms_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of benchmarks that draw arms of public models."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("models", type=Path)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--arms", nargs="+", default=list(USUAL_ARMS), choices=list(ARMS)
    )
    return parser


def main() -> int:
    """Print the table."""
    parser = arms_parser(__doc__)
    parser.add_argument("--logs", type=int, default=20)
    parser.add_argument(
        "--deviations", nargs="+", default=list(DEVIATIONS), choices=DEVIATIONS
    )
    options = parser.parse_args()
    print(f"{'arm':<8}{'kind':<8}{'':<16}coverage  rms/stated    rms  median stated")
    seeds = range(options.first_seed, options.first_seed + options.logs)
    totals = {deviation: Tally({}) for deviation in options.deviations}
    for arm_name in options.arms:
        for deviation in options.deviations:
            path = options.models / ARMS[arm_name]
            tally = study(path, arm_name, deviation, seeds)
            totals[deviation].join(tally)
            for line in tally.lines():
                print(f"{arm_name:<8}{deviation:<8}{line}", flush=True)
    for deviation, total in totals.items():
        for line in total.lines():
            print(f"{'all':<8}{deviation:<8}{line}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

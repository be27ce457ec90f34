"""How often stated 95 % intervals contain the truth, on arms that differ from their models.

    python -m benchmarks.honest_intervals MODELS_FOLDER [--runs 40] [--arms kinova panda]
        [--cells exact given usual payload loaded]

Each run draws an arm: the other links off by some per cent (mass, centre of mass as part of the
link's size, twice that for the inertia; each link for itself, and all alike), torque scales,
encoder zeros and the base's tilt off as the cell says. Torque noise is white, 1 % of each joint's
largest torque, and once more half as large with a memory of 100 ms; encoder steps are 1e-4 rad.

exact     nothing is off but the noise; identified with default priors
given     two sizes of deviations, identified with priors as wide as the drawn deviations
usual     links 2 %, scales 1 %, zeros 1 mrad, tilt 0.1 degrees, under default priors
payload   the same with 2 kg at the flange in the order ABBA, Stribeck and load friction in all
          joints, under default priors
loaded    2 kg at the flange in that order, and nothing off but the noise

Printed per arm and cell: coverage, root mean square error relative to the body's size, and that
error over the stated one, for the mass, centre of mass and inertia of the terminal link (or of
the payload), the mass of a link in the middle, and Coulomb friction of all joints; then the share
of runs with a sentence that names a cause, which is false where nothing is off.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimation.algebra.priors import link_factor
from robot_sysid.estimation.build_result import WIDER, payload_of
from robot_sysid.estimation.identify import Piece, answer_payload, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions, Priors, Question
from robot_sysid.model.bodies import find_flange
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.results.body_errors import load_errors
from robot_sysid.results.record import BodyEstimate
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import generate_excitation_trajectory
from tests.support.core_fits import ORIGIN, result_of_logs
from tests.support.synthetic_data import autocorrelated

ARMS = {
    "kinova": "kinova_gen3/gen3.xml",
    "panda": "franka_panda/panda_nohand.xml",
    "ur5e": "universal_robots_ur5e/ur5e.xml",
    "xarm7": "ufactory_xarm7/xarm7.xml",
}
RATE = 250.0
DURATION = 15.0
STEP = 1e-4
NOISE = 0.01
COLOURED = 0.5
MEMORY = 0.1
PAYLOAD = spatial.theta_from_com(2.0, np.array([0.02, 0.01, 0.08]), 0.006 * np.eye(3))
"""At the terminal link, which for these arms is the flange's."""
ORDER = (False, True, True, False)
STRIBECK = 0.3
LOSS = 0.03
"""Part of Coulomb friction that goes with speed, and of the load that a gear loses."""


@dataclass(frozen=True)
class Cell:
    """Deviations of an arm: links, scale [%], zeros [mrad], tilt [deg].

    ``has_gear_friction`` adds Stribeck and load friction.
    """

    links: float = 0.0
    scale: float = 0.0
    zero: float = 0.0
    tilt: float = 0.0
    has_gear_friction: bool = False

    def options(self) -> EstimationOptions:
        """Return options with priors as wide as these deviations."""
        priors = Priors(
            link=self.links, scale=self.scale, zero=self.zero, gravity=self.tilt
        )
        return EstimationOptions(priors=priors)


USUAL = Cell(2.0, 1.0, 1.0, 0.1)
GIVEN = (USUAL, Cell(2.0, 3.0, 10.0, 0.3))


class Arm:
    """An arm that is drawn at random, and simulates logs of itself.

    Attributes:
        robot: the model as the user has it.
        arm: the model with the true direction of gravity.
        thetas: (n, 10) true parameters of the links.
        scales: (n,) torque column over true torque.
        zeros: (n,) errors of the encoders' zeros [rad].
        plan: the trajectory of all logs.
        dry: (n,) true Coulomb friction of the last log [N m].
    """

    def __init__(self, robot: RobotModel, cell: Cell, rng: np.random.Generator) -> None:
        self.robot = robot
        self.rng = rng
        self.has_gear_friction = cell.has_gear_friction
        angles = np.radians(cell.tilt) * rng.standard_normal(2)
        self.arm = with_gravity(robot, turn_gravity(gravity_vector(robot), angles))
        self.thetas = robot.thetas
        if cell.links:
            links = list(other_links(robot))
            joints = [robot.links[link + 1].translation for link in links]
            lengths = [float(np.linalg.norm(joint)) for joint in joints]
            factor = link_factor(self.thetas[links], 0.01 * cell.links, lengths)
            deviation = factor @ rng.standard_normal(len(factor))
            self.thetas[links] += deviation.reshape(-1, 10)
        self.scales = 1.0 + 0.01 * cell.scale * rng.standard_normal(robot.n_joints)
        self.zeros = 1e-3 * cell.zero * rng.standard_normal(robot.n_joints)
        self.plan, _ = generate_excitation_trajectory(robot, rng, DURATION)
        self.dry: Array = np.zeros(robot.n_joints)

    def log(self, loaded: bool = False) -> Measurement:
        """Return a log with a Stribeck drop and friction that grows with load."""
        motion = self.plan.evaluate(np.arange(int(RATE * DURATION)) / RATE)
        exact = next(iter(simulate_inverse(self.arm, iter([motion]))))
        links = LinkDynamics(self.arm).motion(exact.q, exact.qd, exact.qdd)
        other_torque = exact.tau - self.arm.friction.torque(exact.qd)
        other_torque = other_torque - links.torque(self.robot.thetas)
        carried = self.thetas.copy()
        bare = other_torque + links.torque(carried)
        carried[-1] += PAYLOAD * loaded
        rigid = other_torque + links.torque(carried)
        self.dry = 0.03 * np.max(np.abs(bare), axis=0)
        speed = np.abs(exact.qd)
        fastest = np.max(speed, axis=0)
        drop = np.exp(-speed / (0.1 * fastest))
        dry = self.dry * (1.0 + STRIBECK * self.has_gear_friction * drop)
        dry = dry + LOSS * self.has_gear_friction * np.abs(rigid)
        tau = self.scales * rigid + dry * np.sign(exact.qd)
        tau += self.dry / fastest * exact.qd
        tau += NOISE * np.max(np.abs(tau), axis=0) * noise(self.rng, tau.shape)
        q = exact.q + self.zeros
        return Measurement(exact.time, np.round(q / STEP) * STEP, None, tau)


def noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Return noise of a shape (N, n): white, plus half as large autocorrelated noise."""
    ahead = int(10 * RATE * MEMORY)
    drawn = rng.standard_normal((shape[0] + ahead, shape[1]))
    slow = autocorrelated(drawn, RATE * MEMORY)[ahead:]
    return rng.standard_normal(shape) + COLOURED * slow


Off = tuple[str, float, float, float]
"""Quantity, its error, its stated error, and the size that errors are divided by."""


def body_off(estimate: BodyEstimate, true: Array) -> Iterator[Off]:
    """Yield how far a body's numbers are off."""
    mass, com, inertia = spatial.com_from_theta(true)
    size = float(np.sqrt(np.trace(inertia) / mass))
    stated = estimate.errors.tolist()
    off = (estimate.inertial.theta - true).tolist()
    yield "mass", off[0], stated[0], mass
    com_off = (estimate.inertial.com - com).tolist()
    for error, com_stated in zip(com_off, load_errors(estimate)[1:4].tolist()):
        yield "centre of mass", error, com_stated, size
    for k in range(4, 10):
        yield "inertia", off[k], stated[k], mass * size**2


def link_errors(arm: Arm, options: EstimationOptions) -> tuple[list[Off], list[str]]:
    """Return how far an arm's numbers are off, and the causes whose priors are contradicted."""
    robot = arm.robot
    result = result_of_logs(arm.robot, [arm.log()], options)
    errors = list(body_off(result.links[-1], arm.thetas[-1]))
    middle = other_links(robot)[len(other_links(robot)) // 2]
    link = next((b for b in result.links if b.joint == robot.joint_names[middle]), None)
    if link is not None:
        true = float(arm.thetas[middle][0])
        off = link.inertial.mass - true
        errors.append(("middle mass", off, float(link.errors[0]), true))
    for joint, dry in zip(robot.joint_names, arm.dry.tolist()):
        level = (
            result.joints[joint].terms.get("coulomb")
            or result.joints[joint].terms["sigmoid"]
        )
        errors.append(("Coulomb", level.value - dry, level.error, dry))
    return errors, [conflict.cause for conflict in result.conflicts]


def payload_errors(arm: Arm, options: EstimationOptions) -> tuple[list[Off], list[str]]:
    """Return how far a payload's numbers are off, and the causes whose priors are contradicted."""
    positions = np.linspace(-1.0, 1.0, len(ORDER)).tolist()
    pieces = []
    for k, loaded in enumerate(ORDER):
        pieces.append(Piece(f"log{k}", arm.log(loaded), loaded, positions[k]))
    pieces.sort(key=lambda piece: piece.is_loaded)
    datasets, _ = low_pass_recordings(arm.robot, pieces, options)
    question = Question(options, loaded=True, drifts=True)
    flange = find_flange(arm.robot, None)
    answer, free = answer_payload(arm.robot, datasets, question, Progress(), None)
    result = payload_of(answer, free, flange, ORIGIN)
    assert result.payload is not None
    groups = answer.fit.unknowns.groups
    wide = [g.cause for g in groups if g.may_widen and g.widened > WIDER]
    if not result.verdict.is_trustworthy:
        wide.append(result.verdict.name)
    return list(body_off(result.payload.body, flange.to_flange(PAYLOAD))), wide


def study(robot: RobotModel, name: str, cell: Cell, runs: int) -> Iterator[str]:
    """Yield one line per quantity, and one of the sentences."""
    rows_by_quantity: dict[str, list[tuple[float, ...]]] = {}
    causes_of_runs: list[list[str]] = []
    for seed in range(runs):
        arm = Arm(robot, cell, np.random.default_rng(seed))
        options = cell.options() if name == "given" else EstimationOptions()
        is_payload = name in ("payload", "loaded")
        off, causes = (payload_errors if is_payload else link_errors)(arm, options)
        causes_of_runs.append(causes)
        for quantity, *numbers in off:
            rows_by_quantity.setdefault(quantity, []).append(tuple(numbers))
    for quantity, rows in rows_by_quantity.items():
        error, sigma, size = np.array(rows).T
        inside = 100.0 * np.mean(np.abs(error) < 1.96 * sigma)
        share = 100.0 * float(np.sqrt(np.mean((error / size) ** 2)))
        ratio = float(np.sqrt(np.mean((error / sigma) ** 2)))
        yield f"{quantity:<16}{inside:6.0f} %{share:8.2f} %{ratio:8.2f}"
    listed = sorted(set(itertools.chain.from_iterable(causes_of_runs)))
    share = 100.0 * np.mean([bool(causes) for causes in causes_of_runs])
    yield f"{'sentences':<16}{share:6.0f} %  {', '.join(listed)}"


CELLS = {
    "exact": (Cell(),),
    "given": GIVEN,
    "usual": (USUAL,),
    "payload": (replace(USUAL, has_gear_friction=True),),
}
CELLS["loaded"] = CELLS["exact"]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--cells", nargs="+", default=list(CELLS), choices=list(CELLS))
    options = parser.parse_args()
    print(
        f"{'arm':<8}{'cell':<9}{'links scale zeros tilt':<26}{'':<16}coverage     rms  rms/stated"
    )
    for name in options.arms:
        robot = load_robot_model(options.models / ARMS[name])
        for question in options.cells:
            for cell in CELLS[question]:
                links = f"{cell.links:g} % {cell.scale:g} %"
                description = f"{links} {cell.zero:g} mrad {cell.tilt:g} deg"
                for line in study(robot, question, cell, options.runs):
                    print(f"{name:<8}{question:<9}{description:<26}{line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Sines that show every link, every rotor and every joint's friction together.

Out of random feasible trajectories the one is taken whose torques hold most of all that a whole-arm
fit looks for: log det of Y^T Y / sigma^2 + P, with P what the model knows beforehand, so that what
no motion shows does not count (Bayesian D-optimality; Chaloner, Verdinelli, "Bayesian experimental
design: a review", Statistical Science 10(3), 1995).
"""

from __future__ import annotations

import time as clocks
from collections.abc import Iterator

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.excitation.design.budget import Budget
from robot_sysid.excitation.design.optimise import Design
from robot_sysid.excitation.design.search import draw_trajectories
from robot_sysid.excitation.fourier import FourierTrajectory
from robot_sysid.excitation.limit_check import keeps_limits
from robot_sysid.excitation.problem import ExcitationProblem
from robot_sysid.records import Array, MotionPlan
from robot_sysid.records.progress import Progress

RATE_HZ = 20.0
"""How densely a candidate is looked at."""
KNOWN = 0.3
"""How well the model is taken to know each link, as a share of its numbers."""
_OWN = friction_model("coulomb-viscous-offset-armature")
_UNIT_ROTOR = 0.1


def design_for_arm(
    design: Design, rng: np.random.Generator, progress: Progress
) -> FourierTrajectory:
    """Return the best of the random trajectories that keep all limits.

    Args:
        design: the arm, its limits, how many trajectories are drawn, and the time for it.
        rng: source of randomness.
        progress: where to tell how far it is.

    Raises:
        InputError: none does.
    """
    budget = Budget(clocks.monotonic() + design.options.time_budget, clocks.monotonic)
    scored = sorted(_scored(design, int(rng.integers(2**62)), budget, progress), key=_score)
    for _, plan in scored:
        if keeps_limits(design.problem, plan):
            return plan
    raise InputError(
        f"none of {design.options.draws} random trajectories keeps all limits; relax one, or "
        "change the rest position with --keyframe"
    )


def _score(pair: tuple[float, FourierTrajectory]) -> float:
    return pair[0]


def _scored(
    design: Design, seed: int, budget: Budget, progress: Progress
) -> Iterator[tuple[float, FourierTrajectory]]:
    total, found = design.options.draws, 0
    for number in range(total):
        for draw in draw_trajectories(design, seed, [number]):
            if np.isfinite(draw.score):
                found += 1
                plan = design.trajectory(draw.x)
                yield -information(design.problem, plan), plan
        progress.advance("Designing the trajectory", number + 1, total, f"{found} feasible")
        if budget.is_over and found:
            return


def information(problem: ExcitationProblem, plan: MotionPlan) -> float:
    """Return log det of what the torques of a motion say of all links, rotors and friction."""
    motion = plan.evaluate(np.arange(0.0, plan.duration, 1.0 / RATE_HZ))
    robot, joints = problem.robot, range(problem.n_joints)
    links = [k for k, link in enumerate(robot.links) if link.has_mass]
    columns = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd).columns(links)
    columns = columns * np.concatenate([_link_scale(robot.links[k].theta) for k in links])
    sigma = np.full(problem.n_joints, np.inf)
    sigma[list(problem.rows)] = problem.sigma
    size = np.where(np.array(_OWN.terms) == "armature", _UNIT_ROTOR, 1.0)
    total = np.eye(columns.shape[-1] + len(size) * problem.n_joints)
    for joint in joints:
        nothing = np.zeros(len(motion.time))
        own = _OWN.columns(motion.qd[:, joint], motion.qdd[:, joint], nothing) * size
        rows = np.zeros((len(motion.time), len(total)))
        rows[:, : columns.shape[-1]] = columns[:, joint]
        place = columns.shape[-1] + joint * len(size)
        rows[:, place : place + len(size)] = own
        total += rows.T @ rows / sigma[joint] ** 2
    return float(np.linalg.slogdet(total)[1])


def _link_scale(theta: Array) -> Array:
    """Return (10,) how far a link's parameters are taken to be off."""
    length = max(spatial.characteristic_length(theta), 1e-3)
    return KNOWN * spatial.parameter_scale(float(theta[0]), length)

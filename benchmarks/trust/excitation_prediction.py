"""Are the standard errors that ``plan`` predicts right? Identifies simulated recordings of a plan.

    python -m benchmarks.trust.excitation_prediction [--arms PART] [--runs N] [--exact]

Every run simulates a recording of an arm whose other links, torque scales, zeros, gravity, delay
and friction are drawn from the priors of the estimate, and identifies it with default options. With
``--exact`` the arm is the model itself, and the prediction is that of torque noise alone.

Lines per arm: root mean square errors of the mass, the centre of mass and the ten parameters
(median), over the predicted standard errors, of the results and of the estimates before bodies were
made possible; then the standard errors that the runs state over the predicted ones (median).

With N runs the spread of a normal error is known to 1 / sqrt(2 N), 5 % for 240. Errors of possible
bodies have long tails and need more runs.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from rigs.files.places import GUESS, MODELS
from robot_sysid import spatial
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinkDynamics,
    gravity_vector,
    link_names,
    other_links,
    turn_gravity,
)
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.links import own_errors
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.terms import DELAY, LINKS
from robot_sysid.expected.recording import centre_slopes, expected_fit, prior_knowledge
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.search import Design, design_excitation
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording
from robot_sysid.records.messages import Progress
from robot_sysid.signals.process import low_pass_recordings
from robot_sysid.trajectory import TrajectoryOptions, sample_count

ARMS = (
    GUESS,
    MODELS / "universal_robots_ur5e/ur5e.xml",
    MODELS / "franka_panda/panda.xml",
    MODELS / "kuka_iiwa_14/iiwa14.xml",
)
RATE = 200.0
SIGMA = 0.3 / np.sqrt(5.0)
"""Torque noise with the information of 0.3 N m at 1 kHz, at a fifth of the rate [N m]."""
OPTIONS = EstimationOptions()


def drawn_links(robot, rng):
    """Return parameters of the other links, drawn from their prior and possible as bodies."""
    share = 0.01 * OPTIONS.priors.link
    links = []
    heavier, longer = share * rng.normal(size=2)
    for number in other_links(robot):
        theta = robot.links[number].theta
        next_joint = robot.links[number + 1].translation
        mass, com, inertia = spatial.com_from_theta(theta)
        errors = own_errors(theta, float(np.linalg.norm(next_joint)))
        turns = share * errors[4:, 4:]
        grown = 1.0 + heavier + share * rng.normal()
        size = float(errors[1, 1]) / mass
        outward = com / max(float(np.linalg.norm(com)), 1e-9)
        moved = com + size * (longer * outward + share * rng.normal(size=3))
        off = spatial.symmetric_from_six(np.diag(turns) * rng.normal(size=6))
        while not all(is_body(grown * inertia + sign * off) for sign in (1.0, -1.0)):
            off *= 0.5
        links.append(spatial.theta_from_com(grown * mass, moved, grown * inertia + off))
    return np.concatenate(links)


def is_body(inertia):
    """Return whether a body can have this inertia (3, 3) about its centre of mass."""
    return spatial.is_consistent(spatial.theta_from_com(1.0, np.zeros(3), inertia))


def simulate_log(robot, values, motion):
    """Return (torque, positions), each (N, n), that sensors of an arm with these values report.

    ``values`` maps names of parameters to values; a missing one is zero.
    """

    def of(term):
        """Return the value of a term for each joint (n,)."""
        names = (f"{term}[{joint}]" for joint in robot.joint_names)
        return np.array([values.get(name, 0.0) for name in names])

    thetas = robot.thetas
    for number in other_links(robot):
        thetas[number] = [values[name] for name in link_names(robot, number)]
    tilt = np.array([values.get(name, 0.0) for name in TILT_NAMES])
    down = turn_gravity(gravity_vector(robot), tilt)
    links = LinkDynamics(robot, down).motion(motion.q, motion.qd, motion.qdd)
    gear = links.torque(thetas)
    torque = (1.0 + of("scale")) * gear
    torque += np.sign(motion.qd) * of("load") * np.abs(gear)
    for name, term in TERMS.items():
        if np.any(of(name)):
            torque += of(name) * term.column(motion)
    late = motion.time - values.get(DELAY, 0.0)
    delayed = [np.interp(late, motion.time, column) for column in torque.T]
    return np.column_stack(delayed), motion.q + of("zero")


def identification_errors(predicted, motion, rng, exact):
    """Return the errors of one simulated identification: errors (10,) of the result and of the
    plain estimate, and stated standard errors (10,).

    ``predicted`` is the expected fit, which has the arm and all priors.
    """
    robot = predicted.arm.robot
    values = dict(predicted.arm.model)
    for term in () if exact else predicted.equations.terms:
        if term.prior is None:
            continue
        if term.cause == LINKS:
            drawn = drawn_links(robot, rng)
        else:
            drawn = term.prior.mean + term.prior.factor @ rng.normal(
                size=len(term.names)
            )
        values.update(zip(term.names, drawn))
    tau, q = simulate_log(robot, values, motion)
    tau = tau + SIGMA * rng.normal(size=tau.shape)
    recording = Recording(motion.time, q, None, tau, None)
    recordings, _ = low_pass_recordings(robot, [replace(recording, name="log")])
    fitted = solve_question(robot, recordings, Question(OPTIONS))
    theta = robot.prior.theta
    return fitted.values[:10] - theta, fitted.free[:10] - theta, fitted.errors[:10]


def error_line(theta, squares, covariance, title):
    """Return a line with rms errors over predicted ones; ``squares`` are mean products (10, 10)."""
    ratio = np.sqrt(np.diag(squares) / np.diag(covariance))
    slopes = centre_slopes(theta)
    centre = np.sqrt(
        np.trace(slopes @ squares @ slopes.T) / np.trace(slopes @ covariance @ slopes.T)
    )
    ten = np.array2string(ratio, precision=2)
    figures = (
        f"mass {ratio[0]:.2f}  centre {centre:.2f}  ten {np.median(ratio):.2f}  {ten}"
    )
    return f"  {title:16s} {figures}"


def lines(path, runs, exact):
    """Yield the lines of one arm."""
    robot = load_robot_model(path)
    problem = build_problem(robot, LimitOptions(), noise_torque=SIGMA)
    motion = TrajectoryOptions(sample_rate=RATE)
    options = ExcitationOptions()
    design = Design(problem, options, motion, prior_knowledge(problem, OPTIONS, "link"))
    plan = design_excitation(design, np.random.default_rng(1), Progress())
    predicted = expected_fit(problem, plan, RATE, OPTIONS, "arm")
    covariance = predicted.covariance[:10, :10]
    if exact:
        moved = predicted.inverse[:10]
        weighted = predicted.equations.data(predicted.weights)[:-1, :-1]
        covariance = moved @ weighted @ moved.T
    moves = plan.evaluate(np.arange(sample_count(plan.duration, RATE)) / RATE)
    began = time.process_time()
    errors = []
    for seed in range(runs):
        rng = np.random.default_rng([seed, ARMS.index(path)])
        errors.append(identification_errors(predicted, moves, rng, exact))
    off, free, stated = map(np.array, zip(*errors))
    yield f"{path.parent.name}/{path.stem}: {runs} runs ({time.process_time() - began:.0f} s)"
    for title, missed in (("result", off), ("plain estimate", free)):
        squares = missed.T @ missed / len(missed)
        yield error_line(robot.prior.theta, squares, covariance, title)
    share = np.median(stated, axis=0) / np.sqrt(np.diag(covariance))
    yield f"  stated: {np.array2string(share, precision=2)}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--arms", default="")
    parser.add_argument("--runs", type=int, default=240)
    parser.add_argument("--exact", action="store_true")
    options = parser.parse_args()
    for path in ARMS:
        if options.arms in str(path):
            for line in lines(path, options.runs, options.exact):
                print(line, flush=True)


if __name__ == "__main__":
    main()

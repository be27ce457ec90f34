"""Are the standard errors that ``plan`` predicts right? Identifies simulated recordings of a plan.

    python -m benchmarks.excitation_prediction [--arms PART] [--runs N] [--exact]

Every run simulates a recording of an arm whose other links, torque scales, zeros, gravity, delay
and friction are drawn from the priors of the estimate, and identifies it with default options. With
``--exact`` the arm is the model itself, and the prediction is that of torque noise alone.

Lines per arm: root mean square errors of the mass, the centre of mass and the ten parameters
(median), over the predicted standard errors:

- of all results;
- of results without a common torque scale, with their number;
- of the plain estimates, before bodies were made possible;
- of results with a common torque scale, over the standard errors that they state;
- the standard errors that the runs state over the predicted ones (median).

With N runs the spread of a normal error is known to 1 / sqrt(2 N), 5 % for 240. Errors of possible
bodies have long tails and need more runs.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinkDynamics,
    gravity_vector,
    turn_gravity,
)
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.priors import own_errors
from robot_sysid.estimation.answer import estimate_of
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import LINKS, build_unknowns
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.motion.design import Design
from robot_sysid.motion.design_search import design_excitation
from robot_sysid.motion.expected_errors import (
    RecordingPlan,
    _initial_choice,
    predict_posterior,
    prior_knowledge,
)
from robot_sysid.motion.information import mass_and_centre_errors
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.records import DELAY_NAME, Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.trajectory import TrajectoryOptions, sample_count
from tests.support.places import GUESS, MODELS

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


def beliefs(problem, motion):
    """Return the robot, the columns, and the groups of unknowns with their priors."""
    robot = problem.robot
    columns = Columns(problem.robot, (), OPTIONS.torques)
    torque = np.sqrt(np.mean(problem.arm_torque(motion) ** 2, axis=0))
    is_visible = np.ones(len(columns.names), dtype=bool)
    unknowns = build_unknowns(
        columns,
        Question(OPTIONS),
        _initial_choice(problem, OPTIONS),
        torque,
        is_visible,
    )
    return robot, columns, unknowns.groups


def drawn_links(robot, rng):
    """Return parameters of the other links, drawn from their prior and possible as bodies."""
    share = 0.01 * OPTIONS.priors.link
    links = []
    heavier, longer = share * rng.normal(size=2)
    for number in other_links(robot):
        theta = robot.links[number].theta
        next_joint = robot.links[number + 1].translation
        mass, com, inertia = spatial.com_from_theta(theta)
        _, moves = own_errors(theta, 1.0, float(np.linalg.norm(next_joint)))
        turns = own_errors(theta, share, float(np.linalg.norm(next_joint)))[0][4:, 4:]
        grown = 1.0 + heavier + share * rng.normal()
        size = float(moves[1, 0]) / mass
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


def simulate_log(robot, columns, values, motion):
    """Return (torque, positions), each (N, n), that sensors of an arm with these values report."""
    at = {name: float(value) for name, value in zip(columns.names, values)}

    def of(term):
        """Return the value of a term for each joint (n,)."""
        return np.array([at[f"{term}[{joint}]"] for joint in robot.joint_names])

    tilt = np.array([at[name] for name in TILT_NAMES])
    down = turn_gravity(gravity_vector(robot), tilt)
    links = LinkDynamics(robot, down).motion(motion.q, motion.qd, motion.qdd)
    gear = links.torque(columns.thetas(values))
    sign = np.sign(motion.qd)
    root = sign * np.sqrt(np.abs(motion.qd))
    friction = sign * (of("coulomb") + of("load") * np.abs(gear))
    friction += of("viscous") * motion.qd + of("sqrt") * root
    torque = (1.0 + of("scale")) * gear + friction + of("armature") * motion.qdd
    late = motion.time - at[DELAY_NAME]
    delayed = [np.interp(late, motion.time, column) for column in torque.T]
    return np.column_stack(delayed), motion.q + of("zero")


def identification_errors(problem, motion, rng, exact):
    """Return the errors of one simulated identification.

    Returns:
        errors (10,) of the result and of the plain estimate, stated standard errors (10,), and
        whether a common torque scale was allowed for
    """
    robot, columns, groups = beliefs(problem, motion)
    values = columns.model_values.copy()
    for group in () if exact else groups:
        if group.cause == LINKS:
            drawn = drawn_links(robot, rng)
        else:
            drawn = group.mean + group.factor @ rng.normal(size=len(group.mean))
        values[columns.indices(group.names)] = drawn
    tau, q = simulate_log(robot, columns, values, motion)
    tau = tau + SIGMA * rng.normal(size=tau.shape)
    recording = Measurement(motion.time, q, None, tau, None)
    datasets, _ = low_pass_recordings(robot, [Piece("log", recording)], OPTIONS)
    answer = answer_link(robot, datasets, OPTIONS, Progress(), None)
    fit = answer.fit
    theta = values[:10]
    stated = estimate_of(answer).standard_errors[:10]
    return (
        fit.values[:10] - theta,
        fit.free[:10] - theta,
        stated,
        fit.choice.common_scale > 0.0,
    )


def error_line(theta, squares, covariance, title):
    """Return a line with rms errors over predicted ones; ``squares`` are mean products (10, 10)."""
    ratio = np.sqrt(np.diag(squares) / np.diag(covariance))
    centre = (
        mass_and_centre_errors(theta, squares)[1]
        / mass_and_centre_errors(theta, covariance)[1]
    )
    ten = np.array2string(ratio, precision=2)
    figures = (
        f"mass {ratio[0]:.2f}  centre {centre:.2f}  ten {np.median(ratio):.2f}  {ten}"
    )
    return f"  {title:32s} {figures}"


def lines(path, runs, exact):
    """Yield the lines of one arm."""
    robot = load_robot_model(path)
    problem = build_problem(robot, LimitOptions(), noise_torque=SIGMA)
    motion = TrajectoryOptions(sample_rate=RATE)
    options = ExcitationOptions()
    design = Design(problem, options, motion, prior_knowledge(problem, OPTIONS, "link"))
    plan = design_excitation(design, np.random.default_rng(1)).trajectory
    posterior = predict_posterior(problem, plan, RecordingPlan(RATE, OPTIONS))
    names = posterior.unknowns.estimated_names
    indices = [names.index(name) for name in PARAMETER_NAMES]
    terminal = np.ix_(indices, indices)
    errors = posterior.errors
    covariance = (errors.noise if exact else errors.covariance)[terminal]
    moves = plan.evaluate(np.arange(sample_count(plan.duration, RATE)) / RATE)
    began = time.process_time()
    errors = []
    for seed in range(runs):
        rng = np.random.default_rng([seed, ARMS.index(path)])
        errors.append(identification_errors(problem, moves, rng, exact))
    off, free, stated, common = map(np.array, zip(*errors))
    yield f"{path.parent.name}/{path.stem}: {runs} runs ({time.process_time() - began:.0f} s)"
    selections = {
        "result": off,
        "result, no common torque scale": off[~common],
        "plain estimate": free,
    }
    for title, is_selected in selections.items():
        squares = is_selected.T @ is_selected / max(len(is_selected), 1)
        yield error_line(
            robot.prior.theta, squares, covariance, f"{title} ({len(is_selected)})"
        )
    if np.any(common):
        ratio = np.sqrt(np.mean((off / stated)[common] ** 2, axis=0))
        yield f"  common torque scale, over stated: {np.array2string(ratio, precision=2)}"
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

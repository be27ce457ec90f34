"""Check the whole identification: does it find the terminal link that made the torques?

The guess is the model an engineer has, the truth is the arm in the simulation. Five cases, from
what must succeed exactly to what a real arm does. Exit code 0 when the exact ones are exact.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import gen3
import numpy as np
from numpy.typing import NDArray
from validate_regressor import with_link

from robot_sysid import spatial
from robot_sysid.parser import load_robot_model
from robot_sysid.records import MotionPlan, RobotModel
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import LastLinkTerms, Solution, identify_parameters
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks

Array = NDArray[np.float64]

MODELS = Path(__file__).resolve().parent / "model"
TOLERANCE = 1e-8
SAMPLE_RATE = 1000.0
NAMES = (*spatial.PARAMETER_NAMES, "coulomb", "viscous")


def main() -> int:
    """Run the five cases, print what each found, and return the exit code."""
    guess = load_robot_model(MODELS / "kinova_fullinertia_guess.xml")
    truth = load_robot_model(MODELS / "kinova_fullinertia.xml")
    plan = generate_excitation_trajectory(guess, np.random.default_rng(0))
    passed = [
        own_simulation(guess, plan),
        terminal_torque_only(guess, truth, plan),
        links_known(guess, truth, plan),
        payload_by_difference(guess, truth, plan),
    ]
    links_from_the_catalogue(guess, truth, plan)
    print(f"\n{sum(passed)} of {len(passed)} exact cases are exact to {TOLERANCE:.0e}")
    return 0 if all(passed) else 1


def identify(
    robot: RobotModel, plant: RobotModel, plan: MotionPlan, torques: str = "chain"
) -> Solution:
    """Identify ``robot``'s terminal link from torques that ``plant`` produces along a plan.

    The friction of the terminal joint is identified too.
    """
    arm = LastLinkTerms(robot, torques)
    measurements = simulate_inverse(plant, motion_chunks(plan, SAMPLE_RATE))
    return identify_parameters(arm.exact_sums(measurements), arm.prior)


def own_simulation(guess: RobotModel, plan: MotionPlan) -> bool:
    """Test that a model is identified from its own simulation."""
    print("1. The guess, identified from its own simulation")
    estimate = identify(guess, guess, plan)
    return print_table(model_parameters(guess), estimate.values, guess)


def terminal_torque_only(
    guess: RobotModel, truth: RobotModel, plan: MotionPlan
) -> bool:
    """Test that mass and h_z, which the last joint's torque does not show, stay the guess's."""
    print(
        "\n2. The truth, seen by its last joint only: what it cannot see stays as guessed"
    )
    estimate = identify(guess, truth, plan, torques="terminal")
    print(f"   not visible: {'; '.join(estimate.quality.unidentifiable)}")
    expected = model_parameters(truth)
    expected[[0, 3]] = model_parameters(guess)[[0, 3]]
    # Of Ixx and Iyy only the difference shows; their sum stays as guessed.
    half_sum = 0.5 * (model_parameters(guess)[4] + model_parameters(guess)[7])
    half_difference = 0.5 * (model_parameters(truth)[4] - model_parameters(truth)[7])
    expected[[4, 7]] = half_sum + half_difference, half_sum - half_difference
    return print_table(expected, estimate.values, guess)


def links_known(guess: RobotModel, truth: RobotModel, plan: MotionPlan) -> bool:
    """Test that the truth is identified from a wrong model where the other links are known."""
    print("\n3. The truth, when all other links are known")
    start = replace(truth, links=(*truth.links[:-1], guess.links[-1]))
    estimate = identify(start, truth, plan)
    return print_table(model_parameters(truth), estimate.values, guess)


def payload_by_difference(
    guess: RobotModel, truth: RobotModel, plan: MotionPlan
) -> bool:
    """Test that the tool alone is identified from two runs, in which errors of the links cancel.

    tau_with - tau_without = Y (theta_with - theta_without) = Y theta_tool: least squares are linear
    in torques, so that the difference of two estimates is the estimate from the difference.
    """
    print(
        "\n4. The tool alone: run with it minus run without it, all other links guessed wrong"
    )
    tool = spatial.transform_theta(
        gen3.gripper() + gen3.workpiece(), np.eye(3), np.array(gen3.FLANGE)
    )
    bare = truth.prior.theta - tool
    unloaded = replace(truth, mj_model=with_link(truth, bare))
    loaded, empty = (identify(guess, arm, plan).values for arm in (truth, unloaded))
    return print_table(tool, (loaded - empty)[:10], guess)


def links_from_the_catalogue(
    guess: RobotModel, truth: RobotModel, plan: MotionPlan
) -> None:
    """Print the result where the other links differ from the model, as on a real arm.

    The friction of the other joints is known.
    """
    print(
        "\n5. The truth, when all other links are only guessed (not expected to be exact)"
    )
    start = replace(guess, friction=truth.friction)
    estimate = identify(start, truth, plan)
    print_table(model_parameters(truth), estimate.values, guess)
    verdict = "a" if spatial.is_consistent(estimate.values[:10]) else "no"
    print(f"   residual {estimate.quality.rmse:.3f} N m; {verdict} possible rigid body")


def model_parameters(robot: RobotModel) -> Array:
    """Return a model's own parameters (12,) in the order of NAMES."""
    last = robot.friction.coulomb[-1], robot.friction.viscous[-1]
    return np.append(robot.prior.theta, last)


def print_table(expected: Array, identified: Array, guess: RobotModel) -> bool:
    """Print values beside the expected ones and their errors, scaled by mass and size."""
    length = spatial.characteristic_length(guess.prior.theta)
    scale = np.append(spatial.parameter_scale(guess.prior.mass, length), [1.0, 1.0])
    errors = np.abs(identified - expected) / scale[: len(identified)]
    print(f"   {'':<10}{'expected':>14}{'identified':>14}{'scaled error':>14}")
    for name, expected_value, value, error in zip(NAMES, expected, identified, errors):
        print(f"   {name:<10}{expected_value:>14.6f}{value:>14.6f}{error:>14.1e}")
    return bool(np.all(errors < TOLERANCE))


if __name__ == "__main__":
    sys.exit(main())

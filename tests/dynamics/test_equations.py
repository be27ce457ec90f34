"""Noise-free data gives back the link's parameters, on any chain."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_less

from rigs.arms import small_arms
from rigs.arms.small_arms import SEEDS, random_chain, rigid_bodies, robot_of
from robot_sysid import spatial
from robot_sysid.estimate.identifiability import visible_space
from robot_sysid.records import JointFriction
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import LastLinkTerms, identify_parameters
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks

RATE = 40.0
DURATION = 5.0
ARM_NAMES = [
    "armature",
    "coupled fingers",
    "gravity compensated",
    "home keyframe",
    "in water",
    "massless tip",
    "nameless",
    "seven",
    "shared bodies",
    "slide in chain",
    "springs",
    "tendon spring",
    "three",
    "tilted gravity",
    "unlimited",
]
ARMS = {name: robot_of(small_arms.MODELS[name]) for name in ARM_NAMES}


def plant_with(robot, theta, friction):
    """Return the arm with another terminal link and other friction in its last joint, and the
    truth.

    Args:
        robot: the arm.
        theta: (10,) parameters of the terminal body.
        friction: Coulomb and viscous coefficients.

    Returns:
        The plant, and its true parameters (12,).
    """
    model, truth = small_arms.with_link(robot, theta)
    coulomb = robot.friction.coulomb.copy()
    viscous = robot.friction.viscous.copy()
    coulomb[-1], viscous[-1] = friction
    plant = replace(
        robot,
        mj_model=model,
        friction=JointFriction(coulomb, viscous, robot.friction.shared),
    )
    truth = small_arms.composite_theta(model, robot.reference_qpos, robot.body_id)
    return plant, np.append(truth, friction)


def measure(plant, seed, rate=RATE, duration=DURATION):
    """One chunk of noise-free measurements along an excitation trajectory of the plant."""
    plan = generate_excitation_trajectory(plant, default_rng(seed), duration)
    return list(simulate_inverse(plant, motion_chunks(plan, rate)))


def identify(robot, measurements):
    """Return the solution of the terminal link and its joint's friction, its prior and sums."""
    arm = LastLinkTerms(robot)
    sums = arm.exact_sums(measurements)
    return identify_parameters(sums, arm.prior), arm.prior, sums


def scale_of(truth):
    """Return the typical size (M,) of each parameter; friction has the size of the mass."""
    length = spatial.characteristic_length(truth[:10])
    inertial = spatial.parameter_scale(truth[0], length)
    return np.append(inertial, np.full(len(truth) - 10, inertial[0]))


@given(st.sampled_from(ARM_NAMES), rigid_bodies(), SEEDS)
def test_noise_free_torques_identify_any_possible_link(name, theta, seed):
    robot = ARMS[name]
    rng = default_rng(seed)
    plant, truth = plant_with(robot, theta, rng.uniform(0.0, 2.0, size=2))
    estimate, _, _ = identify(robot, measure(plant, seed))
    assert np.all(np.isfinite(estimate.standard_errors))
    error = np.abs(estimate.values - truth)
    # A link of a few grams is found from torques a thousand times its own: 16 digits leave 1e-13.
    rounding = 1e-12 * np.append(spatial.parameter_scale(1.0, 1.0), [1.0, 1.0])
    assert_array_less(error, 1e-8 * scale_of(truth) + rounding)


@given(random_chain(("any", "parallel")), rigid_bodies(), SEEDS)
def test_identified_parameters_are_exact_and_the_others_keep_the_prior(
    xml, theta, seed
):
    robot = robot_of(xml)
    plant, truth = plant_with(robot, theta, (0.3, 0.2))
    estimate, prior, sums = identify(robot, measure(plant, seed))
    rows = np.concatenate(sums.triangles)
    space = visible_space(rows[:, :-1])
    # Torques carry about 14 digits, of which weak columns and the condition number eat some.
    condition = space.singular[0] / space.singular[-1]
    digits = 1e-8 + 1e-14 * np.linalg.norm(rows[:, -1]) * condition * space.scale
    # In units of its typical size, at least 1 in SI units.
    error = np.abs(estimate.values - truth) / (scale_of(truth) + 1.0)
    assert np.all((error < digits)[np.isfinite(estimate.standard_errors)])
    moved = (estimate.values - prior) / space.scale
    size = np.linalg.norm(moved) + np.linalg.norm((truth - prior) / space.scale)
    rotation = 1e-10 + 1e-15 * condition
    assert_allclose(space.null.T @ moved, 0.0, atol=rotation * size)
    assert estimate.quality.rmse < 1e-9 * (1.0 + np.linalg.norm(truth))


@given(SEEDS, st.integers(7, 200))
def test_sums_of_chunks_are_those_of_one(seed, size):
    """Triangles of any chunks have the products of all rows."""
    robot = ARMS["three"]
    (whole,) = measure(robot, seed)
    parts = [whole[k : k + size] for k in range(0, len(whole), size)]
    one, several = map(LastLinkTerms(robot).exact_sums, ([whole], parts))
    products = np.swapaxes(several.triangles, 1, 2) @ several.triangles
    for product, at, expected in zip(products, one.columns, one.totals):
        scale = np.sqrt(np.diag(expected))
        error = (product[np.ix_(at, at)] - expected) / np.outer(scale, scale)
        assert_array_less(np.abs(error), 1e-12)
    assert one.counts.tolist() == several.counts.tolist()

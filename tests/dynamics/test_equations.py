"""Noise-free data gives back the link's parameters, on any chain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_less

from rigs import arms
from rigs.arms import SEEDS, random_chain, rigid_bodies, robot_of
from robot_sysid import spatial
from robot_sysid.estimate.identifiability import VisibleSpace, visible_space
from robot_sysid.records import JointFriction
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import LastLinkTerms
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
ARMS = {name: robot_of(arms.MODELS[name]) for name in ARM_NAMES}


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
    model, truth = arms.with_link(robot, theta)
    coulomb = robot.friction.coulomb.copy()
    viscous = robot.friction.viscous.copy()
    coulomb[-1], viscous[-1] = friction
    plant = replace(
        robot,
        mj_model=model,
        friction=JointFriction(coulomb, viscous, robot.friction.shared),
    )
    truth = arms.composite_theta(model, robot.reference_qpos, robot.body_id)
    return plant, np.append(truth, friction)


def measure(plant, seed, rate=RATE, duration=DURATION):
    """One chunk of noise-free measurements along an excitation trajectory of the plant."""
    plan = generate_excitation_trajectory(plant, default_rng(seed), duration)
    return list(simulate_inverse(plant, motion_chunks(plan, rate)))


@dataclass(frozen=True)
class Fit:
    """Plain least squares for the deviation from the model."""

    names: tuple
    values: np.ndarray
    prior: np.ndarray
    space: VisibleSpace
    torque_size: float
    rmse: float

    @property
    def is_identified(self):
        return np.array(self.space.is_identified)


def identify(robot, measurements):
    """Return a Fit of the terminal link and joint friction to the measurements."""
    arm = LastLinkTerms(robot)
    sums = arm.exact_sums(measurements)
    rows = np.concatenate(sums.triangles)
    space = visible_space(rows[:, :-1])
    values = arm.prior + space.solve(rows @ np.append(-arm.prior, 1.0))
    residual = np.linalg.norm(rows @ np.append(-values, 1.0))
    rmse = float(residual / np.sqrt(np.sum(sums.counts)))
    torque_size = float(np.linalg.norm(rows[:, -1]))
    return Fit(sums.names, values, arm.prior, space, torque_size, rmse)


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
    estimate = identify(robot, measure(plant, seed))
    assert estimate.space.rank == 12
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
    estimate = identify(robot, measure(plant, seed))
    space = estimate.space
    # Torques carry about 14 digits, of which weak columns and the condition number eat some.
    condition = space.singular[0] / space.singular[-1]
    digits = 1e-8 + 1e-14 * estimate.torque_size * condition * space.scale
    # In units of its typical size, at least 1 in SI units.
    error = np.abs(estimate.values - truth) / (scale_of(truth) + 1.0)
    assert np.all((error < digits)[estimate.is_identified])
    moved = (estimate.values - estimate.prior) / space.scale
    size = np.linalg.norm(moved) + np.linalg.norm(
        (truth - estimate.prior) / space.scale
    )
    rotation = 1e-10 + 1e-15 * condition
    assert_allclose(space.null.T @ moved, 0.0, atol=rotation * size)
    assert estimate.rmse < 1e-9 * (1.0 + np.linalg.norm(truth))


@given(SEEDS, st.integers(1, 200))
def test_sums_of_chunks_are_those_of_one(seed, size):
    """Triangles of any chunks have the products of all rows."""
    robot = ARMS["three"]
    (whole,) = measure(robot, seed)
    parts = [slice(k, k + size) for k in range(0, len(whole), size)]
    arm = LastLinkTerms(robot)
    one, several = (
        arm.exact_sums(chunks) for chunks in ([whole], [whole[part] for part in parts])
    )
    products = np.swapaxes(several.triangles, 1, 2) @ several.triangles
    for product, at, expected in zip(products, one.columns, one.totals):
        scale = np.sqrt(np.diag(expected))
        error = (product[np.ix_(at, at)] - expected) / np.outer(scale, scale)
        assert_array_less(np.abs(error), 1e-12)
    assert one.counts.tolist() == several.counts.tolist()

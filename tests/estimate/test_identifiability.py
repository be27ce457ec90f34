"""What the data shows: rank, condition numbers, and hidden directions in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from rigs.arms import small_arms
from rigs.arms.synthetic_data import arm_equations, sums_of
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.estimate.identifiability import fit_quality, visible_space
from robot_sysid.records import Recording
from robot_sysid.solver import LastLinkTerms


def matrix_of(sums):
    """Return rows (M, p) with the products of all rows of sums."""
    return np.concatenate(sums.triangles)[:, :-1]


def analyse_sums(sums):
    """Return the identifiability from sums."""
    none = np.zeros(len(sums.joints))
    return fit_quality(matrix_of(sums), sums.names, sums.joints, none, none, {})


def analyse(rng, equations, names):
    """Return the identifiability from equations of any torque."""
    truth = rng.normal(size=len(names))
    return analyse_sums(sums_of(equations, names, truth))


def test_a_column_that_looks_like_a_nuisance_is_not_identified():
    """An inertia whose torque is constant is confounded with an offset."""
    rng = np.random.default_rng(5)
    equations, names = arm_equations(rng, joints=3)
    for rows, _ in equations:
        rows[:, 9] = 0.0
    rows, columns = equations[0]
    rows[:, 9] = 2.0
    equations[0] = np.column_stack((rows, np.ones(len(rows)))), np.append(columns, 16)
    identifiability = analyse(rng, equations, (*names, "offset[joint0]"))
    assert identifiability.n_base_params == 11
    assert identifiability.unidentifiable == ("inertia Izz", "offset of joint0")


def test_the_condition_number_is_that_of_the_stacked_regressor_of_the_link_and_its_joint():
    """Friction of the other joints is no part of it, whether it is estimated or not."""
    rng = np.random.default_rng(4)
    equations, names = arm_equations(rng, joints=3)
    identifiability = analyse(rng, equations, names)
    stacked = np.zeros((180, 16))
    for j, (rows, columns) in enumerate(equations):
        stacked[60 * j : 60 * (j + 1), columns] = rows
    stacked = stacked[:, [*range(10), 14, 15]]
    assert names[14:] == ("coulomb[joint2]", "viscous[joint2]")
    expected = pytest.approx(np.linalg.cond(stacked), rel=1e-9)
    assert identifiability.condition_number == expected


@given(
    small_arms.SEEDS,
    st.integers(-14, 14),
    st.permutations(range(16)),
    st.integers(0, 4),
    st.lists(st.sampled_from([1e-7, 1.0, 10.0]), max_size=3),
)
def test_neither_units_nor_nuisances_decide_what_is_visible(
    seed, exponent, order, count, units
):
    """Also where some columns are nothing but rounding noise."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, joints=3)
    for rows, columns in equations:
        rows[:, np.isin(columns, order[:count])] *= 1e-13
    expected = analyse(rng, equations, names)
    rows, columns = equations[0]
    rows = np.column_stack((rows, rng.normal(size=(len(rows), len(units))) * units))
    equations[0] = rows, np.append(columns, 16 + np.arange(len(units)))
    scaled = [(rows * 10.0**exponent, columns) for rows, columns in equations]
    nuisances = [f"nuisance{k}" for k in range(len(units))]
    identifiability = analyse(rng, scaled, (*names, *nuisances))
    assert identifiability.n_base_params == expected.n_base_params
    assert identifiability.unidentifiable == expected.unidentifiable
    condition = pytest.approx(expected.condition_number, rel=1e-6)
    assert identifiability.condition_number == condition


# --- against MuJoCo alone -----------------------------------------------------------------------
# What joint torques show of a link by MuJoCo's inverse dynamics and an SVD. The torque is linear in
# a body's ten parameters, so a difference of any size is exact.

CUT = 1e-10
"""Share of the largest singular value, and of a column's usual length, that is nothing."""
BODY = np.array([2.0, 0.1, -0.2, 0.3, 0.4, 0.02, -0.03, 0.5, 0.01, 0.6])
STEPS = np.array([0.5, *[0.1] * 3, *[0.1] * 6])


@dataclass(frozen=True)
class Visibility:
    """What a motion shows of the link's ten parameters and the last joint's two of friction.

    Attributes:
        matrix: (M, 12) scaled columns.
        scale: (12,) factors of the columns; parameters of a unit share theirs.
        null: (12, d) orthonormal basis of the hidden directions, in scaled coordinates.
        ranks: least and largest rank that a cut ten times larger or smaller gives.
    """

    matrix: np.ndarray
    scale: np.ndarray
    null: np.ndarray
    ranks: tuple[int, int]


def mujoco_columns(robot, q, qd, qdd):
    """Return each chain joint's torque per unit of each parameter (N, n, 12)."""
    columns = np.zeros((*q.shape, 12))
    for k, step in enumerate(np.diag(STEPS)):
        ahead, behind = (
            ArmDynamics(robot, small_arms.with_link(robot, theta)[0]).torque(q, qd, qdd)
            for theta in (BODY + step, BODY - step)
        )
        columns[:, :, k] = (ahead - behind) / (2.0 * STEPS[k])
    columns[:, -1, 10:] = np.column_stack((np.sign(qd[:, -1]), qd[:, -1]))
    return columns


def visibility_of(columns):
    """Return the visibility of stacked columns (N, joints, 12)."""
    matrix = columns.reshape(-1, 12)
    length = np.linalg.norm(matrix, axis=0)
    starts = np.array([0, 1, 4, 10, 11])
    scale = np.repeat(np.maximum.reduceat(length, starts), [1, 3, 6, 1, 1])
    is_zero = scale <= CUT * np.max(length, initial=0.0)
    scale = 1.0 / np.where(is_zero, 1.0, scale)
    scaled = np.where(is_zero, 0.0, matrix * scale)
    _, singular, tau = np.linalg.svd(scaled)
    shares = np.zeros(12)
    shares[: len(singular)] = singular / max(np.max(singular, initial=0.0), 1e-300)
    cuts = CUT * np.array([[10.0], [1.0], [0.1]])
    least, rank, largest = np.count_nonzero(shares > cuts, axis=1)
    return Visibility(scaled, scale, tau[rank:].T, (least, largest))


def random_states(robot, rng, joints, samples):
    """Return (q, qd, qdd) of states in which some joints move and the others rest."""
    q, qd, qdd = small_arms.random_motion(rng, robot.n_joints, samples)
    moving = np.isin(np.arange(robot.n_joints), joints)
    return np.where(moving, q, robot.reference), qd * moving, qdd * moving


def sums_of_states(robot, torques, q, qd, qdd):
    """Return the sums of the package's own equations for some states."""
    measurement = Recording(np.arange(len(q)) / 100.0, q, qd, np.zeros_like(q), qdd)
    return LastLinkTerms(robot, torques).exact_sums([measurement])


def assert_same(sums, visibility):
    """Compare rank, parameters and directions with those that MuJoCo shows.

    Where a combination shows by about as much as the cut requires, another motion may decide
    otherwise, and the rank alone is compared.
    """
    identifiability = analyse_sums(sums)
    least, largest = visibility.ranks
    assert least <= identifiability.n_base_params <= largest
    if least < largest:
        return
    is_identified = np.linalg.norm(visibility.null, axis=1) < 1e-6
    assert len(identifiability.unidentifiable) == np.count_nonzero(~is_identified)
    space = visible_space(matrix_of(sums))
    assert_array_equal(space.is_identified, is_identified)
    hidden = space.scale[:, None] * space.null / visibility.scale[:, None]
    hidden /= np.linalg.norm(hidden, axis=0)
    residual = np.linalg.norm(visibility.matrix @ hidden)
    assert residual <= 1e-6 * max(np.linalg.norm(visibility.matrix), 1e-300)


@given(
    small_arms.random_chain(("any", "aligned", "parallel")),
    st.sets(st.integers(0, 14)),
    st.sampled_from(["chain", "terminal"]),
    small_arms.SEEDS,
)
def test_the_package_shows_what_mujoco_and_an_svd_show(xml, joints, torques, seed):
    """From differences of MuJoCo's inverse dynamics, at other states of the moving joints."""
    robot = small_arms.robot_of(xml)
    rng = np.random.default_rng(seed)
    states, other_states = (
        random_states(robot, rng, tuple(joints), 14) for _ in range(2)
    )
    columns = mujoco_columns(robot, *states)
    visibility = visibility_of(columns if torques == "chain" else columns[:, -1:])
    assert_same(sums_of_states(robot, torques, *other_states), visibility)

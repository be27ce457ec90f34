"""What the data can see: rank, condition numbers, unidentifiable directions in words."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import (
    TERMINAL_FRICTION,
    Equations,
    friction_per_joint,
)
from robot_sysid.estimation.algebra.identifiability import (
    analyse_identifiability,
    column_scale,
    readable_basis,
    visible_space,
)
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator
from robot_sysid.records import JointInformation, Measurement, SquareRootInformation
from tests.support import arms
from tests.support.synthetic_data import (
    ORIGIN,
    arm_equations,
    information_of,
    random_body,
    terminal_information,
)

SEEDS = st.integers(0, 2**32 - 1)


def terminal(seed, axis, offset=ORIGIN):
    rng = np.random.default_rng(seed)
    truth = np.append(random_body(rng), [0.4, 0.1])
    return analyse_identifiability(
        terminal_information(rng, truth, np.asarray(axis), offset)
    )


def test_last_joint_alone_sees_seven_of_ten_and_its_friction():
    seen = terminal(0, [0.0, 0.0, 1.0])
    assert (seen.rank, seen.n_parameters) == (9, 12)
    assert seen.unidentifiable == ("mass", "first moment along z", "Ixx + Iyy")
    unseen = {0, 3, 4, 7}
    assert seen.identified == tuple(k not in unseen for k in range(12))


@given(SEEDS)
def test_last_joint_alone_has_rank_nine_for_every_axis(seed):
    axis = np.random.default_rng(seed).normal(size=3)
    seen = terminal(seed, axis / np.linalg.norm(axis))
    assert seen.rank == 9
    assert len(seen.unidentifiable) == 3
    assert seen.unidentifiable[0] == "mass"


@given(SEEDS, st.lists(st.sampled_from([-7.0, 0.0, 1.0]), max_size=3))
def test_nuisances_of_any_number_and_unit_do_not_count(seed, exponents):
    rng = np.random.default_rng(seed)
    ((rows, columns),), names = arm_equations(rng, joints=1, count=80)
    without = information_of([(rows, columns)], names, rng.normal(size=12))
    more = rng.normal(size=(80, len(exponents))) * 10.0 ** np.array(exponents)
    equations = [(np.column_stack((rows, more)), np.arange(12 + len(exponents)))]
    names += tuple(f"nuisance{k}" for k in range(len(exponents)))
    truth = rng.normal(size=len(names)) / 10.0 ** np.array([0.0] * 12 + exponents)
    seen = analyse_identifiability(information_of(equations, names, truth))
    assert (seen.rank, seen.n_parameters) == (9, 12)
    assert seen.rank == analyse_identifiability(without).rank


def test_the_nuisances_ranks_do_not_make_up_for_what_the_link_hides():
    """Friction of four joints, of which one is asked for; three inertial columns are zero."""
    rng = np.random.default_rng(4)
    equations, names = arm_equations(rng, joints=4)
    for rows, _ in equations:
        rows[:, [0, 3, 6]] = 0.0
    seen = analyse_identifiability(
        information_of(equations, names, rng.normal(size=18))
    )
    assert (seen.rank, seen.n_parameters) == (9, 12)
    assert seen.unidentifiable == ("mass", "first moment along z", "inertia Ixz")


def test_a_column_that_looks_like_a_nuisance_is_not_identified():
    """An inertia whose torque never changes cannot be told from an offset."""
    rng = np.random.default_rng(5)
    equations, names = arm_equations(rng, joints=3)
    (rows, columns) = equations[0]
    names = names + ("offset[joint0]",)
    for other, _ in equations:
        other[:, 9] = 0.0
    rows[:, 9] = 2.0
    equations[0] = np.column_stack((rows, np.ones(len(rows)))), np.append(columns, 16)
    information = information_of(equations, names, rng.normal(size=17))
    seen = analyse_identifiability(information)
    assert (seen.rank, seen.n_parameters) == (11, 12)
    assert not seen.identified[9] and not seen.identified[16]
    assert all(np.delete(seen.identified, [9, 16]))


def test_condition_numbers_are_those_of_the_stacked_regressor_of_the_link_and_its_joint():
    """Friction of the other joints is no part of it, whether it is estimated or not."""
    rng = np.random.default_rng(4)
    equations, names = arm_equations(rng, joints=3)
    seen = analyse_identifiability(
        information_of(equations, names, rng.normal(size=16))
    )
    stacked = np.zeros((180, 16))
    for j, (rows, columns) in enumerate(equations):
        stacked[60 * j : 60 * (j + 1), columns] = rows
    stacked = stacked[:, [*range(10), 14, 15]]
    assert names[14:] == ("coulomb[joint2]", "viscous[joint2]")
    scaled = stacked / np.linalg.norm(stacked, axis=0)
    assert seen.condition_number == pytest.approx(np.linalg.cond(stacked), rel=1e-9)
    assert seen.scaled_condition_number == pytest.approx(
        np.linalg.cond(scaled), rel=1e-9
    )


@given(SEEDS, st.lists(st.floats(-4, 4), min_size=5, max_size=5))
def test_units_do_not_decide_what_is_visible(seed, exponents):
    """Units of mass, first moment, inertia and of each friction coefficient."""
    rng = np.random.default_rng(seed)
    joint = terminal_information(rng, rng.normal(size=12)).joints[0]
    triangle = joint.triangle.copy()
    triangle[:, :-1] *= 10.0 ** np.repeat(exponents, [1, 3, 6, 1, 1])
    scaled = JointInformation(joint.joint, joint.columns, triangle, joint.n_samples)
    names = tuple("abcdefghijkl")
    before = visible_space(SquareRootInformation(names, (joint,)).stacked()[0])
    after = visible_space(SquareRootInformation(names, (scaled,)).stacked()[0])
    assert after.identified == before.identified
    first, second = (
        space.singular[0] / space.singular[-1] for space in (before, after)
    )
    assert second == pytest.approx(first, rel=1e-6)


@given(SEEDS, st.integers(-14, 14), st.permutations(range(16)), st.integers(0, 4))
def test_the_unit_of_torque_does_not_decide_what_is_visible(
    seed, exponent, order, count
):
    """Also where some columns are nothing but rounding noise."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, joints=3)
    for rows, columns in equations:
        rows[:, np.isin(columns, order[:count])] *= 1e-13
    truth = rng.normal(size=16)
    seen = analyse_identifiability(information_of(equations, names, truth))
    scaled = [(rows * 10.0**exponent, columns) for rows, columns in equations]
    again = analyse_identifiability(information_of(scaled, names, truth))
    assert (again.rank, again.identified) == (seen.rank, seen.identified)
    assert again.condition_number == pytest.approx(seen.condition_number, rel=1e-6)
    assert again.scaled_condition_number == pytest.approx(
        seen.scaled_condition_number, rel=1e-6
    )


# --- the visible space --------------------------------------------------------------------------


@given(SEEDS, st.integers(0, 30), st.booleans())
def test_solution_and_inverse_are_those_of_least_squares_in_scaled_columns(
    seed, count, hidden
):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(count, 12)) * 10.0 ** rng.uniform(-2.0, 2.0, 12)
    if hidden and count:
        matrix[:, 11] = matrix[:, 10] * 3.0
        matrix[:, 5] = 0.0
    space = visible_space(matrix)
    scale, zero = column_scale(matrix)
    scaled = np.where(zero, 0.0, matrix * scale)
    assert (
        space.rank == np.linalg.matrix_rank(scaled, tol=1e-8)
        if count
        else space.rank == 0
    )
    again = space.left * space.singular @ space.right.T
    assert_allclose(again, scaled, rtol=0.0, atol=1e-13)
    assert_allclose(scaled @ space.null, 0.0, atol=1e-12)
    basis = np.column_stack((space.right, space.null))
    assert_allclose(basis.T @ basis, np.eye(12), atol=1e-13)
    if count == 0 or space.singular[0] / space.singular[-1] < 1e4:
        pseudo = np.linalg.pinv(scaled, rcond=1e-8)
        right = rng.normal(size=count)
        size = scale * (1.0 + np.max(np.abs(pseudo), initial=0.0)) ** 2
        assert_allclose(space.solve(right) / size, scale * (pseudo @ right) / size,
                                   rtol=0.0, atol=1e-10)  # fmt: skip
        both = scale[:, None] * (pseudo @ pseudo.T) * scale
        root = space.inverse_root()
        assert_allclose(space.inverse() / np.outer(size, size),
                                   both / np.outer(size, size), rtol=0.0, atol=1e-10)  # fmt: skip
        assert_allclose(root @ root.T, space.inverse())


# --- in words -----------------------------------------------------------------------------------

NAMES = (*spatial.PARAMETER_NAMES, "coulomb[tool]", "viscous[tool]", "offset[X]")


@given(
    SEEDS, st.permutations(range(len(NAMES))), st.lists(st.integers(1, 4), max_size=6)
)
def test_a_sparse_basis_is_found_again_however_it_was_turned(seed, order, sizes):
    """Directions that share no parameter: of all bases of their space this one is the sparse."""
    rng = np.random.default_rng(seed)
    known = []
    for used in np.split(order, np.cumsum(sizes))[: len(sizes)]:
        if len(used):
            direction = np.zeros(len(NAMES))
            direction[used] = rng.choice([-1.0, 1.0], len(used)) * rng.uniform(
                0.2, 1.0, len(used)
            )
            known.append(direction / np.linalg.norm(direction))
    known = np.array(known).reshape(-1, len(NAMES))
    turned = known.T @ np.linalg.qr(rng.normal(size=(len(known), len(known))))[0]
    found = np.array(readable_basis(turned)).reshape(-1, len(NAMES))
    expected = known[np.argsort([np.flatnonzero(direction)[0] for direction in known])]
    signs = np.sign(np.sum(found * expected, axis=1))[:, None]
    assert_allclose(found, signs * expected, rtol=0.0, atol=1e-9)


# --- against MuJoCo alone -----------------------------------------------------------------------
# What joint torques show of a link by MuJoCo's inverse dynamics and an SVD. The torque is linear in
# a body's ten parameters, so a difference of any size is exact.

CUT = 1e-10
"""Share of the largest singular value, and of a column's usual length, that is nothing."""
BODY = np.array([2.0, 0.1, -0.2, 0.3, 0.4, 0.02, -0.03, 0.5, 0.01, 0.6])
STEPS = np.array([0.5, *[0.1] * 3, *[0.1] * 6])
UNITS = (slice(0, 1), slice(1, 4), slice(4, 10), slice(10, 11), slice(11, 12))


@dataclass(frozen=True)
class Seen:
    """What a motion shows of the link's ten parameters and the last joint's two of friction.

    Attributes:
        matrix: (M, 12) scaled columns.
        scale: (12,) parameters of a unit share theirs.
        null: (12, d) orthonormal basis of what is hidden, in scaled coordinates.
        ranks: least and largest rank that a cut ten times larger or smaller gives.
    """

    matrix: np.ndarray
    scale: np.ndarray
    null: np.ndarray
    ranks: tuple[int, int]

    @property
    def rank(self):
        """Number of visible combinations."""
        return 12 - self.null.shape[1]

    @property
    def identified(self):
        """Whether each parameter is in no hidden combination."""
        return tuple((np.linalg.norm(self.null, axis=1) < 1e-6).tolist())


def mujoco_columns(robot, q, qd, qdd):
    """(N, n, 12) what each chain joint's torque changes by per unit of each parameter."""
    model = copy.copy(robot.mj_model)
    columns = np.zeros((*q.shape, 12))
    for k, step in enumerate(np.diag(STEPS)):
        ahead, behind = (
            _torques(robot, model, BODY + s * step, q, qd, qdd) for s in (1.0, -1.0)
        )
        columns[:, :, k] = (ahead - behind) / (2.0 * STEPS[k])
    columns[:, -1, 10] = np.sign(qd[:, -1])
    columns[:, -1, 11] = qd[:, -1]
    return columns


def _torques(robot, model, theta, q, qd, qdd):
    """(N, n) inverse dynamics with these parameters in the last body, contacts and springs out."""
    arms.write_body(model, robot.body_id, theta)
    data = mujoco.MjData(model)
    tau = np.zeros((len(q), model.nv))
    for k in range(len(q)):
        data.qpos[:] = robot.reference_qpos
        data.qvel[:] = 0.0
        data.qacc[:] = 0.0
        data.qpos[robot.qpos_index] = q[k]
        data.qvel[robot.dof_index] = qd[k]
        data.qacc[robot.dof_index] = qdd[k]
        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            step(model, data)
        mujoco.mj_rne(model, data, 1, tau[k])
    return tau[:, robot.dof_index]


def oracle(columns):
    """What stacked columns (N, joints, 12) show."""
    matrix = columns.reshape(-1, 12)
    length = np.linalg.norm(matrix, axis=0)
    scale = np.concatenate(
        [np.full_like(length[unit], np.max(length[unit])) for unit in UNITS]
    )
    nothing = scale <= CUT * np.max(length, initial=0.0)
    scale = 1.0 / np.where(nothing, 1.0, scale)
    scaled = np.where(nothing, 0.0, matrix * scale)
    _, singular, right = np.linalg.svd(scaled)
    shares = np.zeros(12)
    shares[: len(singular)] = singular / max(np.max(singular, initial=0.0), 1e-300)
    least, rank, most = (
        int(np.count_nonzero(shares > CUT * k)) for k in (10.0, 1.0, 0.1)
    )
    return Seen(scaled, scale, right[rank:].T, (least, most))


def moves(robot, rng, joints, samples):
    """(q, qd, qdd) of random states in which these joints move and the others rest."""
    q, qd, qdd = arms.random_motion(rng, robot.n_joints, samples)
    moving = np.isin(np.arange(robot.n_joints), joints)
    return np.where(moving, q, robot.reference), qd * moving, qdd * moving


def rows_of(robot, torques, motion):
    """(columns, per joint rows (N, k)) of the package's own equations for a motion."""
    friction = friction_per_joint(robot, "terminal", TERMINAL_FRICTION)
    equations = Equations(robot, torques, friction)
    q, qd, qdd = motion
    measurement = Measurement(np.arange(len(q)) / 100.0, q, qd, np.zeros_like(q), qdd)
    return equations, [rows for rows, _ in equations.rows(measurement)]


def information_of_rows(equations, rows):
    """Square-root information of some rows of each joint."""
    accumulator = InformationAccumulator(
        equations.names, equations.joints, equations.columns
    )
    for index, block in enumerate(rows):
        accumulator.add(index, block, np.zeros(len(block)))
    return accumulator.result()


def assert_same(information, seen):
    """Rank, parameters and directions are those that MuJoCo shows.

    Where a combination shows by about as much as the cut asks for, another motion may decide
    otherwise, and the rank alone is compared.
    """
    found = analyse_identifiability(information)
    assert found.n_parameters == 12
    assert seen.ranks[0] <= found.rank <= seen.ranks[1]
    if seen.ranks[0] < seen.ranks[1]:
        return
    assert found.identified == seen.identified
    assert len(found.unidentifiable) == 12 - seen.rank
    space = visible_space(information.stacked()[0])
    hidden = space.scale[:, None] * space.null / seen.scale[:, None]
    hidden /= np.linalg.norm(hidden, axis=0)
    left = np.linalg.norm(seen.matrix @ hidden)
    assert left <= 1e-6 * max(np.linalg.norm(seen.matrix), 1e-300)


def _vector(rng, size=3):
    return " ".join(f"{x:.6f}" for x in rng.normal(size=size))


@st.composite
def small_arms(draw):
    """(robot, moving joints): one to five joints, simple or skew, under any gravity or none."""
    rng = np.random.default_rng(draw(SEEDS))
    simple = draw(st.booleans())
    gravity = draw(st.sampled_from(["0 0 -9.81", "0 0 0", "9.81 0 0", "3 -4 8"]))
    axes = draw(
        st.lists(
            st.sampled_from([arms.X, arms.Y, arms.Z, None]), min_size=1, max_size=5
        )
    )
    content = ""
    for index in reversed(range(len(axes))):
        slide = 'type="slide"' if rng.random() < 0.2 else ""
        place = "0 0 0" if simple else f"{_vector(rng)}"
        joints = arms.hinge(
            f"joint{index}", axes[index] or _vector(rng), f'{slide} pos="{place}"'
        )
        turn = "1 0 0 0" if simple else _vector(rng, 4)
        tip = arms.TIP if index == len(axes) - 1 else arms.LINK
        content = arms.link(joints, content, "", ".1 .02 .25", turn, tip)
    robot = arms.robot_of(
        arms.world(content, f'gravity="{gravity}"'), f"joint{len(axes) - 1}"
    )
    return robot, draw(st.sets(st.integers(0, len(axes) - 1)))


@given(small_arms(), st.sampled_from(["chain", "terminal"]), SEEDS)
def test_what_is_seen_is_what_mujoco_and_an_svd_see(arm, torques, seed):
    """From differences of MuJoCo's inverse dynamics, at other states of the same joints."""
    robot, moving = arm
    rng = np.random.default_rng(seed)
    first, other = (moves(robot, rng, tuple(moving), 14) for _ in range(2))
    columns = mujoco_columns(robot, *first)
    seen = oracle(columns if torques == "chain" else columns[:, -1:])
    equations, rows = rows_of(robot, torques, other)
    assert_same(information_of_rows(equations, rows), seen)

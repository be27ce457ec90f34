"""What the data can see: rank, condition numbers, unidentifiable directions in words."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.estimation.identifiability import analyse_identifiability, visible_space
from robot_sysid.records import JointInformation, SquareRootInformation
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
    return analyse_identifiability(terminal_information(rng, truth, np.asarray(axis), offset))


def test_last_joint_alone_sees_seven_of_ten_and_its_friction():
    seen = terminal(0, [0.0, 0.0, 1.0])
    assert (seen.rank, seen.n_parameters) == (9, 12)
    assert seen.unidentifiable == ("mass", "first moment along z", "the sum Ixx + Iyy")
    unseen = {0, 3, 4, 7}
    assert seen.identified == tuple(k not in unseen for k in range(12))


def test_unidentifiable_directions_of_a_slanted_axis_name_that_axis():
    assert terminal(0, [0.6, 0.8, 0.0]).unidentifiable == (
        "mass",
        "first moment along (0.6, 0.8, 0)",
        "the sum of the two inertias transverse to (0.6, 0.8, 0)",
    )


def test_an_axis_off_the_origin_reads_as_combinations():
    phrases = terminal(0, [0.0, 0.0, 1.0], np.array([0.5, 0.0, 0.0])).unidentifiable
    assert len(phrases) == 3
    assert "the sum Ixx + Iyy" in phrases
    assert any("m +" in phrase and "hx" in phrase for phrase in phrases)


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_last_joint_alone_has_rank_nine_for_every_axis(seed):
    axis = np.random.default_rng(seed).normal(size=3)
    seen = terminal(seed, axis / np.linalg.norm(axis))
    assert seen.rank == 9
    assert len(seen.unidentifiable) == 3
    assert seen.unidentifiable[0] == "mass"


def test_several_joints_see_everything_and_nuisances_do_not_count():
    rng = np.random.default_rng(1)
    equations, names = arm_equations(rng, joints=4)
    seen = analyse_identifiability(information_of(equations, names, rng.normal(size=18)))
    assert (seen.rank, seen.n_parameters) == (12, 12)
    assert seen.unidentifiable == ()
    assert all(seen.identified)


def test_a_nuisance_that_never_shows_does_not_lower_the_rank():
    rng = np.random.default_rng(2)
    equations, names = arm_equations(rng, joints=3)
    equations[0][0][:, 10:] = 0.0
    seen = analyse_identifiability(information_of(equations, names, rng.normal(size=16)))
    assert seen.rank == 12
    assert seen.unidentifiable == ("Coulomb friction of joint0", "viscous friction of joint0")


def test_the_nuisances_ranks_do_not_make_up_for_what_the_link_hides():
    """Friction of four joints, of which one is asked for; three inertial columns are zero."""
    rng = np.random.default_rng(4)
    equations, names = arm_equations(rng, joints=4)
    for rows, _ in equations:
        rows[:, [0, 3, 6]] = 0.0
    seen = analyse_identifiability(information_of(equations, names, rng.normal(size=18)))
    assert (seen.rank, seen.n_parameters) == (9, 12)
    assert seen.unidentifiable == ("mass", "first moment along z", "inertia Ixz")


def test_a_column_that_looks_like_a_nuisance_is_not_identified():
    """An inertia whose torque never changes cannot be told from an offset."""
    rng = np.random.default_rng(5)
    equations, names = arm_equations(rng, joints=3)
    (rows, columns), names = equations[0], names + ("offset[joint0]",)
    for other, _ in equations:
        other[:, 9] = 0.0
    rows[:, 9] = 2.0
    equations[0] = np.column_stack((rows, np.ones(len(rows)))), np.append(columns, 16)
    information = information_of(equations, names, rng.normal(size=17))
    seen = analyse_identifiability(information)
    assert (seen.rank, seen.n_parameters) == (11, 12)
    assert not seen.identified[9] and not seen.identified[16]
    assert all(np.delete(seen.identified, [9, 16]))


def test_rounding_noise_in_a_column_is_zero_and_does_not_enter_the_condition():
    rng = np.random.default_rng(3)
    matrix = rng.normal(size=(40, 5))
    matrix[:, 2] *= 1e-15
    space = visible_space(matrix)
    assert space.rank == 4
    assert space.identified == (True, True, False, True, True)
    assert space.singular[0] < 5.0 * space.singular[-1]


def test_condition_numbers_are_those_of_the_stacked_regressor_of_the_link_and_its_joint():
    """Friction of the other joints is no part of it, whether it is estimated or not."""
    rng = np.random.default_rng(4)
    equations, names = arm_equations(rng, joints=3)
    seen = analyse_identifiability(information_of(equations, names, rng.normal(size=16)))
    stacked = np.zeros((180, 16))
    for j, (rows, columns) in enumerate(equations):
        stacked[60 * j : 60 * (j + 1), columns] = rows
    stacked = stacked[:, [*range(10), 14, 15]]
    assert names[14:] == ("coulomb[joint2]", "viscous[joint2]")
    scaled = stacked / np.linalg.norm(stacked, axis=0)
    assert seen.condition_number == pytest.approx(np.linalg.cond(stacked), rel=1e-9)
    assert seen.scaled_condition_number == pytest.approx(np.linalg.cond(scaled), rel=1e-9)


@settings(max_examples=100, deadline=None)
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
    first, second = (space.singular[0] / space.singular[-1] for space in (before, after))
    assert second == pytest.approx(first, rel=1e-6)


def test_data_at_rest_sees_nothing():
    joint = JointInformation("joint0", np.arange(10), np.zeros((11, 11)), 100)
    names = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
    seen = analyse_identifiability(SquareRootInformation(names, (joint,)))
    assert seen.rank == 0
    assert len(seen.unidentifiable) == 10
    assert seen.condition_number == float("inf")

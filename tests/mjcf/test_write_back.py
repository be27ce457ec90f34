"""Which body gets what: the sum is always the identified composite, and every body is possible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import plan_write_back, possible_body
from robot_sysid.records import SubtreeBody
from tests.support.arms import random_rotation
from tests.support.model_files import random_theta

seeds = st.integers(0, 2**32 - 1)
NOTHING = np.zeros(10)


def body(number: int, theta, welded: bool = True) -> SubtreeBody:
    return SubtreeBody(number, f"b{number}", theta, welded)


@given(seed=seeds)
def test_the_terminal_body_takes_the_difference(seed):
    rng = np.random.default_rng(seed)
    link, tool, finger = (random_theta(rng, m) for m in (2.0, 0.3, 0.1))
    bodies = [body(3, random_theta(rng)), body(4, tool), body(5, finger, welded=False)]
    plan = plan_write_back(link + tool + finger, bodies)
    np.testing.assert_allclose(plan.theta, link, rtol=0, atol=1e-14)
    assert plan.emptied == () and plan.note is None


@given(seed=seeds)
def test_a_massless_terminal_body_takes_the_whole_rigid_group(seed):
    rng = np.random.default_rng(seed)
    tool, finger, load = (random_theta(rng, m) for m in (1.0, 0.1, 0.5))
    noise = 1e-9 * rng.normal(size=10)
    bodies = [body(3, NOTHING), body(4, tool), body(5, finger, False), body(6, NOTHING)]
    plan = plan_write_back(tool + finger + noise, bodies)
    np.testing.assert_allclose(plan.theta, tool + noise, rtol=0, atol=1e-14)
    assert [b.name for b in plan.emptied] == ["b4"]
    assert (
        plan.note is not None
        and "'b3'" in plan.note
        and "'b4' weigh nothing" in plan.note
    )
    heavier = plan_write_back(tool + finger + load, bodies)
    assert heavier.emptied == () and spatial.is_consistent(heavier.theta)


@given(seed=seeds)
def test_what_hangs_on_joints_gets_as_light_as_it_has_to(seed):
    rng = np.random.default_rng(seed)
    link, tool, finger, thumb = (random_theta(rng, m) for m in (0.2, 0.3, 2.0, 1.0))
    bodies = [
        body(3, link),
        body(4, tool),
        body(5, finger, False),
        body(6, thumb, False),
    ]
    composite = link + tool + 0.1 * (finger + thumb)
    plan = plan_write_back(composite, bodies)
    assert 0.1 <= plan.scale < 1.0 and [b.name for b in plan.lightened] == ["b5", "b6"]
    assert [b.name for b in plan.emptied] == ["b4"] and plan.inflation < 1e-9
    rest = composite - plan.scale * (finger + thumb)
    np.testing.assert_allclose(plan.theta, rest, rtol=0, atol=1e-9)
    assert possible_body(plan.theta, 1.0) is not None
    assert (
        possible_body(composite - 1.0001 * plan.scale * (finger + thumb), 1.0) is None
    )
    assert (
        plan.note is not None
        and "'b4' weigh nothing" in plan.note
        and "\n" not in plan.note
    )
    assert "'b5', 'b6' on joints of their own below body 'b3'" in plan.note
    assert f"inertia are {plan.scale:.4g} of the model's" in plan.note


def test_no_scale_makes_an_impossible_link_possible():
    finger = random_theta(np.random.default_rng(0), 1.0)
    with pytest.raises(ExportError, match="'b1' are not a possible rigid body") as e:
        plan_write_back(
            -0.9 * finger, [body(1, NOTHING), body(2, finger, welded=False)]
        )
    assert "\n" not in str(e.value)


@given(seed=seeds, flatness=st.floats(-1e-11, 1e-11))
def test_a_body_on_the_edge_is_moved_inside_by_less_than_anyone_sees(seed, flatness):
    rng = np.random.default_rng(seed)
    axes = random_rotation(rng)
    second = axes @ np.diag([2e-3, 1e-3, flatness * 3e-3]) @ axes.T
    com = rng.normal(size=3) * 0.1
    theta = spatial.theta_from_com(1.5, com, np.trace(second) * np.eye(3) - second)
    moved = possible_body(theta, 1.5)
    assert moved is not None and spatial.is_consistent(moved)
    assert np.max(np.abs(moved - theta)) < 1e-10 * 6e-3


@pytest.mark.parametrize(
    "theta",
    [
        NOTHING,
        spatial.theta_from_com(1e-7, np.zeros(3), 1e-9 * np.eye(3)),
        spatial.theta_from_com(-1.0, np.zeros(3), np.eye(3)),
        spatial.theta_from_com(1.0, np.zeros(3), np.zeros((3, 3))),
        spatial.theta_from_com(1.0, np.zeros(3), np.diag([1.0, 1.0, -1.0])),
        np.full(10, np.nan),
    ],
)
def test_what_is_no_body_is_none(theta):
    assert possible_body(theta, 1.0) is None


def rod(rng, mass=1.0):
    """All mass on a line: one moment of inertia is zero."""
    along = np.diag([0.0, 0.0, 0.01 * mass])
    inertia = np.trace(along) * np.eye(3) - along
    return spatial.theta_from_com(mass, rng.normal(size=3), inertia)


@given(seed=seeds, bound=st.floats(1e-9, 1e-4))
def test_moments_below_the_files_bound_are_raised_where_they_are_not_known_better(
    seed, bound
):
    identified = rod(np.random.default_rng(seed))
    plan = plan_write_back(identified, [body(1, NOTHING)], bound, 2.0 * bound)
    smallest = np.linalg.eigvalsh(spatial.com_from_theta(plan.theta)[2])[0]
    # Rounding of an inertia about an origin metres away, which is of the order of ten.
    np.testing.assert_allclose(smallest, bound, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        plan.written_composite(identified), plan.theta, rtol=0, atol=1e-13
    )
    assert plan.note is not None and "less than their standard errors" in plan.note


@given(seed=seeds)
def test_a_small_body_below_a_rod_is_kept_where_the_moments_allow(seed):
    """A compiler gives massless frames 1e-6 kg m^2; the rod minus that is impossible by as much."""
    rng = np.random.default_rng(seed)
    identified = rod(rng)
    frame = spatial.theta_from_com(1e-6, np.zeros(3), 1e-6 * np.eye(3))
    plan = plan_write_back(identified, [body(1, NOTHING), body(2, frame)], 0.0, 1e-3)
    assert plan.emptied == () and spatial.is_consistent(plan.theta)
    np.testing.assert_allclose(
        plan.theta + frame, plan.written_composite(identified), rtol=0, atol=1e-13
    )
    assert 1e-7 < plan.inflation < 1e-3

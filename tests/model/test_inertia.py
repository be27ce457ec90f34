"""Links of an arm take every body that a chain joint moves, each of them once."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.model import inertia
from tests.support import arms


@pytest.mark.parametrize("name", sorted(arms.MODELS))
def test_links_weigh_together_what_the_first_joint_moves(name):
    robot = arms.robot_of(arms.MODELS[name])
    model = robot.mj_model
    first = robot.links[0].body_id
    masses = [link.theta[0] for link in robot.links]
    moved = model.body_mass[list(subtree(model, first))]
    assert sum(masses) == pytest.approx(np.sum(moved), rel=1e-12)
    composite = inertia.composite_theta(model, robot.reference_qpos, robot.body_id)
    np.testing.assert_array_equal(robot.links[-1].theta, composite)
    np.testing.assert_array_equal(robot.prior.theta, composite)


@pytest.mark.parametrize("name", sorted(arms.MODELS))
def test_a_link_reaches_at_least_to_its_centre_of_mass(name):
    robot = arms.robot_of(arms.MODELS[name])
    reach = inertia.link_reach(robot.mj_model, robot.reference_qpos, robot.body_id)
    com = spatial.com_from_theta(robot.prior.theta)[1]
    assert reach >= np.linalg.norm(com)

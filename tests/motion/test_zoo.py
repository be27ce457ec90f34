"""Public models of real arms: each gets a trajectory that breaks no limit and touches nothing.

Skipped where the models are not beside the checkout. Checked at 1 kHz by code the search does not
use: the model's own limits, and contacts as MuJoCo reports them.
"""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.model.contacts import find_new_contacts
from robot_sysid.motion.design.optimise import Design
from robot_sysid.motion.design.search import design_excitation
from robot_sysid.motion.options import TOP_FREQUENCY_HZ, ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import TrajectoryOptions, motion_chunks
from tests.support.places import MODELS

# The most different ones: ``excitation_table`` in benchmarks has all.
ARMS = [
    ("franka_panda/scene.xml", None),
    ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ("universal_robots_ur5e/scene.xml", None),
    ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    ("so101/so101_new_calib.xml", "wrist_roll"),
]
QUICK = {"draws": 60, "starts": 1, "rounds": 6, "iterations": 30}


def violations(robot, plan):
    """Sentences on limits of the model that a trajectory breaks at 1 kHz."""
    limits, torque = robot.limits, ArmTorque(robot)
    for motion in motion_chunks(plan, 1000.0):
        for name, value, limit in (
            ("upper", motion.q, limits.upper),
            ("lower", -motion.q, -limits.lower),
            ("velocity", np.abs(motion.qd), limits.velocity),
            ("torque", np.abs(torque(motion)), limits.torque),
        ):
            for k, j in np.argwhere(value > limit * (1.0 + 1e-9) + 1e-12):
                yield f"{name} of {robot.joint_names[j]} at {motion.time[k]:.3f} s"


@pytest.mark.slow
@pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")
@pytest.mark.parametrize(("model", "joint"), ARMS)
def test_every_arm_gets_a_trajectory_it_can_run(model, joint):
    robot, options = load_robot_model(MODELS / model, joint=joint), ExcitationOptions(**QUICK)
    problem = build_problem(robot, LimitOptions(), top_frequency_hz=TOP_FREQUENCY_HZ)
    design = Design(problem, options, TrajectoryOptions())
    result = design_excitation(design, np.random.default_rng(1))
    assert result.limit_check.holds
    assert list(violations(robot, result.trajectory)) == []
    assert find_new_contacts(robot, motion_chunks(result.trajectory, 1000.0)) == ()
    assert result.objective < 0.8 * result.start_objective

"""Public models of real arms: the tool finds the arm and identifies its last link exactly.

Skipped where the models are not beside the checkout.
"""

from __future__ import annotations

import copy
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import TERMINAL_FRICTION, Equations, friction_per_joint
from robot_sysid.dynamics.kinematics import ArmDynamics, ChainKinematics
from robot_sysid.errors import AmbiguousJointError, ModelError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.model.inertia import body_theta, composite_theta
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.records.atomic_files import whole_files
from robot_sysid.regressor import joint_regressor
from robot_sysid.results.model import ModelTarget, write_model
from robot_sysid.results.record import Figure
from robot_sysid.simulator import ArmTorque, collect_sysid_data, simulate_inverse
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import TrajectoryOptions, generate_excitation_trajectory, motion_chunks
from tests.results.test_model import file_of, payload_of, result_of
from tests.support import arms, rank_oracle
from tests.support.model_files import random_theta
from tests.support.places import MODELS

pytestmark = pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")

# Model, terminal joint, number of joints that carry the link.
WHOLE_ARMS = [
    ("kinova_gen3/gen3_official.xml", "joint_7", 7),
    ("kinova_gen3/gen3.xml", "joint_7", 7),
    ("kinova_gen3/scene.xml", "joint_7", 7),
    ("kinova_gen3/gen3_7dof_2023.xml", "joint_7", 7),
    ("franka_panda/panda.xml", "joint7", 7),
    ("franka_panda/scene.xml", "joint7", 7),
    ("franka_panda/panda_nohand.xml", "joint7", 7),
    ("franka_fr3/FrankaFR3_7DoF.urdf", "fr3_joint7", 7),
    ("kuka_iiwa_14/iiwa14.xml", "joint7", 7),
    ("kuka_iiwa_14/scene.xml", "joint7", 7),
    ("universal_robots_ur5e/ur5e.xml", "wrist_3", 6),
    ("universal_robots_ur5e/scene.xml", "wrist_3", 6),
    ("ufactory_xarm7/xarm7.xml", "joint7", 7),
    ("ufactory_xarm7/scene.xml", "joint7", 7),
    ("ufactory_xarm7/xarm7_nohand.xml", "joint7", 7),
    ("trossen/wxai/wxai_follower.xml", "joint_5", 6),
    ("trossen/wxai/wxai_base.xml", "joint_5", 6),
    ("trossen/wxai/scene.xml", "joint_5", 6),
    ("trossen/wxai/scene_wxai_pick_place.xml", "joint_5", 6),
    ("trossen/wxai/scene_wxai_follow_target.xml", "joint_5", 6),
]
DOUBTFUL = [
    ("openarm_v2/openarm_bimanual.xml", ["openarm_left_joint7", "openarm_right_joint7"]),
    ("aloha/aloha.xml", ["left/wrist_rotate", "right/wrist_rotate"]),
    ("aloha/scene.xml", ["left/wrist_rotate", "right/wrist_rotate"]),
    ("so101/so101_new_calib.xml", ["wrist_roll", "gripper"]),
    ("so101/so101_new_calib.urdf", ["wrist_roll", "gripper"]),
    ("so101/scene.xml", ["wrist_roll", "gripper"]),
    ("franka_panda/hand.xml", ["finger_joint1", "finger_joint2"]),
    ("ufactory_xarm7/hand.xml", ["left_finger_joint", "right_finger_joint"]),
]
FRAGMENTS = [
    "aloha/keyframe_ctrl.xml",
    "aloha/keyframe_no_act.xml",
    "aloha/joint_position_actuators.xml",
    "aloha/filtered_cartesian_actuators.xml",
    "so101/joints_properties.xml",
]
GRIPPERS = ("franka_panda/hand.xml", "ufactory_xarm7/hand.xml")
CHOICES = [(model, joint) for model, joints in DOUBTFUL for joint in joints]
LONG_ENOUGH = [(model, None) for model, _, _ in WHOLE_ARMS] + [
    choice for choice in CHOICES if choice[0] not in GRIPPERS
]
SHORT = [choice for choice in CHOICES if choice[0] in GRIPPERS]
QUICK = [("kuka_iiwa_14/iiwa14.xml", None), ("so101/so101_new_calib.urdf", "gripper")]


def slow_unless_quick(choices):
    """Parametrisation in which all but a few models need ``-m slow``."""
    return [
        choice
        if choice[0] == "kuka_iiwa_14/iiwa14.xml"
        else pytest.param(*choice, marks=pytest.mark.slow)
        for choice in choices
    ]


@cache
def load(model, joint=None):
    """Models are read once; nothing here changes them."""
    path = MODELS / model
    if not path.exists():
        pytest.skip(f"{model} is not here")
    try:
        return load_robot_model(path, joint=joint)
    except ModelError as error:
        if "unrecognized attribute" in str(error):
            pytest.skip(f"{model} is written for a later MuJoCo")
        raise


def excitation(robot, duration=15.0):
    rng = np.random.default_rng(0)
    return generate_excitation_trajectory(robot, rng, duration, ArmTorque(robot))[0]


def identify(robot, plant=None):
    """Default options and seed 0; the plant is the model itself unless another is given."""
    options, motion = EstimationOptions(), TrajectoryOptions()
    terms = friction_per_joint(robot, "terminal", TERMINAL_FRICTION)
    equations = Equations(robot, options.torques, terms)
    motions = motion_chunks(excitation(robot, motion.duration), motion.sample_rate)
    information = collect_sysid_data(equations, simulate_inverse(plant or robot, motions))
    return identify_parameters(information, equations.prior)


def error_in_sizes(estimate, theta):
    """Deviation of the ten parameters, each relative to the link's mass and size."""
    scale = spatial.parameter_scale(theta[0], spatial.characteristic_length(theta))
    return np.abs(estimate.values[:10] - theta) / scale


def with_heavier_link(robot):
    """The same arm carrying 30 % more at its last link."""
    model = copy.copy(robot.mj_model)
    arms.write_body(model, robot.body_id, 1.3 * body_theta(model, robot.body_id))
    theta = composite_theta(model, robot.reference_qpos, robot.body_id)
    return model, theta


@pytest.mark.parametrize(("model", "terminal", "joints"), slow_unless_quick(WHOLE_ARMS))
def test_the_arm_is_found(model, terminal, joints):
    robot = load(model)
    assert (robot.terminal_joint, robot.n_joints) == (terminal, joints)


@pytest.mark.parametrize(("model", "joints"), slow_unless_quick(DOUBTFUL))
def test_doubt_lists_the_candidates(model, joints):
    with pytest.raises(AmbiguousJointError) as caught:
        load(model)
    assert [joint for joint, _ in caught.value.candidates] == joints
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("model", FRAGMENTS)
def test_a_fragment_is_refused_in_one_line(model):
    with pytest.raises(ModelError) as caught:
        load(model)
    assert "\n" not in str(caught.value)
    assert model.split("/")[1] in str(caught.value)


@pytest.mark.parametrize(("model", "joint"), slow_unless_quick(LONG_ENOUGH + SHORT))
def test_rest_plus_link_is_mujocos_inverse_dynamics(model, joint):
    robot = load(model, joint)
    heavier, theta = with_heavier_link(robot)
    motion = excitation(robot, 6.0).evaluate(np.linspace(0.0, 6.0, 60))
    body = ChainKinematics(robot).evaluate(motion.q, motion.qd, motion.qdd)
    rows = joint_regressor(body, range(robot.n_joints))
    predicted = body.tau_rest + (rows @ theta).T
    actual = ArmDynamics(robot, heavier).torque(motion.q, motion.qd, motion.qdd)
    np.testing.assert_allclose(predicted, actual, rtol=0.0, atol=1e-9 * np.max(np.abs(actual)))


@pytest.mark.parametrize(("model", "joint"), slow_unless_quick(LONG_ENOUGH))
def test_all_ten_parameters_are_identified(model, joint):
    robot = load(model, joint)
    estimate = identify(robot)
    theta = composite_theta(robot.mj_model, robot.reference_qpos, robot.body_id)
    assert estimate.identifiability.rank == 12
    assert np.max(error_in_sizes(estimate, theta)) < 1e-6
    friction = [robot.friction.coulomb[-1], robot.friction.viscous[-1]]
    np.testing.assert_allclose(estimate.values[10:], friction, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("model", "joint"), slow_unless_quick(LONG_ENOUGH))
def test_another_link_than_the_models_is_found(model, joint):
    """Not a run that can only return the model: the arm that is simulated carries more."""
    robot = load(model, joint)
    heavier, theta = with_heavier_link(robot)
    plant = arms.robot_of(heavier, robot.terminal_joint)
    assert np.max(error_in_sizes(identify(robot, plant), theta)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("model", "joint"), SHORT)
def test_a_short_chain_identifies_some_and_keeps_the_models_values_of_the_rest(model, joint):
    robot = load(model, joint)
    heavier, theta = with_heavier_link(robot)
    plant = arms.robot_of(heavier, robot.terminal_joint)
    estimate = identify(robot, plant)
    seen = np.array(estimate.identifiability.identified)[:10]
    assert estimate.identifiability.rank < 12
    assert np.all(error_in_sizes(estimate, theta)[seen] < 1e-6)
    assert estimate.rmse < 1e-9
    own = identify(robot)
    assert np.max(error_in_sizes(own, robot.prior.theta)) < 1e-9


@pytest.mark.parametrize(("model", "joint"), QUICK)
def test_the_last_joint_alone_keeps_what_it_cannot_see(model, joint):
    robot = load(model, joint)
    terms = friction_per_joint(robot, "terminal", TERMINAL_FRICTION)
    equations = Equations(robot, "terminal", terms)
    motions = motion_chunks(excitation(robot, 5.0), 200.0)
    information = collect_sysid_data(equations, simulate_inverse(robot, motions))
    estimate = identify_parameters(information, equations.prior)
    assert estimate.identifiability.rank <= 9
    np.testing.assert_allclose(estimate.values, equations.prior, rtol=0.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "joint"),
    [
        ("franka_panda/scene.xml", None),
        ("aloha/aloha.xml", "left/wrist_rotate"),
        ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ],
)
def test_a_payload_and_all_links_are_written_into_public_models(tmp_path, model, joint):
    """Each written model is compiled, compared and moved by the writing itself."""
    robot, rng = load(model, joint), np.random.default_rng(0)
    q, qd, qdd = arms.random_motion(rng, robot.n_joints, 5)
    thetas = np.array([link.theta + random_theta(rng, 0.5) for link in robot.links])
    numbers = {"armature": 0.1, "viscous": 0.2, "coulomb": 0.3}
    written = {name: Figure(value, 0.01) for name, value in numbers.items()}
    joints = dict.fromkeys(robot.joint_names, written)
    file = file_of(robot, thetas, joints, 9.81 * np.array([0.1, 0.0, -1.0]))
    payload = payload_of(robot, random_theta(rng, 1.0))
    with whole_files() as files:
        path = tmp_path / f"updated{robot.path.suffix}"
        target = ModelTarget(files, path, Motion(np.arange(5.0), q, qd, qdd), 0.0)
        write_model(result_of(robot, payload=payload), robot, target)
        write_model(result_of(robot, payload=payload), robot, target, "my payload")
        write_model(result_of(robot, file=file), robot, target)
    assert path.is_file()


RANK_ARMS = [
    ("kinova_gen3/gen3.xml", None),
    ("kinova_gen3/gen3_official.xml", None),
    ("franka_panda/panda.xml", None),
    ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ("kuka_iiwa_14/iiwa14.xml", None),
    ("universal_robots_ur5e/ur5e.xml", None),
    ("ufactory_xarm7/xarm7.xml", None),
    ("trossen/wxai/wxai_base.xml", None),
    ("so101/so101_new_calib.xml", "gripper"),
    ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
]
STATES = 10


@pytest.mark.slow
@pytest.mark.parametrize(("model", "joint"), RANK_ARMS)
def test_every_set_of_moving_joints_shows_what_mujoco_says(model, joint):
    """Rank and hidden directions, for the torques of all joints and of the last one alone."""
    robot, rng = load(model, joint), np.random.default_rng(0)
    joints = range(robot.n_joints)
    subsets = [c for k in range(robot.n_joints + 1) for c in combinations(joints, k)]
    first, other = (
        [
            np.concatenate(same)
            for same in zip(*(rank_oracle.moves(robot, rng, moving, STATES) for moving in subsets))
        ]
        for _ in range(2)
    )
    columns = rank_oracle.mujoco_columns(robot, *first)
    for torques, which in (("chain", slice(None)), ("terminal", slice(-1, None))):
        equations, rows = rank_oracle.rows_of(robot, torques, other)
        for index in range(len(subsets)):
            part = slice(STATES * index, STATES * (index + 1))
            information = rank_oracle.information_of(equations, [block[part] for block in rows])
            seen = rank_oracle.oracle(columns[part, which])
            rank_oracle.assert_same(information, seen)

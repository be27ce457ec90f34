"""Each term's columns are the derivative of the torque by its parameters, at any point."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.files.releases import since
from rigs.logs.payload_logs import (
    UNFILTERED,
    exact_recording,
    four_joint_arm,
    perturb_body,
    wide_motion,
)
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    gravity_vector,
    link_names,
    turn_gravity,
)
from robot_sysid.estimate.choose import motors_of, neighbours
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import DELAY, PAYLOAD_NAMES, ArmTerms, Point
from robot_sysid.spatial import PARAMETER_NAMES

ARMS = {
    "four": four_joint_arm('range="-2 2" armature=".3"'),
    "slide": small_arms.robot_of(small_arms.SLIDE_IN_CHAIN),
}
MEAN_OF_SEVEN = replace(UNFILTERED, kernel=np.full(7, 1.0 / 7.0), step=3)
LINEARISED = (
    "scale",
    "scale_drift",
    "zero",
    "zero_drift",
    "load",
    "drift",
    "tilt_1",
    "tilt_2",
    DELAY,
)
"""Parameters that multiply others: zero at the point around which they are linearised."""
PLACE = 0.7
"""Place of the recording on the axis along which friction drifts."""
STEP = 1e-5


def arm_of(robot, torques="chain"):
    """Return all terms of an arm, with two motors that turn two joints each."""
    motors = tuple(neighbours(robot))[:2] if torques == "chain" else ()
    friction = tuple(term for term in TERMS if term != "stribeck")
    return ArmTerms(robot, torques, motors, friction, loaded=True)


def random_values(arm, rng):
    """Return name to value of parameters of an arm that differs from its model."""
    values = {}
    for name in arm.names:
        if name.partition("[")[0] not in LINEARISED:
            values[name] = 0.5 * rng.uniform(0.2, 1.0)
    for link in (*arm.others, arm.robot.n_joints - 1):
        theta = perturb_body(arm.robot.links[link].theta, 0.3, rng)
        values.update(zip(names_of_link(arm, link), theta))
    values.update(zip(PAYLOAD_NAMES, 0.3 * arm.robot.prior.theta))
    return values


def names_of_link(arm, link):
    """Return the ten names of a link's parameters."""
    is_last = link == arm.robot.n_joints - 1
    return PARAMETER_NAMES if is_last else link_names(arm.robot, link)


def point_of(arm, values, gravity):
    """Return the point at some values."""
    thetas = arm.robot.thetas
    for link in (*arm.others, arm.robot.n_joints - 1):
        thetas[link] = [values[name] for name in names_of_link(arm, link)]
    payload = np.array([values[name] for name in PAYLOAD_NAMES])
    return Point(thetas, thetas, payload, gravity, values)


def torque_of(arm, motion, values, gravity, loaded):
    """Return sensor readings (N, J), by MuJoCo and by the formulas of friction."""
    robot = arm.robot
    point = point_of(arm, values, gravity)
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, point.carried_links(loaded)):
        if link.has_mass:
            small_arms.write_body(model, link.body_id, theta)
    model.dof_armature[:] = 0.0
    value_of = {**dict.fromkeys(arm.names, 0.0), **values}
    angles = np.array([value_of.get("tilt_1", 0.0), value_of.get("tilt_2", 0.0)])
    model.opt.gravity[:] = turn_gravity(gravity, angles)
    zero = np.zeros(robot.n_joints)
    for j, name in enumerate(robot.joint_names):
        zero[j] = value_of[f"zero[{name}]"] + value_of[f"zero_drift[{name}]"] * PLACE
    rigid = ArmDynamics(robot, model).torque(motion.q - zero, motion.qd, motion.qdd)
    torque = np.zeros((len(rigid), len(arm.joints)))
    for row, (j, joint) in enumerate(zip(arm.indices, arm.joints)):
        scale = value_of[f"scale[{joint}]"] + value_of[f"scale_drift[{joint}]"] * PLACE
        torque[:, row] = (1.0 + scale) * rigid[:, j]
        torque[:, row] += value_of[f"offset_drift[{joint}]"] * PLACE
        for term in set(arm.friction) & set(TERMS):
            qd = motion.qd[:, j]
            state = (np.sign(qd), qd, motion.qdd[:, j], rigid[:, j])
            column = TERMS[term].of_state(*state, arm.tops[j])
            has_drift = term not in ("offset", "armature")
            drift = 1.0 + value_of[f"drift[{joint}]"] * PLACE * has_drift
            torque[:, row] += drift * value_of[f"{term}[{joint}]"] * column
    for motor in arm.motors:
        speed = motion.qd @ motor.ratios
        sizes = [value_of[parameter.key] for parameter in motor.parameters]
        rates = (np.sign(speed), speed, motion.qdd @ motor.ratios)
        forces = np.dot(sizes, rates)
        for term in set(arm.friction) & {"bend", "quadratic", "cubic"}:
            column = TERMS[term].of_state(*rates, 0.0, motor.top)
            forces += value_of[f"{term}[{motor.name}]"] * column
        torque += np.outer(forces, motor.ratios[arm.indices])
    return torque


def record(motion, tau, arm, loaded=True, low_pass=UNFILTERED):
    """Return all rows of a recording of torques (N, J)."""
    readings = np.zeros_like(motion.q)
    readings[:, arm.indices] = tau
    recording = exact_recording(motion, readings, loaded, PLACE)
    return Rows(replace(recording, low_pass=low_pass), slice(None))


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("name", "torques", "loaded"),
    [("four", "chain", True), ("four", "terminal", True), ("slide", "chain", False)],
)
@settings(max_examples=1)
@given(seed=small_arms.SEEDS)
def test_each_column_is_the_derivative_of_the_torque(name, torques, loaded, seed):
    arm = arm_of(ARMS[name], torques)
    rng = np.random.default_rng(seed)
    values = random_values(arm, rng)
    gravity = turn_gravity(gravity_vector(arm.robot), rng.uniform(-0.5, 0.5, 2))
    motion = wide_motion(seed, arm.robot.n_joints, 0.08, 100.0)
    rows = record(motion, 0.0, arm, loaded)
    point = point_of(arm, values, gravity)
    expected = torque_of(arm, motion, values, gravity, loaded)
    assert_allclose(arm.torque(rows, point, values), expected, rtol=1e-9, atol=1e-9)
    for term in arm.terms.values():
        columns = term.columns(rows, point)
        for k, name in enumerate(term.names):
            if name == DELAY:
                expected = delay_column(arm, motion, values, gravity, loaded)
            else:
                torques = []
                for step in (STEP, -STEP):
                    moved = {**values, name: values.get(name, 0.0) + step}
                    torques.append(torque_of(arm, motion, moved, gravity, loaded))
                expected = (torques[0] - torques[1]) / (2.0 * STEP)
            error = np.max(np.abs(columns[:, :, k] - expected))
            assert error < 1e-6 * max(np.max(np.abs(expected)), 1.0), name


def delay_column(arm, motion, values, gravity, loaded):
    """Return the derivative (N, J) by a delay, of bodies, viscous friction and rotors."""
    smooth = {}
    for name, value in values.items():
        of_joint = name.startswith(("viscous[", "armature[")) and "+" not in name
        if "[" not in name or (of_joint and "-" not in name):
            smooth[name] = value
    torque = torque_of(arm, motion, smooth, gravity, loaded)
    return -np.gradient(torque, motion.time, axis=0)


@given(small_arms.SEEDS)
def test_friction_passes_the_filter_that_the_torque_has_passed(seed):
    arm = arm_of(ARMS["four"])
    values = random_values(arm, np.random.default_rng(seed))
    kinds = ("coulomb", "sqrt", "sigmoid", "fading")
    dry = {name: value for name, value in values.items() if name.startswith(kinds)}
    motion = wide_motion(seed, 4, 1.0, 100.0)
    start = arm.start()
    nothing = dict.fromkeys((*values, *PAYLOAD_NAMES), 0.0)
    tau = torque_of(arm, motion, {**nothing, **dry}, start.gravity, True)
    rows = record(motion, tau, arm, low_pass=MEAN_OF_SEVEN)
    known = arm.known(rows)
    measured = rows.recording.torque[rows.span][:, arm.indices]
    assert_allclose(arm.torque(rows, start, dry) - known, measured, atol=1e-9)


CURVED_MOTOR = small_arms.SHARED_MOTOR.replace('damping=".4"', 'damping=".9 -.3 .04"')
CURVED = {
    "nonlinear damping": small_arms.NONLINEAR_DAMPING,
    "curved motor": CURVED_MOTOR,
}


@pytest.mark.parametrize(
    "name",
    [*small_arms.MODELS, *(pytest.param(name, marks=since(3, 7)) for name in CURVED)],
)
def test_the_models_parameters_make_the_models_torque(name):
    """Inverse dynamics by MuJoCo with all springs and tendons, and friction added."""
    robot = small_arms.robot_of({**small_arms.MODELS, **CURVED}[name])
    motors, _ = motors_of(robot, "chain")
    arm = ArmTerms(robot, motors=motors)
    motion = small_arms.seeded_motion(0, robot.n_joints)
    rows = record(motion, 0.0, arm)
    friction = robot.friction.coulomb * np.sign(motion.qd)
    expected = ArmDynamics(robot).torque(motion.q, motion.qd, motion.qdd) + friction
    expected += robot.friction.viscous * motion.qd
    for motor in motors:
        dry = motor.model[0] * np.sign(motion.qd @ motor.ratios)
        expected += np.outer(dry, motor.ratios)
    torque = arm.torque(rows, arm.start(), arm.model)
    assert_allclose(torque, expected, atol=1e-9 * np.max(np.abs(expected)))

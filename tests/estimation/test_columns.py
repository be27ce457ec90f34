"""Each column is the derivative of the whole torque model, and the truth solves the equations."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.friction import NONLINEAR_TERMS, TERMS, speed_name
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    gravity_vector,
    turn_gravity,
)
from robot_sysid.estimation.choices import neighbours
from robot_sysid.estimation.columns import Columns
from robot_sysid.records import DELAY_NAME
from robot_sysid.signals import process as process_module
from robot_sysid.signals.filters import LowPass, design_low_pass
from tests.support import arms
from tests.support.payload_logs import (
    exact_recording,
    four_joint_arm,
    perturb_body,
    wide_motion,
)

ARMS = {
    "four": four_joint_arm('range="-2 2" armature=".3"'),
    "tilted gravity": arms.robot_of(arms.TILTED_GRAVITY),
    "slide": arms.robot_of(arms.SLIDE_IN_CHAIN),
}
FOUR = ARMS["four"]
RATE = 100.0
PLACE = 0.7
"""Place of the recordings on the axis along which friction drifts."""
SPEED = {"stribeck": 0.3, "sigmoid": 0.4}
UNFILTERED = LowPass(20.0, RATE, np.ones(1), 1)
MEAN_OF_SEVEN = replace(UNFILTERED, kernel=np.full(7, 1.0 / 7.0), step=3)


def true_values(columns, seed, loss=0.1):
    """Return parameters (p,) of an arm that differs from the model, with a level base.

    Columns of bodies and gravity leave out what a gear loses (``loss``), in which alone it is
    linear.
    """
    rng = np.random.default_rng(seed)
    sizes = {"scale": 0.05, "drift": 0.2, "load": loss}
    values = np.zeros(len(columns.names))
    for index, name in enumerate(columns.names):
        term, bracket, _ = name.partition("[")
        if bracket and term != "zero" and not term.endswith("_speed"):
            values[index] = sizes.get(term, 0.5) * rng.uniform(0.2, 1.0)
    for name, indices in columns.bodies().items():
        theta = perturb_body(columns.robot.prior.theta, 0.3, rng)
        values[indices] = theta * (0.3 if name == "payload" else 1.0)
    return values


def torque_of(columns, motion, values, is_loaded):
    """Return sensor readings (N, rows), by MuJoCo and by the formulas of friction."""
    value_of = dict(zip(columns.names, values.tolist()))
    rigid = rigid_torque(columns, motion, values, is_loaded)
    scaled = rigid
    if not is_loaded:
        scaled = rigid_torque(columns, motion, with_model_links(columns, values), False)
    torque = np.zeros((len(rigid), len(columns.joints)))
    for row, (j, joint) in enumerate(zip(columns.joint_indices, columns.joints)):
        qd = motion.qd[:, j]
        qdd = motion.qdd[:, j]
        dry = np.zeros_like(qd)
        for term in set(TERMS) - {"offset", "armature"}:
            column = TERMS[term](qd, qdd, rigid[:, j])
            if term in NONLINEAR_TERMS:
                vs = SPEED[term] + value_of[f"{term}_speed[{joint}]"]
                column = NONLINEAR_TERMS[term].column(qd, np.array(vs))
            dry += value_of[f"{term}[{joint}]"] * column
        torque[:, row] = rigid[:, j] + value_of[f"scale[{joint}]"] * scaled[:, j]
        torque[:, row] += (1.0 + value_of[f"drift[{joint}]"] * PLACE) * dry
        torque[:, row] += value_of[f"armature[{joint}]"] * qdd
        torque[:, row] += value_of[f"offset[{joint}]"]
    for motor in columns.couplings:
        terms = np.array([value_of[name] for name in motor.parameter_names])
        motor_torque = motor.columns(motion.qd, motion.qdd) @ terms
        torque += np.outer(motor_torque, motor.ratios[list(columns.joint_indices)])
    return torque


def with_model_links(columns, values):
    """Return values (p,) with the model's parameters of all links but the last."""
    values = values.copy()
    bodies = columns.bodies()
    for name in bodies.keys() - {columns.robot.body_name, "payload"}:
        values[bodies[name]] = columns.model_values[bodies[name]]
    return values


def rigid_torque(columns, motion, values, is_loaded):
    """Return inverse dynamics (N, n) at the true positions and under the true gravity."""
    robot = columns.robot
    value_of = dict(zip(columns.names, values.tolist()))
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, columns.thetas(values, is_loaded)):
        if link.has_mass:
            arms.write_body(model, link.body_id, theta)
    model.dof_armature[:] = 0.0
    angles = np.array([value_of["tilt_1"], value_of["tilt_2"]])
    model.opt.gravity[:] = turn_gravity(gravity_vector(robot), angles)
    zero = np.array([value_of[f"zero[{name}]"] for name in robot.joint_names])
    return ArmDynamics(robot, model).torque(motion.q - zero, motion.qd, motion.qdd)


def record(columns, values, is_loaded, seed=0, low_pass=UNFILTERED, duration=0.3):
    """Return (exact motion, columns of its recording with the torque that values make)."""
    motion = wide_motion(seed, columns.robot.n_joints, duration, RATE)
    tau = np.zeros_like(motion.q)
    tau[:, list(columns.joint_indices)] = torque_of(columns, motion, values, is_loaded)
    recording = exact_recording(motion, tau, is_loaded, PLACE)
    signals = replace(recording.source, low_pass=low_pass, position_filter=low_pass)
    datasets = [replace(recording, source=signals)]
    return motion, Columns(columns.robot, datasets, columns.torques, columns.couplings)


def point_at(columns, values, **changes):
    speed = {term: np.full(columns.robot.n_joints, vs) for term, vs in SPEED.items()}
    return replace(columns.start(), values=values, speed=speed, **changes)


def dense_rows(samples):
    """Return per joint rows (K, p), zero where a parameter is not in its equations."""
    joints = []
    for rows, columns in zip(samples.rows, samples.columns):
        joints.append(np.zeros((len(rows), len(samples.names))))
        joints[-1][:, columns] = rows
    return joints


def assert_same_equations(samples, others, atol):
    for block, other in zip((*samples.rows, *samples.tau), (*others.rows, *others.tau)):
        assert_allclose(block, other, rtol=0.0, atol=atol)


def without_dry_friction(columns, values):
    """Return the values (p,) of bodies, viscous friction and rotors, and zeros elsewhere."""
    smooth = np.zeros_like(values)
    for index, name in enumerate(columns.names):
        if name.startswith(("viscous[", "armature[")):
            smooth[index] = values[index]
    for indices in columns.bodies().values():
        smooth[indices] = values[indices]
    return smooth


@pytest.mark.parametrize(
    ("name", "torques"), [*((name, "chain") for name in ARMS), ("four", "terminal")]
)
def test_each_column_is_the_derivative_of_the_torque(name, torques):
    motors = tuple(neighbours(ARMS[name]))[:2] if torques == "chain" else ()
    bare = Columns(ARMS[name], (), torques, motors)
    values = true_values(bare, 1, loss=0.0)
    motion, columns = record(bare, values, True)
    (samples,) = columns.samples(point_at(columns, values))
    rows = np.stack(dense_rows(samples), axis=1)
    for index, parameter in enumerate(columns.names):
        if parameter == DELAY_NAME:
            smooth = without_dry_friction(columns, values)
            torque = torque_of(columns, motion, smooth, True)
            expected = -np.gradient(torque, samples.time, axis=0)
        else:
            step = 1e-5 * np.eye(len(values))[index]
            ahead = torque_of(columns, motion, values + step, True)
            behind = torque_of(columns, motion, values - step, True)
            expected = (ahead - behind) / 2e-5
        error = np.max(np.abs(rows[..., index] - expected))
        assert error < 1e-6 * max(np.max(np.abs(expected)), 1.0), parameter


@given(arms.SEEDS)
def test_the_truth_solves_the_low_passed_equations(seed):
    """With torque scales, drift, nonlinear friction, shared motors, and with or without payload."""
    bare = Columns(FOUR, (), "chain", tuple(neighbours(FOUR))[:2])
    values = true_values(bare, seed)
    for is_loaded in (False, True):
        _, columns = record(bare, values, is_loaded, seed, MEAN_OF_SEVEN)
        (samples,) = columns.samples(point_at(columns, values, exact_load=True))
        for rows, tau in zip(dense_rows(samples), samples.tau):
            error = np.max(np.abs(rows @ values - tau))
            assert error < 1e-9 * max(np.max(np.abs(tau)), 1.0)


@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("angle", [0.02, 0.5])
def test_rows_under_another_gravity_are_those_made_for_it(torques, angle):
    """The effect of a small turn is not filtered anew, to within 1e-4; that of a large one is."""
    bare = Columns(FOUR, (), torques)
    values = true_values(bare, 3)
    low_pass = design_low_pass(20.0, RATE)
    _, columns = record(bare, values, True, 3, low_pass, duration=2.0)
    columns.samples(columns.start())
    down = turn_gravity(gravity_vector(FOUR), np.full(2, angle))
    point = point_at(columns, values, gravity=down)
    (samples,) = columns.samples(point)
    (anew,) = Columns(columns.robot, columns.datasets, torques).samples(point)
    assert_same_equations(samples, anew, 1e-3 * angle * (angle < 0.1))


@given(arms.SEEDS)
def test_a_step_changes_no_speed_of_friction_by_more_than_a_factor_of_two(seed):
    """A column's slope tells nothing of far speeds, and a full step can end at a bound for good."""
    rng = np.random.default_rng(seed)
    columns = Columns(FOUR, ())
    point = columns.start()
    names = [speed_name("stribeck", joint) for joint in columns.joints]
    values = np.zeros(len(columns.names))
    values[columns.indices(names)] = rng.choice([0.01, 1.0]) * rng.normal(size=4)
    steps = values[columns.indices(names)]
    old = point.speed["stribeck"]
    new = columns.move_point(point, values, names).speed["stribeck"]
    assert_array_equal(new, np.clip(old + steps, old / 2.0, 2.0 * old))
    low, high = NONLINEAR_TERMS["stribeck"].bounds
    assert np.all((new >= low) & (new <= high))


def test_a_file_has_the_columns_of_the_arm_that_it_can_hold():
    bare = Columns(FOUR, ())
    values = true_values(bare, 5)
    for name in (*bare._scales, *bare._drifts):
        values[bare.index[name]] = 0.0
    for is_loaded in (False, True):
        _, columns = record(bare, values, is_loaded, 5)
        point = point_at(columns, values)
        (of_arm,) = columns.samples(point)
        (of_file,) = columns.samples(replace(point, in_file=True))
        for joint, dense in enumerate(dense_rows(of_arm)):
            file_columns = dense[:, of_file.columns[joint]]
            assert_array_equal(of_file.rows[joint], file_columns)
            assert_array_equal(of_file.tau[joint], of_arm.tau[joint])


def test_the_chunk_size_changes_nothing(monkeypatch):
    bare = Columns(FOUR, ())
    values = true_values(bare, 4)
    _, columns = record(bare, values, True, 4, MEAN_OF_SEVEN)
    point = point_at(columns, values, exact_load=True)
    (samples,) = columns.samples(point)
    monkeypatch.setattr(process_module, "CHUNK", 7)
    (in_chunks,) = Columns(columns.robot, columns.datasets).samples(point)
    assert_same_equations(samples, in_chunks, 1e-12)

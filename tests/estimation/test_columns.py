"""Each column is the derivative of the whole torque model, and the truth solves the equations."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.friction import BENT, TERMS
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.dynamics.nuisances import gravity, turned
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.couplings import neighbours
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
RATE = 100.0
PLACE = 0.7
SPEED = {"stribeck": 0.3, "sigmoid": 0.4}
UNFILTERED = LowPass(20.0, RATE, np.ones(1), 1)


def true_values(columns, seed, loss=0.1):
    """Parameters (p,) of an arm that is another one than the model, at level with it.

    What a gear loses is linear in the loss alone: columns of bodies and gravity leave it out.
    """
    rng = np.random.default_rng(seed)
    sizes = {"scale": 0.05, "drift": 0.2, "load": loss}
    values = np.zeros(len(columns.names))
    for index, name in enumerate(columns.names):
        term, bracket, _ = name.partition("[")
        if bracket and term != "zero" and not term.endswith("_speed"):
            values[index] = sizes.get(term, 0.5) * rng.uniform(0.2, 1.0)
    for name, places in columns.bodies().items():
        values[places] = perturb_body(columns.robot.prior.theta, 0.3, rng)
        values[places] *= 0.3 if name == "payload" else 1.0
    return values


def torque_of(columns, motion, values, is_loaded):
    """What the torque sensors of the arm read (N, rows), by MuJoCo and the friction's formulas."""
    known = dict(zip(columns.names, values.tolist()))
    rigid = rigid_torque(columns, motion, values, is_loaded)
    scaled = (
        rigid
        if is_loaded
        else rigid_torque(columns, motion, as_modelled(columns, values), 0)
    )
    found = np.zeros((len(rigid), len(columns.joints)))
    for row, (j, name) in enumerate(zip(columns.rows_of, columns.joints)):
        qd = motion.qd[:, j]
        qdd = motion.qdd[:, j]
        dry = np.zeros_like(qd)
        for term in set(TERMS) - {"offset", "armature"}:
            column = TERMS[term](qd, qdd, rigid[:, j])
            if term in BENT:
                vs = SPEED[term] + known[f"{term}_speed[{name}]"]
                column = BENT[term].column(qd, np.array(vs))
            dry += known[f"{term}[{name}]"] * column
        found[:, row] = rigid[:, j] + known[f"scale[{name}]"] * scaled[:, j]
        found[:, row] += (1.0 + known[f"drift[{name}]"] * PLACE) * dry
        found[:, row] += known[f"armature[{name}]"] * qdd + known[f"offset[{name}]"]
    for motor in columns.couplings:
        own = np.array([known[name] for name in motor.parameter_names])
        torque = motor.columns(motion.qd, motion.qdd) @ own
        found += np.outer(torque, motor.ratios[list(columns.rows_of)])
    return found


def as_modelled(columns, values):
    """Values of an arm whose other links are the model's."""
    found = values.copy()
    bodies = columns.bodies()
    for name in bodies.keys() - {columns.robot.body_name, "payload"}:
        found[bodies[name]] = columns.prior[bodies[name]]
    return found


def rigid_torque(columns, motion, values, is_loaded):
    """Inverse dynamics (N, n) at the true positions and under the true gravity."""
    robot = columns.robot
    known = dict(zip(columns.names, values.tolist()))
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, columns.thetas(values, is_loaded)):
        if link.has_mass:
            arms.write_body(model, link.body_id, theta)
    model.dof_armature[:] = 0.0
    angles = np.array([known["tilt_1"], known["tilt_2"]])
    model.opt.gravity[:] = turned(gravity(robot), angles)
    zero = np.array([known[f"zero[{name}]"] for name in robot.joint_names])
    return ArmDynamics(robot, model).torque(motion.q - zero, motion.qd, motion.qdd)


def recorded(columns, values, is_loaded, seed=0, low_pass=UNFILTERED, duration=0.3):
    """(motion, the columns of its recording): torques that these values make, motion exact."""
    motion = wide_motion(seed, columns.robot.n_joints, duration, RATE)
    tau = np.zeros_like(motion.q)
    tau[:, list(columns.rows_of)] = torque_of(columns, motion, values, is_loaded)
    made = exact_recording(motion, tau, is_loaded, PLACE)
    made = replace(made, source=replace(made.source, low_pass=low_pass, flat=low_pass))
    couplings = columns.couplings
    return motion, Columns(columns.robot, [made], columns.torques, couplings)


def point_at(columns, values, **more):
    speed = {term: np.full(columns.robot.n_joints, vs) for term, vs in SPEED.items()}
    return replace(columns.start(), values=values, speed=speed, **more)


def dense(samples):
    """Per joint (K, p), zero where a parameter is not in its equations."""
    for rows, places in zip(samples.rows, samples.columns):
        full = np.zeros((len(rows), len(samples.names)))
        full[:, places] = rows
        yield full


def without_dry_friction(columns, values):
    """Values of what follows smoothly from the motion."""
    found = values.copy()
    bodies = {k for at in columns.bodies().values() for k in at}
    for index, name in enumerate(columns.names):
        if index not in bodies and name.partition("[")[0] not in (
            "viscous",
            "armature",
        ):
            found[index] = 0.0
    return found


@pytest.mark.parametrize(
    ("name", "torques"), [*((name, "chain") for name in ARMS), ("four", "terminal")]
)
def test_each_column_is_the_derivative_of_the_torque(name, torques):
    motors = tuple(neighbours(ARMS[name]))[:2] if torques == "chain" else ()
    bare = Columns(ARMS[name], (), torques, motors)
    values = true_values(bare, 1, loss=0.0)
    motion, columns = recorded(bare, values, True)
    (samples,) = columns.samples(point_at(columns, values))
    full = np.stack(list(dense(samples)), axis=1)
    for index, parameter in enumerate(columns.names):
        if parameter == DELAY_NAME:
            smooth = torque_of(
                columns, motion, without_dry_friction(columns, values), True
            )
            expected = -np.gradient(smooth, samples.time, axis=0)
        else:
            step = 1e-5 * np.eye(len(values))[index]
            up, down = (
                torque_of(columns, motion, values + s * step, True) for s in (1, -1)
            )
            expected = (up - down) / 2e-5
        off = np.max(np.abs(full[..., index] - expected))
        assert off < 1e-6 * max(np.max(np.abs(expected)), 1.0), parameter


@given(arms.SEEDS)
def test_the_truth_solves_the_equations(seed):
    """Whatever is scaled, drifts, bends, is shared or carried, and through a low-pass."""
    robot = ARMS["four"]
    bare = Columns(robot, (), "chain", tuple(neighbours(robot))[:2])
    values = true_values(bare, seed)
    for is_loaded in (False, True):
        low_pass = replace(UNFILTERED, kernel=np.full(7, 1.0 / 7.0), step=3)
        _, columns = recorded(bare, values, is_loaded, seed, low_pass)
        (samples,) = columns.samples(point_at(columns, values, exact_load=True))
        for rows, tau in zip(dense(samples), samples.tau):
            off = np.max(np.abs(rows @ values - tau))
            assert off < 1e-9 * max(np.max(np.abs(tau)), 1.0)


@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("angle", [0.02, 0.5])
def test_rows_under_another_gravity_are_those_made_for_it(torques, angle):
    """A small turn's part is not filtered anew, which leaves 1e-4 of it; a large one's is."""
    bare = Columns(ARMS["four"], (), torques)
    values = true_values(bare, 3)
    low_pass = design_low_pass(20.0, RATE)
    _, columns = recorded(bare, values, True, 3, low_pass, duration=2.0)
    columns.samples(columns.start())
    point = point_at(
        columns, values, gravity=turned(gravity(ARMS["four"]), np.full(2, angle))
    )
    (found,) = columns.samples(point)
    (anew,) = Columns(columns.robot, columns.datasets, torques).samples(point)
    for mine, other in zip((*found.rows, *found.tau), (*anew.rows, *anew.tau)):
        assert_allclose(mine, other, rtol=0.0, atol=1e-3 * angle * (angle < 0.1))


def test_a_file_has_the_same_columns_as_the_arm_that_they_are_of():
    bare = Columns(ARMS["four"], ())
    values = true_values(bare, 5)
    for name in (*bare._scales, *bare._drifts):
        values[bare.place[name]] = 0.0
    for is_loaded in (False, True):
        _, columns = recorded(bare, values, is_loaded, 5)
        point = point_at(columns, values)
        (every,), (some,) = (
            columns.samples(replace(point, in_file=f)) for f in (False, True)
        )
        pairs = zip(some.columns, some.rows, some.tau, dense(every), every.tau)
        for places, rows, tau, whole, side in pairs:
            assert_array_equal(rows, whole[:, places])
            assert_array_equal(tau, side)


def test_the_chunk_size_changes_nothing(monkeypatch):
    low_pass = replace(UNFILTERED, kernel=np.full(7, 1.0 / 7.0), step=3)
    bare = Columns(ARMS["four"], ())
    values = true_values(bare, 4)
    _, columns = recorded(bare, values, True, 4, low_pass)
    point = point_at(columns, values, exact_load=True)
    (whole,) = columns.samples(point)
    monkeypatch.setattr(process_module, "CHUNK", 7)
    (parts,) = Columns(columns.robot, columns.datasets).samples(point)
    for one, other in zip((*whole.rows, *whole.tau), (*parts.rows, *parts.tau)):
        assert_allclose(one, other, rtol=0.0, atol=1e-12)

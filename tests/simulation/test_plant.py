"""A plant's measurements, the laws of its sensors, and which model may be a plant.

Beside them a closed loop in MuJoCo with its own friction, which reports effective torques: an
identification from them proves the whole computation from positions and torques.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.parser import load_robot_model
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulation.plant import PlantSimulation, load_plant, round_to_multiples
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import SineTrajectory
from tests.support import arms
from tests.support import closed_loop_proof as proof
from tests.support.arms import (
    FREE_OBJECT_BESIDE,
    SEEDS,
    SEVEN,
    THREE,
    X,
    Y,
    Z,
    robot_of,
    serial_arm,
)
from tests.support.closed_loop import ClosedLoop, ForwardPlant


def swing(robot, speed=1.0, duration=4.0, frequency=0.5):
    """All joints swing at one frequency, each in a phase of its own, up to about this speed."""
    shape = (robot.n_joints, 1)
    amplitude = np.full(shape, speed / (2.0 * np.pi * frequency))
    amplitude[robot.is_slide] *= 0.1
    phase = np.arange(robot.n_joints, dtype=float)[:, None]
    frequencies = np.full(shape, frequency)
    fade = 0.25 * duration
    return SineTrajectory(
        robot.reference, amplitude, frequencies, phase, duration, fade
    )


@pytest.mark.parametrize(
    "name", ["seven", "slide in chain", "coupled fingers", "dry friction"]
)
def test_the_log_obeys_the_equations_of_motion_and_the_trajectory_is_followed(name):
    robot = robot_of(arms.MODELS[name])
    plan = swing(robot, duration=1.0)
    loop = ClosedLoop(robot, plan, 500.0)
    log = proof.record_run(loop)
    ramp = ForwardPlant(robot, loop.period, robot.reference[None]).ramp
    expected = ArmDynamics(robot).torque(log.q, log.qd, log.qdd)
    expected += robot.friction.viscous * log.qd + proof.ramp_torque(
        ramp, log.qd, log.qdd
    )
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(log.tau, expected, rtol=0.0, atol=1e-8 * scale)
    assert np.max(np.abs(log.q - plan.evaluate(log.time).q)) < 1e-3


def effective_torque_error(robot, sample_rate):
    """RMS of (reported torque - inverse dynamics of the differentiated positions) [N m]."""
    loop = ClosedLoop(robot, swing(robot, speed=2.0), sample_rate)
    log = proof.differentiate_log(proof.record_run(loop), sample_rate)
    expected = (
        ArmDynamics(robot).torque(log.q, log.qd, log.qdd)
        + robot.friction.viscous * log.qd
    )
    return float(np.sqrt(np.mean((log.tau - expected) ** 2)))


def test_reported_torque_is_the_effective_torque_to_second_order_in_the_period():
    robot = robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X), joint='damping="2"'))
    coarse, fine = (effective_torque_error(robot, rate) for rate in (500.0, 1000.0))
    # A first-order error, such as apparent armature h damping / 2, would only halve.
    assert coarse / fine > 3.5
    # Damping 2 N m s/rad, accelerations of 6 rad/s^2: apparent armature would leave 6e-3 N m.
    assert fine < 1e-4


@pytest.mark.parametrize(
    ("rate", "period"), [(1000.0, 1e-3), (100.0, 2e-3), (300.0, 1.0 / 600.0)]
)
def test_the_control_period_divides_the_sample_period_and_is_at_most_the_models_step(
    rate, period
):
    robot = robot_of(arms.THREE)
    assert ClosedLoop(robot, swing(robot), rate).period == pytest.approx(
        period, rel=1e-12
    )


@pytest.fixture(scope="module")
def arm():
    """The seven-joint arm without friction of its own, as the engineer believes it to be."""
    return robot_of(arms.serial_arm(arms.SEVEN_AXES))


@pytest.fixture(scope="module")
def proof_errors(arm):
    """Closed-loop run of a plant with armature and dry friction."""
    return proof.proof_run(arm, proof.excitation(arm, duration=8.0), 500.0)


def test_mass_and_friction_come_back_from_positions_and_torques(proof_errors):
    errors, _, _ = proof_errors
    assert errors.mass < 0.002
    assert errors.coulomb < 0.02 and errors.viscous < 0.02 and errors.armature < 0.02


def test_without_leaving_out_the_ramp_friction_would_be_wrong(arm, proof_errors):
    _, log, _ = proof_errors
    plant = proof.plant_from(arm)
    assert proof.errors_of(proof.identify_log(arm, log, 0.0), plant).viscous > 0.2


RATE = 200.0


@pytest.fixture(scope="module")
def plant():
    """A small arm with armature and dry friction."""
    joint = 'range="-2 2" frictionloss=".3" damping=".2" armature=".1"'
    return robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=joint))


@pytest.fixture(scope="module")
def plan(plant):
    """Five seconds of motion."""
    return proof.excitation(plant, duration=5.0)


def run(plant, plan, **sensors):
    """One simulation with these sensors."""
    options = SimulatedArmOptions(**sensors)
    return PlantSimulation(plant, plan, options, RATE, np.random.default_rng(5))


def read(plant, plan, **sensors):
    """The measurements of one simulation, joined."""
    return join_measurements(run(plant, plan, **sensors))


def test_noise_has_its_standard_deviation_in_every_joint(plant):
    plan = proof.excitation(plant, duration=300.0)
    levels = np.array([0.1, 0.5, 2.0])
    exact = read(plant, plan)
    noisy = read(plant, plan, noise_torque=tuple(levels), encoder_resolution=0.02)
    # An arm with only encoders would have to compute them from the rounded positions.
    assert noisy.qd is None and noisy.qdd is None
    # 60 000 draws: the spread of an estimated deviation is 0.3 %; 1.5 % is five times that.
    np.testing.assert_allclose(
        np.std(noisy.tau - exact.tau, axis=0), levels, rtol=0.015
    )
    assert np.max(np.abs(noisy.q - exact.q)) <= 0.01 * (1.0 + 1e-9)


@given(st.floats(1e-6, 0.1), SEEDS)
def test_rounded_positions_are_the_nearest_multiples_of_the_step(step, seed):
    values = np.random.default_rng(seed).normal(size=50)
    rounded = round_to_multiples(values, step)
    assert np.all(np.abs(rounded - values) <= 0.5 * step * (1.0 + 1e-9))
    steps = rounded / step
    np.testing.assert_allclose(steps, np.round(steps), rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(round_to_multiples(rounded, step), rounded)


THREE_JOINTS = robot_of(THREE)


@given(st.floats(0.0, 0.05))
def test_a_delayed_torque_is_that_of_the_earlier_motion(delay):
    plan = proof.excitation(THREE_JOINTS, duration=2.0)
    log = read(THREE_JOINTS, plan, torque_delay=delay)
    earlier = plan.evaluate(np.maximum(log.time - delay, 0.0))
    tau = ArmTorque(THREE_JOINTS)(earlier)
    np.testing.assert_allclose(log.tau, tau, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(log.q, plan.evaluate(log.time).q)


@pytest.mark.parametrize(
    ("sensors", "option"),
    [
        ({"noise_torque": -0.1}, "--noise-torque"),
        ({"torque_delay": 5.0}, "--torque-delay"),
    ],
)
def test_impossible_sensors_are_refused_by_the_option_name(sensors, option):
    with pytest.raises(InputError, match=option):
        SimulatedArmOptions(**sensors)


def test_forward_and_inverse_agree_where_friction_is_complete(plant, plan):
    forward = proof.record_run(ClosedLoop(plant, plan, RATE))
    inverse = read(plant, plan)
    np.testing.assert_array_equal(forward.time, inverse.time)
    fast = np.abs(inverse.qd) > 0.1
    # The loop follows within 1e-4 rad and 1e-2 rad/s^2 of its trajectory away from reversals.
    difference = np.abs(forward.tau - inverse.tau)[fast]
    assert np.median(difference) < 1e-3 and np.max(difference) < 0.1


def test_reading_twice_gives_the_same_measurements(plant, plan):
    measurements = run(plant, plan, noise_torque=0.1, encoder_resolution=1e-4)
    first = join_measurements(measurements)
    second = join_measurements(measurements)
    np.testing.assert_array_equal(first.tau, second.tau)
    np.testing.assert_array_equal(first.q, second.q)


def test_noise_levels_and_trajectory_must_fit_the_plant(plant, plan):
    with pytest.raises(
        InputError,
        match="--noise-torque takes one number, or one for each of the 3 joints",
    ):
        run(plant, plan, noise_torque=(0.1, 0.2))
    other = robot_of(arms.SEVEN)
    with pytest.raises(InputError, match="moves 3 joints, the plant has 7"):
        run(other, plan)


@pytest.fixture
def robot(arm_file):
    """The three-joint arm from a file."""
    return load_robot_model(arm_file(THREE))


def test_a_plant_keeps_its_own_inertials_friction_and_armature(robot, arm_file):
    joint = 'range="-2 2" frictionloss=".7" damping=".3" armature=".05"'
    heavier = serial_arm((Z, Y, X), joint=joint).replace('mass=".8"', 'mass="1.9"')
    plant = load_plant(robot, arm_file(heavier, "plant.xml"))
    assert plant.joint_names == robot.joint_names
    assert plant.prior.mass == pytest.approx(1.9, rel=1e-12)
    np.testing.assert_array_equal(plant.friction.coulomb, 0.7)
    np.testing.assert_array_equal(plant.mj_model.dof_armature[plant.dof_index], 0.05)
    assert plant.notes == ()


def test_a_plant_may_have_other_things_around_the_arm(robot, arm_file):
    plant = load_plant(robot, arm_file(FREE_OBJECT_BESIDE, "plant.xml"))
    assert plant.joint_names == robot.joint_names
    assert plant.notes == ("joints only the plant has are held still: door_hinge",)


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (
            SEVEN.replace("joint2", "j2"),
            "has no joint joint2, the last joint of arm.xml.*j2",
        ),
        (
            THREE.replace("joint1", "roll"),
            "joint0, roll, joint2 instead of joint0, joint1, joint2",
        ),
        (
            THREE.replace('name="joint1"', 'name="joint1" type="slide"'),
            "joint1 is a slide instead of a hinge",
        ),
        (
            THREE.replace("joint0", "t")
            .replace("joint1", "joint0")
            .replace('"t"', '"joint1"'),
            "joint1, joint0, joint2 instead of joint0, joint1, joint2",
        ),
    ],
)
def test_a_plant_with_other_joints_is_refused_with_a_list(
    robot, arm_file, xml, message
):
    with pytest.raises(InputError, match=message):
        load_plant(robot, arm_file(xml, "plant.xml"))


def test_another_geometry_is_allowed_and_noted(robot, arm_file):
    longer = arm_file(THREE.replace('pos="0 .02 .25"', 'pos="0 .02 .251"'), "plant.xml")
    (note,) = load_plant(robot, longer).notes
    assert "mm from where the model has it" in note

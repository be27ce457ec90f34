"""Motors that turn several joints."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.equations import NO_FRICTION, Equations
from robot_sysid.dynamics.friction import DEFAULT_MEASURED, friction_model
from robot_sysid.errors import InputError
from robot_sysid.estimation.choices import (
    coupling,
    couplings_of,
    couplings_of_model,
    read_couplings,
)
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Measurement, Motion
from robot_sysid.simulator import simulate_inverse
from tests.support import arms
from tests.support.releases import since


@pytest.fixture(scope="module")
def wrist():
    """Return an arm whose model has a motor that turns two joints."""
    return arms.robot_of(arms.SHARED_MOTOR)


@since(3, 3)
@pytest.mark.parametrize("friction", [NO_FRICTION, friction_model(DEFAULT_MEASURED)])
def test_a_motor_of_the_model_is_in_the_torque_whether_estimated_or_not(
    wrist, friction
):
    (motor,) = couplings_of_model(wrist)
    assert motor.name == "joint1-2*joint2" and motor.tendon == 0
    assert_array_equal(motor.model[:3], [1.5, 0.4, 0.03])
    motion = Motion(
        np.arange(20.0), *arms.random_motion(np.random.default_rng(0), 3, 20)
    )
    (measured,) = simulate_inverse(wrist, [motion])
    for motors in ((), (motor,)):
        equations = Equations(wrist, "chain", (friction,) * 3, motors)
        for (rows, tau), columns in zip(equations.rows(measured), equations.columns):
            assert_allclose(rows @ equations.prior[columns], tau, atol=1e-10)


@since(3, 3)
def test_motors_of_the_model_are_neither_candidates_nor_counted_twice(wrist, tmp_path):
    motors, candidates = couplings_of(wrist, EstimationOptions())
    assert [motor.tendon for motor in motors] == [0, None, None, None, None]
    assert motors[1:] == candidates
    content = {"m": {"joint1": -1.5, "joint2": 3.0}, "n": {"joint0": 1, "joint1": 1}}
    options = EstimationOptions(coupling=write_couplings(tmp_path, content))
    motors, candidates = couplings_of(wrist, options)
    names = [motor.name for motor in motors]
    assert names == ["joint1-2*joint2", "joint0+joint1"] and not candidates


def test_a_spring_or_a_tendon_to_a_held_joint_is_no_motor():
    spring = arms.TENDON_SPRING.replace('damping="3"', "")
    assert couplings_of_model(arms.robot_of(spring)) == ()
    (damper,) = couplings_of_model(arms.robot_of(arms.TENDON_SPRING))
    assert damper.model[1] == 3.0 and not np.any(damper.model[[0, 2]])
    shorter_arm = arms.robot_of(arms.TENDON_SPRING, joint="joint1")
    assert couplings_of_model(shorter_arm) == ()


def write_couplings(folder, content):
    """Write JSON, or text as it is, and return the path."""
    path = folder / "coupling.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_joints_and_motor_have_the_same_power(three_joint_arm):
    """tau^T qd = tau_motor s, whatever the ratios."""
    qd, qdd, q, tau = np.random.default_rng(0).normal(size=(4, 5, 3))
    motor = coupling(three_joint_arm, np.array([0.5, 0.0, -2.0]))
    equations = Equations(three_joint_arm, "chain", (NO_FRICTION,) * 3, (motor,))
    rows_of_joints = equations.rows(Measurement(np.arange(5.0), q, qd, tau, qdd))
    power = np.zeros((len(equations.names), 5))
    for joint, (rows, _) in enumerate(rows_of_joints):
        power[equations.columns[joint]] += rows.T * qd[:, joint]
    speed = qd @ motor.ratios
    for term, expected in (("viscous", speed**2), ("coulomb", np.abs(speed))):
        index = equations.names.index(f"{term}[{motor.name}]")
        assert power[index] == pytest.approx(expected)


@pytest.mark.parametrize(
    "content",
    [
        {"motor_3": {"joint1": 1, "joint2": 1.0}, "motor_1": {"joint0": 3.0}},
        [[1, 0, 0], [0, 1, 0], [0, 1, 1]],
    ],
)
def test_a_file_names_motors_or_holds_a_matrix(three_joint_arm, tmp_path, content):
    (motor,) = read_couplings(write_couplings(tmp_path, content), three_joint_arm)
    assert motor.name == "joint1+joint2"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not JSON"),
        ({"m": {"wrist": 1.0}}, "no joint of the arm: joint0, joint1, joint2"),
        ({"m": {"joint1": "fast"}}, "must be like"),
        ({"m": {"joint1": True}}, "must be like"),
        ('{"m": {"joint1": NaN}}', "must be like"),
        ([[1, 0]], "3 finite numbers in each row"),
        ("3", "must be like"),
    ],
)
def test_a_wrong_file_is_refused(three_joint_arm, tmp_path, content, message):
    with pytest.raises(InputError, match=message):
        read_couplings(write_couplings(tmp_path, content), three_joint_arm)

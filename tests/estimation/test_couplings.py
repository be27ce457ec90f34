"""Motors that turn with several joints."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics.equations import NO_FRICTION, Equations
from robot_sysid.dynamics.friction import DEFAULT_MEASURED, friction_model
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.couplings import (
    coupling,
    couplings_of,
    couplings_of_model,
    read_couplings,
)
from robot_sysid.records import Measurement, Motion
from robot_sysid.simulator import simulate_inverse
from tests.support import arms
from tests.support.releases import since


@pytest.fixture(scope="module")
def robot():
    return arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X)))


@pytest.fixture(scope="module")
def wrist():
    """An arm whose model has a motor that turns two joints."""
    return arms.robot_of(arms.SHARED_MOTOR)


@since(3, 3)
@pytest.mark.parametrize("friction", [NO_FRICTION, friction_model(DEFAULT_MEASURED)])
def test_a_motor_of_the_model_is_in_the_torque_whether_it_is_sought_or_not(
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
def test_what_the_model_has_is_neither_offered_nor_counted_twice(wrist, tmp_path):
    every, offered = couplings_of(wrist, EstimationOptions())
    assert [motor.tendon for motor in every] == [0, *(None,) * 4] and every[
        1:
    ] == offered
    path = written(
        tmp_path,
        {"m": {"joint1": -1.5, "joint2": 3.0}, "n": {"joint0": 1, "joint1": 1}},
    )
    every, offered = couplings_of(wrist, EstimationOptions(coupling=path))
    assert [motor.name for motor in every] == [
        "joint1-2*joint2",
        "joint0+joint1",
    ] and not offered


def test_a_tendon_that_only_pulls_or_leads_elsewhere_is_no_motor():
    spring = arms.TENDON_SPRING.replace('damping="3"', "")
    assert couplings_of_model(arms.robot_of(spring)) == ()
    (damper,) = couplings_of_model(arms.robot_of(arms.TENDON_SPRING))
    assert damper.model[1] == 3.0 and not np.any(damper.model[[0, 2]])
    # Of a shorter arm, the other joint is held.
    assert couplings_of_model(arms.robot_of(arms.TENDON_SPRING, joint="joint1")) == ()


def written(tmp_path, content):
    path = tmp_path / "coupling.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_power_is_the_same_on_both_sides(robot):
    """tau^T qd = tau_motor s, whatever the ratios."""
    qd, qdd, q, tau = np.random.default_rng(0).normal(size=(4, 5, 3))
    each = coupling(robot, np.array([0.5, 0.0, -2.0]))
    equations = Equations(robot, "chain", (NO_FRICTION,) * 3, (each,))
    rows = equations.rows(Measurement(np.arange(5.0), q, qd, tau, qdd))
    power = dict.fromkeys(each.parameter_names, 0.0)
    for joint, ((block, _), columns) in enumerate(zip(rows, equations.columns)):
        for column, place in zip(block.T, columns):
            if equations.names[place] in power:
                power[equations.names[place]] += column * qd[:, joint]
    speed = qd @ each.ratios
    assert power[f"viscous[{each.name}]"] == pytest.approx(speed**2)
    assert power[f"coulomb[{each.name}]"] == pytest.approx(np.abs(speed))


def test_a_file_may_name_motors_or_hold_a_matrix(robot, tmp_path):
    named = {"motor_3": {"joint1": 1, "joint2": 1.0}, "motor_1": {"joint0": 3.0}}
    matrix = [[1, 0, 0], [0, 1, 0], [0, 1, 1]]
    for content in (named, matrix):
        (found,) = read_couplings(written(tmp_path, content), robot)
        assert found.name == "joint1+joint2"


@pytest.mark.parametrize(
    ("content", "said"),
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
def test_what_does_not_fit_is_refused(robot, tmp_path, content, said):
    with pytest.raises(InputError, match=said):
        read_couplings(written(tmp_path, content), robot)

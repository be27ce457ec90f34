"""Motors that turn with several joints."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_sysid.dynamics.equations import NO_FRICTION, Equations
from robot_sysid.errors import InputError
from robot_sysid.estimation.couplings import coupling, read_couplings
from robot_sysid.records import Measurement
from tests.support import arms


@pytest.fixture(scope="module")
def robot():
    return arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X)))


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

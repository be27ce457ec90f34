"""Motors that turn with several joints."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.estimation.couplings import COUPLED_TERMS, coupling, read_couplings
from robot_sysid.records import Motion
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
    rng = np.random.default_rng(0)
    motion = Motion(np.arange(5.0), *rng.normal(size=(3, 5, 3)))
    each = coupling(robot, np.array([0.5, 0.0, -2.0]))
    columns = each.columns(motion)
    speed = motion.qd @ each.ratios
    power = np.einsum("njt,nj->nt", columns, motion.qd)
    place = {term: index for index, term in enumerate(COUPLED_TERMS)}
    assert power[:, place["viscous"]] == pytest.approx(speed**2)
    assert power[:, place["coulomb"]] == pytest.approx(np.abs(speed))


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

"""Settings files of drivers get identified numbers and stay otherwise as they are.

Names and structure are those of the public sources: ``i2rt/robots/config/yam.yml`` of
github.com/i2rt-robotics/i2rt (``coulomb_friction`` since its release 1.1.1, ``friction_comp`` with
``breakaway`` on another branch), which reads a list of N m per arm joint, the gripper's motor left
out; and ``config/follower.yaml`` of github.com/enactic/openarm_teleop, which reads eight numbers
per field, the gripper's last, and commands ``Fc tanh(0.1 k v) + Fv v + Fo``. The numbers are made
up.
"""

from __future__ import annotations

import pytest

from robot_sysid.errors import InputError
from robot_sysid.results.driver_settings import (
    require_driver_settings,
    updated_settings,
)
from tests.support import results

I2RT = """\
motor_list:
  - [0x01, "DM4340"]
  - [0x02, "DM4310"]

directions: [1, 1]
kp: [70.0, 30.0]
gravity_comp_factor: [1.2, 1.1]
grav_comp_kd:        [0.2, 0.1]
coulomb_friction:    [0.9, 0.8]  # by hand
"""
I2RT_BREAKAWAY = """\
gravity_comp_factor: [1.2, 1.1]

friction_comp:
  enable: false
  breakaway: [0.0, 0.0]
  eps: 0.02
"""
OPENARM = """\
FollowerArmParam:
  Dn: [0.4, 0.4, 0.1]
  # Fc: [0.0, 0.0, 0.0]
  Kf: [1.1, 1.2, 1.3]
  Fc: [0.9, 0.8, 0.07]
  k:  [20.5, 20.5, 5.0]
  Fv: [0.06, 0.05, 0.08]
  Fo: [0.01, 0.02, -0.05]
"""


@pytest.fixture
def result():
    """A result of joints j5 and j6: new friction of j5; j6 keeps its 0.2 N m of the model."""
    return results.whole()


def changed_lines(text, result, scales=(1.0, 1.0)):
    """Return the lines that differ from those before."""
    after = updated_settings(text, result, scales).splitlines()
    before = text.splitlines()
    assert len(after) == len(before)
    return [new for old, new in zip(before, after) if old != new]


def test_i2rt_gets_friction_and_a_factor_of_one_for_a_model_that_is_right(result):
    assert changed_lines(I2RT, result) == [
        "gravity_comp_factor: [1, 1]",
        "coulomb_friction:    [0.45, 0.2]  # by hand",
    ]
    assert changed_lines(I2RT_BREAKAWAY, result) == [
        "gravity_comp_factor: [1, 1]",
        "  breakaway: [0.45, 0.2]",
    ]


def test_openarm_keeps_the_numbers_of_its_gripper(result):
    assert changed_lines(OPENARM, result) == [
        "  Fc: [0.45, 0.2, 0.07]",
        "  Fv: [0.25, 0, 0.08]",
    ]


def test_torque_scales_return_to_what_the_driver_commands(result):
    assert changed_lines(I2RT, result, (1.25, 2.0)) == [
        "gravity_comp_factor: [1.25, 2]",
        "coulomb_friction:    [0.5625, 0.4]  # by hand",
    ]


def test_the_settings_of_another_arm_are_refused(tmp_path):
    path = tmp_path / "arm.yml"
    with pytest.raises(InputError, match="cannot be read; give the settings file"):
        require_driver_settings(path, 2)
    path.write_text("kp: [1.0]\nxFc: [1.0]\n")
    with pytest.raises(
        InputError, match="none of the fields gravity_comp_factor, coul"
    ):
        require_driver_settings(path, 2)
    path.write_text(OPENARM)
    require_driver_settings(path, 2)
    with pytest.raises(InputError, match="Fc has 3 numbers, the arm has 4 joints"):
        require_driver_settings(path, 4)

"""Two arms of one model that move at the same time."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.model.contacts import parts_of
from robot_sysid.motion.limit_check import BetweenArms, as_one
from robot_sysid.motion.trajectories import straight_way
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.simulator import ArmTorque

LINK = """
<body name="{side}0" pos="0 {y} 0"><joint name="{side}_a" axis="0 0 1" range="-3 3"/>
 <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
 <body name="{side}1" pos=".3 0 0"><joint name="{side}_b" axis="0 1 0" range="-3 3"/>
  <geom type="capsule" fromto="0 0 0 .2 0 0" size=".03" mass=".5"/></body></body>"""


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """Two arms side by side along x, 0.5 m apart, that can reach each other."""
    path = tmp_path_factory.mktemp("arms") / "two.xml"
    bodies = "".join(LINK.format(side=side, y=y) for side, y in (("left", 0.25), ("right", -0.25)))
    head = "<mujoco><compiler angle='radian'/><worldbody>"
    path.write_text(f"{head}{bodies}</worldbody></mujoco>")
    return tuple(load_robot_model(path, joint=f"{side}_b") for side in ("left", "right"))


def test_two_arms_as_one_need_the_torques_of_each(arms):
    both, rng = as_one(*arms), np.random.default_rng(0)
    assert both.joint_names == ("left_a", "left_b", "right_a", "right_b")
    parts = rng.uniform(-1.0, 1.0, (3, 5, 4))
    torque = ArmTorque(both)(Motion(np.arange(5.0), *parts))
    for arm, own in zip(arms, (slice(0, 2), slice(2, 4))):
        alone = ArmTorque(arm)(Motion(np.arange(5.0), *parts[:, :, own]))
        np.testing.assert_allclose(torque[:, own], alone, atol=1e-12)


@pytest.mark.parametrize("end", [[-0.6, 0.0, 0.6, 0.0], [-1.2, 0.5, 0.0, 0.0], [0.9, 1, -0.9, -1]])
def test_the_first_touch_is_that_of_a_dense_look(arms, end):
    between, way = BetweenArms(*arms), straight_way(np.zeros(4), np.array(end))
    time = np.linspace(0.0, way.duration, 2000)
    near = [between.distance(q) < 2e-3 for q in way.evaluate(time).q]
    found = between.touch_at(way)
    assert (found is None) == (not any(near))
    if found is not None:
        assert found == pytest.approx(time[near.index(True)], abs=3e-3)


def test_what_is_for_a_serial_chain_refuses_both(arms):
    with pytest.raises(InputError, match="no serial chain: take one arm"):
        parts_of(as_one(*arms))


def test_one_of_them_reaches_the_other_and_one_does_not(arms):
    """The three ends of the test above are of both kinds."""
    between = BetweenArms(*arms)
    assert between.distance(np.array([-0.6, 0.0, 0.6, 0.0])) < 0.0
    assert between.distance(np.zeros(4)) == 0.2

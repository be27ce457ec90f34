"""What a recording's setting changes: the gain, what a supply gives, the links with their load."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.records import Recording
from robot_sysid.records.servo_setting import UNKNOWN, parse_servo_setting
from robot_sysid.servo.play import make_tracks
from robot_sysid.servo.setting import (
    gain_of,
    links_of,
    loaded,
    strength_of,
    with_setting,
)
from robot_sysid.spatial import com_from_theta

ARM = """<mujoco><worldbody><body><joint name="pan" axis="0 0 1"/>
<inertial pos="0 0 .05" mass=".2" diaginertia="2e-4 2e-4 2e-4"/><body pos="0 0 .1">
<joint name="lift" axis="0 1 0" pos=".02 0 0"/>
<inertial pos=".12 0 0" mass=".3" diaginertia="2e-4 5e-4 5e-4"/></body></body></worldbody>
</mujoco>"""
GRAVITY = 9.81


def setting(text):
    return parse_servo_setting(text)


FIRST = setting("kp=400, voltage=7.4")
OTHERS = [
    (FIRST, 1.0, 1.0),
    (setting("kp=100, voltage=7.4"), 0.25, 1.0),
    (setting("kp=400, voltage=5"), 5.0 / 7.4, 5.0 / 7.4),
    (setting("kp=800, voltage=5"), 2.0 * 5.0 / 7.4, 5.0 / 7.4),
    # What is not known of one of both is taken to be the same.
    (setting("kp=100"), 0.25, 1.0),
    (setting("voltage=3.7"), 0.5, 0.5),
    (UNKNOWN, 1.0, 1.0),
]


@pytest.mark.parametrize(("other", "gain", "strength"), OTHERS)
def test_the_register_scales_the_gain_and_the_voltage_gain_and_limit(
    other, gain, strength
):
    assert gain_of(other, FIRST) == pytest.approx(gain, rel=1e-12)
    assert strength_of(other, FIRST) == pytest.approx(strength, rel=1e-12)
    assert gain_of(UNKNOWN, other) == strength_of(UNKNOWN, other) == 1.0
    assert gain_of(FIRST, other) * gain == pytest.approx(1.0, rel=1e-12)
    servos = servo_logs.servos(
        [[20.0, 30.0], [0.5, 0.4], [0.1, 0.2], [0.02, 0.03]], 0.03, 2.0
    )
    scaled = with_setting(servos, other, FIRST)
    assert_allclose(scaled.numbers[0], gain * servos.numbers[0], rtol=1e-12)
    assert_allclose(scaled.limits, strength * servos.limits, rtol=1e-12)
    assert_array_equal(scaled.numbers[1:], servos.numbers[1:])
    assert scaled.delay == servos.delay
    assert servos.numbers[0].tolist() == [20.0, 30.0]


LOADS = [
    ("load=0.2 at 0.1 0.02 -0.03", 0.5, False),
    ("load=0.2 at 0.15", 0.5, False),
    ("link=0.7 at 0.25", 0.7, True),
    ("link=0.7 at 0.1 0 0.05", 0.7, True),
]
PLACES = ([0.1, 0.02, -0.03], [0.17, 0.0, 0.0], [0.27, 0.0, 0.0], [0.1, 0.0, 0.05])
"""Where they are in the last link's frame, whose joint is at 0.02 m along x."""


@pytest.mark.parametrize(
    ("text", "mass", "is_whole", "place"),
    [(*load, place) for load, place in zip(LOADS, PLACES)],
)
def test_a_load_changes_the_last_link(text, mass, is_whole, place):
    robot = robot_of(ARM)
    thetas, is_known = links_of(robot, setting(text))
    assert_array_equal(thetas[0], robot.thetas[0])
    assert is_known.tolist() == [False, is_whole]
    found, com, inertia = com_from_theta(thetas[-1])
    assert found == pytest.approx(mass, rel=1e-12)
    of_load = np.array(place)
    if is_whole:
        assert_allclose(com, of_load, atol=1e-12)
        _, _, of_link = com_from_theta(robot.thetas[-1])
        assert_allclose(inertia, of_link * mass / 0.3, rtol=1e-9, atol=1e-15)
    else:
        link_com = np.array([0.12, 0.0, 0.0])
        assert_allclose(mass * com, 0.3 * link_com + 0.2 * of_load, atol=1e-12)


@pytest.mark.parametrize("text", ["", "kp=4", "load=0", "kp=4, load=0"])
def test_without_a_load_the_arm_is_the_model(text):
    robot = robot_of(ARM)
    bare = setting(text) if text else UNKNOWN
    thetas, is_known = links_of(robot, bare)
    assert_array_equal(thetas, robot.thetas)
    assert not np.any(is_known)
    assert loaded(robot, bare) is robot


@pytest.mark.parametrize(("text", "mass", "is_whole"), LOADS)
def test_rollouts_carry_what_the_equations_do(text, mass, is_whole):
    robot = robot_of(ARM)
    thetas, _ = links_of(robot, setting(text))
    other = loaded(robot, setting(text))
    motion = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 5, 2))
    torques = [ArmDynamics(arm, arm.mj_model).torque(*motion) for arm in (robot, other)]
    expected = LinkDynamics(robot).motion(*motion).torque(thetas)
    assert_allclose(torques[1], expected, atol=1e-9)
    # The model as it was is not changed.
    without = LinkDynamics(robot).motion(*motion).torque(robot.thetas)
    assert_allclose(torques[0], without, atol=1e-9)
    assert np.max(np.abs(torques[1] - torques[0])) > 0.05


def test_a_distance_from_a_link_whose_mass_is_at_its_joint_is_no_place():
    robot = robot_of(ARM.replace('pos=".12 0 0"', 'pos=".02 0 0"'))
    with pytest.raises(
        InputError, match="centre of mass of the last link at its joint"
    ):
        links_of(robot, setting("load=0.2 at 0.15"))
    links_of(robot, setting("load=0.2 at 0.1 0 0"))


def recording(text):
    time = np.arange(200) / 100.0
    q = 0.3 * np.sin(np.outer(time, [2.0, 3.0]))
    piece = Recording(time, q, None, 0.0 * q, command=q)
    return replace(piece, setting=setting(text) if text else UNKNOWN)


def test_tracks_have_the_gain_the_strength_and_the_load_of_their_recordings():
    robot = robot_of(ARM)
    texts = ("kp=4, voltage=6", "kp=8, voltage=3, load=0.2 at 0.1")
    tracks = make_tracks(robot, [recording(text) for text in texts], 2.0, 60)
    assert tracks.joint.tolist() == [0, 1, 0, 1]
    assert tracks.scale.tolist() == [1.0, 1.0, 1.0, 1.0]
    assert tracks.strength.tolist() == [1.0, 1.0, 0.5, 0.5]
    q = tracks.middle[:, 1]
    lift = tracks.torque[:, 3] - tracks.torque[:, 1]
    speed = np.gradient(tracks.middle[:, 0], 1e-3)
    # The load's weight, and that pan's speed pulls it outwards.
    outwards = 0.2 * (0.02 + 0.1 * np.cos(q)) * 0.1 * np.sin(q) * speed**2
    expected = outwards - 0.2 * GRAVITY * 0.1 * np.cos(q)
    inner = slice(200, -300)
    assert_allclose(lift[inner], expected[inner], atol=2e-3)


def test_a_link_that_was_weighed_has_no_error():
    """That of the first joint's link stays."""
    robot = robot_of(ARM)
    plain, known = (
        make_tracks(robot, [recording(text)], 2.0, 60)
        for text in ("", "link=0.7 at 0.25")
    )
    sizes = [np.sum(tracks.errors**2, axis=(0, 1)) for tracks in (plain, known)]
    assert sizes[0][1] > 0.0
    assert sizes[1][1] < 1e-20

"""A zero that has moved is told from links that weigh something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.safety.zeros import describe_moved_zero
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.records import Measurement
from tests.support import arms

JOINTS = damiao_joints(["DM4340", "DM4340", "DM4310"], 3)


def played(robot, seed, links=0.0, load=0.0, shift=None, seconds=8.0):
    """What a run of an arm shows whose links are off by a share, and that carries a load [kg]."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.03)
    frequencies = random.uniform(0.15, 0.5, (3, 3))
    phases = random.uniform(0.0, 6.0, (3, 3))
    q, qd, qdd = np.zeros((3, len(time), 3))
    for frequency, phase in zip(frequencies, phases):
        omega = 2.0 * np.pi * frequency
        q += 0.3 * np.sin(np.outer(time, omega) + phase)
        qd += 0.3 * omega * np.cos(np.outer(time, omega) + phase)
        qdd -= 0.3 * omega**2 * np.sin(np.outer(time, omega) + phase)
    thetas = robot.thetas * (1.0 + links * random.normal(size=(3, 1)))
    thetas[-1, 0] += load
    stands = q if shift is None else q + np.array(shift)
    tau = LinkDynamics(robot).motion(stands, qd, qdd).torque(thetas)
    tau += 0.3 * np.tanh(qd / 0.02) + 0.02 * random.normal(size=tau.shape)
    return Measurement(time, q, qd, tau)


@pytest.fixture
def arm():
    """An arm whose links weigh enough to load its motors."""
    robot = arms.robot_of(arms.THREE)
    heavy = tuple(replace(link, theta=10.0 * link.theta) for link in robot.links)
    return replace(robot, links=heavy)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("joint", [1])
@pytest.mark.parametrize("angle", [-0.3, 0.3])
def test_a_moved_zero_is_named(arm, seed, joint, angle):
    shift = angle * np.eye(3)[joint]
    words = describe_moved_zero(arm, JOINTS, played(arm, seed, 0.15, shift=shift))
    assert f"the zero of motor {joint + 1} has moved by about 0." in words


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("load", [0.0, 2.0])
def test_links_and_loads_that_are_off_are_no_moved_zero(arm, seed, load):
    assert describe_moved_zero(arm, JOINTS, played(arm, seed, 0.2, load)) == ""


def test_a_short_run_says_nothing(arm):
    shift = (0.0, 0.5, 0.0)
    assert describe_moved_zero(arm, JOINTS, played(arm, 0, shift=shift, seconds=2.0)) == ""


def test_a_long_run_takes_no_more_memory_than_a_short_one(arm, monkeypatch):
    sizes = []
    factor = np.linalg.cholesky
    monkeypatch.setattr(np.linalg, "cholesky", lambda x: sizes.append(len(x)) or factor(x))
    run = played(arm, 0, 0.15, shift=(0.0, 0.3, 0.0), seconds=600.0)
    assert "the zero of motor 2" in describe_moved_zero(arm, JOINTS, run)
    assert max(sizes) <= 80 * 3


def test_a_link_without_mass_has_no_errors_to_compete(arm):
    light = replace(arm.links[0], theta=0.0 * arm.links[0].theta)
    robot = replace(arm, links=(light, *arm.links[1:]))
    assert describe_moved_zero(robot, JOINTS, played(robot, 0, 0.15)) == ""

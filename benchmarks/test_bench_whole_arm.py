"""Every link of a 7-joint arm from 15 000 samples, against pinocchio's regressor loop and lstsq.

Run: pytest benchmarks/test_bench_whole_arm.py --benchmark-only
Needs ``pip install -e ".[bench]"`` and the public logs; set OMP_NUM_THREADS=1 for one BLAS thread.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import whole_arm_runs as whole_arm
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.parser import load_robot_model
from tests.support.places import DATA

URDF = DATA / "kuka_lwr4" / "kuka_lwr4.urdf"
pytestmark = pytest.mark.skipif(
    not URDF.exists(), reason="the model of a real arm is not here"
)
pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed")


@pytest.fixture(scope="module")
def robot():
    return load_robot_model(URDF)


@pytest.fixture(scope="module")
def model():
    return pinocchio.buildModelFromUrdf(str(URDF))


@pytest.fixture(scope="module")
def log(robot):
    return whole_arm.measured(robot)


def test_both_mean_the_same_arm(robot, model, log):
    """Torques of the model's links: ours against pinocchio's own recursion [N m]."""
    data = model.createData()
    motion = [part[::500] for part in log[1]]
    theirs = [pinocchio.rnea(model, data, *row) for row in zip(*motion)]
    thetas = robot.thetas
    mine = LinkDynamics(robot).motion(*motion).torque(thetas)
    assert mine == pytest.approx(np.array(theirs), abs=1e-9)


def test_regressor(benchmark, robot, log):
    benchmark(whole_arm.regressor_columns, robot, log[1])


def test_regressor_of_pinocchio(benchmark, model, log):
    benchmark(whole_arm.pinocchio_regressor, model, model.createData(), log[1])


def test_whole_arm_with_given_settings(benchmark, robot, log):
    benchmark(whole_arm.ours, robot, log[0])


def test_whole_arm_with_all_choices(benchmark, robot, log):
    benchmark.pedantic(whole_arm.ours, (robot, log[0], whole_arm.CHOSEN), rounds=3)


def test_least_squares_of_pinocchio(benchmark, model, log):
    benchmark(whole_arm.pinocchio_fit, model, model.createData(), log[1], log[0].tau)

"""Collecting 15 s of seven joints at 1 kHz, against MuJoCo's inverse dynamics in a bare loop."""

from __future__ import annotations

import time

import mujoco
import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.files.places import MODELS
from robot_sysid.parser import load_robot_model
from robot_sysid.regressor import wrench_regressor
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import LastLinkTerms
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks

ARMS = {
    "inline": None,
    "kinova": MODELS / "kinova_gen3" / "gen3.xml",
    "iiwa": MODELS / "kuka_iiwa_14" / "iiwa14.xml",
    "panda": MODELS / "franka_panda" / "panda.xml",
}


@pytest.fixture(params=ARMS)
def recorded_arm(request):
    """Return (arm, its measurements): 15 001 samples in chunks."""
    path = ARMS[request.param]
    if path is not None and not path.exists():
        pytest.skip("the public models are not here")
    robot = (
        small_arms.robot_of(small_arms.SEVEN)
        if path is None
        else load_robot_model(path)
    )
    plan = generate_excitation_trajectory(robot, np.random.default_rng(0))
    wrench_regressor(np.zeros((1, 6)), np.zeros((1, 6)))
    return robot, list(simulate_inverse(robot, motion_chunks(plan, 1000.0)))


def collect(robot, measurements):
    """Return the sums of measurements in the parameters of the terminal link."""
    return LastLinkTerms(robot).exact_sums(measurements)


def bare_loop(robot, measurements):
    """Run the plain alternative: nothing but mj_inverse per sample."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.reference_qpos
    at_q, at_v = (
        slice(int(i[0]), int(i[-1]) + 1) for i in (robot.qpos_index, robot.dof_index)
    )
    for chunk in measurements:
        for q, qd, qdd in zip(chunk.q, chunk.qd, chunk.qdd):
            data.qpos[at_q] = q
            data.qvel[at_v] = qd
            data.qacc[at_v] = qdd
            mujoco.mj_inverse(model, data)


def best_of(function, *arguments, rounds=5):
    """Return the shortest time of several runs [s]."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function(*arguments)
        times.append(time.perf_counter() - start)
    return min(times)


def test_collection_against_a_bare_loop_of_mj_inverse(benchmark, recorded_arm):
    bare = best_of(bare_loop, *recorded_arm)
    sums = benchmark.pedantic(collect, recorded_arm, rounds=5, warmup_rounds=1)
    assert np.sum(sums.counts) == 7 * 15_001
    benchmark.extra_info["mj_inverse loop [ms]"] = round(1e3 * bare, 1)
    benchmark.extra_info["ratio"] = round(benchmark.stats.stats.min / bare, 2)

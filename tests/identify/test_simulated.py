"""A model identified from its own simulation gives itself back, and says what the data was."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from robot_sysid import __version__
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.simulated import ITSELF, SimulatedRun, identify_itself, versions
from robot_sysid.records import Source, Status
from robot_sysid.records.progress import Progress
from robot_sysid.trajectory import CHUNK
from tests.support import arms
from tests.support.log_files import read_measurements
from tests.support.measured_logs import plan_of, true_arm


class Listener(Progress):
    """Remembers what it is told."""

    def __init__(self):
        self.notes, self.steps = [], 0

    def note(self, message):
        self.notes.append(message)

    def track(self, items, label, total):
        for item in items:
            self.steps += 1
            yield item
        assert self.steps == total


@pytest.fixture(scope="module")
def robot():
    return true_arm()


def run_of(robot, duration=4.0, rate=200.0, **more):
    return SimulatedRun(plan_of(robot, 1, duration), rate, 7, **more)


@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("friction", [True, False])
def test_the_models_own_values_come_back(robot, torques, friction):
    options = EstimationOptions(torques=torques, no_friction=not friction)
    found = identify_itself(robot, run_of(robot), options, Progress()).identification
    estimate = found.estimate
    np.testing.assert_allclose(estimate.values[:10], robot.prior.theta, rtol=0.0, atol=1e-10)
    assert (estimate.value("coulomb[joint2]") is not None) == friction
    if friction:
        assert estimate.value("coulomb[joint2]") == pytest.approx(0.3, abs=1e-10)
        assert estimate.value("viscous[joint2]") == pytest.approx(0.2, abs=1e-10)
    whole = torques == "chain"
    assert estimate.status is (Status.OK if whole else Status.PARTLY_FROM_MODEL)
    assert (found.torques, estimate.method) == (torques, "ols")


def test_the_result_says_what_the_data_was(robot):
    listener, run = Listener(), run_of(robot)
    analysis = identify_itself(robot, run, EstimationOptions(), listener)
    found = analysis.identification
    assert listener.notes == [ITSELF]
    data = dataclasses.astuple(found.data)
    assert data == (Source.ITSELF, "", run.plan.duration, 200.0, 7, ())
    assert not found.data.source.is_measured
    assert found.joint_names == robot.joint_names and found.friction_model is None
    assert (found.delay, found.tilt, found.cutoff, found.validation) == (None, None, None, ())
    times = analysis.checkpoints.time
    assert (times[0], times[-1]) == (0.0, run.plan.duration)


def test_progress_counts_the_chunks_that_come(robot):
    listener = Listener()
    run = run_of(robot, 6.0, 1000.0)
    identify_itself(robot, run, EstimationOptions(), listener)
    assert listener.steps == run.n_chunks == int(np.ceil(6001 / CHUNK))


def test_measurements_are_written_where_asked_for(robot, tmp_path):
    path = tmp_path / "log.csv"
    run = run_of(robot, save=path)
    identify_itself(robot, run, EstimationOptions(), Progress())
    log = read_measurements(path, robot.joint_names).samples
    np.testing.assert_allclose(log.q, run.plan.evaluate(log.time).q, rtol=0.0, atol=1e-12)
    assert len(log) == 801


def test_versions_are_those_that_run():
    found = versions()
    assert set(found) == {"robot_sysid", "mujoco", "numpy", "python"}
    assert (found["robot_sysid"], found["mujoco"]) == (__version__, mujoco.__version__)


def test_a_slide_says_so():
    robot = arms.robot_of(
        arms.serial_arm((arms.Z, arms.Y, arms.X), joint='type="slide" range="-1 1"')
    )
    found = identify_itself(robot, run_of(robot), EstimationOptions(), Progress()).identification
    assert found.slides

"""The order of recordings decides whether a drift can be told from a payload."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.logs.log_files import open_log
from rigs.logs.measured_logs import XML, log_of
from robot_sysid.config import PayloadConfig
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.payload import payload_estimate
from robot_sysid.estimate.questions import Question
from robot_sysid.faults.gate import judge
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline import stages
from robot_sysid.pipeline.recordings import is_drift_identifiable, order_positions
from robot_sysid.records import Recording
from robot_sysid.records.messages import Progress


def recording(start):
    """A log of 10 s that begins at a time on a clock that all recordings share [s]."""
    time = np.linspace(start, start + 10.0, 5)
    return Recording(time, *np.zeros((3, 5, 1)))


EMPTY_FIRST = [recording(start) for start in (0.0, 60.0, 20.0, 40.0)]
"""Recorded empty, loaded, loaded, empty; listed with the empty ones first."""


@pytest.mark.parametrize("order", ["ABBA", None])
def test_letters_and_clocks_give_the_same_positions(order):
    positions = order_positions(EMPTY_FIRST, order)
    np.testing.assert_allclose(
        positions, [-1.0, 1.0, -1.0 / 3.0, 1.0 / 3.0], rtol=1e-12
    )


def test_clocks_that_overlap_give_no_order():
    assert order_positions([recording(0.0), recording(9.0)], None) is None


@pytest.mark.parametrize(
    ("order", "is_identifiable"),
    [("AB", False), ("AABB", True), ("ABBA", True), ("ABAB", True)],
)
def test_a_drift_needs_recordings_of_a_kind_at_several_times(order, is_identifiable):
    is_loaded = np.array(sorted(letter == "B" for letter in order))
    positions = order_positions([], order)
    assert positions is not None
    assert is_drift_identifiable(is_loaded, positions) == is_identifiable


@pytest.fixture
def robot(arm_file):
    return load_robot_model(arm_file(XML))


def write_logs(arm, folder):
    """Write an empty log of two parts with a long hole between them, and a complete loaded one."""
    paths = folder / "cut.csv", folder / "complete.csv"
    log = log_of(arm, noise_torque=0.1)
    later = replace(log, time=log.time + 60.0)
    for path, parts in zip(paths, ([log, later], [log_of(arm, seed=2)])):
        write_measurement_csv(path, arm.joint_names, parts)
    return paths


def judged_logs(arm, paths, options):
    """Return the first log as an empty one and the second as a loaded one, judged together."""
    logs = [open_log(arm, path) for path in paths]
    question = Question(options, loaded=True)
    return judge(arm, logs, question, Progress(), [False, True], [-1.0, 1.0])


@pytest.mark.slow
def test_logs_are_judged_together_with_the_options_of_the_run(robot, tmp_path):
    arm = load_robot_model(robot.path, mass_scale=1.5)
    assert arm.mass == pytest.approx(1.5 * robot.mass)
    empty, loaded = paths = write_logs(arm, tmp_path)
    config = PayloadConfig.of(
        robot.path,
        empty=(empty,),
        loaded=(loaded,),
        priors={"zero": 7.0},
        mass_scale=1.5,
    )
    result, _ = stages.identify(config, stages.load_arm(config, Progress()), Progress())
    of_run, as_usual = (
        payload_estimate(judged_logs(arm, paths, options).fit)
        for options in (config.estimation, EstimationOptions())
    )
    assert result.payload.recordings == {
        "empty": (str(empty),),
        "loaded": (str(loaded),),
    }
    np.testing.assert_allclose(result.payload.covariance, of_run.covariance, rtol=1e-9)
    assert np.all(of_run.covariance != as_usual.covariance)


@pytest.mark.slow
def test_parts_of_a_log_with_a_long_hole_are_one_log(robot, tmp_path):
    paths = write_logs(robot, tmp_path)
    judged = judged_logs(robot, paths, EstimationOptions())
    cut, complete = map(str, paths)
    found = [(log.name, log.is_loaded, log.order) for log in judged.fit.recordings]
    assert found == [(cut, False, -1.0)] * 2 + [(complete, True, 1.0)]

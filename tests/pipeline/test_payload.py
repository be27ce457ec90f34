"""The order of recordings decides whether a drift can be told from a payload."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.logs.log_files import open_log
from rigs.logs.measured_logs import XML, log_of
from robot_sysid.config import PayloadConfig
from robot_sysid.diagnosis.gate import judge
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline import recordings, stages
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


@pytest.fixture
def paths(robot, tmp_path):
    """An empty log in two parts with a long hole between them, and a complete loaded one."""
    paths = tmp_path / "cut.csv", tmp_path / "complete.csv"
    log = log_of(robot, noise_torque=0.1)
    later = replace(log, time=log.time + 60.0)
    for path, parts in zip(paths, ([log, later], [log_of(robot, seed=2)])):
        write_measurement_csv(path, robot.joint_names, parts)
    return paths


class Checked(Exception):
    """Ends a run where its logs are judged."""


def test_logs_are_judged_together_with_the_options_of_the_run(
    robot, paths, monkeypatch
):
    empty, loaded = paths
    priors = {"zero": 7.0}
    config = PayloadConfig.of(
        robot.path, empty=(empty,), loaded=(loaded,), priors=priors, mass_scale=1.5
    )

    def check(arm, logs, question, progress, is_loaded, order):
        assert arm.mass == pytest.approx(1.5 * robot.mass)
        assert question.options == config.estimation and question.loaded
        assert [log.name for log in logs] == [*map(str, paths)]
        assert is_loaded == [False, True] and order == [-1.0, 1.0]
        raise Checked

    monkeypatch.setattr(recordings, "judge", check)
    with pytest.raises(Checked):
        stages.run(config, Progress())


def test_parts_of_a_log_with_a_long_hole_are_one_log(robot, paths):
    logs = [open_log(robot, path) for path in paths]
    question = Question(EstimationOptions(), loaded=True)
    judged = judge(robot, logs, question, Progress(), [False, True], [-1.0, 1.0])
    cut, complete = map(str, paths)
    found = [(log.name, log.is_loaded, log.order) for log in judged.fit.recordings]
    assert found == [(cut, False, -1.0)] * 2 + [(complete, True, 1.0)]

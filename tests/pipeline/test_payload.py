"""The order of recordings decides whether a drift can be told from a payload."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from robot_sysid.config import PayloadConfig
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline import payload, stages
from robot_sysid.pipeline.payload import (
    _datasets,
    is_drift_identifiable,
    order_positions,
)
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from tests.support.measured_logs import CUTOFF, XML, log_of, true_arm


def recording(start: float) -> SimpleNamespace:
    """A log of 10 s that begins at a time on a clock that all recordings share [s]."""
    time = np.linspace(start, start + 10.0, 5)
    return SimpleNamespace(samples=Measurement(time, *np.zeros((3, 5, 1))))


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


class Checked(Exception):
    """Ends a run at the check of its first log."""


def test_logs_are_checked_with_the_options_of_the_run(arm_file, tmp_path, monkeypatch):
    robot = load_robot_model(arm_file(XML))
    path = tmp_path / "log.csv"
    write_measurement_csv(path, robot.joint_names, [log_of(robot)])
    config = PayloadConfig.of(
        tmp_path / "arm.xml",
        empty=(path,),
        loaded=(path,),
        priors={"zero": 7.0},
        mass_scale=1.5,
    )

    def check(arm, log, accepted, progress, options=None, links_known=True):
        assert arm.mass == pytest.approx(1.5 * robot.mass) and not links_known
        assert options == config.estimation
        raise Checked

    monkeypatch.setattr(payload, "check_log", check)
    with pytest.raises(Checked):
        stages.run(config, Progress())


def test_parts_of_a_log_with_a_long_hole_are_one_log():
    arm = true_arm()
    log = log_of(arm, noise_torque=0.1)
    logs = [
        SimpleNamespace(path="cut", notes=(), pieces=(log, log)),
        SimpleNamespace(path="complete", notes=(), pieces=(log,)),
    ]
    order = np.array([-1.0, 1.0])
    datasets, _ = _datasets(arm, logs, order > 0.0, order, CUTOFF)
    names = [dataset.name for dataset in datasets]
    assert names == ["cut", "cut", "complete"]

"""The order of recordings decides whether a drift can be told from a payload."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.pipeline.payload import (
    RawRecording,
    _moving_datasets,
    is_drift_identifiable,
    order_positions,
)
from robot_sysid.records import Measurement
from tests.support.measured_logs import CUTOFF, log_of, true_arm


def recording(is_loaded: bool, start: float) -> RawRecording:
    """A recording of 10 s that begins at a time on a clock that all recordings share [s]."""
    time = np.linspace(start, start + 10.0, 5)
    return RawRecording("", Measurement(time, *np.zeros((3, 5, 1))), is_loaded)


EMPTY_FIRST = [
    recording(False, 0.0),
    recording(False, 60.0),
    recording(True, 20.0),
    recording(True, 40.0),
]
"""Recorded empty, loaded, loaded, empty; listed with the empty ones first."""


@pytest.mark.parametrize("order", ["ABBA", None])
def test_letters_and_clocks_give_the_same_positions(order):
    positions = order_positions(EMPTY_FIRST, order)
    np.testing.assert_allclose(
        positions, [-1.0, 1.0, -1.0 / 3.0, 1.0 / 3.0], rtol=1e-12
    )


def test_clocks_that_overlap_give_no_order():
    assert order_positions([recording(False, 0.0), recording(True, 9.0)], None) is None


@pytest.mark.parametrize(
    ("order", "is_identifiable"),
    [("AB", False), ("AABB", True), ("ABBA", True), ("ABAB", True)],
)
def test_a_drift_needs_recordings_of_a_kind_at_several_times(order, is_identifiable):
    kinds = sorted(letter == "B" for letter in order)
    recordings = [recording(is_loaded, 0.0) for is_loaded in kinds]
    positions = order_positions(recordings, order)
    assert positions is not None
    assert is_drift_identifiable(recordings, positions) == is_identifiable


def test_parts_of_a_log_with_a_long_hole_are_one_log():
    arm = true_arm()
    log = log_of(arm, noise_torque=0.1)
    options = EstimationOptions(cutoff=CUTOFF)
    recordings = [
        RawRecording("cut", log, False, pieces=(log, log)),
        RawRecording("complete", log, True, pieces=(log,)),
    ]
    datasets, _ = _moving_datasets(arm, recordings, np.array([-1.0, 1.0]), options)
    names = [dataset.name for dataset in datasets]
    assert names == ["cut", "cut", "complete"]

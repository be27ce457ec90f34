"""From logs to recordings: one cut-off for all, pieces on their own, notes once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.payload.data.processing import filtered
from robot_sysid.identify.payload.data.recordings import RawRecording
from robot_sysid.records import Measurement
from tests.support.measured_logs import log_of, true_arm

ARM = true_arm()


@pytest.fixture(scope="module")
def raw():
    log = log_of(ARM, noise_position=1e-4)
    coarse = log_of(ARM, noise_position=1e-3)
    return [
        RawRecording("a.csv", False, log, (log,), notes=("said of it",)),
        RawRecording("b.csv", True, coarse, (coarse,), notes=("said of it",)),
    ]


def test_all_go_through_the_lowest_cut_off(raw):
    found = filtered(ARM, raw, None, EstimationOptions())
    cutoffs = {each.source.signals.cutoff for each in found.recordings}
    assert cutoffs == {found.cutoff}
    assert [each.is_loaded for each in found.recordings] == [False, True]
    assert found.motion.q.shape[1] == ARM.n_joints


def test_a_note_is_said_once_with_those_it_is_about(raw):
    found = filtered(ARM, raw, None, EstimationOptions(cutoff=5.0))
    assert found.notes.count("all recordings: said of it") == 1
    other = [raw[0], replace(raw[1], notes=())]
    assert "a.csv: said of it" in filtered(ARM, other, None, EstimationOptions(cutoff=5.0)).notes


def test_pieces_of_a_log_are_recordings_of_their_own(raw):
    log = raw[0].samples
    half = len(log.time) // 2
    pieces = (part(log, slice(0, half)), part(log, slice(half, None)))
    both = [replace(raw[0], pieces=pieces), raw[1]]
    found = filtered(ARM, both, np.array([-1.0, 1.0]), EstimationOptions(cutoff=5.0))
    names = [each.name for each in found.recordings]
    assert names == ["a.csv (part 1)", "a.csv (part 2)", "b.csv"]
    assert [each.place for each in found.recordings] == [-1.0, -1.0, 1.0]


def test_a_log_that_is_too_short_is_named(raw):
    short = part(raw[0].samples, slice(0, 50))
    with pytest.raises(InputError, match="a.csv: .*too short"):
        filtered(
            ARM, [replace(raw[0], pieces=(short,)), raw[1]], None, EstimationOptions(cutoff=5.0)
        )


def part(log, rows):
    return Measurement(log.time[rows], log.q[rows], None, log.tau[rows])

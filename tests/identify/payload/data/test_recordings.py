"""The order of recordings: what is known of it, and what it lets be told apart."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.identify.payload.data.recordings import RawRecording, drift_shows, places
from robot_sysid.records import Measurement


def raw(is_loaded, start=0.0, name="log"):
    time = start + np.linspace(0.0, 10.0, 20)
    q = np.zeros((20, 2))
    samples = Measurement(time, q, None, q)
    return RawRecording(name, is_loaded, samples, (samples,))


def of(kinds, starts=None):
    found = [raw(kind == "B", start) for kind, start in zip(kinds, starts or [0.0] * len(kinds))]
    return sorted(found, key=lambda each: each.is_loaded)


def test_letters_tell_the_order():
    at = places(of("ABBA"), "ABBA")
    assert at == pytest.approx([-1.0, 1.0, -1.0 / 3.0, 1.0 / 3.0])


def test_a_clock_that_all_share_tells_the_order():
    at = places(of("ABBA", [1000.0, 1020.0, 1040.0, 1060.0]), None)
    assert at == pytest.approx([-1.0, 1.0, -1.0 / 3.0, 1.0 / 3.0])


def test_clocks_that_start_anew_tell_nothing():
    assert places(of("ABBA"), None) is None


@pytest.mark.parametrize(
    ("order", "shows"), [("AB", False), ("ABBA", True), ("AABB", True), ("ABAB", True)]
)
def test_a_drift_shows_where_a_kind_was_recorded_at_several_times(order, shows):
    recordings = of(order)
    assert drift_shows(recordings, places(recordings, order)) is shows

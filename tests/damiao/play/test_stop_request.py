"""Wishes to stop; whole runs are in test_run.py."""

from __future__ import annotations

import signal

import pytest

from robot_sysid.damiao.play.stop_request import StopRequest

SIGNALS = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


def test_the_first_reason_to_stop_is_kept():
    stop = StopRequest()
    stop("first")
    stop("second")
    assert (stop.count, stop.reason) == (2, "first")


@pytest.mark.parametrize("name", SIGNALS)
def test_signals_are_wishes_inside_the_block_only(name):
    number, stop = getattr(signal, name), StopRequest()
    before = signal.getsignal(number)
    with stop.on_signals():
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert signal.getsignal(number) is before
    assert (stop.count, stop.reason) == (2, f"stopped by {name}")

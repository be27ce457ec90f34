"""Somebody's wish that a run should end."""

from __future__ import annotations

import signal

import pytest

from robot_sysid.damiao.player import StopRequest
from robot_sysid.errors import STOP_SIGNALS


@pytest.mark.parametrize("name", [number.name for number in STOP_SIGNALS])
def test_signals_are_wishes_inside_the_block_only(name, heard):
    number = getattr(signal, name)
    stop = StopRequest()
    with stop.on_signals():
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert signal.getsignal(number) is signal.default_int_handler
    assert (stop.count, stop.reason, stop.insisted) == (2, f"stopped by {name}", False)


@pytest.mark.parametrize("name", [number.name for number in STOP_SIGNALS])
def test_what_nohup_or_a_shell_makes_a_process_ignore_stays_ignored(name, heard):
    number = getattr(signal, name)
    stop = StopRequest()
    signal.signal(number, signal.SIG_IGN)
    with stop.on_signals():
        signal.raise_signal(number)
    assert stop.count == 0 and signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.parametrize(("later", "insisted"), [(0.1, False), (0.3, True)])
def test_only_ctrl_c_again_insists_and_not_one_that_came_twice(
    later, insisted, heard, monkeypatch
):
    now = iter((5.0, 5.0 + later))
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    stop = StopRequest()
    with stop.on_signals():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert (stop.count, stop.insisted) == (2, insisted)

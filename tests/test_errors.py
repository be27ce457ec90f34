"""Requests to stop wait for the end of a block, whichever thread they reach."""

from __future__ import annotations

import os
import signal
import socket
import threading

import pytest

from robot_sysid.cli import record_interrupts
from robot_sysid.errors import STOP_SIGNALS, delay_signals, ignore_repeated_ctrl_c

pytestmark = pytest.mark.skipif(
    os.name == "nt", reason="signals cannot be sent to oneself"
)


@pytest.fixture
def other_thread():
    """A thread that takes a signal which the main thread masks; calling it waits until it has."""
    done = threading.Event()
    thread = threading.Thread(target=done.wait)
    thread.start()
    receiver, tells = socket.socketpair()
    tells.setblocking(False)
    old_handlers = signal.set_wakeup_fd(tells.fileno())

    def take(number):
        signal.pthread_kill(thread.ident, number)
        assert receiver.recv(1) == bytes([number])

    yield take
    signal.set_wakeup_fd(old_handlers)
    done.set()
    thread.join()
    receiver.close()
    tells.close()


@pytest.fixture
def stops():
    """What reached the handlers, each of which stops the main thread."""
    numbers = []

    def stop(number, frame):
        numbers.append(number)
        raise KeyboardInterrupt

    old_handlers = {number: signal.signal(number, stop) for number in STOP_SIGNALS}
    yield numbers
    for number, handler in old_handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("threads", ["one thread", "two threads"])
@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_waits_for_the_end_of_the_block(number, threads, stops, other_thread):
    send = signal.raise_signal if threads == "one thread" else other_thread
    reached = []
    with pytest.raises(KeyboardInterrupt):
        with delay_signals():
            send(number)
            for k in range(1000):
                reached.append(k)
        reached.append("after")
    assert reached == list(range(1000))
    assert stops == [number]


def test_only_the_first_ctrl_c_counts():
    old_handlers = signal.getsignal(signal.SIGINT)
    with ignore_repeated_ctrl_c():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        with delay_signals():
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is old_handlers


def test_a_handler_that_stops_nothing_hears_every_request():
    heard = []
    old_handler = signal.signal(
        signal.SIGINT, lambda number, frame: heard.append(number)
    )
    try:
        with ignore_repeated_ctrl_c():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, old_handler)
    assert heard == 2 * [signal.SIGINT]


def test_under_the_command_line_asking_twice_loses_nothing_either():
    with record_interrupts() as numbers, ignore_repeated_ctrl_c():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert numbers == [signal.SIGINT]

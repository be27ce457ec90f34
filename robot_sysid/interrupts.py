"""Moments in which a request to stop has to wait."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

STOPPING = tuple(getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n))
"""Signals by which a user or the system asks a program to end."""


@contextlib.contextmanager
def held_back(signals: tuple[signal.Signals, ...] = STOPPING) -> Iterator[None]:
    """Deliver these signals only after the block.

    A process that is started inside never gets them, where the system has signal masks.
    """
    with _masked(signals), _put_off(signals):
        yield


@contextlib.contextmanager
def only_the_first() -> Iterator[None]:
    """Let the first Ctrl-C inside that raises anything through; ignore those that follow it.

    Whoever is asked to stop needs a moment to save what there is; asking twice must not lose it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    before = signal.getsignal(signal.SIGINT)
    if not callable(before):  # Ignored, or whoever embeds Python sees to it.
        yield
        return
    heard = before

    def stop(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        heard(number, frame)
        signal.signal(signal.SIGINT, stop)  # It stopped nothing.

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _masked(signals: tuple[signal.Signals, ...]) -> Iterator[None]:
    """Keep signals from this thread; Windows has no masks."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _put_off(signals: tuple[signal.Signals, ...]) -> Iterator[None]:
    """Remember signals that another thread takes: Python handles them in this one all the same."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    late: list[int] = []

    def remember(number: int, frame: Any) -> None:
        late.append(number)

    known = [number for number in signals if signal.getsignal(number) is not None]
    before = {number: signal.signal(number, remember) for number in known}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for seen in dict.fromkeys(late):
            signal.raise_signal(seen)

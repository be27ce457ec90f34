"""Moments in which a request to stop has to wait."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2")
STOPPING = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
"""Signals by which a user or the system asks a program to end, and which end it unless heard."""


@contextlib.contextmanager
def heard_by(
    handler: Callable[[int, Any], object], ends: bool = False
) -> Iterator[None]:
    """Have these signals call ``handler`` inside the block.

    What nohup or a shell's ``&`` makes a process ignore stays ignored: it is meant for others. Only
    the main thread hears signals. After the block a process that ``ends`` hears none: Python's own
    way out would die of it instead of returning the exit code.
    """
    main = threading.current_thread() is threading.main_thread()
    asked = STOPPING if main else ()
    heard = [
        number for number in asked if signal.getsignal(number) is not signal.SIG_IGN
    ]
    before = {number: signal.signal(number, handler) for number in heard}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, signal.SIG_IGN if ends else usual)


@contextlib.contextmanager
def held_back(signals: tuple[signal.Signals, ...] = STOPPING) -> Iterator[None]:
    """Deliver these signals only after the block.

    A process that is started inside never gets them, where the system has signal masks.
    """
    late: dict[int, Any] = {}
    with contextlib.ExitStack() as after:
        if hasattr(signal, "pthread_sigmask"):  # Windows has no masks.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
            after.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        if threading.current_thread() is threading.main_thread():
            # Python handles here what another thread takes.
            known = [
                number for number in signals if signal.getsignal(number) is not None
            ]
            handlers = {
                number: signal.signal(number, late.setdefault) for number in known
            }
            after.callback(_deliver, late, handlers)
        yield


def _deliver(late: Mapping[int, Any], handlers: Mapping[signal.Signals, Any]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
    for seen in late:
        signal.raise_signal(seen)


@contextlib.contextmanager
def only_the_first() -> Iterator[None]:
    """Let the first Ctrl-C inside that raises anything through; ignore those that follow it.

    Whoever is asked to stop needs a moment to save what there is; asking twice must not lose it.
    """
    before: Any = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or not callable(
        before
    ):  # Ignored, or whoever embeds Python sees to it.
        yield
        return

    def stop(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        before(number, frame)
        signal.signal(signal.SIGINT, stop)  # It stopped nothing.

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)

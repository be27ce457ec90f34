"""Whether somebody still reads what a run prints: a run that nobody watches comes to rest.

A pipe whose reader has ended shows that only to who writes into it, and a run prints nothing for
minutes. The operating system is asked in each control cycle, which takes a microsecond.
"""

from __future__ import annotations

import contextlib
import os
import select
from collections.abc import Callable, Iterator, Sequence
from typing import Any


@contextlib.contextmanager
def watched_outputs(streams: Sequence[Any]) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether the reader of one of these streams has gone.

    Streams without a file, such as those of a notebook, count as read; so does every stream of an
    operating system that cannot be asked (Windows).

    Args:
        streams: text streams that are written.
    """
    if not hasattr(select, "poll"):
        yield lambda: False
        return
    # It reports errors and hang-ups whether they are asked for or not, and nothing else is.
    poll = select.poll()
    with contextlib.ExitStack() as stack:
        for stream in streams:
            # Printing may put another file in the stream's place, so that the pipe is kept here.
            with contextlib.suppress(AttributeError, OSError, ValueError):
                number = os.dup(stream.fileno())
                stack.callback(os.close, number)
                poll.register(number, 0)
        yield lambda: bool(poll.poll(0))

"""What is done beside a run neither stops it nor holds it up."""

from __future__ import annotations

import threading

import pytest

from robot_sysid.damiao.exchange.aside import Aside
from robot_sysid.errors import words_of


@pytest.mark.parametrize("threaded", [False, True])
def test_everything_is_done_in_order(threaded):
    done, aside = [], Aside(threaded)
    for k in range(100):
        aside(lambda k=k: done.append(k))
    aside.finish()
    assert done == list(range(100)) and aside.failure is None


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize(
    "error", [OSError(28, "full"), RuntimeError(), SystemExit(), MemoryError()]
)
def test_what_goes_wrong_is_kept_and_nothing_is_done_after_it(threaded, error):
    def fail():
        raise error

    done, aside = [], Aside(threaded)
    aside(fail)
    aside(lambda: done.append(1))
    aside.finish()
    assert aside.failure is error and done == []
    assert words_of(error) == ("full" if isinstance(error, OSError) else type(error).__name__)


def test_somebody_who_does_not_answer_is_not_waited_for():
    """A terminal held with Ctrl-S: handing over goes on at once, and the end does not wait long."""
    held, moved = threading.Event(), []
    aside = Aside(threaded=True)
    aside(held.wait)
    for _ in range(10):
        aside(lambda: None)
        aside.if_idle(lambda: moved.append(1))
    aside.finish(patience=0.01)
    assert isinstance(aside.failure, TimeoutError) and moved == []
    held.set()

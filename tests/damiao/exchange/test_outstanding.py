"""Every answer that is believed belongs to the command before it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.exchange.session import PAUSE, Outstanding

ONE = np.ones(1, bool)
# Cycles that an answer takes; None is lost. Up to as many as the pause can tell apart.
DELAYS = st.lists(st.integers(0, PAUSE) | st.none(), min_size=1, max_size=60)


@given(DELAYS)
def test_no_answer_is_taken_for_that_to_another_command(delays):
    books, underway = Outstanding(1), []
    for cycle in range(4 * len(delays) + 8):
        # What came too late for the cycle before is found at the beginning of this one.
        for _ in [each for each in underway if each[1] < cycle]:
            books.heard(0)
        underway = [each for each in underway if each[1] >= cycle]
        if books.may_be_told(ONE)[0]:
            delay = delays.pop(0) if delays else 0
            underway += [] if delay is None else [(cycle, cycle + delay)]
        for asked, _ in [each for each in underway if each[1] == cycle]:
            assert books.heard(0) == (asked == cycle)
        underway = [each for each in underway if each[1] > cycle]


def test_without_a_missing_answer_nobody_pauses():
    books = Outstanding(2)
    for _ in range(10):
        assert books.may_be_told(np.ones(2, bool)).all()
        assert books.heard(0) and books.heard(1)


def test_one_lost_answer_costs_the_pause_and_no_more():
    books = Outstanding(1)
    assert books.may_be_told(ONE)[0]
    assert [bool(books.may_be_told(ONE)[0]) for _ in range(PAUSE + 1)] == [False] * PAUSE + [True]
    assert books.heard(0)

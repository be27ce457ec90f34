"""Signals of the closed loop: the low-pass of positions, and what commands are ahead of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.records import Recording
from robot_sysid.servo.loop import (
    DELAYS,
    distances,
    goal_error,
    low_pass,
    low_pass_motion,
    rms,
)


def held(time, command):
    """Return a function of times that returns the command that holds then."""

    def at(instants):
        """Return the commands (M, n) at instants (M,)."""
        last = np.searchsorted(time, instants, side="right") - 1
        return command[np.maximum(last, 0)]

    return at


@pytest.mark.parametrize("delay", [0.0, 0.0125, 0.1])
def test_positions_that_are_late_commands_have_no_distance(delay):
    """A command holds until the next one; the first one holds before it was given."""
    # Numbers that floats hold exactly.
    time = np.arange(500) / 64.0
    command = np.sin(np.outer(time, [2.0, 3.0]))
    q = held(time, command)(time - delay)
    piece = Recording(time, q, None, command - q, command=command)
    assert_array_equal(distances([piece], delay), 0.0)
    assert rms(distances([piece], delay + 0.05)) > 0.05
    # The nearest delay that is tried is at most half a step away.
    assert goal_error([piece]) < 0.02
    assert goal_error([piece]) == min(rms(distances([piece], late)) for late in DELAYS)


def test_pieces_follow_one_another_and_no_command_of_one_acts_in_another():
    time = np.arange(20) / 64.0
    command = np.arange(20.0)[:, None]
    pieces = [
        Recording(start + time, 0.0 * command, None, command, command=command)
        for start in (0.0, 100.0)
    ]
    rows = distances(pieces, 2.0 / 64.0)[:, 0]
    expected = np.maximum(np.arange(20.0) - 2.0, 0.0)
    assert_array_equal(rows, np.tile(expected, 2))


@pytest.mark.parametrize("rate", [20.0, 50.0, 500.0])
def test_lines_at_uneven_time_stamps_and_parabolas_have_their_derivatives(rate):
    rng = np.random.default_rng(0)
    time = np.arange(300) / rate
    uneven = time + 0.2 / rate * low_pass(time, rng.normal(size=300))
    q = np.column_stack((1.0 + 2.0 * uneven, 3.0 * uneven))
    piece = Recording(uneven, q, None, q, command=q)
    _, qd, qdd = low_pass_motion(piece)
    inner = slice(100, -100)
    assert_allclose(qd[inner], np.tile([2.0, 3.0], (100, 1)), rtol=1e-9)
    assert_allclose(qdd[inner], 0.0, atol=1e-6 * rate**2)
    squares = np.square(time)[:, None]
    even = Recording(time, squares, None, squares, command=squares)
    _, qd, qdd = low_pass_motion(even)
    assert_allclose(qd[inner, 0], 2.0 * time[inner], rtol=1e-6)
    assert_allclose(qdd[inner, 0], 2.0, rtol=1e-4)

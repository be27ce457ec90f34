"""Windows of logs, played: how long they are, that they begin late, and what settings change."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from robot_sysid.errors import InputError
from robot_sysid.records import Recording
from robot_sysid.records.servo_setting import UNKNOWN, parse_servo_setting
from robot_sysid.servo.setting import loaded, with_setting
from robot_sysid.servo.windows import BEGINNING, LEAST_WINDOW, WINDOW, ServoProblem
from robot_sysid.simulation.playback import MAX_WINDOWS

ARM = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" armature=".02" damping=".1"/>
<inertial pos=".1 0 0" mass=".3" diaginertia="2e-4 5e-4 5e-4"/></body></worldbody>
<actuator><position joint="lift" kp="20"/></actuator></mujoco>"""
TRUTH = servo_logs.servos([[16.0], [0.4], [0.05], [0.03]], 0.035, 4.0)
RATE = 50.0


def log_of(seconds=3.0, setting=UNKNOWN, servos=TRUTH, seed=0):
    """An arm in some setting, read without an encoder's steps."""
    robot = loaded(robot_of(ARM), setting)
    time, command = servo_logs.sines_and_steps(seconds, seed)
    command = command[:, :1]
    own = with_setting(servos, setting, FIRST)
    q = servo_logs.exact_positions(robot, time, command, own, steps=20)
    piece = Recording(time, q, None, command - q, command=command)
    return replace(piece, setting=setting)


FIRST = parse_servo_setting("kp=400, voltage=7")
OTHER = parse_servo_setting("kp=200, voltage=6, load=0.2 at 0.1")


def problem_of(pieces, delay=TRUTH.delay):
    return ServoProblem(robot_of(ARM), pieces, FIRST, delay)


def test_true_numbers_play_what_was_measured():
    problem = problem_of([log_of(seconds=4.0)])
    errors = problem.errors(TRUTH, 1e-3)
    assert errors.shape == problem.measured.shape
    # A start's velocity is read behind a low-pass.
    assert np.sqrt(np.mean(errors**2)) < 2e-3
    wrong = replace(TRUTH, numbers=TRUTH.numbers * [[1.0], [2.0], [1.0], [1.0]])
    before, after, is_worse = problem.test(TRUTH, wrong)
    assert after[0] > 3.0 * before[0]
    assert before[0] == pytest.approx(np.sqrt(np.mean(problem.errors(TRUTH) ** 2)))


@pytest.mark.parametrize(
    ("lengths", "expected"),
    [((9.0,), WINDOW), ((9.0, 2.0), 2.0 - BEGINNING), ((1.0,), 1.0 - BEGINNING)],
)
def test_windows_are_as_long_as_the_shortest_piece_allows(lengths, expected):
    pieces = [still(seconds) for seconds in lengths]
    problem = problem_of(pieces, delay=0.0)
    assert problem.length == pytest.approx(expected, abs=1.5 / RATE)
    count = int(problem.length / (1.0 / RATE))
    assert problem.times.shape[1] == count
    # No window begins where commands act that came before its piece.
    for window in problem.windows:
        assert window.start >= BEGINNING - 1e-9


def still(seconds):
    time = np.arange(round(seconds * RATE) + 1) / RATE
    q = np.zeros((len(time), 1))
    return Recording(time, q, None, q, command=q)


def test_a_delay_and_what_a_servo_takes_to_follow_come_before_the_first_window():
    problem = problem_of([still(6.0)], delay=0.4)
    first = min(window.start for window in problem.windows)
    assert 0.4 < first < 0.5


@pytest.mark.parametrize("seconds", [0.1, BEGINNING + 0.5 * LEAST_WINDOW])
def test_a_piece_that_is_too_short_is_refused_with_what_it_needs(seconds):
    with pytest.raises(InputError, match=rf"needs {LEAST_WINDOW:g} s; record longer"):
        problem_of([still(9.0), still(seconds)])


def test_of_many_windows_some_are_judged():
    problem = problem_of([still(400.0)], delay=0.0)
    assert MAX_WINDOWS / 2 <= len(problem.windows) <= MAX_WINDOWS
    starts = [window.start for window in problem.windows]
    # They are spread over all of the log.
    assert starts[-1] > 400.0 - 4.0 * WINDOW


def test_windows_of_each_setting_are_played_with_its_gain_its_limit_and_its_load():
    pieces = [log_of(setting=setting) for setting in (FIRST, OTHER)]
    problem = problem_of(pieces)
    errors = problem.errors(TRUTH, 1e-3)
    assert np.sqrt(np.mean(errors**2)) < 3e-3
    # As if all were recorded as the first one.
    unknown = [replace(piece, setting=FIRST) for piece in pieces]
    of_one = problem_of(unknown).errors(TRUTH, 1e-3)
    assert_array_equal(of_one[0], errors[0])
    assert np.sqrt(np.mean(of_one[1:] ** 2)) > 5.0 * np.sqrt(np.mean(errors[1:] ** 2))


def test_a_model_that_diverges_is_as_wrong_as_can_be():
    problem = problem_of([log_of()])
    pushed_away = np.array([[-1e4], [0.0], [0.0], [0.03]])
    mad = replace(TRUTH, numbers=pushed_away, limits=np.full(1, np.inf))
    errors = problem.errors(mad)
    assert np.all(np.isfinite(errors))
    assert errors[0, -1, 0] == np.pi
    before, after, is_worse = problem.test(TRUTH, mad)
    assert after[0] > before[0]
    assert np.all(np.isfinite([before, after]))


def test_a_difference_that_no_encoder_shows_is_no_reason():
    """Clearly worse is what exceeds a third of an encoder's step."""
    problem = problem_of([log_of(seconds=6.0)], delay=0.5)
    slightly = replace(TRUTH, numbers=TRUTH.numbers * 1.0001)
    *_, is_worse = problem.test(TRUTH, slightly)
    assert not np.any(is_worse)
    assert_allclose(*problem.test(TRUTH, TRUTH)[:2], rtol=0.0)

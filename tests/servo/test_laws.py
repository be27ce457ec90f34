"""Laws of servos: what is put in comes out, whatever the numbers are."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.small_arms import robot_of
from rigs.logs.servo_logs import positions, sines_and_steps
from robot_sysid.records import Recording
from robot_sysid.servo.equations import loop_columns, solve_not_negative
from robot_sysid.servo.fit import fit_servos
from robot_sysid.servo.loop import distances, goal_error, low_pass, low_pass_motion
from robot_sysid.simulation.playback import ServoParameters

ARM = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".1 0 .02" mass="{lift}" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".15 0 0"><joint name="elbow" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".08 0 .01" mass="{elbow}" diaginertia="1e-4 3e-4 3e-4"/></body></body></worldbody>
<actuator><position joint="lift" kp="20"/><position joint="elbow" kp="20"/></actuator></mujoco>"""
"""Two joints that carry links."""


def arm(heavier=1.0):
    return robot_of(ARM.format(lift=0.4 * heavier, elbow=0.3 * heavier))


def random_servos(seed):
    """Servos of any numbers that samples of 50 Hz resolve."""
    rng = np.random.default_rng(seed)
    usual = np.array([14.0, 0.5, 0.06, 0.03])[:, None]
    numbers = usual * np.exp(rng.uniform(-0.5, 0.5, (4, 2)))
    return ServoParameters(numbers, rng.uniform(0.0, 0.05), np.zeros(2))


def log_of(robot, servos, seed=0):
    time, command = sines_and_steps(20.0, seed)
    q = positions(robot, time, command, servos, steps=20)
    return Recording(time, q, None, command - q, command=command)


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("seed", range(5))
def test_true_numbers_are_found_within_their_errors(seed):
    servos = random_servos(seed)
    fit = fit_servos(arm(), [log_of(arm(), servos, seed)])
    assert fit.is_known.all() and not fit.is_fast.any()
    assert np.all(np.abs(fit.numbers - servos.numbers) < 2.0 * fit.errors)
    assert abs(fit.delay - servos.delay) < 3.0 * fit.delay_error


@pytest.mark.slow
def test_errors_of_delays_are_as_large_as_stated():
    """None is far off, and none is so near all the time that its ± says nothing."""
    offs = []
    for seed in range(20):
        servos = random_servos(seed)
        fit = fit_servos(arm(), [log_of(arm(), servos, seed)])
        offs.append((fit.delay - servos.delay) / fit.delay_error)
    assert np.max(np.abs(offs)) < 2.5
    assert 0.5 < np.sqrt(np.mean(np.square(offs))) < 1.1


def test_a_delay_on_which_joints_disagree_is_less_sure():
    """What is missed of a joint moves its own delay: that of the second is 12 ms longer here."""
    piece = log_of(arm(), random_servos(1))
    late = piece.command.copy()
    late[:, 1] = np.interp(piece.time + 0.012, piece.time, piece.command[:, 1])
    other = Recording(piece.time, piece.q, None, late - piece.q, command=late)
    sure, unsure = (fit_servos(arm(), [log]).delay_error for log in (piece, other))
    assert unsure > 5.0 * sure


def test_the_equations_hold_of_true_numbers_alone():
    servos = random_servos(1)
    piece = log_of(arm(), servos)
    columns, *_ = loop_columns(arm(), [piece])
    gain, *others = servos.numbers
    values = np.stack((1.0 / gain, *(number / gain for number in others)))
    is_moving = np.abs(columns[:, :, 1]) > 0.3

    def misfit(values, delay):
        left = distances([piece], delay) - np.einsum("ijk,kj->ij", columns, values)
        return np.sqrt(np.mean(left[is_moving] ** 2))

    right = misfit(values, servos.delay)
    size = np.sqrt(np.mean(distances([piece], servos.delay)[is_moving] ** 2))
    assert right < 0.05 * size
    assert misfit(values, servos.delay + 0.01) > 2.0 * right
    for k in range(4):
        wrong = values.copy()
        wrong[k] *= 1.5
        assert misfit(wrong, servos.delay) > 1.2 * right


@pytest.mark.slow
def test_a_log_shows_no_unit_of_torque():
    """Of links with twice the mass all numbers are twice as large, and the delay is the same."""
    heavy = robot_of(
        ARM.format(lift=0.8, elbow=0.6)
        .replace("2e-4 5e-4 5e-4", "4e-4 1e-3 1e-3")
        .replace("1e-4 3e-4 3e-4", "2e-4 6e-4 6e-4")
        .replace('kp="20"', 'kp="40"')
    )
    piece = log_of(arm(), random_servos(2))
    light = fit_servos(arm(), [piece])
    twice = fit_servos(heavy, [piece])
    assert_allclose(twice.numbers, 2.0 * light.numbers, rtol=1e-6)
    assert_allclose(twice.errors, 2.0 * light.errors, rtol=1e-6)
    assert twice.delay == pytest.approx(light.delay, rel=1e-6)


@pytest.mark.slow
def test_pieces_of_a_log_are_one_log():
    """But for the samples at their ends, which the low-pass repeats."""
    piece = log_of(arm(), random_servos(3))
    whole = fit_servos(arm(), [piece])
    half = len(piece) // 2
    parts = fit_servos(arm(), [piece[:half], piece[half:]])
    assert np.all(np.abs(parts.numbers - whole.numbers) < whole.errors)


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.1])
def test_positions_that_are_late_commands_have_no_distance(delay):
    """Of commands that hold until the next one, a servo sees a wave half a period later.

    It is smaller than the wave through the commands, by a sinc.
    """
    time = np.arange(500) / 50.0
    waves = np.array([2.0, 3.0])
    command = np.sin(np.outer(time, waves))
    size = np.sinc(0.02 * waves / (2.0 * np.pi))
    q = size * np.sin(np.outer(time - delay - 0.01, waves))
    piece = Recording(time, q, None, command - q, command=command)
    inner = slice(20, -20)
    assert np.max(np.abs(distances([piece], delay)[inner])) < 1e-5
    assert np.max(np.abs(distances([piece], delay + 0.05)[inner])) > 0.05
    assert goal_error([piece]) < 0.02


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


@pytest.mark.parametrize("seed", range(10))
def test_no_value_is_negative_and_none_is_held_that_need_not_be(seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(30, 4))
    truth = np.maximum(rng.normal(size=4), 0.0)
    target = rows @ truth + 0.1 * rng.normal(size=30)
    table = np.column_stack((rows, target))
    values = solve_not_negative(table.T @ table, np.ones(4, dtype=bool))
    assert np.all(values >= 0.0)
    slope = rows.T @ (target - rows @ values)
    # Of free values the slope is zero; that of held ones would push them below zero.
    assert_allclose(slope[values > 0.0], 0.0, atol=1e-8)
    assert np.all(slope[values == 0.0] < 1e-8)


def test_values_of_which_none_may_be_positive_are_all_zero():
    table = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -2.0]])
    values = solve_not_negative(table.T @ table, np.ones(2, dtype=bool))
    assert values.tolist() == [0.0, 0.0]

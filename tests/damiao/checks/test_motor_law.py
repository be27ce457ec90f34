"""Gains of a motor's law, estimated together with the ages of what it reports."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.checks.motor_law import MotorRows, MotorSteps, estimate_factors

PERIOD = 0.004
KP = 60.0
KD = 1.5
AGES = {"position": 0.7, "velocity": 1.6}
"""How much older than in its row the position and velocity are that made a torque [cycles]."""


def signals_of(factors, rng, n_rows=2000):
    """Return the columns of a motor that makes ``factors`` (3,) of what its law asks for."""
    time = PERIOD * np.arange(n_rows) + 1e-4 * rng.uniform(size=n_rows)
    position_time = time - PERIOD * AGES["position"]
    velocity_time = time - PERIOD * AGES["velocity"]
    rates = rng.uniform(2.0, 9.0, 4)
    command = 0.5 * np.sin(rates[0] * time)
    command_speed = 0.5 * rates[0] * np.cos(rates[0] * time)

    def position(moments):
        return 0.5 * np.sin(rates[0] * moments) + 0.02 * np.sin(rates[1] * moments)

    def speed(moments):
        path = 0.5 * rates[0] * np.cos(rates[0] * moments)
        return path + 0.02 * rates[1] * np.cos(rates[1] * moments)

    fed = 2.0 * np.cos(rates[2] * time) + np.sin(rates[3] * time)
    parts = (
        fed,
        KP * (command - position(position_time)),
        KD * (command_speed - speed(velocity_time)),
    )
    torque = np.array(factors) @ parts
    return {
        "time": time,
        "pos": position(time),
        "vel": speed(time) + 0.05 * rng.standard_normal(n_rows),
        "tau": torque + 0.02 * rng.standard_normal(n_rows),
        "cmd_pos": command,
        "cmd_vel": command_speed,
        "cmd_tau": fed,
        "cmd_mean": 0.0 * time,
    }


@pytest.mark.parametrize("seed", range(5))
def test_factors_are_found_within_their_errors_whatever_the_ages_are(seed):
    rng = np.random.default_rng(seed)
    factors = rng.uniform(0.0, 1.5, 3)
    rows = MotorRows.of(signals_of(factors, rng), KP, KD)
    estimate, errors = estimate_factors(rows, MotorSteps())
    assert np.all(np.abs(estimate - factors) < 4.0 * errors + 0.01)
    assert np.all(errors < [0.05, 0.05, 0.2])


def test_rows_around_a_lost_answer_are_not_judged():
    signals = signals_of([1.0, 1.0, 1.0], np.random.default_rng(0), n_rows=40)
    signals["pos"][20] = np.nan
    rows = MotorRows.of(signals, KP, KD)
    expected = [*range(4, 16), *range(24, 35)]
    assert np.flatnonzero(rows.is_judged).tolist() == expected
    assert len(rows.signals["time"]) == 39


def test_rows_around_a_cycle_that_was_left_out_are_not_judged():
    signals = signals_of([1.0, 1.0, 1.0], np.random.default_rng(0), n_rows=40)
    signals["time"][20:] += PERIOD
    rows = MotorRows.of(signals, KP, KD)
    expected = [*range(4, 16), *range(24, 36)]
    assert np.flatnonzero(rows.is_judged).tolist() == expected

"""Equations of a log: both sides filtered alike, the truth solves them, masks only leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.information import combined
from robot_sysid.estimation.dataset import DecimatedSamples, JoinedSamples, decimated_equations
from robot_sysid.signals.process import process
from tests.support.arms import SEEDS
from tests.support.measured_logs import CUTOFF, equations_of, guessed, log_of, true_arm, true_values


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def signals(plant):
    return process(log_of(plant), plant.joint_names, CUTOFF)


def random_samples(seed, count=40):
    """Two joints that share their first two of five parameters."""
    rng = np.random.default_rng(seed)
    tau = rng.normal(size=(2, count))
    tau[rng.random((2, count)) < 0.3] = np.nan
    return DecimatedSamples(
        names=("a", "b", "c", "d", "e"),
        joints=("one", "two"),
        columns=(np.array([0, 1, 2]), np.array([0, 1, 3, 4])),
        time=np.arange(float(count)),
        rows=(rng.normal(size=(count, 3)), rng.normal(size=(count, 4))),
        tau=tuple(tau),
        measured=tuple(rng.normal(size=(2, count))),
    )


def test_the_truth_solves_the_filtered_equations(plant, signals):
    """Whatever the guess is: other values of the terminal link and no friction at all."""
    equations = equations_of(guessed(plant))
    samples = decimated_equations(equations, signals)
    truth = true_values(plant, samples.names)
    for rows, tau, columns in zip(samples.rows, samples.tau, samples.columns):
        used = np.isfinite(tau)
        assert np.count_nonzero(used) > 80
        error = tau[used] - rows[used] @ truth[columns]
        # What remains: the low-pass changes motion a little before the equations are built.
        assert np.max(np.abs(error)) < 2e-3 * np.max(np.abs(tau[used]))


def test_rows_stand_at_the_decimated_instants_and_masked_ones_stay_in_place(plant, signals):
    samples = decimated_equations(equations_of(plant), signals)
    np.testing.assert_array_equal(samples.time, signals.decimated_time())
    for tau, usable in zip(samples.tau, signals.usable().T):
        np.testing.assert_array_equal(np.isfinite(tau), usable)


def test_a_log_without_motion_is_refused_with_the_remedy(plant, signals):
    still = replace(signals, deadband=np.full(3, 1e3))
    with pytest.raises(InputError, match="faster than its velocity deadband; record a motion, or"):
        decimated_equations(equations_of(plant), still)


@given(SEEDS)
def test_parts_add_up_to_the_whole(seed):
    samples = random_samples(seed)
    first = np.random.default_rng(seed).random(len(samples)) < 0.5
    parts = [samples.where(first).information(), samples.where(~first).information()]
    whole, joined = samples.information(), combined(parts)
    x = np.random.default_rng(seed + 1).normal(size=5)
    np.testing.assert_allclose(whole.squared_residuals(x), joined.squared_residuals(x), rtol=1e-10)
    assert whole.n_samples == joined.n_samples


@given(SEEDS)
def test_logs_joined_hold_the_information_of_both(seed):
    first, second = random_samples(seed, 40), random_samples(seed + 1, 25)
    both = JoinedSamples((first, second))
    names = [joint.joint for joint in both.information().joints]
    assert (both.information().names, names) == (first.names, list(first.joints))
    x = np.random.default_rng(seed + 2).normal(size=5)
    apart = sum(s.information().squared_residuals(x) for s in (first, second))
    np.testing.assert_allclose(both.information().squared_residuals(x), apart, rtol=1e-10)
    squared = first.squared_torque() + second.squared_torque()
    np.testing.assert_allclose(both.squared_torque(), squared, rtol=1e-12)

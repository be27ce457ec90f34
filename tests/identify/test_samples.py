"""Equations of a log: both sides filtered alike, the truth solves them, masks only leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from robot_sysid.errors import InputError
from robot_sysid.estimation.information import combined
from robot_sysid.identify import samples as samples_module
from robot_sysid.identify.samples import DecimatedSamples, decimated_equations, joined
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
        blocks=((rng.normal(size=(count, 3)),), (rng.normal(size=(count, 4)),)),
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


@pytest.mark.parametrize("chunk", [7, 100, 5000])
def test_the_chunk_size_changes_nothing(plant, signals, chunk, monkeypatch):
    whole = decimated_equations(equations_of(plant), signals)
    monkeypatch.setattr(samples_module, "_CHUNK", chunk)
    parts = decimated_equations(equations_of(plant), signals)
    for one, other in zip((*whole.rows, *whole.tau), (*parts.rows, *parts.tau)):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


def test_rows_stand_at_the_decimated_instants_and_masked_ones_stay_in_place(plant, signals):
    samples = decimated_equations(equations_of(plant), signals)
    np.testing.assert_array_equal(samples.time, signals.decimated_time())
    for tau, usable in zip(samples.tau, signals.usable().T):
        np.testing.assert_array_equal(np.isfinite(tau), usable)


def test_terminal_torques_give_one_joints_equations(plant, signals):
    samples = decimated_equations(equations_of(plant, "terminal"), signals)
    assert samples.joints == (plant.terminal_joint,)
    assert len(samples.names) == 14


def test_shared_columns_pass_the_same_low_pass(plant, signals):
    equations = equations_of(plant, shared=("late",))
    samples = decimated_equations(
        equations, signals, lambda motion, place: signals.tau[place][:, :, None]
    )
    for rows, measured in zip(samples.rows, samples.measured):
        np.testing.assert_array_equal(rows[:, -1], measured)


def test_a_log_without_motion_is_refused_with_the_remedy(plant, signals):
    still = replace(signals, deadband=np.full(3, 1e3))
    with pytest.raises(InputError, match="faster than its velocity deadband; record a motion, or"):
        decimated_equations(equations_of(plant), still)


def test_a_zero_deadband_uses_every_row(plant):
    log = log_of(plant, encoder_resolution=1e-6)  # without noise, corners would be masked
    signals = process(log, cutoff=CUTOFF, deadband=0.0)
    samples = decimated_equations(equations_of(plant), signals)
    assert all(np.all(np.isfinite(tau)) for tau in samples.tau)


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
def test_residuals_of_the_deviation_are_those_of_the_sum(seed):
    samples, rng = random_samples(seed), np.random.default_rng(seed + 1)
    prior, step = rng.normal(size=(2, 5))
    np.testing.assert_allclose(
        samples.information().squared_residuals(prior + step),
        samples.deviation(prior).information().squared_residuals(step),
        rtol=1e-10,
    )


@given(SEEDS)
def test_the_samples_in_use_hold_all_the_information(seed):
    samples = random_samples(seed)
    used = samples.used()
    assert all(np.all(np.isfinite(tau)) for tau in used.tau)
    x = np.random.default_rng(seed + 1).normal(size=5)
    residuals = [
        np.sum((rows @ x[columns] - tau) ** 2)
        for rows, tau, columns in zip(used.rows, used.tau, used.columns)
    ]
    np.testing.assert_allclose(samples.information().squared_residuals(x), residuals, rtol=1e-10)


@settings(max_examples=20)
@given(SEEDS)
def test_squared_torque_counts_only_what_is_used(seed):
    samples = random_samples(seed)
    expected = [
        sum(m**2 for m, t in zip(measured, tau) if np.isfinite(t))
        for measured, tau in zip(samples.measured, samples.tau)
    ]
    np.testing.assert_allclose(samples.squared_torque(), expected, rtol=1e-12)


@given(SEEDS)
def test_logs_joined_hold_the_information_of_both(seed):
    first, second = random_samples(seed, 40), random_samples(seed + 1, 25)
    both = joined([first, second])
    assert len(both) == 65 and (both.names, both.joints) == (first.names, first.joints)
    x = np.random.default_rng(seed + 2).normal(size=5)
    apart = sum(s.information().squared_residuals(x) for s in (first, second))
    np.testing.assert_allclose(both.information().squared_residuals(x), apart, rtol=1e-10)
    squared = first.squared_torque() + second.squared_torque()
    np.testing.assert_allclose(both.squared_torque(), squared, rtol=1e-12)
    np.testing.assert_array_equal(both.time, np.concatenate((first.time, second.time)))


@given(SEEDS)
def test_logs_joined_joint_by_joint_are_the_logs_joined(seed):
    parts = (random_samples(seed), random_samples(seed + 1, 25))
    at_once, one_by_one = joined(parts), samples_module.JoinedSamples(parts)
    for (_, rows, tau), (_, same_rows, same_tau) in zip(at_once, one_by_one):
        np.testing.assert_array_equal(rows, same_rows)
        np.testing.assert_array_equal(tau, same_tau)
    both = [each.information().squared_residuals(np.ones(5)) for each in (at_once, one_by_one)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-12)
    np.testing.assert_allclose(at_once.squared_torque(), one_by_one.squared_torque(), rtol=1e-12)


@given(SEEDS)
def test_columns_of_one_joint_alone_are_columns_that_are_zero_elsewhere(seed):
    samples, rng = random_samples(seed), np.random.default_rng(seed)
    own = [rng.normal(size=(40, 1)) for _ in samples.joints]
    few = samples.with_columns(("f", "g"), own, [np.array([0]), np.array([1])])
    zero = np.zeros((40, 1))
    full = samples.with_columns(("f", "g"), [np.hstack((own[0], zero)), np.hstack((zero, own[1]))])
    values = rng.normal(size=7)
    wrong = [each.information().squared_residuals(values) for each in (few, full)]
    np.testing.assert_allclose(wrong[0], wrong[1], rtol=1e-12)

"""Parts of recordings are predicted from the others, and choices are judged by that alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.dataset import block_masks
from robot_sysid.estimation.held_out import held_out, is_clearly_lower
from tests.support.core_fits import KNOWN, datasets_of, fitted


def equations(part, sought, weights):
    """Yield each joint's (rows (M, k), right-hand sides (M,)) in what is sought."""
    for weight, rows, tau, places in zip(weights, part.rows, part.tau, part.columns):
        full, used = np.zeros((len(rows), len(sought.names))), np.isfinite(tau)
        full[:, places] = rows
        known = np.delete(full, sought.kept, 1) @ np.delete(sought.held, sought.kept)
        yield weight * full[used][:, sought.kept], weight * (tau - known)[used]


def test_each_block_is_predicted_from_the_others(robot, noisy):
    """Done again by hand, with the rows themselves."""
    (log,), options = datasets_of(robot, noisy)
    fit = fitted(robot, [log], options)
    judge, (samples,), sought = held_out(fit), fit.samples, fit.unknowns
    prior = np.vstack([group.rows(sought.kept_names) for group in sought.groups])
    for mask, squared in zip(block_masks(samples), judge.squared(sought)):
        rest = list(equations(samples.where(~mask), sought, 1.0 / judge.noise))
        matrix = np.vstack([*(rows for rows, _ in rest), prior[:, :-1]])
        right = np.concatenate([*(tau for _, tau in rest), prior[:, -1]])
        values = np.linalg.lstsq(matrix, right, rcond=None)[0]
        parts = equations(samples.where(mask), sought, np.ones(3))
        left = [np.sum((rows @ values - tau) ** 2) for rows, tau in parts]
        np.testing.assert_allclose(squared, left, rtol=1e-4)


def test_the_error_is_that_of_the_noise(payload_fit):
    judge = held_out(payload_fit)
    found = judge.validation(judge.of(payload_fit), "parts")
    noise = np.sqrt(np.mean(payload_fit.weighted.noise**2))
    assert found.rmse == pytest.approx(noise, rel=0.15)
    assert 0.0 < found.relative_error < 0.05
    assert tuple(found.rmse_per_joint) == payload_fit.columns.joints
    assert judge.score(judge.of(payload_fit)) == pytest.approx(1.0, abs=0.3)


def test_a_fit_is_judged_with_bodies_that_are_possible(robot, noisy):
    """Noise ten times as large: what a block alone would give is impossible."""
    loud = replace(
        noisy, tau=noisy.tau + 3.0 * np.random.default_rng(1).normal(size=noisy.tau.shape)
    )
    (log,), options = datasets_of(robot, loud, **KNOWN)
    fit = fitted(robot, [log], options)
    assert spatial.is_consistent(fit.values[:10]) and fit.constrained
    judge = held_out(fit)
    assert np.sum(judge.of(fit)) < np.sum(judge.squared(fit.unknowns))


def test_a_stretch_that_shows_friction_far_more_than_others_does_not_hide_it():
    """Every stretch is far better; their gains differ by a factor of a hundred."""
    before = np.array([4.2, 3.9, 2.8, 3.9, 400.0])
    assert is_clearly_lower(before / 5.0, before)


def test_a_fit_that_failed_is_never_taken_and_always_left():
    good, bad = np.ones(5), np.array([1.0, 1.0, np.inf, 1.0, 1.0])
    assert is_clearly_lower(good, bad) and not is_clearly_lower(0.1 * bad, good)


@given(st.floats(1e-12, 1e12), st.lists(st.floats(0.1, 10.0), min_size=5, max_size=5))
def test_units_do_not_decide(scale, ratios):
    before = np.linspace(1.0, 3.0, 5)
    after = before * np.array(ratios)
    assert is_clearly_lower(scale * after, scale * before) == is_clearly_lower(after, before)

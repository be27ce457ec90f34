"""Prediction error on held-out data, the same from samples and from triangles."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.errors import InputError
from robot_sysid.estimation.cross_validation import blocks, choose_model, hold_out, validate
from robot_sysid.estimation.information import InformationAccumulator, combined, restricted
from robot_sysid.records import SquareRootInformation

JOINTS = ("shoulder", "elbow")


def held_out(rows, tau) -> SquareRootInformation:
    """Information of two joints; NaN where a sample is left out."""
    accumulator = InformationAccumulator("abc", JOINTS, [np.arange(3)] * 2)
    for joint in range(2):
        keep = np.isfinite(tau[:, joint])
        accumulator.add(joint, rows[joint][keep], tau[keep, joint])
    return accumulator.result()


@given(st.integers(0, 2**32), st.floats(0.0, 0.5))
def test_triangles_give_the_errors_of_the_textbook_formulas(seed, left_out):
    rng = np.random.default_rng(seed)
    rows, values = rng.normal(size=(2, 60, 3)), rng.normal(size=3)
    tau = rng.normal(size=(60, 2)) * [5.0, 0.5]
    tau[rng.random(tau.shape) < left_out] = np.nan
    total = np.nansum(tau**2, axis=0)
    result = validate(held_out(rows, tau), values, "test", total)
    wrong = tau - np.stack([rows[j] @ values for j in range(2)], axis=1)
    assert result.rmse == pytest.approx(np.sqrt(np.nanmean(wrong**2)), rel=1e-9)
    whole = np.sqrt(np.nansum(wrong**2) / np.sum(total))
    assert result.relative_error == pytest.approx(whole, rel=1e-9)
    each = np.sqrt(np.nansum(wrong**2, axis=0) / total)
    assert list(result.relative_error_per_joint.values()) == pytest.approx(list(each), rel=1e-9)
    rmse = np.sqrt(np.nanmean(wrong**2, axis=0))
    assert list(result.rmse_per_joint.values()) == pytest.approx(list(rmse), rel=1e-9)
    assert tuple(result.rmse_per_joint) == JOINTS
    assert result.n_samples == np.max(np.count_nonzero(np.isfinite(tau), axis=0))


def test_the_whole_measured_torque_sets_the_scale():
    """The right-hand sides lack what the rest of the arm explains."""
    rng = np.random.default_rng(0)
    rows, tau = rng.normal(size=(2, 60, 3)), rng.normal(size=(60, 2))
    values = rng.normal(size=3)
    result = validate(held_out(rows, tau), values, "t", np.array([1e4, 3e4]))
    assert result.relative_error == pytest.approx(result.rmse * np.sqrt(120 / 4e4), rel=1e-9)
    elbow = result.rmse_per_joint["elbow"] * np.sqrt(60 / 3e4)
    assert result.relative_error_per_joint["elbow"] == pytest.approx(elbow, rel=1e-9)


def test_a_joint_without_torque_has_no_relative_error():
    rows = np.ones((2, 1, 3))
    tau = np.array([[1.0, 0.0]])
    result = validate(held_out(rows, tau), np.array([0.5, 0.0, 0.0]), "t", np.array([1.0, 0.0]))
    assert result.relative_error_per_joint["elbow"] is None
    assert result.relative_error_per_joint["shoulder"] == pytest.approx(0.5, rel=1e-12)


def test_nothing_to_validate_on_is_said():
    nothing = held_out(np.ones((2, 1, 3)), np.full((1, 2), np.nan))
    with pytest.raises(InputError, match="no usable torque samples to validate on in the last"):
        validate(nothing, np.zeros(3), "the last 20 %", np.zeros(2))


@given(st.integers(0, 2**32), st.integers(40, 3000), st.floats(0.01, 0.5), st.integers(0, 3))
def test_parts_are_a_gap_apart_and_the_arm_moves_where_it_is_held_out(seed, n_rows, fraction, gap):
    moving = np.random.default_rng(seed).random(n_rows) < 0.8
    fitted, held = hold_out(moving, fraction, gap)
    assert np.all(moving[held])
    share = np.count_nonzero(held) / np.count_nonzero(moving)
    assert fraction <= share < fraction + 10.0 / np.count_nonzero(moving)
    apart = np.abs(np.flatnonzero(fitted)[:, None] - np.flatnonzero(held)[None, :])
    assert np.min(apart) == gap + 1
    assert held[np.flatnonzero(moving)[-1]]


def test_a_long_log_is_tested_all_along_it_and_not_where_it_stands_still():
    moving = np.arange(5000) % 1000 < 600
    _, held = hold_out(moving, 0.2, 5)
    assert [np.any(held[k : k + 1000]) for k in range(0, 5000, 1000)] == [True] * 5


def test_holding_out_nothing_fits_everything():
    fitted, held = hold_out(np.ones(10, dtype=bool), 0.0, gap=5)
    assert np.all(fitted) and not np.any(held)


@pytest.mark.parametrize("moving", [np.ones(5, dtype=bool), np.zeros(50, dtype=bool)])
def test_a_split_without_rows_to_fit_or_to_test_is_refused(moving):
    with pytest.raises(InputError, match="cannot be split"):
        hold_out(moving, 0.5, gap=3)


@given(st.integers(2, 12), st.integers(12, 5000))
def test_blocks_cover_all_rows_once_and_evenly(count, n_rows):
    cut = blocks(n_rows, count)
    assert np.concatenate([np.arange(n_rows)[part] for part in cut]).tolist() == list(range(n_rows))
    lengths = [part.stop - part.start for part in cut]
    assert max(lengths) - min(lengths) <= 1


def test_too_few_rows_for_blocks_are_refused():
    with pytest.raises(InputError, match="3 rows cannot be cut into 5 blocks; record longer"):
        blocks(3, 5)


FULL = friction_model("coulomb-viscous-offset-sqrt-stribeck")
TERMS = ("inertia", *FULL.parameter_names("j"))
CANDIDATES = ("none", "viscous", "coulomb-viscous", "coulomb-viscous-offset",
              "coulomb-viscous-sqrt", FULL.name)  # fmt: skip


def least_squares(information: SquareRootInformation) -> np.ndarray:
    matrix, right = information.stacked()
    return np.linalg.lstsq(matrix, right, rcond=None)[0]


def data(seed: int, true: str, noise: float, n: int = 500) -> list[SquareRootInformation]:
    """One joint with an inertia and the friction model ``true``; information of five blocks."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * 0.02
    omega = rng.uniform(1.0, 6.0, 3)
    phase = rng.uniform(0.0, 6.0, 3)
    qd = np.cos(np.outer(time, omega) + phase) @ [0.4, 0.7, 0.3]
    qdd = -np.sin(np.outer(time, omega) + phase) @ ([0.4, 0.7, 0.3] * omega)
    model = friction_model(true)
    tau = 0.3 * qdd + model.columns(qd, qdd, qdd) @ rng.uniform(0.5, 1.5, len(model.terms))
    tau += noise * rng.normal(size=n)
    rows = np.column_stack((qdd, FULL.columns(qd, qdd, qdd)))
    return [information(rows[part], tau[part]) for part in blocks(n, 5)]


def information(rows: np.ndarray, tau: np.ndarray) -> SquareRootInformation:
    accumulator = InformationAccumulator(TERMS, ("j",), [np.arange(len(TERMS))])
    accumulator.add(0, rows, tau)
    return accumulator.result()


def candidates(parts: list[SquareRootInformation]) -> dict[str, list[SquareRootInformation]]:
    chosen = {}
    for name in CANDIDATES:
        kept = ("inertia", *friction_model(name).parameter_names("j"))
        chosen[name] = list(map(partial(restricted, names=kept), parts))
    return chosen


@given(st.integers(0, 2**32), st.sampled_from(["viscous", "coulomb-viscous"]))
def test_the_model_that_made_the_data_is_never_judged_too_simple(seed, true):
    choice = choose_model(candidates(data(seed, true, 0.05)), least_squares)
    contained = [name for name in CANDIDATES if set(_terms(true)) <= set(_terms(name))]
    assert choice.name in contained
    assert choice.rmse[choice.name] == pytest.approx(0.05, rel=0.3)


def _terms(name: str) -> tuple[str, ...]:
    return friction_model(name).terms


def test_the_true_model_is_usually_chosen_exactly():
    """The one-standard-error rule picks the truth in at least 85 % of 100 draws."""
    draws = [choose_model(candidates(data(s, "coulomb-viscous", 0.05)), least_squares).name
             for s in range(100)]  # fmt: skip
    assert draws.count("coulomb-viscous") >= 85


@pytest.mark.slow
@given(st.integers(0, 2**32), st.floats(0.01, 100.0))
def test_the_choice_does_not_depend_on_the_unit_of_torque(seed, scale):
    parts = data(seed, "coulomb-viscous", 0.1)
    scaled = [_scaled(part, scale) for part in parts]
    first, other = (choose_model(candidates(each), least_squares) for each in (parts, scaled))
    assert other.name == first.name
    expected = {name: scale * rmse for name, rmse in first.rmse.items()}
    assert other.rmse == pytest.approx(expected, rel=1e-6)


def _scaled(part: SquareRootInformation, scale: float) -> SquareRootInformation:
    (joint,) = part.joints
    factors = np.append(np.ones(len(joint.columns)), scale)
    return replace(part, joints=(replace(joint, triangle=joint.triangle * factors),))


def test_noise_free_data_is_decided_too():
    choice = choose_model(candidates(data(3, "coulomb-viscous", 0.0)), least_squares)
    assert choice.rmse["coulomb-viscous"] < 1e-12 < 1e-3 < choice.rmse["viscous"]
    assert "coulomb" in choice.name and choice.name in choice.note


@given(st.integers(0, 2**32))
def test_combined_and_restricted_information_equal_a_fit_to_the_samples(seed):
    rng = np.random.default_rng(seed)
    rows, tau = rng.normal(size=(80, len(TERMS))), rng.normal(size=80)
    parts = [information(rows[part], tau[part]) for part in blocks(80, 4)]
    kept = [TERMS[0], TERMS[3], TERMS[1]]
    small = restricted(combined(parts), kept)
    assert small.names == (TERMS[0], TERMS[1], TERMS[3])
    expected = np.linalg.lstsq(rows[:, [0, 1, 3]], tau, rcond=None)
    np.testing.assert_allclose(least_squares(small), expected[0], atol=1e-10)
    residual = small.squared_residuals(expected[0])
    np.testing.assert_allclose(residual, expected[1], rtol=1e-10)
    assert small.n_samples == 80

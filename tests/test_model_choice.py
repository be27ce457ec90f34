"""Cross-validation finds the model that made the data, and not a richer one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.friction import friction_model
from robot_sysid.information import InformationAccumulator, combined, restricted
from robot_sysid.model_choice import choose_model
from robot_sysid.records import SquareRootInformation
from robot_sysid.validation import blocks

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
    tau = 0.3 * qdd + model.columns(qd) @ rng.uniform(0.5, 1.5, len(model.terms))
    tau += noise * rng.normal(size=n)
    rows = np.column_stack((qdd, FULL.columns(qd)))
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


@settings(max_examples=100, deadline=None)
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


@settings(max_examples=100)
@given(st.integers(0, 2**32), st.floats(0.01, 100.0))
def test_the_choice_does_not_depend_on_the_unit_of_torque(seed, scale):
    parts = data(seed, "coulomb-viscous", 0.1)
    scaled = [_scaled(part, scale) for part in parts]
    first = choose_model(candidates(parts), least_squares)
    assert choose_model(candidates(scaled), least_squares).score == pytest.approx(
        first.score, rel=1e-6
    )


def _scaled(part: SquareRootInformation, scale: float) -> SquareRootInformation:
    (joint,) = part.joints
    factors = np.append(np.ones(len(joint.columns)), scale)
    return replace(part, joints=(replace(joint, triangle=joint.triangle * factors),))


def test_noise_free_data_is_decided_too():
    choice = choose_model(candidates(data(3, "coulomb-viscous", 0.0)), least_squares)
    assert choice.rmse["coulomb-viscous"] < 1e-12 < 1e-3 < choice.rmse["viscous"]
    assert "coulomb" in choice.name and choice.name in choice.note


@settings(max_examples=100)
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


def test_unknown_parameters_and_unlike_parts_are_refused():
    parts = data(0, "viscous", 0.1)
    with pytest.raises(InputError, match=r"no parameter 'mass'; there are inertia, coulomb\[j\]"):
        restricted(parts[0], ["mass"])
    with pytest.raises(InputError, match="same parameters and joints"):
        combined([parts[0], restricted(parts[1], ["inertia"])])


def test_one_block_or_no_candidate_is_refused():
    with pytest.raises(InputError, match="at least two blocks"):
        choose_model({"a": data(0, "viscous", 0.1)[:1]}, least_squares)
    with pytest.raises(InputError, match="needs a candidate"):
        choose_model({}, least_squares)

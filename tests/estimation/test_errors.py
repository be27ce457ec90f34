"""Stated errors are as large as errors are, and add up from their causes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.algebra.priors import misfits
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.errors import FILTERING, filtering_bias, fit_errors
from robot_sysid.estimation.unknowns import COMMON, SCALES
from robot_sysid.signals.process import ProcessedSignals
from tests.support import arms
from tests.support.core_fits import NOISE_ONLY, filter_logs, fit_recordings
from tests.support.imperfect_arm import ImperfectArm, Imperfections
from tests.support.measured_logs import guess_model, log_of, plan_of, true_values
from tests.support.payload_logs import PAYLOAD, RATE, TrueArm, add_torque, wide_motion

SMALL = arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X)))
WITHIN = 3.5
"""Standard errors that the worst of some twenty parameters may be off."""


def white(shape, rng):
    return 0.1 * rng.standard_normal(shape)


def coloured(shape, rng):
    keep = np.exp(-1.0 / (0.1 * RATE))
    return lfilter(
        [1.0], [1.0, -keep], np.sqrt(1.0 - keep**2) * white(shape, rng), axis=0
    )


@pytest.mark.parametrize(
    "noise", [pytest.param(white, marks=pytest.mark.slow), coloured]
)
def test_errors_are_the_spread_of_many_recordings(noise):
    """Noise is all that is not known; what has a memory counts by its memory."""
    arm = TrueArm(SMALL, 1, model_error=0.0)
    off = []
    stated = []
    exact = arm.recording(wide_motion(3, 3), False)
    for run in range(48):
        drawn = noise(exact.torque.shape, np.random.default_rng(run))
        fit = fit_recordings(
            SMALL, [add_torque(exact, drawn)], EstimationOptions(**NOISE_ONLY)
        )
        off.append((fit.values - arm.values(fit.columns))[fit.unknowns.kept])
        stated.append(fit_errors(fit).whole.standard_errors)
    ratio = np.sqrt(
        np.mean(np.square(off), axis=0) / np.mean(np.square(stated), axis=0)
    )
    assert np.all((ratio > 0.6) & (ratio < 1.6))
    assert np.mean(np.abs(off) < 1.96 * np.array(stated)) == pytest.approx(
        0.95, abs=0.03
    )


@pytest.mark.slow
def test_whole_errors_cover_all_that_is_wrong_with_an_arm():
    plan = plan_of(SMALL, 1, 20.0)
    off = []
    sizes = {
        "links": 0.04,
        "zero": 2e-3,
        "tilt": np.radians(0.4),
        "lag": 3e-3,
        "load": 0.02,
    }
    for run in range(24):
        rng = np.random.default_rng(run)
        scale = 1.0 + 0.02 * rng.standard_normal(3)
        arm = ImperfectArm(SMALL, rng, Imperfections(**sizes, noise=0.2), scale)
        datasets, options = filter_logs(SMALL, arm.log(plan, np.zeros(10), rng))
        fit = fit_recordings(SMALL, datasets, options)
        errors = fit_errors(fit).whole.standard_errors[:10]
        off.append((fit.values[:10] - arm.thetas[-1]) / errors)
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.2
    assert np.mean(np.abs(off) < 1.96) > 0.9


def filtered_fit(plant, cutoff, seed, **sensors):
    """(errors, distance of all parameters from the truth) where noise is all that is not known."""
    log = log_of(plant, plan_of(plant, seed, 25.0), **sensors)
    datasets, options = filter_logs(
        guess_model(plant), log, cutoff=cutoff, **NOISE_ONLY
    )
    fit = fit_recordings(guess_model(plant), datasets, options)
    off = np.abs(fit.values - true_values(plant, fit.columns.names))[fit.unknowns.kept]
    return fit_errors(fit), off


@pytest.mark.parametrize("cutoff", [0.9, 1.2])
def test_a_cutoff_close_to_the_motion_is_paid_for(plant, cutoff):
    """Motion of up to 0.6 Hz: noise alone, as the residuals show it, does not explain the error."""
    errors, off = filtered_fit(plant, cutoff, 2, encoder_resolution=1e-6)
    assert np.max(off / np.sqrt(np.diag(errors.whole.noise))) > 4.0
    assert np.max(off / errors.whole.standard_errors) < WITHIN


def test_beside_noise_the_low_pass_does_not_count(plant):
    errors, off = filtered_fit(plant, 8.0, 1, noise_torque=0.1, encoder_resolution=1e-4)
    part = np.linalg.norm(errors.causes[FILTERING], axis=0)
    assert np.all(part < 0.05 * np.sqrt(np.diag(errors.whole.noise)))
    assert np.max(off / errors.whole.standard_errors) < WITHIN


def test_where_a_joint_turns_round_between_two_passes_its_friction_says_nothing(
    monkeypatch,
):
    """Reversed motion takes the same torque of the links; only the sign of friction differs."""
    recording = TrueArm(SMALL, 1, model_error=0.0).recording(wide_motion(3, 3), False)
    fit = fit_recordings(SMALL, [recording], EstimationOptions(**NOISE_ONLY))

    def reversed_motion(signals):
        once = signals.decimated_motion()
        return np.arange(len(once.time)), replace(once, qd=-once.qd)

    monkeypatch.setattr(ProcessedSignals, "refiltered", property(reversed_motion))
    point = replace(fit.point, values=fit.values)
    assert not np.any(filtering_bias(fit.columns, point, recording, fit.samples[0]))


@pytest.mark.parametrize(("seed", "seconds"), [(2, 0.1), (0, 0.3)])
def test_noise_with_a_memory_is_no_cause(plant, seed, seconds):
    """The model is the plant; noise without a memory would not do what this noise does."""
    log = log_of(
        plant, plan_of(plant, seed), seed, noise_torque=0.1, encoder_resolution=1e-4
    )
    keep = np.exp(-1.0 / (200.0 * seconds))
    drawn = np.random.default_rng(seed).standard_normal(log.tau.shape)
    slow = 0.1 * lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], drawn, axis=0)
    datasets, options = filter_logs(plant, replace(log, tau=log.tau + slow))
    fit = fit_recordings(plant, datasets, options)
    assert fit_errors(fit).conflicts == ()
    assert misfits(fit.information, 1.0 / fit.weights, fit.unknowns.groups)


@pytest.mark.slow
@pytest.mark.parametrize("repeated", [True, False])
def test_more_logs_make_nothing_worse(plant, robot, repeated):
    """One, ten and a hundred logs, of the same motion or of others."""
    errors = []
    for count in (1, 10, 100):
        plans = [plan_of(plant, 1 if repeated else 1 + k) for k in range(count)]
        noise = {"noise_torque": 0.1, "encoder_resolution": 1e-4}
        logs = [log_of(plant, plan, k, **noise) for k, plan in enumerate(plans)]
        datasets, options = filter_logs(robot, *logs)
        fit = fit_recordings(robot, datasets, options)
        errors.append(fit_errors(fit).whole.standard_errors[0])
        assert abs(fit.values[0] - plant.prior.mass) < 2.0 * errors[-1]
    assert errors[0] > errors[1] > 0.98 * errors[2]


# ---- of a payload


@pytest.fixture(scope="module")
def errors(payload_fit):
    return fit_errors(payload_fit)


@pytest.fixture(scope="module")
def change(payload_fit):
    kept = payload_fit.unknowns.kept
    return np.eye(len(kept))[
        np.searchsorted(kept, payload_fit.columns.at(PAYLOAD_NAMES))
    ]


def test_squares_of_the_causes_and_of_noise_add_up(payload_fit, errors, change):
    covariance, noise, budget = errors.of(change, PAYLOAD)
    assert COMMON not in budget and len(budget) >= 6
    total = noise**2 + np.sum([part**2 for part in budget.values()], axis=0)
    assert_allclose(np.diag(covariance), total, rtol=1e-6)


@pytest.mark.parametrize(("moved", "share"), [(0.3, 1.0), (2e-4, 0.0)])
def test_what_a_possible_body_was_moved_by_beyond_chance_is_an_error(
    payload_fit, errors, moved, share
):
    free = payload_fit.free.copy()
    place = payload_fit.columns.at(PAYLOAD_NAMES[:1])[0]
    free[place] = payload_fit.values[place] - moved
    kept = int(np.searchsorted(payload_fit.unknowns.kept, place))
    stated = fit_errors(replace(payload_fit, free=free)).whole.standard_errors[kept]
    before = errors.whole.standard_errors[kept]
    assert stated == pytest.approx(np.hypot(share * moved, before), rel=0.05)


def test_a_scale_of_all_joints_is_an_error_in_proportion(errors, change):
    """Nothing tells it: 3 % of each of four joints is 1.5 % of all."""
    without, with_it = (errors.of(change, theta) for theta in (None, PAYLOAD))
    assert errors.common == pytest.approx(0.015, rel=0.01)
    grown = np.sqrt(np.diag(with_it[0]) - np.diag(without[0]))
    assert_allclose(grown, errors.common * np.abs(PAYLOAD), rtol=1e-6)
    assert with_it[2][SCALES][0] > without[2][SCALES][0]


def test_the_truth_lies_within_the_errors(payload_fit, errors, change):
    found = payload_fit.values[payload_fit.columns.at(PAYLOAD_NAMES)]
    stated = np.sqrt(np.diag(errors.of(change, found)[0]))
    assert np.max(np.abs(found - PAYLOAD) / stated) < WITHIN
    assert np.all(errors.shown(change))
    share = errors.share(payload_fit)
    names = payload_fit.unknowns.kept_names
    assert share[names.index("m(payload)")] > 0.99 and np.all(
        (share >= 0.0) & (share <= 1.0)
    )
    # Its joint shows none of it; what other links weigh tells a little.
    assert share[names.index("m(link0)")] < 0.3


def test_what_no_torque_shows_has_no_error():
    """Axes parallel to gravity: the moment along them, and with it any sum, stays unknown."""
    upright = arms.robot_of(arms.serial_arm((arms.Z, arms.Z, arms.Z)))
    arm = TrueArm(upright, 1, model_error=0.0)
    recording = arm.recording(wide_motion(1, 3), False)
    fit = fit_recordings(upright, [recording], EstimationOptions(**NOISE_ONLY))
    errors = fit_errors(fit)
    hidden = {"hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz"}
    own = np.eye(len(fit.unknowns.kept))[:10]
    assert_array_equal(errors.shown(own), [n not in hidden for n in PARAMETER_NAMES])
    assert (
        np.isinf(errors.of(own[3:4])[1][0]) and not errors.shown(own[:1] + own[3:4])[0]
    )

"""From a whole log to an estimate: truth recovered, delay and tilt put right, honest hold-out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.gravity import gravity, with_gravity
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.least_squares import EstimatorOptions
from robot_sysid.estimation.uncertainty import OTHER_LINKS
from robot_sysid.identify import fit as measured_module
from robot_sysid.identify.fit import MeasuredOptions, identify_measured, validate_on
from robot_sysid.records import Status
from robot_sysid.records.progress import Silent
from robot_sysid.signals.process import SignalOptions
from tests.support.measured_logs import SIGNALS, guessed, log_of, plan_of, true_arm, true_values

AUTO = EstimatorOptions(consistency="auto")


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def robot(plant):
    return guessed(plant)


@pytest.fixture(scope="module")
def noisy(plant):
    return log_of(plant, noise_torque=0.1, encoder_resolution=1e-4)


def fit_of(robot, log, **options):
    chosen = {"signals": SIGNALS, "estimator": AUTO, **options}
    return identify_measured(robot, log, MeasuredOptions(**chosen), Silent())


def relative_errors(fit, plant):
    """Of the ten parameters, relative to mass and size; then of friction."""
    truth = true_values(plant, fit.estimate.names)
    mass, length = plant.prior.mass, spatial.characteristic_length(plant.prior.theta)
    scale = np.append(spatial.parameter_scale(mass, length), np.ones(len(truth) - 10))
    return np.abs(fit.estimate.values - truth) / scale


@pytest.mark.parametrize("method", ["ols", "wls", "robust"])
@pytest.mark.parametrize("scale", [0.3, 3.0])
def test_a_clean_log_gives_the_truth_whatever_the_guess(plant, method, scale):
    fit = fit_of(guessed(plant, scale), log_of(plant), method=method)
    # What remains: the low-pass changes motion a little before the equations are built.
    assert np.max(relative_errors(fit, plant)) < 2e-3
    assert fit.estimate.status is Status.OK


@pytest.mark.parametrize("method", ["ols", "wls", "robust"])
def test_errors_of_a_noisy_log_are_as_large_as_it_says(plant, robot, noisy, method):
    fit = fit_of(robot, noisy, method=method)
    error = np.abs(fit.estimate.values - true_values(plant, fit.estimate.names))
    within = error < 3.0 * fit.estimate.standard_errors
    assert np.mean(within) > 0.9


def test_outliers_hardly_move_the_robust_estimate(plant, robot, noisy):
    """Every hundredth torque sample is off by 20 N m."""
    hit = np.random.default_rng(0).random(noisy.tau.shape) < 0.01
    log = replace(noisy, tau=noisy.tau + 20.0 * hit)
    truth = plant.prior.theta
    plain, robust = (
        np.abs(fit_of(robot, log, method=m).estimate.values[:10] - truth) for m in ("wls", "robust")
    )
    clean = np.abs(fit_of(robot, noisy, method="wls").estimate.values[:10] - truth)
    assert np.linalg.norm(robust) < 0.8 * np.linalg.norm(plain)
    assert np.linalg.norm(robust) < 5.0 * np.linalg.norm(clean) + 1e-3


def test_terminal_torques_keep_what_they_cannot_see(plant, robot, noisy):
    fit = fit_of(robot, noisy, torques="terminal")
    assert fit.estimate.values[0] == pytest.approx(robot.prior.mass, rel=1e-6)
    assert fit.estimate.status is Status.PARTLY_FROM_MODEL
    assert not np.isfinite(fit.estimate.standard_errors[0])


# ---- delay and tilt


@pytest.mark.parametrize(
    ("delay", "degrees", "direction", "seed"),
    [(0.0, 0.0, 0.0, 1), (0.001, 0.3, 1.0, 2), (0.0047, 1.0, 3.0, 9), (0.01, 0.5, 5.0, 4)]
    + [(0.1, 3.0, 2.0, 5)],
)
def test_delay_and_tilt_are_found_together(plant, delay, degrees, direction, seed):
    """To 0.1 ms and 0.02 degrees, encoder step 2e-5 rad."""
    turn = np.radians(degrees) * np.array([np.cos(direction), np.sin(direction), 0.0])
    askew = with_gravity(plant, spatial.rotation_from_vector(turn) @ gravity(plant))
    log = log_of(askew, plan_of(plant, seed), torque_delay=delay, encoder_resolution=2e-5)
    fit = fit_of(guessed(plant), log, estimate_delay=True, estimate_tilt=True)
    assert abs(fit.alignment.delay - delay) < 1e-4
    assert np.degrees(fit.alignment.tilt_from(gravity(askew))) < 0.02


def test_an_unknown_delay_would_spoil_the_result(plant, robot):
    log = log_of(plant, torque_delay=0.02, encoder_resolution=1e-4)
    ignored = relative_errors(fit_of(robot, log), plant)[:10]
    found = relative_errors(fit_of(robot, log, estimate_delay=True), plant)[:10]
    assert np.max(ignored) > 5.0 * np.max(found)


def test_what_is_not_asked_for_is_not_estimated(robot, noisy):
    fit = fit_of(robot, noisy)
    assert fit.alignment.delay == 0.0 and fit.alignment.tilt_from(gravity(robot)) == 0.0
    assert fit.estimate.value("delay") is None and fit.estimate.value("tilt_1") is None


def test_every_method_can_look_for_a_delay(robot, noisy):
    for method in ("ols", "robust"):
        fit = fit_of(robot, noisy, method=method, estimate_delay=True)
        assert abs(fit.alignment.delay) < 5.0 * fit.estimate.error("delay") + 1e-4


def test_a_search_that_does_not_settle_ends_with_a_remedy(robot, noisy, monkeypatch):
    monkeypatch.setattr(measured_module, "_MOST_ROUNDS", 1)
    with pytest.raises(SysidError, match="delay and tilt_1 and tilt_2 do not settle within 1 "):
        fit_of(robot, noisy, estimate_delay=True, estimate_tilt=True)


def test_a_delay_lowers_the_cutoff_that_the_data_alone_would_give(plant, robot):
    log = log_of(plant, noise_torque=0.02)
    free, delayed = (
        fit_of(robot, log, signals=SignalOptions(), estimate_delay=delay) for delay in (False, True)
    )
    assert free.cutoff > measured_module.DELAY_CUTOFF == delayed.cutoff
    given = fit_of(robot, log, signals=SignalOptions(cutoff=12.0), estimate_delay=True)
    assert given.cutoff == 12.0


# ---- validation


def test_the_held_out_part_is_not_fitted(robot, noisy):
    spoiled = np.where(np.arange(len(noisy))[:, None] > 0.9 * len(noisy), 99.0, noisy.tau)
    before, after = fit_of(robot, noisy), fit_of(robot, replace(noisy, tau=spoiled))
    np.testing.assert_array_equal(before.estimate.values, after.estimate.values)
    assert after.validation.rmse > 10.0 * before.validation.rmse
    assert before.validation.rmse < 2.0 * before.estimate.rmse


def test_nothing_is_held_out_on_request(robot, noisy):
    fit = fit_of(robot, noisy, held_out=0.0)
    assert fit.validation is None
    assert sum(fit.estimate.samples.values()) > sum(fit_of(robot, noisy).estimate.samples.values())


def test_another_log_is_predicted_down_to_its_noise(plant, robot, noisy):
    options = MeasuredOptions(signals=SIGNALS, estimator=AUTO)
    fit = identify_measured(robot, noisy, options, Silent())
    other = log_of(plant, plan_of(plant, 7), 7, noise_torque=0.1, encoder_resolution=1e-4)
    found = validate_on(robot, other, options, fit, "other.csv")
    assert found.source == "other.csv"
    assert found.rmse < 1.3 * fit.estimate.rmse
    heavier = validate_on(robot, replace(other, tau=1.2 * other.tau), options, fit, "x")
    assert heavier.relative_error > 3.0 * found.relative_error


def test_a_found_delay_holds_for_the_validation_log_too(plant, robot):
    options = MeasuredOptions(signals=SIGNALS, estimator=AUTO, estimate_delay=True)
    logs = [
        log_of(plant, plan_of(plant, k), k, torque_delay=0.02, noise_torque=0.02) for k in (1, 7)
    ]
    fit = identify_measured(robot, logs[0], options, Silent())
    assert validate_on(robot, logs[1], options, fit, "x").rmse < 1.5 * fit.estimate.rmse


# ---- everything else


def test_no_result_is_an_impossible_body(plant, robot):
    """Weak motion, strong noise: the plain estimate is often impossible, the result never."""
    impossible = 0
    for seed in range(10):
        log = log_of(plant, plan_of(plant, seed, 6.0), seed, noise_torque=3.0)
        plain = fit_of(robot, log, estimator=EstimatorOptions(consistency="off"))
        impossible += plain.estimate.status is Status.INCONSISTENT
        assert fit_of(robot, log).estimate.inertial.is_consistent
    assert impossible > 0


def test_a_mass_that_noise_hides_is_not_trusted(plant, robot):
    log = log_of(plant, plan_of(plant, 3, 6.0), 3, noise_torque=80.0)
    assert fit_of(robot, log).estimate.status in (Status.TOO_WEAK, Status.INCONSISTENT)


def test_a_torque_of_the_wrong_sign_is_refused(robot, noisy):
    flipped = noisy.tau * np.array([1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="torque of joint joint1 has the opposite sign"):
        fit_of(robot, replace(noisy, tau=flipped))


def test_a_still_joint_costs_only_its_own_friction(plant, robot):
    plan = plan_of(plant).scaled(np.array([0.0, 1.0, 1.0]))
    fit = fit_of(robot, log_of(plant, plan, noise_torque=0.02, encoder_resolution=1e-4))
    assert "joint0" not in fit.estimate.noise_per_joint
    assert fit.estimate.error("coulomb[joint0]") == np.inf
    assert np.isfinite(fit.estimate.error("coulomb[joint1]"))
    assert any("only 0 % of the rows of joint joint0" in note for note in fit.notes)


def test_sensitivity_to_the_other_links_is_what_heavier_links_do(plant, robot):
    """The plant's other links made 1 % heavier, in another log of the same motion."""
    plan = plan_of(plant)
    plain = {"method": "ols", "estimator": EstimatorOptions(consistency="off")}
    before = fit_of(robot, log_of(plant, plan), **plain)
    after = fit_of(robot, log_of(heavier_links(plant), plan), **plain)
    moved = (after.estimate.values - before.estimate.values)[:10]
    stated = np.array(list(before.sensitivity[OTHER_LINKS].values()))[:10]
    np.testing.assert_allclose(moved, stated, rtol=0.0, atol=1e-3 * np.max(np.abs(moved)))


def heavier_links(plant):
    import copy

    model = copy.copy(plant.mj_model)
    others = [b for b in range(model.nbody) if b != plant.body_id]
    model.body_mass[others] *= 1.01
    model.body_inertia[others] *= 1.01
    model.dof_armature[:] *= 1.01
    return replace(plant, mj_model=model)


@pytest.mark.parametrize("friction", ["none", "coulomb-viscous-offset-armature", "auto"])
def test_every_friction_choice_runs(robot, noisy, friction):
    fit = fit_of(robot, noisy, friction=friction)
    assert fit.friction.name == friction or friction == "auto"
    assert (friction == "auto") == any("chosen by cross-validation" in n for n in fit.notes)

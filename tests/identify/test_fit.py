"""From a whole log to an estimate: truth recovered, delay and tilt put right, honest hold-out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.gravity import gravity, with_gravity
from robot_sysid.errors import SysidError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify import alignment as alignment_module
from robot_sysid.identify import fit as fit_module
from robot_sysid.identify.fit import fit_measured, validate_on
from robot_sysid.records import Motion, Status
from robot_sysid.records.progress import Progress
from tests.support import arms
from tests.support.measured_logs import (
    CUTOFF,
    JOINT,
    guessed,
    log_of,
    plan_of,
    true_arm,
    true_values,
)


@pytest.fixture(scope="module")
def plant():
    return true_arm()


@pytest.fixture(scope="module")
def robot(plant):
    return guessed(plant)


@pytest.fixture(scope="module")
def noisy(plant):
    return log_of(plant, noise_torque=0.1, encoder_resolution=1e-4)


KNOWN = {
    "link_uncertainty": 0.0,
    "scale_uncertainty": 0.0,
    "zero_uncertainty": 0.0,
    "gravity_uncertainty": 0.0,
    "friction_uncertainty": 0.0,
}
"""Noise is all that is not known."""


def fit_of(robot, log, **options):
    chosen = EstimationOptions(**{"cutoff": CUTOFF, **KNOWN, **options})
    return fit_measured(robot, [log], chosen, Progress())


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
    # The first moment that shows is not possible with the model's mass, which gives way a little.
    assert 1.0 <= fit.estimate.values[0] / robot.prior.mass < 2.0
    assert fit.estimate.status is Status.PARTLY_FROM_MODEL
    assert not np.isfinite(fit.estimate.standard_errors[0])


def test_friction_and_offsets_of_all_joints_do_not_count_as_seen_of_the_link():
    """All axes parallel to gravity: of the link only m, hx, hy and Izz show, whatever the rest."""
    upright = arms.robot_of(arms.serial_arm((arms.Z, arms.Z, arms.Z), joint=JOINT))
    log = log_of(upright, noise_torque=1e-3, encoder_resolution=1e-6)
    fit = fit_of(upright, log)
    seen = fit.estimate.identifiability
    assert (seen.rank, seen.n_parameters) == (4 + 2, 12)
    assert np.flatnonzero(seen.identified[:10]).tolist() == [0, 1, 2, 9]
    assert len(seen.unidentifiable) == 6
    assert fit.estimate.status is Status.PARTLY_FROM_MODEL
    unseen = ~np.array(seen.identified[:10])
    assert not np.any(np.isfinite(fit.estimate.standard_errors[:10][unseen]))
    prior = upright.prior.theta[unseen]
    np.testing.assert_allclose(fit.estimate.values[:10][unseen], prior, rtol=0.0, atol=1e-12)


# ---- several logs


def together(robot, logs, **options):
    chosen = EstimationOptions(**{"cutoff": CUTOFF, **KNOWN, **options})
    return fit_measured(robot, logs, chosen, Progress())


def test_a_log_given_twice_says_the_same_and_no_more(robot, noisy):
    """What the model leaves comes again as it was, so it does not average; one noise for both has
    a few more rows to be told from, which makes it a little smaller."""
    once, twice = (
        together(robot, [noisy] * n, validate=0.0, method="ols").estimate for n in (1, 2)
    )
    np.testing.assert_allclose(twice.values, once.values, rtol=0.0, atol=1e-9)
    assert all(twice.samples[joint] == 2 * once.samples[joint] for joint in once.samples)
    ratio = twice.standard_errors / once.standard_errors
    assert np.all((ratio > 0.9) & (ratio < 1.01))


def test_what_one_log_does_not_show_another_may(plant, robot):
    """Each moves two joints of three; friction of the third shows in the other log."""
    logs = [
        log_of(plant, plan_of(plant, k).scaled(np.array(still)), k, noise_torque=0.02)
        for k, still in ((1, [0.0, 1.0, 1.0]), (2, [1.0, 1.0, 0.0]))
    ]
    alone = [together(robot, [log]).estimate for log in logs]
    both = together(robot, logs).estimate
    assert [e.error("coulomb[joint0]") == np.inf for e in (*alone, both)] == [True, False, False]
    assert [e.error("coulomb[joint2]") == np.inf for e in (*alone, both)] == [False, True, False]
    error = np.abs(both.values - true_values(plant, both.names))
    assert np.mean(error < 3.0 * both.standard_errors) > 0.9


def test_all_logs_pass_the_lowest_cutoff_that_one_of_them_asks_for(plant, robot):
    quiet = log_of(plant, encoder_resolution=1e-5)
    loud = log_of(plant, plan_of(plant, 2), 2, encoder_resolution=3e-3)
    each = [together(robot, [log], cutoff=None).cutoff for log in (quiet, loud)]
    assert each[1] < 0.8 * each[0]
    for logs in ([quiet, loud], [loud, quiet]):
        assert together(robot, logs, cutoff=None).cutoff == each[1]


def test_the_end_of_each_log_is_held_out(plant, robot, noisy):
    other = log_of(plant, plan_of(plant, 7), 7, noise_torque=0.1, encoder_resolution=1e-4)
    logs = [noisy, other]
    before = together(robot, logs)
    assert before.validation.source == "20 % of each log that was not fitted for it"
    assert before.validation.rmse < 2.0 * before.estimate.rmse
    for k in range(2):
        spoiled = list(logs)
        end = np.arange(len(logs[k]))[:, None] > 0.9 * len(logs[k])
        spoiled[k] = replace(logs[k], tau=np.where(end, 99.0, logs[k].tau))
        after = together(robot, spoiled)
        assert after.validation.rmse > 10.0 * before.validation.rmse


def test_logs_share_their_delay(plant, robot):
    logs = [
        log_of(plant, plan_of(plant, k), k, torque_delay=0.004, encoder_resolution=2e-5)
        for k in (2, 7)
    ]
    fit = together(robot, logs, cutoff=None, delay="auto")
    assert abs(fit.alignment.delay - 0.004) < 1e-4


# ---- delay and tilt


@pytest.mark.parametrize(
    ("delay", "degrees", "direction", "seed"),
    [(0.0, 0.0, 0.0, 1), (0.001, 0.3, 1.0, 2), (0.0047, 1.0, 3.0, 9), (0.01, 0.5, 5.0, 4)]
    + [(0.1, 3.0, 2.0, 5)],
)
def test_delay_and_tilt_are_found_together(plant, delay, degrees, direction, seed):
    """To 0.1 ms and 0.02 degrees, encoder step 2e-5 rad."""
    turn = np.radians(degrees) * np.array([np.cos(direction), np.sin(direction), 0.0])
    askew = with_gravity(plant, Rotation.from_rotvec(turn).apply(gravity(plant)))
    log = log_of(askew, plan_of(plant, seed), torque_delay=delay, encoder_resolution=2e-5)
    fit = fit_of(guessed(plant), log, delay="auto", tilt="auto")
    assert abs(fit.alignment.delay - delay) < 1e-4
    assert np.degrees(fit.alignment.tilt_from(gravity(askew))) < 0.02


def test_an_unknown_delay_would_spoil_the_result(plant, robot):
    log = log_of(plant, torque_delay=0.02, encoder_resolution=1e-4)
    ignored = relative_errors(fit_of(robot, log), plant)[:10]
    found = relative_errors(fit_of(robot, log, delay="auto"), plant)[:10]
    assert np.max(ignored) > 5.0 * np.max(found)


def test_what_is_not_asked_for_is_not_estimated(robot, noisy):
    fit = fit_of(robot, noisy)
    assert fit.alignment.delay == 0.0 and fit.alignment.tilt_from(gravity(robot)) == 0.0
    assert fit.estimate.value("delay") is None and fit.estimate.value("tilt_1") is None


@pytest.mark.slow
def test_every_method_can_look_for_a_delay(robot, noisy):
    for method in ("ols", "robust"):
        fit = fit_of(robot, noisy, method=method, delay="auto")
        assert abs(fit.alignment.delay) < 5.0 * fit.estimate.error("delay") + 1e-4


def test_a_search_that_does_not_settle_ends_with_a_remedy(robot, noisy, monkeypatch):
    monkeypatch.setattr(alignment_module, "_MOST_ROUNDS", 1)
    with pytest.raises(SysidError, match="delay and tilt_1 and tilt_2 do not settle within 1 "):
        fit_of(robot, noisy, delay="auto", tilt="auto")


def test_a_delay_lowers_the_cutoff_that_the_data_alone_would_give(plant, robot):
    log = log_of(plant, noise_torque=0.02)
    free, delayed = (fit_of(robot, log, cutoff=None, delay=delay) for delay in ("off", "auto"))
    assert free.cutoff > fit_module.DELAY_CUTOFF == delayed.cutoff
    given = fit_of(robot, log, cutoff=12.0, delay="auto")
    assert given.cutoff == 12.0


# ---- validation


def test_the_held_out_part_is_not_fitted_for_its_prediction(robot, noisy):
    spoiled = np.where(np.arange(len(noisy))[:, None] > 0.9 * len(noisy), 99.0, noisy.tau)
    before, after = fit_of(robot, noisy), fit_of(robot, replace(noisy, tau=spoiled))
    assert after.validation.rmse > 10.0 * before.validation.rmse
    assert before.validation.rmse < 2.0 * before.estimate.rmse


def test_nothing_is_held_out_on_request_and_the_numbers_come_from_all_rows_anyway(robot, noisy):
    fit, held = fit_of(robot, noisy, validate=0.0), fit_of(robot, noisy)
    assert fit.validation is None and held.validation is not None
    assert fit.estimate.samples == held.estimate.samples
    np.testing.assert_allclose(fit.estimate.values, held.estimate.values, rtol=1e-6, atol=1e-9)


def test_another_log_is_predicted_down_to_its_noise(plant, robot, noisy):
    options = EstimationOptions(cutoff=CUTOFF)
    fit = fit_measured(robot, [noisy], options, Progress())
    other = log_of(plant, plan_of(plant, 7), 7, noise_torque=0.1, encoder_resolution=1e-4)
    found = validate_on(robot, other, options, fit, "other.csv")
    assert found.source == "other.csv"
    assert found.rmse < 1.3 * fit.estimate.rmse
    heavier = validate_on(robot, replace(other, tau=1.2 * other.tau), options, fit, "x")
    assert heavier.relative_error > 3.0 * found.relative_error


def test_a_found_delay_holds_for_the_validation_log_too(plant, robot):
    options = EstimationOptions(cutoff=CUTOFF, delay="auto")
    logs = [
        log_of(plant, plan_of(plant, k), k, torque_delay=0.02, noise_torque=0.02) for k in (1, 7)
    ]
    fit = fit_measured(robot, logs[:1], options, Progress())
    assert validate_on(robot, logs[1], options, fit, "x").rmse < 1.5 * fit.estimate.rmse


# ---- everything else


def test_no_result_is_an_impossible_body(plant, robot):
    """Weak motion, strong noise: the plain estimate is often impossible, the result never."""
    impossible = 0
    for seed in range(10):
        log = log_of(plant, plan_of(plant, seed, 6.0), seed, noise_torque=3.0)
        plain = fit_of(robot, log, consistency="off")
        impossible += plain.estimate.status is Status.INCONSISTENT
        assert fit_of(robot, log).estimate.inertial.is_consistent
    assert impossible > 0


def test_a_mass_that_noise_hides_is_not_trusted(plant, robot):
    log = log_of(plant, plan_of(plant, 3, 6.0), 3, noise_torque=80.0)
    assert fit_of(robot, log).estimate.status in (Status.TOO_WEAK, Status.INCONSISTENT)


def test_a_torque_that_runs_against_the_models_is_said(robot, noisy):
    """Whether its sign is wrong is asked before the fit; a payload may turn a wrist's round."""
    flipped = noisy.tau * np.array([1.0, -1.0, 1.0])
    notes = " ".join(fit_of(robot, replace(noisy, tau=flipped)).notes)
    assert "the torque of joint joint1 runs against the model's" in notes


def test_a_still_joint_costs_only_its_own_friction(plant, robot):
    plan = plan_of(plant).scaled(np.array([0.0, 1.0, 1.0]))
    fit = fit_of(robot, log_of(plant, plan, noise_torque=0.02, encoder_resolution=1e-4))
    assert "joint0" not in fit.estimate.noise_per_joint
    assert fit.estimate.error("coulomb[joint0]") == np.inf
    assert np.isfinite(fit.estimate.error("coulomb[joint1]"))
    assert any("only 0 % of the rows of joint joint0" in note for note in fit.notes)


class Drift:
    """A plan on which one joint never turns back."""

    def __init__(self, plan, joint):
        self._plan, self._joint = plan, joint
        self.duration, self.n_joints = plan.duration, plan.n_joints

    def evaluate(self, time):
        motion = self._plan.evaluate(time)
        q, qd, qdd = (np.array(part) for part in (motion.q, motion.qd, motion.qdd))
        speed = 1.2 * np.max(np.abs(self._plan.evaluate(np.linspace(0.0, 10.0, 999)).qd))
        q[:, self._joint] += speed * time
        qd[:, self._joint] += speed
        return Motion(motion.time, q, qd, qdd)


def test_a_joint_that_moves_one_way_only_is_named_and_no_other(plant, robot):
    """Its Coulomb friction looks like an offset."""
    words = "Coulomb friction and offset can only be told apart"
    both = log_of(plant, noise_torque=0.02, encoder_resolution=1e-5)
    assert not any(words in note for note in fit_of(robot, both).notes)
    drift = log_of(plant, Drift(plan_of(plant), 1), noise_torque=0.02, encoder_resolution=1e-5)
    (said,) = [note for note in fit_of(robot, drift).notes if words in note]
    assert said.startswith("joint1 moves faster than")
    (again,) = [
        note
        for note in fit_measured(
            robot, [both, drift], EstimationOptions(cutoff=CUTOFF), Progress()
        ).notes
        if words in note
    ]
    assert again == said


def test_a_joint_without_an_offset_to_tell_apart_may_move_one_way(plant, robot):
    log = log_of(plant, Drift(plan_of(plant), 1), noise_torque=0.02, encoder_resolution=1e-5)
    for friction in ("coulomb-viscous", "viscous-offset"):
        notes = fit_of(robot, log, friction_model=friction).notes
        assert not any("told apart" in note for note in notes)


@pytest.mark.parametrize("friction", ["none", "coulomb-viscous-offset-armature", "auto"])
def test_every_friction_choice_runs(robot, noisy, friction):
    fit = fit_of(robot, noisy, friction_model=friction)
    assert fit.friction.name == friction or friction == "auto"
    assert (friction == "auto") == any("chosen by cross-validation" in n for n in fit.notes)

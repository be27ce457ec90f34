"""The one fit: the truth comes back, priors hold what they say, bodies and bounds are possible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import NONLINEAR_TERMS
from robot_sysid.dynamics.newton_euler import gravity_vector, with_gravity
from robot_sysid.errors import SysidError
from robot_sysid.estimation import fit as fit_module
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import LARGEST_LOSS
from robot_sysid.records import DELAY_NAME
from tests.support import arms
from tests.support.core_fits import (
    BASIC,
    EXACT_SENSORS,
    NOISE_ONLY,
    body_error,
    choice_of,
    filter_logs,
    fit_recordings,
    fitter_of,
)
from tests.support.measured_logs import guess_model, log_of, plan_of
from tests.support.payload_logs import (
    PAYLOAD,
    TrueArm,
    add_noise,
    add_torque,
    exact_recording,
    four_joint_arm,
    wide_motion,
)
from tests.support.synthetic_data import random_body

ROBOT = four_joint_arm()
JOINTS = ROBOT.joint_names


def payload(fit):
    return fit.values[fit.columns.indices(PAYLOAD_NAMES)]


def pair(seed, **arm):
    """One exact empty and one exact loaded recording of an arm."""
    true = TrueArm(ROBOT, seed, **arm)
    return [true.recording(wide_motion([seed, k]), k > 0) for k in range(2)]


# ---- exact recordings


@settings(max_examples=4)
@given(arms.SEEDS)
def test_another_last_link_is_recovered_whatever_is_uncertain(seed):
    arm = TrueArm(ROBOT, seed, model_error=0.0)
    arm.thetas[-1] = random_body(np.random.default_rng(seed))
    recording = arm.recording(wide_motion(seed), False)
    for options, allowed in (
        (EstimationOptions(), 1e-8),
        (EstimationOptions(**NOISE_ONLY), 1e-10),
    ):
        fit = fit_recordings(ROBOT, [recording], options)
        assert body_error(fit.values[:10], arm.thetas[-1]) < allowed
        # Exact data makes no error smaller than a millionth of the torque would.
        torque = np.sqrt(np.mean(recording.torque**2))
        assert (
            np.all(1.0 / fit.weights > 0.9e-6 * torque)
            or options.link_uncertainty == 0.0
        )
        truth = arm.values(fit.columns)[fit.unknowns.estimated]
        assert_allclose(fit.values[fit.unknowns.estimated], truth, atol=1e-6)


@settings(max_examples=2)
@given(arms.SEEDS)
def test_a_payload_is_recovered_whatever_the_model_has_wrong(seed):
    """Links off by up to 30 %, friction and rotors that the model does not have, other motions."""
    recordings = pair(seed)
    assert (
        body_error(
            payload(fit_recordings(ROBOT, recordings, EXACT_SENSORS, loaded=True)),
            PAYLOAD,
        )
        < 1e-6
    )
    assert (
        body_error(payload(fit_recordings(ROBOT, recordings, loaded=True)), PAYLOAD)
        < 1e-4
    )


def test_torques_times_k_give_bodies_times_k():
    """Which a scale of all joints is, too: it goes into the payload, not into scales."""
    recordings = [
        add_torque(each, 0.3 * each.torque) for each in pair(5, model_error=0.1)
    ]
    fit = fit_recordings(ROBOT, recordings, EXACT_SENSORS, loaded=True)
    assert body_error(payload(fit), 1.3 * PAYLOAD) < 1e-6
    assert np.mean([fit.value(f"scale[{joint}]") for joint in JOINTS]) == pytest.approx(
        0, abs=1e-9
    )


def test_a_drift_of_friction_is_told_from_the_payload():
    recordings = TrueArm(ROBOT, 3).abba(3, drift=0.15)
    fit = fit_recordings(ROBOT, recordings, EXACT_SENSORS, loaded=True, drifts=True)
    assert_allclose([fit.value(f"drift[{j}]") for j in JOINTS], 0.15, rtol=1e-6)
    assert body_error(payload(fit), PAYLOAD) < 1e-6
    blind = fit_recordings(ROBOT, recordings, EXACT_SENSORS, loaded=True)
    assert body_error(payload(blind), PAYLOAD) > 1e-3


def test_a_known_mass_tells_the_torque_scales():
    scale = np.array([1.03, 0.96, 1.02, 0.98])
    recordings = TrueArm(ROBOT, 4, scale=scale).abba(4)
    weight = {"known_mass": float(PAYLOAD[0])}
    fit = fit_recordings(ROBOT, recordings, EXACT_SENSORS, loaded=True, **weight)
    assert_allclose([1.0 + fit.value(f"scale[{j}]") for j in JOINTS], scale, atol=1e-6)
    assert body_error(payload(fit), PAYLOAD) < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_links_that_are_off_the_other_way_ask_for_the_opposite_scales(seed):
    """What may be off either way is no scale on average."""
    motion = wide_motion(2)
    found = []
    for sign in (1.0, 0.0, -1.0):
        arm = TrueArm(ROBOT, seed, model_error=0.1)
        model = np.array([link.theta for link in ROBOT.links])
        arm.thetas[:-1] = (model + sign * (arm.thetas - model))[:-1]
        fit = fit_recordings(ROBOT, [add_noise(arm.recording(motion, False), 0.02, 0)])
        found.append(
            fit.free[fit.columns.indices([f"scale[{joint}]" for joint in JOINTS])]
        )
    bent = found[0] + found[2] - 2.0 * found[1]
    straight = found[0] - found[2]
    assert np.linalg.norm(bent) < 0.1 * np.linalg.norm(straight)


def test_what_gears_lose_with_their_load_is_found_and_stays_within_bounds():
    arm = TrueArm(ROBOT, 6)
    recordings = []
    lost = np.array([0.0, 0.08, -0.05, 0.5])
    bare = TrueArm(ROBOT, 6)
    bare.coulomb = bare.viscous = bare.offset = bare.armature = np.zeros(4)
    for each in arm.abba(6):
        motion = each.source.motion(np.arange(len(each.source)))
        carried = bare.torque(motion, each.is_loaded)
        recordings.append(add_torque(each, lost * np.abs(carried) * np.sign(motion.qd)))
    fit = fit_recordings(ROBOT, recordings, EXACT_SENSORS, f"{BASIC}-load", loaded=True)
    found = [fit.value(f"load[{joint}]") for joint in JOINTS]
    assert found[1] == pytest.approx(0.08, abs=0.02)
    assert found[2] == 0.0 and found[3] == LARGEST_LOSS
    assert {"load[joint2]", "load[joint3]"} <= set(fit.unknowns.names_at_bound)


def test_the_speed_of_a_stribeck_term_is_found_with_it_within_its_bounds():
    motion = wide_motion(9)
    arm = TrueArm(ROBOT, 9, model_error=0.0)
    drop = np.sign(motion.qd) * np.exp(-((motion.qd / 0.3) ** 2))
    tau = arm.torque(motion, False) + np.array([0.4, 0.4, 0.4, 0.0]) * drop
    fit = fit_recordings(
        ROBOT, [exact_recording(motion, tau, False)], friction=f"{BASIC}-stribeck"
    )
    for joint in JOINTS[:3]:
        assert fit.value(f"stribeck_speed[{joint}]") == pytest.approx(0.3, rel=0.05)
        assert fit.value(f"stribeck[{joint}]") == pytest.approx(0.4, rel=0.1)
    assert fit.value("stribeck[joint3]") == pytest.approx(0.0, abs=0.02)
    low, high = NONLINEAR_TERMS["stribeck"].bounds
    assert np.all(
        (fit.point.speed["stribeck"] >= low) & (fit.point.speed["stribeck"] <= high)
    )


# ---- recordings put together


def test_order_and_cuts_of_recordings_change_nothing(recordings):
    """The same rows, whole, in another order, and cut in two."""

    def values_of(parts):
        fitter = replace(fitter_of(ROBOT, parts), visits=None)
        return fitter.fit(
            Question(EstimationOptions(), loaded=True), choice_of(ROBOT)
        ).values

    rows = len(recordings[0].motion.time)
    masks = [np.arange(rows) < rows // 3, np.arange(rows) >= rows // 3]
    cut = [replace(each, used=mask) for each in recordings for mask in masks]
    whole = values_of(recordings)
    for other in (values_of(recordings[::-1]), values_of(cut)):
        assert_allclose(other, whole, rtol=1e-6, atol=1e-7)


def test_a_recording_given_twice_says_no_more(robot, noisy):
    """What the model leaves comes again as it was, so it does not average."""
    (log,), options = filter_logs(robot, noisy, **NOISE_ONLY)
    once, twice = (fit_recordings(robot, [log] * count, options) for count in (1, 2))
    assert np.all(twice.inflation > 1.7) and np.all(once.inflation < 1.3)
    roots = [
        np.linalg.inv(np.linalg.qr(f.information.equations(f.weights)[0], "r"))
        for f in (once, twice)
    ]
    errors = [np.linalg.norm(root, axis=1) for root in roots]
    assert np.all((errors[1] > 0.85 * errors[0]) & (errors[1] < 1.05 * errors[0]))
    moved = (twice.values - once.values)[once.unknowns.estimated]
    assert np.max(np.abs(moved) / errors[0]) < 0.02
    # What is said of a single sample is its own noise.
    assert_allclose(twice.noise, once.noise, rtol=0.05)


# ---- priors


def test_a_wrong_zero_is_found_and_taken_from_its_joint_alone(plant):
    """The model knows the links; one encoder reads 10 mrad too much."""
    log = log_of(plant, noise_torque=0.02)
    read = replace(log, q=log.q + np.array([0.0, 0.01, 0.0]))
    (shifted,), options = filter_logs(
        plant, read, **{**NOISE_ONLY, "zero_uncertainty": 10.0}
    )
    fit = fit_recordings(plant, [shifted], options)
    assert fit.value("zero[joint1]") == pytest.approx(0.01, abs=1e-3)
    assert abs(fit.value("zero[joint2]")) < 1e-3


# ---- delay and tilt


def test_delay_and_tilt_are_found_together(plant, robot):
    """To 0.1 ms and 0.02 degrees, encoder step 2e-5 rad."""
    delay = 0.1
    degrees = 3.0
    direction = 2.0
    seed = 5
    turn = np.radians(degrees) * np.array([np.cos(direction), np.sin(direction), 0.0])
    askew = with_gravity(plant, Rotation.from_rotvec(turn).apply(gravity_vector(plant)))
    log = log_of(
        askew, plan_of(plant, seed), torque_delay=delay, encoder_resolution=2e-5
    )
    datasets, options = filter_logs(robot, log, **NOISE_ONLY, delay="auto", tilt="auto")
    fit = fit_recordings(robot, datasets, options)
    assert fit.value(DELAY_NAME) == pytest.approx(delay, abs=1e-4)
    cosine = fit.point.gravity @ gravity_vector(askew) / 9.81**2
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.02


def test_a_search_that_does_not_settle_ends_with_a_remedy(robot, noisy, monkeypatch):
    monkeypatch.setattr(fit_module, "_AUTO_ROUNDS", 1)
    datasets, options = filter_logs(robot, noisy, delay="auto", tilt="auto")
    with pytest.raises(
        SysidError, match="delay and tilt do not settle within 1 rounds"
    ):
        fit_recordings(robot, datasets, options)


# ---- bodies


def test_a_clean_log_gives_the_truth_whatever_the_guess(plant):
    (log,), options = filter_logs(plant, log_of(plant))
    fit = fit_recordings(guess_model(plant, 3.0), [log], options)
    assert body_error(fit.values[:10], plant.prior.theta) < 1e-5


def test_no_estimate_is_an_impossible_body_and_a_possible_one_stays(plant, robot):
    """Weak motion, strong noise: the plain estimate is impossible, the result never."""
    impossible = 0
    for seed, noise in enumerate((3.0, 0.02, 1.0, 0.02)):
        log = log_of(plant, plan_of(plant, seed, 6.0), seed, noise_torque=noise)
        (one,), options = filter_logs(robot, log, **NOISE_ONLY)
        fit = fit_recordings(robot, [one], options)
        assert spatial.is_consistent(fit.values[:10])
        wrong = not spatial.is_consistent(fit.free[:10])
        impossible += wrong
        assert fit.is_constrained == wrong
        if not wrong:
            assert_array_equal(fit.values, fit.free)
    assert 0 < impossible < 4


def test_terminal_torques_keep_what_they_cannot_see(plant, robot):
    """First moments that show are not possible with the model's mass, which gives way a little."""
    for seed in range(2):
        log = log_of(plant, plan_of(plant, seed), seed, noise_torque=0.3)
        (one,), options = filter_logs(robot, log, torques="terminal")
        fit = fit_recordings(robot, [one], options, "coulomb-viscous-offset")
        assert fit.free[0] == pytest.approx(robot.prior.mass)
        assert 0.5 < fit.values[0] / robot.prior.mass < 3.0
        assert spatial.is_consistent(fit.values[:10])


# ---- what is hardly there


@pytest.mark.parametrize("link", [1, 3])
def test_a_placeholder_link_is_found_all_the_same(link):
    """Its 1e-9 kg in the model are no reason to believe that it weighs nothing."""
    arm = TrueArm(ROBOT, 1, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(1), False), 0.02, 0)
    tiny = spatial.theta_from_com(1e-9, np.zeros(3), 1e-15 * np.eye(3))
    model = arms.compile_xml(arms.serial_arm((arms.Z, arms.Y, arms.Y, arms.X)))
    arms.write_body(model, ROBOT.links[link].body_id, tiny)
    guess = arms.robot_of(model)
    fit = fit_recordings(guess, [recording])
    name = ROBOT.links[link].body_name
    theta = fit.values[fit.columns.bodies()[name]]
    assert spatial.is_consistent(theta) and np.all(np.isfinite(fit.values))
    if link == 3:
        assert theta[0] == pytest.approx(ROBOT.prior.mass, rel=0.1)
    rows = fit.samples[0].rows[1]
    tau = fit.samples[0].tau[1]
    left = tau - rows @ fit.values[fit.samples[0].columns[1]]
    assert np.std(left) < 0.03


def test_a_tool_far_larger_than_the_models_link_is_not_pulled_towards_it():
    """Its mass is known to what the errors say also where noise makes an impossible body of it."""
    small = spatial.theta_from_com(0.1, np.array([0.0, 0.0, 0.01]), 1e-6 * np.eye(3))
    model = arms.compile_xml(arms.serial_arm((arms.Z, arms.Y, arms.Y, arms.X)))
    arms.write_body(model, ROBOT.links[-1].body_id, small)
    arm = TrueArm(ROBOT, 2, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(2), False), 1.0, 2)
    fit = fit_recordings(arms.robot_of(model), [recording])
    off = (fit.values[0] - fit.free[0]) / fit_errors(fit).total.standard_errors[0]
    assert fit.is_constrained and 0.3 < abs(off) < 1.0

"""The fit: the truth comes back, priors hold as stated, bodies and bounds are possible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import NONLINEAR_TERMS
from robot_sysid.estimation import fit as fit_module
from robot_sysid.estimation.choices import posterior_of
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import LARGEST_LOSS
from tests.support import arms
from tests.support.core_fits import (
    BASIC,
    EXACT_SENSORS,
    NO_PRIORS,
    NOISE_ONLY,
    body_error,
    choice_of,
    fit_logs,
    fit_recordings,
    fitter_of,
)
from tests.support.measured_logs import guess_model, log_of, seeded_log
from tests.support.payload_logs import (
    PAYLOAD,
    TrueArm,
    add_noise,
    add_torque,
    exact_recording,
    four_joint_arm,
    four_joint_xml,
    wide_motion,
)
from tests.support.synthetic_data import random_body

ROBOT = four_joint_arm()
JOINTS = ROBOT.joint_names


def payload_error(fit, payload=PAYLOAD):
    return body_error(fit.values[fit.columns.indices(PAYLOAD_NAMES)], payload)


def joint_values(fit, term):
    """Return the estimate of one parameter of each joint."""
    return [fit.value(f"{term}[{joint}]") for joint in fit.columns.robot.joint_names]


def record_pair(seed, **arm):
    """Return one exact empty and one exact loaded recording of an arm."""
    true_arm = TrueArm(ROBOT, seed, **arm)
    return [true_arm.recording(wide_motion([seed, k]), k > 0) for k in range(2)]


def fit_payload(recordings, friction=BASIC, **question):
    return fit_recordings(
        ROBOT, recordings, EXACT_SENSORS, friction, loaded=True, **question
    )


# ---- exact recordings


@settings(max_examples=4)
@given(arms.SEEDS)
@example(60121)  # the estimate of a link of 0.16 kg that the default priors pull most
def test_another_last_link_is_recovered_whatever_is_uncertain(seed):
    """Priors pull by the square of the noise, and exact data leaves the least noise of weights."""
    arm = TrueArm(ROBOT, seed, model_error=0.0)
    arm.thetas[-1] = random_body(np.random.default_rng(seed))
    recording = arm.recording(wide_motion(seed), False)
    torque = np.sqrt(np.mean(recording.torque**2))
    for uncertainties, tolerance in (({}, 1e-6), (NOISE_ONLY, 1e-10)):
        fit = fit_recordings(ROBOT, [recording], EstimationOptions(**uncertainties))
        link = fit.values[:10]
        assert body_error(link, arm.thetas[-1]) < tolerance
        # Exact data makes no error smaller than a millionth of the torque would.
        assert uncertainties or np.all(1.0 / fit.weights > 0.9e-6 * torque)
        _, covariance = posterior_of(fit, fit.unknowns, fit.columns.names[:10])
        deviations = np.abs(link - arm.thetas[-1])
        assert uncertainties or np.all(deviations < 1e-6 * np.sqrt(np.diag(covariance)))
        estimated = fit.unknowns.estimated
        truth = arm.values(fit.columns)[estimated]
        assert_allclose(fit.values[estimated], truth, atol=1e-6)


@settings(max_examples=2)
@given(arms.SEEDS)
def test_a_payload_is_recovered_whatever_the_model_has_wrong(seed):
    """Links off by up to 30 %, friction and rotors that the model does not have, other motions."""
    recordings = record_pair(seed)
    assert payload_error(fit_payload(recordings)) < 1e-6
    assert payload_error(fit_recordings(ROBOT, recordings, loaded=True)) < 1e-4


def test_a_common_factor_of_the_torques_goes_into_the_payload_and_not_into_scales():
    recordings = record_pair(5, model_error=0.1)
    fit = fit_payload([add_torque(r, 0.3 * r.torque) for r in recordings])
    assert payload_error(fit, 1.3 * PAYLOAD) < 1e-6
    assert np.mean(joint_values(fit, "scale")) == pytest.approx(0, abs=1e-9)


def test_a_drift_of_friction_is_distinguished_from_the_payload():
    recordings = TrueArm(ROBOT, 3).abba(3, drift=0.15)
    fit = fit_payload(recordings, drifts=True)
    assert_allclose(joint_values(fit, "drift"), 0.15, rtol=1e-6)
    assert payload_error(fit) < 1e-6
    assert payload_error(fit_payload(recordings)) > 1e-3


def test_a_known_mass_identifies_the_torque_scales():
    scale = np.array([1.03, 0.96, 1.02, 0.98])
    recordings = TrueArm(ROBOT, 4, scale=scale).abba(4)
    fit = fit_payload(recordings, known_mass=float(PAYLOAD[0]))
    assert_allclose(joint_values(fit, "scale"), scale - 1.0, atol=1e-6)
    assert payload_error(fit) < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_opposite_errors_of_links_give_opposite_torque_scales(seed):
    """An error of unknown sign is no torque scale on average."""
    motion = wide_motion(2)
    scales = []
    for sign in (1.0, 0.0, -1.0):
        arm = TrueArm(ROBOT, seed, model_error=0.1)
        model = ROBOT.thetas
        arm.thetas[:-1] = (model + sign * (arm.thetas - model))[:-1]
        recording = add_noise(arm.recording(motion, False), 0.02, 0)
        fit = fit_recordings(ROBOT, [recording])
        names = [f"scale[{joint}]" for joint in JOINTS]
        scales.append(fit.free[fit.columns.indices(names)])
    even = scales[0] + scales[2] - 2.0 * scales[1]
    odd = scales[0] - scales[2]
    assert np.linalg.norm(even) < 0.1 * np.linalg.norm(odd)


def test_load_losses_of_gears_are_found_and_stay_within_bounds():
    arm = TrueArm(ROBOT, 6)
    loss = np.array([0.0, 0.08, -0.05, 0.5])
    recordings = []
    for recording in arm.abba(6):
        motion = recording.source.motion(np.arange(len(recording.source)))
        load = np.abs(arm.rigid_torque(motion, recording.is_loaded))
        recordings.append(add_torque(recording, loss * load * np.sign(motion.qd)))
    fit = fit_payload(recordings, f"{BASIC}-load")
    losses = joint_values(fit, "load")
    assert losses[1] == pytest.approx(0.08, abs=0.02)
    assert losses[2:] == [0.0, LARGEST_LOSS]
    assert {"load[joint2]", "load[joint3]"} <= set(fit.unknowns.names_at_bound)


def test_the_speed_of_a_stribeck_term_is_found_within_its_bounds():
    motion = wide_motion(9)
    drop = np.sign(motion.qd) * np.exp(-((motion.qd / 0.3) ** 2))
    torque = TrueArm(ROBOT, 9, model_error=0.0).torque(motion, False)
    tau = torque + np.array([0.4, 0.4, 0.4, 0.0]) * drop
    recording = exact_recording(motion, tau, False)
    fit = fit_recordings(ROBOT, [recording], friction=f"{BASIC}-stribeck")
    *levels, level_without = joint_values(fit, "stribeck")
    speeds = joint_values(fit, "stribeck_speed")
    assert speeds[:3] == pytest.approx([0.3] * 3, rel=0.05)
    assert levels == pytest.approx([0.4] * 3, rel=0.1)
    assert level_without == pytest.approx(0.0, abs=0.02)
    low, high = NONLINEAR_TERMS["stribeck"].bounds
    speed = fit.point.speed["stribeck"]
    assert np.all((speed >= low) & (speed <= high))


# ---- several recordings


def test_order_and_cuts_of_recordings_change_nothing(recordings, monkeypatch):
    monkeypatch.setattr(fit_module, "_correlation_times", lambda _: np.ones(4))

    def fit_values(datasets):
        fitter = fitter_of(ROBOT, datasets)
        question = Question(EstimationOptions(), loaded=True)
        return fitter.fit(question, choice_of(ROBOT)).values

    n_rows = len(recordings[0].motion.time)
    is_first = np.arange(n_rows) < n_rows // 3
    pieces = [
        replace(recording, used=mask)
        for recording in recordings
        for mask in (is_first, ~is_first)
    ]
    expected = fit_values(recordings)
    for datasets in (recordings[::-1], pieces):
        assert_allclose(fit_values(datasets), expected, rtol=1e-6, atol=1e-7)


# ---- sensors and gravity


def test_a_wrong_zero_is_found_in_its_joint_alone(plant):
    """The model knows the links; one encoder reads 10 mrad too much."""
    log = log_of(plant, noise_torque=0.02)
    shifted = replace(log, q=log.q + np.array([0.0, 0.01, 0.0]))
    fit = fit_logs(plant, shifted, priors=replace(NO_PRIORS, zero=10.0))
    assert fit.value("zero[joint1]") == pytest.approx(0.01, abs=1e-3)
    assert abs(fit.value("zero[joint2]")) < 1e-3


# ---- bodies


def test_a_clean_log_gives_the_truth_whatever_the_model(plant):
    fit = fit_logs(guess_model(plant, 3.0), log_of(plant))
    assert body_error(fit.values[:10], plant.prior.theta) < 1e-5


def test_no_estimate_is_an_impossible_body_and_a_possible_one_stays(plant, robot):
    """Weak motion, strong noise: the plain estimate is impossible, the result never."""
    impossible_count = 0
    for seed, noise in enumerate((3.0, 0.02, 1.0, 0.02)):
        log = seeded_log(plant, seed, 6.0, noise_torque=noise)
        fit = fit_logs(robot, log, **NOISE_ONLY)
        assert spatial.is_consistent(fit.values[:10])
        is_impossible = not spatial.is_consistent(fit.free[:10])
        impossible_count += is_impossible
        assert fit.is_constrained == is_impossible
        if not is_impossible:
            assert_array_equal(fit.values, fit.free)
    assert 0 < impossible_count < 4


@pytest.mark.parametrize("seed", range(2))
def test_parameters_hidden_from_terminal_torques_change_as_little_as_possible(
    plant, robot, seed
):
    """The visible first moments are not possible with the model's mass, which changes a little."""
    log = seeded_log(plant, seed, noise_torque=0.3)
    fit = fit_logs(robot, log, friction="coulomb-viscous-offset", torques="terminal")
    assert fit.free[0] == pytest.approx(robot.prior.mass)
    assert 0.5 < fit.values[0] / robot.prior.mass < 3.0
    assert spatial.is_consistent(fit.values[:10])


def robot_with(link, theta):
    """Return the model of the four-joint arm with another body."""
    model = arms.compile_xml(four_joint_xml())
    arms.write_body(model, ROBOT.links[link].body_id, theta)
    return arms.robot_of(model)


@pytest.mark.parametrize("link", [1, 3])
def test_a_link_that_the_model_holds_to_be_massless_is_found(link):
    """Its 1e-9 kg in the model are no reason to believe that it weighs nothing."""
    arm = TrueArm(ROBOT, 1, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(1), False), 0.02, 0)
    tiny = spatial.theta_from_com(1e-9, np.zeros(3), 1e-15 * np.eye(3))
    fit = fit_recordings(robot_with(link, tiny), [recording])
    theta = fit.values[fit.columns.bodies()[ROBOT.links[link].body_name]]
    assert spatial.is_consistent(theta) and np.all(np.isfinite(fit.values))
    if link == 3:
        assert theta[0] == pytest.approx(ROBOT.prior.mass, rel=0.1)
    (samples,) = fit.samples
    residual = samples.tau[1] - samples.rows[1] @ fit.values[samples.columns[1]]
    assert np.std(residual) < 0.03


def test_a_tool_far_larger_than_the_models_link_is_not_pulled_towards_it():
    """The errors of its mass hold also where noise makes an impossible body of it."""
    small = spatial.theta_from_com(0.1, np.array([0.0, 0.0, 0.01]), 1e-6 * np.eye(3))
    arm = TrueArm(ROBOT, 2, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(2), False), 1.0, 2)
    fit = fit_recordings(robot_with(-1, small), [recording])
    stated = fit_errors(fit).total.standard_errors[0]
    error = fit.values[0] - arm.values(fit.columns)[0]
    assert fit.is_constrained and abs(error) < 1.96 * stated

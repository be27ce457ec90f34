"""The fit: the truth comes back within its errors, what is put in is found, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.arms.core_fits import BASIC, NOISE_ONLY, body_error, fit_logs, fit_recordings
from rigs.arms.synthetic_data import autocorrelated
from rigs.arms.wrong_arms import draw_arm, link_torque
from rigs.logs.measured_logs import seeded_log
from rigs.logs.payload_logs import (
    PAYLOAD,
    TrueArm,
    add_noise,
    add_torque,
    four_joint_arm,
    four_joint_xml,
    wide_motion,
)
from robot_sysid import spatial
from robot_sysid.estimate.choose import neighbours
from robot_sysid.estimate.fit import Problem, correlation_times
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.rows import row_chunks
from robot_sysid.estimate.terms import (
    DELAY,
    DRIFT,
    PAYLOAD_NAMES,
    SCALE_DRIFT,
    SCALES,
    TILT,
    ZEROS,
    ArmTerms,
    independent,
)
from robot_sysid.spatial import PARAMETER_NAMES

ROBOT = four_joint_arm()
JOINTS = ROBOT.joint_names
EXACT = EstimationOptions(**NOISE_ONLY)
QUESTION = Question(EXACT)


def values_of(fitted, term):
    """Return the value of a term in each joint."""
    return np.array([fitted.by_name[f"{term}[{joint}]"] for joint in JOINTS])


def payload_error(fitted, payload=PAYLOAD):
    return body_error(fitted.values[fitted.at(PAYLOAD_NAMES)], payload)


# ---- exact recordings


@settings(max_examples=2)
@given(small_arms.SEEDS)
def test_another_last_link_is_recovered_whatever_is_uncertain(seed):
    """Priors act by the square of the noise, and exact data leaves the least noise.

    Offsets, whose prior is the narrowest, are zero.
    """
    arm = TrueArm(ROBOT, seed, model_error=0.0, offset=np.zeros(4))
    arm.thetas[-1] = small_arms.random_theta(np.random.default_rng(seed))
    recording = arm.recording(wide_motion(seed), False)
    for options, tolerance in ((EstimationOptions(), 1e-6), (EXACT, 1e-8)):
        fitted = fit_recordings(ROBOT, [recording], options)
        link = fitted.values[fitted.at(PARAMETER_NAMES)]
        assert body_error(link, arm.thetas[-1]) < tolerance
        assert_allclose(fitted.values, arm.values(fitted.names), atol=1e-6)
        assert not fitted.at_bound and not fitted.arm.motors


@settings(max_examples=2)
@given(small_arms.SEEDS)
def test_a_payload_is_recovered_whatever_the_model_has_wrong(seed):
    """Links off by up to 30 %, friction and rotors that the model lacks, other motions.

    A factor of all torques goes into the payload and not into scales.
    """
    arm = TrueArm(ROBOT, seed, scales=np.full(4, 1.3))
    recordings = []
    for k in range(2):
        motion = wide_motion([seed, k])
        recordings.append(arm.recording(motion, k > 0, name=f"log{k}"))
    fitted = fit_recordings(ROBOT, recordings, loaded=True)
    assert payload_error(fitted, 1.3 * PAYLOAD) < 1e-3
    assert np.mean(values_of(fitted, "scale")) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.slow
def test_a_known_mass_identifies_torque_scales_beside_a_drift_of_friction():
    scales = np.array([1.03, 0.96, 1.02, 0.98])
    recordings = TrueArm(ROBOT, 4, scales=scales).abba(4, drift=0.15)
    mass = float(PAYLOAD[0])
    question = {"loaded": True, "known_mass": mass, "drifts": True}
    fitted = fit_recordings(ROBOT, recordings, **question)
    assert_allclose(values_of(fitted, "scale"), scales - 1.0, atol=1e-4)
    assert_allclose(values_of(fitted, "drift"), 0.15, rtol=1e-3)
    assert payload_error(fitted) < 1e-3


# ---- bounds and bodies


def test_bounds_are_kept_and_the_rest_is_the_best_beside_them():
    """A gear that gained torque by its load, and one that lost too much."""
    arm = TrueArm(ROBOT, 6, model_error=0.0)
    loss = np.array([0.0, 0.08, -0.05, 0.5])
    recording = arm.recording(wide_motion(6), False)
    motion = recording.motion
    load = link_torque(ROBOT, motion, arm.thetas)
    lossy = add_torque(recording, loss * np.abs(load) * np.sign(motion.qd))
    options = replace(EXACT, friction_model=f"{BASIC}-load")
    fitted = fit_recordings(ROBOT, [lossy], options)
    assert_allclose(values_of(fitted, "load")[2:], [0.0, 0.3])
    assert {"load[joint2]", "load[joint3]"} <= set(fitted.at_bound)
    held = np.array([name in fitted.at_bound for name in fitted.names])
    equations = fitted.equations
    normal = equations.normal(fitted.weights)
    change = np.append(-fitted.free, 1.0)
    gradient = (normal @ change)[:-1] / np.sqrt(np.diag(normal)[:-1])
    assert np.max(np.abs(gradient[~held])) < 1e-3 * np.max(np.abs(gradient[held]))


def test_no_estimate_is_an_impossible_body_and_a_possible_one_stays(plant, robot):
    """Weak motion, strong noise: the plain estimate is impossible, the result never."""
    impossible = []
    for seed, noise in enumerate((3.0, 0.02, 1.0, 0.02)):
        log = seeded_log(plant, seed, 6.0, noise_torque=noise)
        fitted = fit_logs(robot, log, **NOISE_ONLY)
        assert spatial.is_consistent(fitted.values[:10])
        impossible.append(not spatial.is_consistent(fitted.free[:10]))
        if not impossible[-1]:
            assert_array_equal(fitted.values, fitted.free)
    assert impossible[0] and not all(impossible)


def test_what_no_torque_shows_stays_at_the_models_and_has_no_error():
    """Axes parallel to gravity: only four parameters of the last link act."""
    upright = small_arms.robot_of(small_arms.serial_arm((small_arms.Z,) * 3))
    arm = TrueArm(upright, 1, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(1, 3), False), 0.05, 1)
    fitted = fit_recordings(upright, [recording], EXACT)
    hidden = [name not in ("m", "hx", "hy", "Izz") for name in PARAMETER_NAMES]
    assert_array_equal(np.isinf(fitted.errors[:10]), hidden)
    model = upright.prior.theta
    assert_allclose(fitted.free[:10][hidden], model[hidden], rtol=1e-4, atol=1e-6)
    assert not np.any(fitted.share()[:10][hidden])


@pytest.mark.parametrize("link", [1, 3])
def test_a_link_that_the_model_holds_to_be_massless_is_found(link):
    """Its 1e-9 kg in the model are no reason to believe that it weighs nothing."""
    tiny = spatial.theta_from_com(1e-9, np.zeros(3), 1e-15 * np.eye(3))
    model = small_arms.compile_xml(four_joint_xml())
    small_arms.write_body(model, ROBOT.links[link].body_id, tiny)
    arm = TrueArm(ROBOT, 1, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(1), False), 0.02, 0)
    fitted = fit_recordings(small_arms.robot_of(model), [recording])
    assert fitted.noise[1] < 0.03 and np.all(np.isfinite(fitted.values))
    if link == 3:
        assert fitted.by_name["m"] == pytest.approx(ROBOT.prior.mass, rel=0.1)


# ---- explanations


PUT_IN = {
    SCALES: 0.05,
    ZEROS: 0.01,
    TILT: 0.02,
    DELAY: 0.01,
    DRIFT: 0.2,
    SCALE_DRIFT: 0.05,
    "load": 0.1,
    "fading": 0.3,
    "bend": 1.0,
    "joint0+joint1": 0.1,
}
"""Term, and a size of it that the torques of the arm clearly show."""


@pytest.mark.parametrize(("seed", "key"), [*enumerate(PUT_IN)])
def test_what_is_put_in_is_found_with_its_value_and_nothing_else_is(seed, key):
    """The gain is that of the log marginal likelihood, exactly so with the same noise."""
    truth = TrueArm(ROBOT, seed, model_error=0.0)
    recordings = truth.abba(seed, sigma=0.02)[::3]
    arm = ArmTerms(ROBOT, loaded=True)
    arm = arm.beside(map(arm.motor, neighbours(ROBOT)))
    names = [name for term in arm.terms.values() for name in term.names]
    point = replace(arm.start(), friction=dict(zip(names, truth.values(names))))
    size = np.full(len(arm.terms[key].names), PUT_IN[key])
    term = replace(arm.terms[key], prior=independent(size), is_bounded=False)
    sizes = size * np.random.default_rng(seed).choice([-1.0, 1.0], len(size))
    if key == "joint0+joint1":
        # Joints would lose friction that is subtracted, and cross their bounds.
        sizes = size
    for factor in (0.0, 1.0):
        logs = []
        for recording in recordings:
            (rows,) = row_chunks(recording, 1)
            torque = term.columns(rows, point) @ (factor * sizes)
            logs.append(add_torque(recording, torque))
        sums = arm.sums(logs, point)
        terms = arm_question(arm, QUESTION, sums.rms_torque)
        base = Problem(arm, logs, point, sums, QUESTION).fit(terms, possible=False)
        gain = Offers(base, base.weights).offer(Effect.of(term)).gain
        assert gain > 100.0 if factor else gain < 0.0
        wider = base.fit([*terms, term], noise=base.noise)
        at = wider.at(term.names)
        off = np.abs(wider.values[at] - factor * sizes)
        assert np.all(off < 3.0 * wider.errors[at])


# ---- errors


@pytest.mark.slow
def test_errors_are_as_large_as_is_stated_where_everything_is_as_the_priors_say():
    """Of links, friction, torque scales, zeros and base; noise is white or has a memory."""
    ratios = {}
    for seed in range(10):
        drawn = draw_arm(ROBOT, "priors", False, 12.0, seed % 2 == 0, seed)
        fitted = fit_logs(ROBOT, drawn.log)
        off = (fitted.values - drawn.arm.values(fitted.names)) / fitted.errors
        for name, ratio in zip(fitted.names, off):
            kind = name.partition("(")[0].partition("[")[0]
            if name not in fitted.at_bound:
                kind = "last" if name in PARAMETER_NAMES else kind
                ratios.setdefault(kind, []).append(ratio)
    for kind in ("m", "last", "coulomb", "viscous", "armature", "scale", "zero"):
        found = np.array(ratios[kind])
        assert 0.9 <= np.mean(np.abs(found) < 1.96) <= 1.0, kind
        # The links' masses have a prior of at least twice the stated 5 %.
        least = 0.3 if kind == "m" else 0.5
        assert least < np.sqrt(np.mean(found**2)) < 1.2, kind
    for kind in ("delay", "tilt_1", "tilt_2"):
        assert np.max(np.abs(ratios[kind])) < 4.0, kind


@given(small_arms.SEEDS)
def test_rows_of_noise_with_a_memory_count_less(seed):
    white = np.random.default_rng(seed).standard_normal((20000, 2))
    for memory, expected in ((0.0, 1.0), (10.0, 20.0)):
        noise = autocorrelated(white, memory)
        noise[::7, 0] = np.nan
        assert_allclose(correlation_times([noise]), expected, rtol=0.3)


def test_what_no_prior_names_is_in_the_errors_by_the_blocks():
    """Friction that falls within the log: the estimates without each block differ by more."""
    arm = TrueArm(ROBOT, 2, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(2, duration=12.0), False), 0.01, 2)
    motion = recording.motion
    fall = np.linspace(0.3, -0.3, len(motion.time))[:, None]
    fallen = add_torque(recording, fall * arm.coulomb * np.sign(motion.qd))
    fitted = fit_recordings(ROBOT, [fallen], EXACT)
    at = fitted.at([f"coulomb[{joint}]" for joint in JOINTS])
    formal = np.sqrt(np.diag(fitted.inverse))
    assert np.all(fitted.errors >= (1.0 - 1e-9) * formal)
    assert np.median(fitted.errors[at] / formal[at]) > 1.5


def test_blocks_that_differ_say_nothing_of_torque_scales(payload_fit):
    """The jackknife raises what noise and priors imply of a payload, not what scales do to it."""
    apart = 10.0 * np.sqrt(np.diag(payload_fit.inverse))
    differing = replace(payload_fit)
    differing.__dict__["alone"] = np.stack([-apart, apart])
    at = np.ix_(*2 * (payload_fit.at(PAYLOAD_NAMES),))
    expected = 100.0 * payload_fit.inverse[at] + payload_fit.scale_errors[at]
    assert_allclose(differing.covariance[at], expected, rtol=1e-9)


def test_the_causes_of_an_error_add_up_in_squares(payload_fit):
    rows = np.eye(len(payload_fit.names))[payload_fit.at(PAYLOAD_NAMES)]
    budget = payload_fit.budget(rows)
    total = np.sum([error**2 for error in budget.values()], axis=0)
    variances = np.diag(payload_fit.inverse + payload_fit.scale_errors)
    assert_allclose(total, rows @ variances, rtol=1e-6)
    assert len(budget) >= 6
    common = np.diag(payload_fit.scale_errors)[payload_fit.at(PAYLOAD_NAMES)]
    payload = payload_fit.values[payload_fit.at(PAYLOAD_NAMES)]
    # 3 % of each of four joints is 1.5 % of all, which no torque shows.
    assert_allclose(np.sqrt(common), 0.015 * np.abs(payload), rtol=1e-3)
    stated = payload_fit.errors[payload_fit.at(PAYLOAD_NAMES)]
    assert np.max(np.abs(payload - PAYLOAD) / stated) < 3.5

"""The result of an arm and of a payload: its numbers, its verdict and its notes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.diagnosis.log_rows import rms
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.estimation.build_result import payload_of, result_of, traces_of
from robot_sysid.estimation.dataset import Dataset, RestingPoses
from robot_sysid.estimation.identify import answer_link, answer_payload
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.records import Flange, Measurement
from robot_sysid.records.messages import Progress, with_error
from robot_sysid.results.record import LINK, Quantity, Verdict
from tests.support.core_fits import BASIC, ORIGIN, filter_logs
from tests.support.imperfect_arm import ImperfectArm, Imperfections
from tests.support.measured_logs import log_of, plan_of
from tests.support.payload_logs import PAYLOAD, TrueArm, four_joint_arm

ROBOT = four_joint_arm()
FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


def answer_log(robot, log, kept=(), **options):
    """Return the answer from a log; the model file keeps the parts ``kept``, None for no file."""
    recording = filter_logs(robot, log, friction_model=BASIC, **options)
    return answer_link(robot, *recording, Progress(), kept)


def link_result(*arguments, **options):
    """Return the result for the answer of ``answer_log``."""
    return result_of(answer_log(*arguments, **options), ORIGIN)


@pytest.fixture(scope="module")
def answer(robot, noisy):
    return answer_log(robot, noisy)


@pytest.fixture(scope="module")
def result(answer):
    return result_of(answer, ORIGIN)


def test_bodies_joints_and_sensors_are_those_of_the_plant(plant, result):
    assert result.question == LINK
    assert result.verdict is Verdict.BETTER and not result.reasons
    assert [link.name for link in result.links] == ["link0", "link1", "link2"]
    assert [link.joint for link in result.links] == list(plant.joint_names)
    first, _, last = result.links
    error = np.abs(last.inertial.theta - plant.prior.theta)
    assert np.max(error / last.errors) < 4.0 and result.relative_mass_error < 0.25
    assert first.data_share[0] < 0.3 and last.data_share[9] > 0.9
    for name, joint in result.joints.items():
        assert joint.friction_model == BASIC
        assert set(joint.terms) == set(BASIC.split("-"))
        coulomb = joint.terms["coulomb"].value
        offset = joint.terms["offset"].value
        assert coulomb == pytest.approx(0.3, abs=0.05)
        directions = [friction.value for friction in joint.directional_coulomb]
        assert directions == pytest.approx([coulomb + offset, coulomb - offset])
        assert joint.noise == pytest.approx(0.1 * np.sqrt(2.0 * 8.0 / 200.0), rel=0.3)
        assert {f"{term}[{name}]" for term in ("scale", "zero", "load")} <= set(
            result.sensors
        )
    assert result.validation[0].rmse < 1.5 * result.estimate.rmse
    assert result.cutoff == 8.0


@pytest.mark.parametrize(
    ("share", "verdict", "is_noted"),
    [
        (0.01, Verdict.BETTER, False),
        (0.05, Verdict.BETTER, True),
        (0.2, Verdict.TORQUES_ONLY, True),
    ],
)
def test_unexplained_torque_is_noted(robot, noisy, share, verdict, is_noted):
    """A slow torque that no motion makes: the file may still predict better, its numbers not."""
    wave = np.sqrt(2.0) * np.sin(2.0 * np.pi * 0.37 * noisy.time)
    torque = np.outer(wave, share * rms(noisy.tau))
    result = link_result(robot, replace(noisy, tau=noisy.tau + torque))
    assert result.verdict is verdict and result.failure is None
    assert result.verdict.is_trustworthy == (verdict is Verdict.BETTER)
    message = "explained by neither the model nor noise"
    notes = tuple(note for note in result.notes if message in note)
    assert len(notes) == is_noted
    assert result.reasons == (notes if verdict is Verdict.TORQUES_ONLY else ())


def test_the_estimate_leads_with_the_link_and_its_errors_add_up(result):
    estimate = result.estimate
    assert estimate.names[:10] == spatial.PARAMETER_NAMES
    count = len(estimate.identifiability.identified)
    assert count == 10 + 4 * 3
    assert not {"m(link0)", "scale[joint0]"} & set(estimate.names[:count])
    variances = np.square(estimate.standard_errors)
    assert_allclose(np.diag(estimate.covariance), variances, rtol=1e-6)
    assert estimate.samples.keys() == result.joints.keys()
    assert estimate.effective_samples.keys() == result.joints.keys()


@pytest.mark.parametrize("seed", [0, 1])
def test_sensor_parameters_are_the_deviation_from_the_model(plant, seed):
    """An arm that is tilted and late, with wrong zeros and scales, all estimated at once."""
    rng = np.random.default_rng(seed)
    sizes = Imperfections(
        links=0.02, scale=0.02, tilt=np.radians(0.3), lag=0.004, load=0.01, noise=0.05
    )
    arm = ImperfectArm(plant, rng, sizes)
    log = arm.log(plan_of(plant, seed, 20.0), np.zeros(10), rng)
    result = link_result(plant, log, kept=None)
    truth = arm.sensors()
    assert truth.keys() <= result.sensors.keys()
    estimate = dict(zip(result.estimate.names, result.estimate.values))
    for name, (value, error) in result.sensors.items():
        # Friction terms without a true value may be there and are not.
        assert abs(value - truth.get(name, 0.0)) < 4.0 * error, name
        assert estimate[name] == value
    assert {"delay", *TILT_NAMES} <= result.sensors.keys()


@pytest.mark.parametrize(
    ("scale", "is_noted"), [(1.3, True), (1.01, False), (0.7, True)]
)
def test_a_common_torque_scale_is_noted_where_it_is_large(
    plant, noisy, scale, is_noted
):
    """The prior that allows for it follows from a first fit; the last one may find next to none."""
    answer = answer_log(plant, noisy, None)
    fit = answer.fit
    values = fit.values.copy()
    names = [f"scale[{joint}]" for joint in plant.joint_names]
    values[fit.columns.indices(names)] = scale - 1.0
    choice = replace(fit.choice, common_scale=0.15)
    scaled_fit = replace(fit, choice=choice, values=values)
    notes = "\n".join(result_of(replace(answer, fit=scaled_fit), ORIGIN).notes)
    assert (f"all torques read about {scale:g} times" in notes) is is_noted
    assert ("torques read about" in notes) is is_noted


def test_a_resting_joint_keeps_the_models_numbers_and_an_offset_is_noted(
    plant, robot, result
):
    plan = plan_of(plant).scale_amplitudes(np.array([1.0, 1.0, 0.0]))
    log = log_of(plant, plan, noise_torque=0.05)
    resting = link_result(robot, replace(log, tau=log.tau + [0.0, 1.0, 0.0]))
    joint = resting.joints["joint2"]
    assert joint.friction_model == "none" and not joint.terms
    file = resting.file
    assert "joint2" not in file.joints
    notes = "\n".join(resting.notes)
    assert "joint2 does not move fast enough" in notes
    start = "no model file holds an offset of a torque sensor (joint1 "
    _, text = notes.split(start)
    numbers = text.partition("\n")[0].split()
    assert float(numbers[0]) == pytest.approx(1.0, abs=0.1)
    # The offset of 1 N m is a share of the torque of the two joints that move.
    validation = file.validation_after
    torque = validation.rmse / validation.relative_error
    expected = np.hypot(validation.rmse, 1.0 / np.sqrt(2.0)) / torque
    assert float(numbers[-2]) / 100.0 == pytest.approx(expected, rel=0.1)
    assert not any("torque sensor" in note for note in result.notes)


def test_a_log_with_its_joints_reversed_is_refused(robot, noisy):
    result = link_result(robot, replace(noisy, tau=noisy.tau[:, ::-1]))
    assert result.verdict is Verdict.NO_BETTER and result.failure


def test_traces_hold_the_residual_of_the_file(robot, answer):
    fit = answer.file.fit
    traces = traces_of(answer)
    assert traces.joints == robot.joint_names
    squares = fit.evidence.total.squared_residuals(fit.values)
    assert_allclose(np.nansum(traces.residual**2, axis=0), squares, rtol=1e-9)
    # The model before is clearly worse.
    error_before = np.nanstd(traces.measured - traces.prior_prediction, axis=0)
    assert np.all(error_before > 2.0 * np.nanstd(traces.residual, axis=0))
    # At a reversal the low-pass smooths the jump of friction.
    speed = np.abs(traces.qd[:, -1])
    is_fast = np.isfinite(traces.measured[:, -1]) & (speed > 0.3)
    friction = np.abs(traces.friction[is_fast, -1])
    tolerance = 0.05 + abs(fit.value("offset[joint2]"))
    assert_allclose(friction, 0.3 + 0.2 * speed[is_fast], atol=tolerance)


# ---- payload


def payload_result(recordings, kept=None, resting=False, **question):
    """Return (result of recordings with a payload, its answer)."""
    options = EstimationOptions(friction_model=None if resting else BASIC)
    question = Question(options, loaded=True, resting=resting, **question)
    answer, mass_without = answer_payload(ROBOT, recordings, question, Progress(), kept)
    return payload_of(answer, mass_without, FLANGE, ORIGIN), answer


def test_a_refused_payload_has_one_error_of_its_mass(recordings):
    swapped = []
    for recording in recordings:
        swapped.append(replace(recording, is_loaded=not recording.is_loaded))
    result, _ = payload_result(swapped)
    body = result.payload.body
    (reason,) = result.reasons
    assert result.verdict is Verdict.SWAPPED
    assert reason.endswith(with_error(body.inertial.mass, body.errors[0], "kg"))


def test_a_payload_is_given_in_the_flange_frame_with_its_errors(recordings):
    result, _ = payload_result(recordings, kept=())
    payload = result.payload
    assert result.verdict is Verdict.OK
    file = result.file
    error_before = file.validation_before.relative_error
    assert file.validation_after.relative_error < error_before
    body = payload.body
    theta = body.inertial.theta
    assert np.max(np.abs(theta - FLANGE.to_flange(PAYLOAD)) / body.errors) < 4.0
    assert body.errors[0] < 0.02 and result.body.inertial is body.inertial
    causes = body.mass_causes
    assert causes["noise"] == body.noise_errors[0]
    assert np.linalg.norm([*causes.values()]) == pytest.approx(body.errors[0])
    difference = payload.total.inertial.theta - payload.link.inertial.theta
    assert_allclose(FLANGE.to_flange(difference), theta, atol=1e-12)
    names = {"empty": ("log0", "log3"), "loaded": ("log1", "log2")}
    assert payload.recordings == names and len(payload.scatter) == 4
    assert payload.torque_scale == {} and "drift[joint0]" not in result.sensors


def test_an_inertia_within_its_error_of_zero_is_replaced_by_a_balls():
    """In the payload, in the link with it and in the file's validation; a note has its errors."""
    ball = spatial.aluminium_ball(0.4, np.array([0.03, -0.02, 0.08]))
    arm = TrueArm(ROBOT, 0, model_error=0.03, payload=ball)
    result, answer = payload_result(arm.abba(0, sigma=0.1), kept=())
    payload = result.payload
    theta = result.body.inertial.theta
    assert result.verdict is Verdict.INERTIA_NOT_KNOWN and result.verdict.is_trustworthy
    expected = spatial.aluminium_ball(theta[0], theta[1:4] / theta[0])
    assert_allclose(theta, expected, atol=1e-12)
    difference = payload.total.inertial.theta - payload.link.inertial.theta
    for carried in (difference, answer.file.fit.question.carried):
        assert_allclose(FLANGE.to_flange(carried), theta, atol=1e-12)
    for body in (payload.body, payload.total):
        assert np.all(np.isinf(body.errors) == (np.arange(10) >= 4))
    (note,) = [
        note for note in result.notes if "differ significantly from zero" in note
    ]
    assert note.count("±") == 3


def test_a_weight_that_contradicts_the_known_mass_is_refused(recordings):
    result, _ = payload_result(recordings, known_mass=3.0)
    assert result.verdict is Verdict.WRONG_WEIGHT and result.failure


def test_a_known_mass_is_the_payloads_and_identifies_scales(recordings):
    result, _ = payload_result(recordings, known_mass=1.2)
    payload = result.payload
    assert result.verdict is Verdict.OK and payload.known_mass == 1.2
    assert result.body.inertial.mass == pytest.approx(1.2, rel=1e-4)
    assert payload.scatter == ()
    for name, scale in payload.torque_scale.items():
        assert isinstance(scale, Quantity)
        assert abs(scale.value - 1.0) < 3.0 * scale.error, name
    # Joints along gravity show nothing of it.
    assert min(scale.error for scale in payload.torque_scale.values()) < 0.01


def test_resting_poses_show_mass_and_centre_of_mass_and_no_inertia():
    arm = TrueArm(ROBOT, 2, model_error=0.03)
    time = np.arange(30.0)
    recordings = []
    for is_loaded in (False, True):
        q = np.random.default_rng(is_loaded).uniform(-1.0, 1.0, (30, 4))
        zero = np.zeros_like(q)
        tau = arm.torque(Measurement(time, q, zero, zero, zero), is_loaded)
        noise = np.random.default_rng(is_loaded + 5).standard_normal(q.shape)
        poses = Measurement(time, q, zero, tau + 0.02 * noise, zero)
        name = "loaded" if is_loaded else "empty"
        recordings.append(Dataset(name, RestingPoses(poses, q == q), is_loaded))
    result, _ = payload_result(recordings, resting=True)
    assert result.verdict is Verdict.INERTIA_NOT_KNOWN and result.cutoff is None
    assert (
        "the payload's inertia is not identifiable from these torques" in result.notes
    )
    inertial = result.body.inertial
    expected = FLANGE.to_flange(PAYLOAD)[:4]
    assert_allclose(inertial.theta[:4], expected, rtol=0.1, atol=0.01)
    moments = inertial.principal_moments
    assert moments[0] == pytest.approx(moments[2], rel=1e-9)
    assert np.all(np.isinf(result.payload.body.errors[4:]))

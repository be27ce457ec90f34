"""What is said of an arm and of a payload, and when it is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.diagnosis.rows import rms
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.newton_euler import TILT_NAMES
from robot_sysid.estimation.build_result import payload_of, result_of
from robot_sysid.estimation.dataset import Dataset, RestingPoses
from robot_sysid.estimation.identify import answer_link, answer_payload
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.records import Flange, Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import LINK, Quantity, Verdict
from tests.support.core_fits import BASIC, ORIGIN, filter_logs
from tests.support.imperfect_arm import ImperfectArm, Imperfections
from tests.support.measured_logs import log_of, plan_of
from tests.support.payload_logs import PAYLOAD, TrueArm, four_joint_arm

ROBOT = four_joint_arm()
FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


def of_link(robot, log, kept=(), **options):
    datasets, chosen = filter_logs(robot, log, friction_model=BASIC, **options)
    answer = answer_link(robot, datasets, chosen, Progress(), kept)
    return result_of(answer, ORIGIN)


@pytest.fixture(scope="module")
def result(robot, noisy):
    return of_link(robot, noisy)


def test_bodies_joints_and_sensors_are_those_of_the_plant(plant, result):
    assert (result.question, result.verdict) == (
        LINK,
        Verdict.BETTER,
    ) and not result.reasons
    assert [link.name for link in result.links] == ["link0", "link1", "link2"]
    assert [link.joint for link in result.links] == list(plant.joint_names)
    last = result.links[-1]
    off = np.abs(last.inertial.theta - plant.prior.theta) / last.errors
    assert np.max(off) < 4.0 and result.relative_mass_error < 0.25
    assert result.links[0].data_share[0] < 0.3 and last.data_share[9] > 0.9
    for name, joint in result.joints.items():
        assert joint.friction_model == BASIC and set(joint.terms) == set(
            BASIC.split("-")
        )
        assert joint.terms["coulomb"].value == pytest.approx(0.3, abs=0.05)
        forward, backward = joint.directional_coulomb
        both = (
            0.5 * (forward.value + backward.value),
            0.5 * (forward.value - backward.value),
        )
        assert both == pytest.approx(
            (joint.terms["coulomb"].value, joint.terms["offset"].value)
        )
        assert joint.noise == pytest.approx(0.1 * np.sqrt(2.0 * 8.0 / 200.0), rel=0.3)
        assert {f"scale[{name}]", f"zero[{name}]", f"load[{name}]"} <= set(
            result.sensors
        )
    own = result.validation[0]
    assert own.rmse < 1.5 * result.estimate.rmse and result.cutoff == 8.0


@pytest.mark.parametrize(
    ("share", "verdict", "is_told"),
    [
        (0.01, Verdict.BETTER, False),
        (0.05, Verdict.BETTER, True),
        (0.2, Verdict.TORQUES_ONLY, True),
    ],
)
def test_torque_that_nothing_explains_is_said(robot, noisy, share, verdict, is_told):
    """A slow torque that no motion makes: the file may still predict better, its numbers not."""
    wave = np.sqrt(2.0) * np.sin(2.0 * np.pi * 0.37 * noisy.time)
    made = np.outer(wave, share * rms(noisy.tau))
    found = of_link(robot, replace(noisy, tau=noisy.tau + made))
    assert found.verdict is verdict and found.failure is None
    assert found.verdict.is_trustworthy == (verdict is Verdict.BETTER)
    said = [
        note
        for note in found.notes
        if "explained by neither the model nor noise" in note
    ]
    assert len(said) == is_told
    assert found.reasons == (tuple(said) if verdict is Verdict.TORQUES_ONLY else ())


def test_the_estimate_leads_with_the_link_and_its_errors_add_up(result):
    estimate = result.estimate
    assert estimate.names[:10] == spatial.PARAMETER_NAMES
    interest = estimate.names[: len(estimate.identifiability.identified)]
    assert {"m(link0)", "scale[joint0]"} & set(interest) == set()
    assert len(interest) == 10 + 4 * 3
    total = np.square(estimate.standard_errors)
    assert_allclose(np.diag(estimate.covariance), total, rtol=1e-6)
    assert (
        estimate.samples.keys()
        == estimate.effective_samples.keys()
        == result.joints.keys()
    )


@pytest.mark.parametrize("degrees", [3.0, 25.0])
@pytest.mark.parametrize("seed", range(2))
def test_every_number_of_sensors_is_the_whole_of_it(plant, degrees, seed):
    """An arm that is tilted and late, with wrong zeros and scales; all of it is sought at once."""
    rng = np.random.default_rng(seed)
    sizes = {
        "links": 0.02,
        "scale": 0.02,
        "tilt": np.radians(degrees),
        "lag": 0.05,
        "load": 0.01,
    }
    arm = ImperfectArm(plant, rng, Imperfections(**sizes, noise=0.05))
    log = arm.log(plan_of(plant, seed, 20.0), np.zeros(10), rng)
    found = of_link(plant, log, kept=None, tilt="auto", delay="auto")
    truth = arm.sensors()
    assert truth.keys() <= found.sensors.keys()
    for name, (value, error) in found.sensors.items():
        # All else is friction that may be there and is not.
        assert abs(value - truth.get(name, 0.0)) < 4.0 * error, name
    assert found.sensors["delay"].error < 0.2 * arm.off.lag
    assert max(found.sensors[name].error for name in TILT_NAMES) < 0.2 * arm.off.tilt
    assert found.tilt == pytest.approx(arm.off.tilt, rel=0.2)
    assert found.delay == found.sensors["delay"].value
    in_estimate = dict(zip(found.estimate.names, found.estimate.values))
    assert all(
        in_estimate[name] == figure.value for name, figure in found.sensors.items()
    )


@pytest.mark.parametrize(("size", "is_told"), [(1.3, True), (1.01, False), (0.7, True)])
def test_a_common_scale_is_told_only_where_it_is_worth_a_word(
    plant, noisy, size, is_told
):
    """That it is allowed for follows from a first fit; the last one may find next to none."""
    datasets, options = filter_logs(plant, noisy, friction_model=BASIC)
    answer = answer_link(plant, datasets, options, Progress(), None)
    fit = answer.fit
    values = fit.values.copy()
    values[[fit.columns.index[f"scale[{joint}]"] for joint in plant.joint_names]] = (
        size - 1.0
    )
    choice = replace(fit.choice, common_scale=0.15)
    notes = result_of(
        replace(answer, fit=replace(fit, choice=choice, values=values)), ORIGIN
    ).notes
    assert (
        any(f"all torques read about {size:g} times" in note for note in notes)
        is is_told
    )
    assert is_told or not any("torques read about" in note for note in notes)


def test_a_still_joint_keeps_the_models_numbers_and_an_offset_is_told(
    plant, robot, result
):
    plan = plan_of(plant).scaled(np.array([1.0, 1.0, 0.0]))
    log = log_of(plant, plan, noise_torque=0.05)
    found = of_link(robot, replace(log, tau=log.tau + [0.0, 1.0, 0.0]))
    assert (
        found.joints["joint2"].friction_model == "none"
        and not found.joints["joint2"].terms
    )
    assert "joint2" not in found.file.joints
    assert any("joint2 does not move fast enough" in note for note in found.notes)
    of = "no model file holds an offset of a torque sensor (joint1 "
    ((_, said),) = [note.split(of) for note in found.notes if of in note]
    assert float(said.split()[0]) == pytest.approx(1.0, abs=0.1)
    lost = float(said.split()[-2]) / 100.0
    size = found.file.validation_after.rmse / found.file.validation_after.relative_error
    whole = np.hypot(
        found.file.validation_after.rmse, 1.0 / np.sqrt(2.0)
    )  # joint2 is still
    assert lost == pytest.approx(whole / size, rel=0.1)
    assert not any("torque sensor" in note for note in result.notes)


def test_a_log_turned_in_its_joints_is_refused(robot, noisy):
    result = of_link(robot, replace(noisy, tau=noisy.tau[:, ::-1]))
    assert result.verdict is Verdict.NO_BETTER and result.failure


# ---- payload


def of_payload(recordings, kept=None, resting=False, options=None, **question):
    usual = EstimationOptions(friction_model=None if resting else BASIC)
    asked = Question(options or usual, loaded=True, resting=resting, **question)
    answer, weighed = answer_payload(ROBOT, recordings, asked, Progress(), kept)
    return payload_of(answer, weighed, FLANGE, ORIGIN)


def test_a_payload_is_told_in_the_flange_frame_with_its_errors(recordings):
    result = of_payload(recordings, kept=())
    assert result.verdict is Verdict.OK
    assert (
        result.file.validation_after.relative_error
        < result.file.validation_before.relative_error
    )
    body = result.payload.body
    truth = FLANGE.to_flange(PAYLOAD)
    assert np.max(np.abs(body.inertial.theta - truth) / body.errors) < 4.0
    assert body.errors[0] < 0.02 and result.body.inertial is body.inertial
    link = result.payload.link.inertial.theta
    total = result.payload.total.inertial.theta
    assert_allclose(FLANGE.to_flange(total - link), body.inertial.theta, atol=1e-12)
    kinds = {"empty": ("log0", "log3"), "loaded": ("log1", "log2")}
    assert result.payload.recordings == kinds and len(result.payload.scatter) == 4
    assert result.payload.torque_scale == {} and "drift[joint0]" not in result.sensors


def test_an_inertia_that_is_not_told_from_zero_is_a_balls():
    """... in the payload, the link with it and what the file is judged with; a note has its ±."""
    ball = spatial.aluminium_ball(0.4, np.array([0.03, -0.02, 0.08]))
    arm = TrueArm(ROBOT, 0, model_error=0.03, payload=ball)
    asked = Question(EstimationOptions(friction_model=BASIC), loaded=True)
    answer, weighed = answer_payload(ROBOT, arm.abba(0, sigma=0.1), asked, Progress())
    result = payload_of(answer, weighed, FLANGE, ORIGIN)
    payload = result.payload
    theta = result.body.inertial.theta
    assert result.verdict is Verdict.INERTIA_NOT_KNOWN and result.verdict.is_trustworthy
    expected = spatial.aluminium_ball(theta[0], theta[1:4] / theta[0])
    assert_allclose(theta, expected, atol=1e-12)
    total = payload.total.inertial.theta - payload.link.inertial.theta
    for carried in (total, answer.file.fit.question.carried):
        assert_allclose(FLANGE.to_flange(carried), theta, atol=1e-12)
    for body in (payload.body, payload.total):
        assert np.all(np.isfinite(body.errors[:4])) and np.all(
            np.isinf(body.errors[4:])
        )
    (said,) = [note for note in result.notes if "not told from zero" in note]
    assert said.count("±") == 3


def test_another_weight_than_was_said_is_refused(recordings):
    result = of_payload(recordings, known_mass=3.0)
    assert result.verdict is Verdict.WRONG_WEIGHT and result.failure


def test_a_known_mass_is_the_payloads_and_tells_scales(recordings):
    result = of_payload(recordings, known_mass=1.2)
    assert result.verdict is Verdict.OK and result.payload.known_mass == 1.2
    assert result.body.inertial.mass == pytest.approx(1.2, rel=1e-4)
    assert result.payload.scatter == ()
    # Axes along gravity show nothing of it.
    for name, scale in result.payload.torque_scale.items():
        assert (
            isinstance(scale, Quantity) and abs(scale.value - 1.0) < 3.0 * scale.error
        ), name
    assert min(each.error for each in result.payload.torque_scale.values()) < 0.01


def test_resting_poses_tell_mass_and_place_and_no_inertia():
    arm = TrueArm(ROBOT, 2, model_error=0.03)
    time = np.arange(30.0)
    recordings = []
    for loaded in (False, True):
        q = np.random.default_rng(loaded).uniform(-1.0, 1.0, (30, 4))
        still = np.zeros_like(q)
        torque = arm.torque(Measurement(time, q, still, still, still), loaded)
        noise = 0.02 * np.random.default_rng(loaded + 5).standard_normal(q.shape)
        poses = RestingPoses(Measurement(time, q, still, torque + noise, still), q == q)
        recordings.append(Dataset("ab"[loaded], poses, bool(loaded)))
    result = of_payload(recordings, resting=True)
    assert result.verdict is Verdict.INERTIA_NOT_KNOWN and result.cutoff is None
    assert "these torques do not show the payload's inertia" in result.notes
    found = result.body.inertial
    truth = FLANGE.to_flange(PAYLOAD)
    assert_allclose(found.theta[:4], truth[:4], rtol=0.1, atol=0.01)
    moments = found.principal_moments
    assert moments[0] == pytest.approx(moments[2], rel=1e-9)
    assert np.all(np.isinf(result.payload.body.errors[4:]))

"""Each implausible estimate is refused with its reason; a wide error alone is no reason."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms import small_arms
from rigs.arms.core_fits import fit_logs
from rigs.files import results as made
from robot_sysid import spatial
from robot_sysid.estimate.links import CENTRE, MASS
from robot_sysid.estimate.payload import Contradiction
from robot_sysid.model.bodies import link_reach
from robot_sysid.records import Flange, Validation
from robot_sysid.records.file_access import strict_json
from robot_sysid.records.messages import Level
from robot_sysid.records.quantities import BodyEstimate, Quantity
from robot_sysid.results import reasons
from robot_sysid.results.notes import wrong_links
from robot_sysid.results.rules import (
    OF_ACCEPTED,
    OF_ARM,
    OF_FILES,
    OF_OTHER_MOTIONS,
    OF_PAYLOAD,
    PayloadEvidence,
)
from robot_sysid.results.self_test import OF_SELF_TEST, SelfTestEvidence
from robot_sysid.results.verdicts import MEANINGS, Verdict, judge, verdict_of

SEVEN = small_arms.robot_of(small_arms.SEVEN)
REACH = link_reach(SEVEN)
ARM = REACH + sum(float(np.linalg.norm(link.translation)) for link in SEVEN.links[1:])
OK = Verdict.OK
IMPLAUSIBLE = Verdict.IMPLAUSIBLE
NOT_SEEN = Verdict.NOT_SEEN
WRONG_WEIGHT = Verdict.WRONG_WEIGHT


def body(distance=0.1, moment_error=1e-3, mass=1.0, error=0.01, radius=0.05):
    """Return a body whose centre of mass is at a distance along z [m], with errors along z."""
    inertia = abs(mass) * radius**2 * np.eye(3)
    theta = spatial.theta_from_com(mass, np.array([0.0, 0.0, distance]), inertia)
    errors = np.array([error, 0.0, 0.0, moment_error] + [1e-3] * 6)
    covariance = np.nan_to_num(np.diag(errors**2))
    return BodyEstimate(theta, "it", covariance, np.isfinite(errors), {"noise": errors})


FAR = REACH + 0.3 * ARM
"""Distance of a centre of mass from the last joint up to which it is plausible [m]."""


SPREAD = np.linspace(0.7, 1.3, 10)
"""Shares of an error in ten blocks of a log."""


def prediction(relative_error=None, spread=SPREAD, torque=None, **joints):
    """Return held-out errors of a joint, or of several, as a share of the torque.

    ``torque`` has the root mean squares of the joints; none for a joint without torque.
    """
    errors = np.array([*joints.values()] or [relative_error or 0.0])
    names = tuple(joints) or ("it",)
    if torque is None:
        torque = np.full(len(names), float(bool(joints) or relative_error is not None))
    counts = np.full(len(names), 100)
    blocks = 100 * np.outer(spread / np.sum(spread), np.square(errors * torque))
    return Validation(names, blocks, counts, "parts", 100 * np.square(torque), True)


def first(remarks):
    """The verdict of some remarks, OK where there is none, and all sentences."""
    remarks = list(remarks)
    return verdict_of(remarks), tuple(remark.text for remark in remarks)


def implausible(reasons_against):
    """The remarks on a body that this arm cannot have."""
    return map(IMPLAUSIBLE.remark, reasons_against)


def judge_link(*args, **numbers):
    return implausible(reasons.impossible_link(SEVEN, body(*args, **numbers)))


def judge_payload(contradiction=None, relative_error=0.03, known_mass=None, **numbers):
    test = prediction(relative_error)
    flange = Flange("here", np.eye(3), np.zeros(3))
    found = body(**numbers)
    evidence = PayloadEvidence(SEVEN, found, contradiction, flange, test, known_mass)
    return judge(OF_PAYLOAD, evidence)


def judge_known_mass(mass_without, **numbers):
    return judge_payload(known_mass=1.0, mass=mass_without, **numbers)


def judge_joint(**terms):
    """Return the reasons against the last joint's friction and rotor."""
    sizes = (9.0, 40.0, 5.0, 20.0, 1.0, 4.0, 0.5)
    torque = dict(zip(SEVEN.joint_names, sizes))
    last = SEVEN.joint_names[-1]
    rows = [Quantity(term, last, "", None, size, 0.1) for term, size in terms.items()]
    return implausible(reasons.impossible_joints(SEVEN, rows, torque))


@pytest.mark.parametrize(
    ("findings", "verdict", "message"),
    [
        (judge_link(), OK, ""),
        # A gripper and its load, a fifth of the arm's reach beyond the flange.
        (judge_link(REACH + 0.2 * ARM, mass=2.0), OK, ""),
        # A tenth of a metre too far away: one standard error of that, or three.
        (judge_link(FAR + 0.1, 0.1), OK, ""),
        (judge_link(FAR + 0.1, 0.07), OK, ""),
        (judge_link(FAR + 0.1, 0.03), IMPLAUSIBLE, "away"),
        (judge_link(radius=0.6), IMPLAUSIBLE, "radius of gyration is 0.6 m"),
        (judge_link(mass=10.4, error=np.inf), IMPLAUSIBLE, "do not show the mass"),
        (judge_joint(coulomb=30.0, viscous=200.0, armature=0.5), OK, ""),
        (judge_joint(coulomb=141.2), IMPLAUSIBLE, "141 N·m of dry friction"),
        (judge_joint(armature=1e3), IMPLAUSIBLE, "rotor"),
        (judge_payload(error=0.4), OK, ""),
        (judge_payload(mass=-1.0), Verdict.SWAPPED, "-1"),
        (judge_payload(mass=0.01, error=0.02), NOT_SEEN, "0.010 ± 0.020 kg"),
        # Two standard errors of its mass decide.
        (judge_payload(mass=0.038, error=0.02), NOT_SEEN, "0.038"),
        (judge_payload(mass=0.042, error=0.02), OK, ""),
        (judge_payload(error=np.inf), NOT_SEEN, "(± not known)"),
        (judge_payload(distance=1.8), IMPLAUSIBLE, "1.8 m"),
        (
            judge_payload(Contradiction("a", ("b",), body().theta, 0.03)),
            Verdict.DISAGREE,
            "a differs from b: it carries 1 kg at (0, 0, 100) mm",
        ),
        (judge_payload(relative_error=0.6), Verdict.UNEXPLAINED, "60 %"),
        (judge_known_mass(0.8), OK, ""),
        (judge_known_mass(0.3), WRONG_WEIGHT, "0.3 kg"),
        (judge_known_mass(2.1), WRONG_WEIGHT, "2.1 kg"),
        # A finding that the known mass puts right is no reason to refuse it; another is.
        (judge_known_mass(0.8, distance=1.8), OK, ""),
        (judge_known_mass(-1.0), Verdict.SWAPPED, "comes out as -1"),
    ],
)
def test_each_implausible_estimate_is_refused_with_its_reason(
    findings, verdict, message
):
    judgement, sentences = first(findings)
    assert judgement is verdict
    assert judgement.is_trustworthy == (verdict is OK) == (not sentences)
    assert message in " ".join(sentences)


@pytest.mark.parametrize(
    ("model", "file", "verdict"),
    [
        (prediction(0.3), prediction(0.1), Verdict.BETTER),
        (prediction(0.1), prediction(0.104), Verdict.AS_GOOD),
        (prediction(0.1), prediction(0.12), Verdict.NO_BETTER),
        # Lower in some blocks and higher in others: nothing is clear.
        (prediction(0.1), prediction(0.11, SPREAD[::-1] ** 3), Verdict.AS_GOOD),
        (prediction(0.9), prediction(0.6), Verdict.NO_BETTER),
        (prediction(0.0), prediction(1e-12), Verdict.AS_GOOD),
        (prediction(None), prediction(None), Verdict.NO_BETTER),
        # A joint that the file predicts clearly worse, unless nobody sees the difference.
        (prediction(a=0.1, b=1), prediction(a=0.12, b=0.1), Verdict.NO_BETTER),
        (prediction(a=0.1, b=1), prediction(a=0.104, b=0.1), Verdict.BETTER),
        (prediction(a=0.01, b=1), prediction(a=0.019, b=0.1), Verdict.BETTER),
    ],
)
def test_a_file_is_compared_with_the_model_before(model, file, verdict):
    errors = made.errors_from(model, file, model, file)
    assert verdict_of(judge(OF_FILES, [errors])) is verdict


def test_a_file_that_is_worse_as_it_is_used_is_refused_whatever_its_offsets_explain():
    """Weight that the fit took for an offset is missing in the file."""
    aside = prediction(0.24), prediction(0.09)
    used = prediction(0.28), prediction(0.37)
    (remark,) = judge(OF_FILES, [made.errors_from(*aside, *used)])
    assert remark.about is Verdict.NO_BETTER
    assert "28 % -> 37 %" in remark.text
    (better,) = judge(OF_FILES, [made.errors_from(*aside, *used[::-1])])
    assert better.about is Verdict.BETTER


@pytest.mark.parametrize(("used", "is_usable"), [(0.49, True), (0.51, False)])
def test_a_file_whose_errors_are_half_of_the_torque_is_refused_as_it_is_used(
    used, is_usable
):
    """Offsets are errors then, however much larger those of the model were."""
    model = prediction(0.9)
    errors = made.errors_from(model, prediction(0.1), model, prediction(used))
    assert verdict_of(judge(OF_FILES, [errors])).is_trustworthy == is_usable


@pytest.mark.parametrize(("share", "is_usable"), [(0.49, True), (0.51, False)])
def test_no_file_is_usable_that_is_wrong_by_half_of_the_torque_on_other_motions(
    share, is_usable
):
    """It may be the best that a log of one joint shows, and far better than the model."""
    errors = made.elsewhere(after=share)
    remarks = [Verdict.BETTER.remark(), *judge(OF_OTHER_MOTIONS, errors)]
    verdict = verdict_of(remarks)
    assert verdict.is_trustworthy == is_usable
    assert ("usable" in verdict.use) == is_usable


def judge_fit(fitted, *tests):
    """Return (verdict, reasons) of a fit and of its errors in other rows."""
    misfits = reasons.torque_misfits(fitted, tests)
    return first(map(Verdict.UNEXPLAINED.remark, misfits))


@pytest.mark.parametrize(
    ("factor", "relative_error", "is_ok"),
    [(2.5, 0.1, True), (3.5, 0.01, True), (3.5, 0.1, False)],
)
def test_held_out_errors_may_be_three_times_the_noise(
    noisy_fit, factor, relative_error, is_ok
):
    noise = noisy_fit.noise_per_joint
    torque = factor * np.array([*noise.values()]) / relative_error
    test = prediction(torque=torque, **dict.fromkeys(noise, relative_error))
    verdict, sentences = judge_fit(noisy_fit, test)
    assert verdict is (OK if is_ok else Verdict.UNEXPLAINED)
    assert is_ok or "of parts are predicted 3.5 times worse" in sentences[0]
    unknown = replace(test, is_informative=False)
    assert judge_fit(noisy_fit, unknown) == (OK, ())


@pytest.mark.parametrize("is_noise", [False, True])
def test_a_joint_with_unexplained_torque_is_named_unless_it_is_white_noise(
    robot, noisy, is_noise
):
    tau = noisy.tau.copy()
    if is_noise:
        size = 9.0 * np.sqrt(np.mean(tau[:, 2] ** 2))
        white = np.repeat(np.random.default_rng(0).normal(size=len(tau)), 8)
        tau[:, 2] += size * white[: len(tau)]
    else:
        tau[:, 2] = tau[::-1, 0]
    verdict, sentences = judge_fit(fit_logs(robot, replace(noisy, tau=tau)))
    assert verdict is (OK if is_noise else Verdict.UNEXPLAINED)
    assert is_noise or "of the torque of joint2 is unexplained" in sentences[0]


@pytest.mark.parametrize(
    ("distance", "error", "is_named"),
    [(0.1, 0.001, False), (0.15, 0.01, True), (0.15, 0.03, False)],
)
def test_a_link_is_named_whose_first_moment_is_clearly_wrong(distance, error, is_named):
    """By 50 %: beyond two errors of 0.01 kg m, within two of 0.03."""
    link = replace(body(distance, error), prior=body())
    named = list(wrong_links([link], made.model_file(), {}))
    assert len(named) == is_named
    for remark in named:
        assert (remark.level, remark.about) == (Level.DOUBTS, link.name)
        assert "0.150 ± 0.010 kg·m, in the model 0.1," in remark.text


def test_a_link_whose_mass_is_far_off_is_named_by_its_mass():
    link = replace(body(0.15, 0.01), prior=body())
    (remark,) = wrong_links([link], made.model_file(), {link.name: MASS})
    assert f"{link.name} of the model is probably wrong: its mass is" in remark.text
    assert "counts as not known" in remark.text


def test_a_link_whose_centre_is_far_off_is_named_by_its_centre():
    link = replace(body(0.15, 0.01), prior=body())
    (remark,) = wrong_links([link], made.model_file(), {link.name: CENTRE})
    assert "its centre of mass is" in remark.text and "mm from where" in remark.text


@pytest.mark.parametrize(
    ("scale", "error", "rank", "expected"),
    [
        (1.0, 0.49, 12, Verdict.OK),
        (1.0, 0.51, 12, Verdict.TOO_WEAK),
        (1.0, 0.51, 11, Verdict.TOO_WEAK),
        (1.0, 0.49, 11, Verdict.PARTLY_FROM_MODEL),
        (1.0, np.inf, 11, Verdict.PARTLY_FROM_MODEL),
        # An error that a scale would not show is never too large.
        (1e-9, 0.9e-6, 12, Verdict.OK),
        (1e-9, 1.1e-6, 12, Verdict.TOO_WEAK),
    ],
)
def test_the_verdict_on_an_own_simulation_says_what_is_wrong_first(
    scale, error, rank, expected
):
    quality = replace(made.QUALITY, unidentifiable=("mass",) * (12 - rank))
    evidence = SelfTestEvidence(scale, error, quality)
    assert verdict_of(judge(OF_SELF_TEST, evidence)) is expected


def test_every_verdict_has_a_meaning_and_a_condition_that_leads_to_it():
    rules = (*OF_ARM, *OF_OTHER_MOTIONS, *OF_ACCEPTED, *OF_PAYLOAD, *OF_SELF_TEST)
    assert {rule.verdict for rule in rules} == {*Verdict} == MEANINGS.keys()


@given(st.lists(st.sampled_from(Verdict), max_size=6))
def test_a_result_is_as_bad_as_the_worst_that_holds_and_the_first_of_these_is_named(
    verdicts,
):
    levels = [*Level]
    verdict = verdict_of([each.remark("so") for each in verdicts])
    worst = min((levels.index(each.level) for each in verdicts), default=2)
    assert levels.index(verdict.level) == worst
    assert verdict in (verdicts or [OK])
    before = verdicts[: verdicts.index(verdict)] if verdicts else []
    assert all(levels.index(each.level) > worst for each in before)


def test_a_verdict_is_written_as_its_name():
    assert [str(each) for each in Verdict] == [each.name for each in Verdict]
    assert strict_json(Verdict.NO_BETTER.remark("so"))["about"] == "NO_BETTER"
    assert pickle.loads(pickle.dumps(Verdict.OK)) is Verdict.OK

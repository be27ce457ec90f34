"""Each way to be wrong is refused with its reason; a wide error is an answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.estimation import trust
from robot_sysid.estimation.algebra.least_squares import sample_counts
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.held_out import held_out, held_out_validation
from robot_sysid.estimation.trust import first
from robot_sysid.model.inertia import link_reach
from robot_sysid.records import InertialParameters, Validation
from robot_sysid.results.record import BodyEstimate, JointEstimate, Quantity, Verdict
from tests.support import arms
from tests.support.core_fits import filter_logs, fit_recordings

SEVEN = arms.robot_of(arms.SEVEN)
REACH = link_reach(SEVEN.mj_model, SEVEN.reference_qpos, SEVEN.body_id)
ARM = REACH + sum(float(np.linalg.norm(each.translation)) for each in SEVEN.links[1:])


def body(mass=1.0, com=(0.0, 0.0, 0.1), error=0.01, size=0.05, moved=1e-3):
    """A body estimate; its mass and its first moment along z are known to an error."""
    theta = spatial.theta_from_com(mass, np.array(com), abs(mass) * size**2 * np.eye(3))
    covariance = np.diag([error**2, 0.0, 0.0, moved**2] + [1e-6] * 6)
    noise = np.sqrt(np.diag(covariance))
    return BodyEstimate(
        "it",
        InertialParameters(theta),
        np.nan_to_num(covariance),
        np.isfinite(noise),
        noise,
    )


def prediction(relative):
    return Validation("parts", 100, 0.1, relative, {}, {})


def of_link(link):
    return trust.implausible_link(SEVEN, link)


def of_links(index=0, change=lambda theta: theta):
    thetas = SEVEN.thetas
    thetas[index] = change(thetas[index])
    return trust.implausible_links(SEVEN, thetas)


def moved(theta):
    mass, com, inertia = spatial.com_from_theta(theta)
    return spatial.theta_from_com(mass, com + 2.0, inertia)


def of_payload(payload, misfit="", relative=0.03):
    return trust.judge_payload(SEVEN, payload, misfit, prediction(relative))


def of_weight(weighed, *before):
    return trust.judge_known_mass(before, weighed, 1.0)


OK = Verdict.OK
IMPLAUSIBLE = Verdict.IMPLAUSIBLE


@pytest.mark.parametrize(
    ("findings", "status", "words"),
    [
        (of_link(body()), OK, ""),
        (of_link(body(error=5.0)), OK, ""),
        # A gripper and what it holds, a fifth of the arm's reach beyond the flange.
        (of_link(body(mass=2.0, com=(0.0, 0.0, REACH + 0.2 * ARM))), OK, ""),
        # A tenth of a metre too far away: one standard error of that, or three.
        (of_link(body(com=(0.0, 0.0, REACH + 0.3 * ARM + 0.1), moved=0.1)), OK, ""),
        (of_link(body(com=(0.0, 0.0, REACH + 0.3 * ARM + 0.1), moved=0.07)), OK, ""),
        (
            of_link(body(com=(0.0, 0.0, REACH + 0.3 * ARM + 0.1), moved=0.03)),
            IMPLAUSIBLE,
            "away",
        ),
        (
            of_link(body(com=(0.0, 0.0, 1.8))),
            IMPLAUSIBLE,
            "centre of mass is 1.8 m away",
        ),
        (of_link(body(size=0.6)), IMPLAUSIBLE, "radius of gyration is 0.6 m"),
        (of_link(body(mass=10.4, error=np.inf)), IMPLAUSIBLE, "do not show the mass"),
        (of_links(1, lambda theta: 3.0 * theta), OK, ""),
        (of_links(1, lambda theta: 100.0 * theta), IMPLAUSIBLE, "link1 would weigh"),
        (of_links(2, moved), IMPLAUSIBLE, "centre of mass of link2"),
        (
            of_links(3, lambda theta: -theta),
            IMPLAUSIBLE,
            "link3 is no possible rigid body",
        ),
        (of_payload(body(error=0.4)), OK, ""),
        (of_payload(body(mass=-1.0)), Verdict.SWAPPED, "-1"),
        (of_payload(body(mass=0.01, error=0.02)), Verdict.NOT_SEEN, "0.010 ± 0.020 kg"),
        # Two standard errors of its mass decide.
        (of_payload(body(mass=0.038, error=0.02)), Verdict.NOT_SEEN, "0.038"),
        (of_payload(body(mass=0.042, error=0.02)), OK, ""),
        (of_payload(body(mass=-0.038, error=0.02)), Verdict.NOT_SEEN, "-0.038"),
        (of_payload(body(error=np.inf)), Verdict.NOT_SEEN, "(± not known)"),
        (of_payload(body(com=(0.0, 1.8, 0.0))), IMPLAUSIBLE, "1.8 m"),
        (of_payload(body(size=1.5)), IMPLAUSIBLE, "radius of gyration"),
        (of_payload(body(), "a differs from b"), Verdict.DISAGREE, "a differs from b"),
        (of_payload(body(), relative=0.6), Verdict.UNEXPLAINED, "60 %"),
        (of_weight(0.8), OK, ""),
        (of_weight(0.3), Verdict.WRONG_WEIGHT, "0.3 kg"),
        (of_weight(2.1), Verdict.WRONG_WEIGHT, "2.1 kg"),
        # What a known mass puts right is no reason to refuse it; what it cannot is.
        (of_weight(0.8, (IMPLAUSIBLE, "far")), OK, ""),
        (of_weight(-1.0, (Verdict.SWAPPED, "less")), Verdict.SWAPPED, "less"),
    ],
)
def test_each_fault_is_refused_with_its_reason(findings, status, words):
    found, reasons = first(findings, OK)
    assert found is status and found.is_trustworthy == (status is OK) == (not reasons)
    assert words in " ".join(reasons)


@pytest.mark.parametrize(
    ("before", "after", "status"),
    [
        (0.3, 0.1, Verdict.BETTER),
        (0.1, 0.109, Verdict.AS_GOOD),
        (0.1, 0.12, Verdict.NO_BETTER),
        (0.9, 0.6, Verdict.NO_BETTER),
        (0.0, 1e-12, Verdict.AS_GOOD),
        (None, None, Verdict.NO_BETTER),
    ],
)
def test_a_file_is_judged_beside_the_one_before(before, after, status):
    assert trust.judge_file(prediction(before), prediction(after))[0] is status


def fit_of(robot, log):
    datasets, options = filter_logs(robot, log)
    return fit_recordings(robot, datasets, options)


def test_held_out_torque_may_be_three_times_the_noise(robot, noisy):
    fit = fit_of(robot, noisy)
    noise = fit.noise_per_joint
    for times, relative, status in ((2.5, 0.1, OK), (3.5, 0.01, OK), (3.5, 0.1, None)):
        errors = {joint: times * each for joint, each in noise.items()}
        test = replace(prediction(relative), rmse_per_joint=errors)
        found, reasons = first(trust.find_misfits(fit, [test], 0.0, {}), OK)
        assert found is (status or Verdict.UNEXPLAINED)
        assert status or "of parts are predicted 3.5 times worse" in reasons[0]
    coarse, (reason,) = first(trust.find_misfits(fit, [], 0.49, {}), OK)
    assert coarse is Verdict.UNEXPLAINED and "49 %" in reason


def test_friction_that_one_stretch_alone_shows_is_no_misfit(robot, noisy):
    """What a joint that turns each way once leaves to be predicted is not told; chance is as large
    as what happens elsewhere.
    """
    (log,), options = filter_logs(robot, noisy, cutoff=3.8)
    speed = log.motion.qd[:, 2]
    count = len(log.motion.time)
    used = np.ones((count, 3), dtype=bool)
    at = np.arange(count)
    used[:, 2] = np.where(
        at < 0.2 * count, speed > 0.0, (at < 0.5 * count) & (speed < 0.0)
    )
    fit = fit_recordings(robot, [replace(log, used=used)], options)
    judge = held_out(fit)
    squared = judge.squared_errors(fit.unknowns)
    chance = judge.expected_squared_errors(fit)
    assert np.sum(squared[:, :2]) == pytest.approx(np.sum(chance[:, :2]), rel=0.3)
    assert (
        held_out_validation(fit).rmse_per_joint["joint2"]
        > 3.0 * fit.noise_per_joint["joint2"]
    )
    speed = log.motion.qd
    at = at[:, None]
    used = np.where(at < 0.2 * count, speed > 0.0, (at < 0.5 * count) & (speed < 0.0))
    fit = fit_recordings(robot, [replace(log, used=used)], options)
    own = held_out_validation(fit)
    assert own.relative_error > trust.HARMLESS
    assert first(trust.find_misfits(fit, [own], 0.0, {}), OK) == (OK, ())
    told = replace(own, is_informative=True)
    assert first(trust.find_misfits(fit, [told], 0.0, {}), OK)[0] is Verdict.UNEXPLAINED


@pytest.mark.parametrize("what", ["another joint's torque", "white noise"])
def test_a_joint_whose_torque_follows_from_nothing_is_named_one_with_noise_is_not(
    robot, noisy, what
):
    tau = noisy.tau.copy()
    tau[:, 2] = tau[::-1, 0]
    if what == "white noise":
        usual = np.sqrt(np.mean(noisy.tau[:, 2] ** 2))
        tau[:, 2] = (
            noisy.tau[:, 2]
            + 9.0
            * usual
            * np.repeat(np.random.default_rng(0).normal(size=len(tau)), 8)[: len(tau)]
        )
    fit = fit_of(robot, replace(noisy, tau=tau))
    counts = sample_counts(fit.information)
    share = dict(
        zip(robot.joint_names, np.array(fit_errors(fit).total.effective) / counts)
    )
    odd = first(trust.find_misfits(fit, [], 0.0, {}), OK)
    assert "of the torque of joint2 is unexplained" in odd[1][0]
    found = first(trust.find_misfits(fit, [], 0.0, share), OK)
    assert found == (odd if what != "white noise" else (OK, ())), share


def test_friction_and_rotors_that_no_joint_has_are_refused():
    torque = np.array([9.0, 40.0, 5.0, 20.0, 1.0, 4.0, 0.5])

    def judged(**terms):
        joints = {name: JointEstimate("some", {}) for name in SEVEN.joint_names}
        figures = {term: Quantity(value, 0.1) for term, value in terms.items()}
        joints[SEVEN.joint_names[-1]] = JointEstimate("some", figures)
        return first(trust.implausible_joints(SEVEN, joints, torque), OK)

    assert judged(coulomb=30.0, viscous=200.0, armature=0.5) == (OK, ())
    assert "141 N m of dry friction" in judged(coulomb=141.2)[1][0]
    assert judged(armature=1e3)[0] is Verdict.IMPLAUSIBLE


@pytest.mark.parametrize(
    ("distance", "error", "is_named"),
    [(0.1, 0.001, False), (0.15, 0.01, True), (0.15, 0.03, False)],
)
def test_a_link_is_named_whose_first_moment_is_clearly_off(distance, error, is_named):
    """Off by 50 %: beyond two errors of 0.01 kg m, within two of 0.03."""
    link = replace(
        body(com=(0.0, 0.0, distance), moved=error),
        prior=body(com=(0.0, 0.0, 0.1)).inertial,
    )
    named = list(trust.wrong_links([link]))
    assert bool(named) == is_named
    for wrong in named:
        assert wrong.first_moment_of_model == pytest.approx(0.1)
        assert wrong.first_moment == pytest.approx(0.15)
        assert wrong.error == pytest.approx(0.01)

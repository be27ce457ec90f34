"""The contest of explanations finds nothing in a correct log, nor what the prior allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.diagnosis.contest import Contest, findings
from robot_sysid.diagnosis.log_checks import check_against_model, low_pass
from robot_sysid.diagnosis.plausibility import is_plausible, last_mass, misfit
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimation.question import EstimationOptions, Priors
from robot_sysid.records import Measurement
from tests.diagnosis.conftest import FOUR_AXES
from tests.support import arms
from tests.support.wrong_logs import truth_of


def test_a_correct_log_fits_shows_the_link_and_has_no_explanation(truth, contest):
    assert misfit(contest.posterior) < 0.02
    assert is_plausible(contest.posterior)
    mass, error = last_mass(contest.posterior)
    assert abs(mass - truth.theta[0]) < 3.0 * error
    assert findings(contest, np.ones(5)) == []


def test_torque_that_nothing_explains_is_said(truth):
    noise = 5.0 * np.random.default_rng(0).normal(size=truth.log.tau.shape)
    signals = low_pass([replace(truth.log, tau=noise)], None)
    contest = Contest(truth.robot, signals, EstimationOptions())
    (finding,) = findings(contest, np.ones(5))
    assert finding.name == "model"
    assert "% of the torque is explained by nothing" in finding.text


def test_deviations_that_the_prior_allows_are_not_named(truth):
    """Torque scales that the user declares uncertain are unknowns of the base model."""
    log = replace(truth.log, tau=truth.log.tau * [1.0, 1.3, 0.8, 1.2, 1.0])
    signals = low_pass([log], None)
    declared = EstimationOptions(priors=Priors(scale=40.0))
    for options, is_named in ((EstimationOptions(), True), (declared, False)):
        contest = Contest(truth.robot, signals, options)
        assert bool(findings(contest, np.ones(5))) is is_named


@pytest.mark.parametrize("damping", ["5", "50"])
def test_friction_that_a_model_overstates_hides_and_feigns_no_fault(damping):
    """Public models state the damping that steadies a simulation, here far above the arm's."""
    joint = f'range="-2.5 2.5" armature=".02" damping="{damping}"'
    robot = arms.robot_of(arms.serial_arm(FOUR_AXES, joint=joint))
    log = truth_of(robot, seed=3).log
    assert check_against_model(robot, [log]) == ()
    exchanged = [0, 2, 1, 3]
    wrong = replace(log, q=log.q[:, exchanged], qd=log.qd[:, exchanged])
    (finding,) = check_against_model(robot, [wrong])
    assert finding.text.startswith("joints joint1 and joint2 are exchanged in the pos")


@pytest.mark.parametrize("stribeck_speed", [0.02, 0.1])
def test_friction_of_a_joint_that_dwells_once_is_no_contact(
    four_joints, stribeck_speed
):
    """The last joint's speed exceeds zero for a moment only."""
    robot = four_joints.robot
    time = np.arange(7500) / 250.0
    since_dwell = time - 15.3
    rate = np.array([1.1, 0.8, 1.5, 1.3])
    other_rate = np.array([1.7, 1.9, 0.9, 1.5])
    # Each speed is a sum of two sines; that of the last joint is nearly zero at the dwell.
    sizes = np.array([0.3, 0.4, 0.3, 0.3])
    shift = np.array([0.4, 1.0, 0.2, np.pi / 2.0])
    other_sizes = -1.01 * sizes
    qd = np.zeros((len(time), 4))
    q = np.zeros_like(qd)
    qdd = np.zeros_like(qd)
    for size, w in ((sizes, rate), (other_sizes, other_rate)):
        angle = w * since_dwell[:, None] + shift
        q -= size / w * np.cos(angle)
        qd += size * np.sin(angle)
        qdd += size * w * np.cos(angle)
    tau = LinkDynamics(robot).motion(q, qd, qdd).torque(robot.thetas)
    size = 0.3 * np.sqrt(np.mean(tau**2, axis=0))
    stribeck = np.exp(-((qd / np.array([0.1, 0.1, 0.1, stribeck_speed])) ** 2))
    tau += size * np.tanh(qd / 0.003) * (1.0 + 0.5 * stribeck)
    rng = np.random.default_rng(0)
    tau += 0.03 * size * rng.normal(size=tau.shape)
    q += 3e-5 * rng.normal(size=q.shape)
    assert check_against_model(robot, [Measurement(time, q, None, tau)]) == ()

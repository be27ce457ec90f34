"""What class a torque is of: measured in any unit, external, computed or commanded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.synthetic_data import autocorrelated
from rigs.arms.wrong_arms import MEMORY, link_torque
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.faults.gate import judge
from robot_sysid.faults.shares import common_share, shares_of
from robot_sysid.records.arm import KINDS
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Level, Progress
from tests.faults.conftest import fit_of, found_in, read_log

QUESTION = Question(EstimationOptions())


def shares(truth, tau):
    """Return the shares of torques (N, 4) in the motion of a truth."""
    return shares_of(fit_of(truth, tau=tau))


def external(truth, times):
    """Return torque (N, 4) without that of links, but for so many times the last link's."""
    thetas = np.zeros((4, 10))
    thetas[-1] = times * truth.theta
    return truth.log.tau - truth.rigid + link_torque(truth.robot, truth.motion, thetas)


def coloured(truth, tau, share):
    """Return torques (N, 4) with noise of a memory, a share of each joint's."""
    drawn = np.random.default_rng(3).standard_normal(tau.shape)
    size = share * np.sqrt(np.mean(tau**2, axis=0))
    return {"tau": tau + size * autocorrelated(drawn, MEMORY)}


def test_shares_are_in_proportion_to_the_torque(four_joints):
    """So that a measured torque in another unit is told from one without the links' weight."""
    right = shares(four_joints, four_joints.log.tau)
    own = right.is_weighed
    assert own[[1, 2]].all() and not own[[0, 3]].any()
    assert right.weight[own] == pytest.approx(1.0, abs=0.2)
    small = shares(four_joints, 0.01 * four_joints.log.tau)
    assert small.weight[own] == pytest.approx(0.01 * right.weight[own], rel=0.01)
    assert not right.has_no_weight and not small.has_no_weight


def test_placeholders_of_inertia_hide_no_weight(four_joints):
    """The bodies that stand for them count; 1 kg m^2 at each link would take up all torque."""
    robot = four_joints.robot
    more = np.repeat([0.0, 1.0, 0.0], (4, 3, 3))
    links = [
        replace(link, theta=link.theta + more, placeholders=KINDS[2:])
        for link in robot.links
    ]
    arm = replace(four_joints.arm, robot=replace(robot, links=tuple(links)))
    vague = replace(four_joints, arm=arm)
    right = shares(four_joints, four_joints.log.tau)
    found = shares(vague, four_joints.log.tau)
    assert found.weight == pytest.approx(right.weight, abs=0.01)
    share, _ = found.common_inertia
    assert share > 0.5 and not found.has_no_weight


@pytest.mark.parametrize("error, is_known", [(0.02, True), (9.0, False)])
def test_inertia_is_gone_only_where_it_is_known(four_joints, error, is_known):
    """What a last link takes up may be anything: a turned sign leaves -22 +- 9 of inertia."""
    right = shares(four_joints, four_joints.log.tau)
    assert not right.is_weight_alone
    own = np.diag(np.full(4, error**2))
    other = replace(right, inertia=np.full(4, -22.0), inertia_covariance=own)
    assert other.is_weight_alone == is_known


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("times", [1.0, 3.0])
def test_external_torque_has_no_weight_whatever_hangs_on_the_flange(four_joints, times):
    tau = external(four_joints, times)
    assert shares(four_joints, tau).has_no_weight
    robot = four_joints.robot
    logs = [
        read_log(robot, replace(four_joints.log, tau=external(four_joints, k)), f"{k}")
        for k in (times, times + 1.0)
    ]
    asked = (
        (QUESTION, logs[:1], ()),
        (replace(QUESTION, loaded=True), logs, (False, True)),
    )
    for question, read, sides in asked:
        found = judge(robot, read, question, Progress(), sides).findings
        assert [f.about for f in found if f.level is Level.REFUSES] == ["gravity"]
        assert "external torque" in found[0].text


@pytest.mark.parametrize(
    ("torque", "text"),
    [
        (lambda truth: truth.rigid, "an arm without friction looks the same"),
        (
            lambda truth: link_torque(truth.robot, truth.motion, truth.robot.thetas),
            "this model's links but the last, as they are, leave",
        ),
    ],
    ids=["commanded", "computed"],
)
def test_noise_with_a_memory_does_not_hide_that_there_is_no_friction(
    four_joints, torque, text
):
    found = found_in(four_joints, **coloured(four_joints, torque(four_joints), 0.01))
    assert [each.about for each in found] == [FaultName.COMPUTED]
    assert found[0].level is Level.DOUBTS and text in found[0].text


@pytest.mark.slow
@pytest.mark.parametrize("times", [1.0, 1.3])
def test_torque_of_the_model_and_its_friction_is_called_its_own(four_joints, times):
    """Links that are all heavier than the model's are an arm's, whatever its friction is."""
    robot = four_joints.robot
    links = link_torque(robot, four_joints.motion, robot.thetas)
    tau = ArmDynamics(robot)(four_joints.motion) + (times - 1.0) * links
    found = found_in(four_joints, **coloured(four_joints, tau, 0.003))
    named = [each for each in found if each.about is FaultName.COMPUTED]
    assert [each.level for each in named] == [Level.SAYS] * (times == 1.0)
    assert all("its friction as well" in each.text for each in named)


@pytest.mark.slow
def test_as_much_noise_makes_no_measured_torque_a_computed_one(four_joints):
    """A tenth of the usual friction is what sensors behind gears see."""
    little = 0.1 * four_joints.friction + four_joints.rigid
    found = found_in(four_joints, **coloured(four_joints, little, 0.01))
    assert FaultName.COMPUTED not in [each.about for each in found]


@pytest.mark.parametrize(("friction", "named"), [(0.0, 1), (0.1, 0)])
def test_noise_of_a_sensor_without_friction_is_no_doubt_and_has_a_word(
    four_joints, friction, named
):
    """Sensors behind the gears feel no friction; a file without it needs to say so."""
    tau = friction * four_joints.friction + four_joints.rigid
    noise = 0.02 * np.sqrt(np.mean(tau**2, axis=0))
    tau = tau + noise * np.random.default_rng(3).standard_normal(tau.shape)
    found = found_in(four_joints, tau=tau)
    assert [(each.about, each.level) for each in found] == named * [
        (FaultName.COMPUTED, Level.SAYS)
    ]


@pytest.mark.parametrize("times", [-0.3, -0.7])
def test_friction_that_drives_is_never_usable(four_joints, times):
    """Drives that add more than friction takes leave a log that any other cause explains."""
    tau = four_joints.rigid + times * four_joints.friction
    tau = tau + 0.01 * np.random.default_rng(5).standard_normal(tau.shape)
    found = found_in(four_joints, tau=tau)
    assert [each.level for each in found] == [Level.DOUBTS]
    assert "friction would drive joint" in found[0].text


def test_what_shares_have_in_common_is_that_without_what_a_last_link_changes():
    """A last link raises one joint's share, lowers another's, and so says what both are."""
    apart = np.array([1.0, -4.0])
    noise = 0.01**2 * np.eye(2)
    covariance = np.outer(apart, apart) + noise
    share, error = common_share(0.8 + 0.2 * apart, covariance)
    assert share == pytest.approx(0.8, abs=0.02) and error < 0.05
    shows = np.diag([0.01**2, np.inf])
    assert common_share(np.array([0.3, 9.0]), shows) == pytest.approx((0.3, 0.01))
    assert common_share(np.zeros(1), np.diag([np.inf])) == (0.0, np.inf)

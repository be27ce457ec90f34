"""Mistakes of logs of public arms, and right logs of theirs: what is said, and what is not."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.motions import one_at_a_time
from rigs.arms.wrong_arms import ARMS, draw_arm, link_torque, truth_of
from rigs.files.places import MODELS
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    gravity_vector,
    turn_gravity,
)
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.quantities import link_estimates
from robot_sysid.estimate.restricted_fit import errors_of, fit_file
from robot_sysid.faults.misfits import lost_links
from robot_sysid.model.bodies import write_body
from robot_sysid.parser import load_robot_model
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.messages import Level
from robot_sysid.records.usual_errors import GRAVITY_IN_FILE
from tests.faults.conftest import findings_of, found_in, judged
from tests.faults.test_gate import swings

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not MODELS.exists(), reason="needs the public models"),
]


@pytest.fixture(scope="module", params=["ur5e", "panda"])
def truth(request):
    """Return a right log of a public arm, whose links are off by 10 %."""
    return truth_of(load_robot_model(MODELS / ARMS[request.param]), 5, wrong_links=0.1)


def noisy(tau):
    """Return torques (N, n) with a little noise."""
    size = 0.005 * np.sqrt(np.mean(tau**2, axis=0))
    noise = np.random.default_rng(1).normal(0.0, size, tau.shape)
    return {"tau": tau + noise}


def turned(truth, joints):
    """Return the torques of a log, those of some joints turned."""
    is_turned = np.isin(range(truth.robot.n_joints), joints)
    return {"tau": np.where(is_turned, -1.0, 1.0) * truth.log.tau}


def with_zeros(truth):
    """Return the positions of a log with the zeros of two loaded joints off by 90 degrees."""
    loaded = np.argsort(-np.mean(truth.still**2, axis=0))[:2]
    is_off = np.isin(range(truth.robot.n_joints), loaded)
    return {"q": truth.log.q + 0.5 * np.pi * is_off}


WRONG = {
    "weight alone": (lambda truth: noisy(truth.still), {"computed"}),
    "all signs": (lambda truth: turned(truth, range(truth.robot.n_joints)), {"sign"}),
    "three signs": (lambda truth: turned(truth, [1, 2, 4]), {"sign"}),
    "both signs of a wrist": (
        lambda truth: {
            **turned(truth, [4]),
            "q": np.where(np.arange(truth.robot.n_joints) == 4, -1.0, 1.0)
            * truth.log.q,
            "qd": None,
        },
        {"sign"},
    ),
    "a base that reads half": (
        lambda truth: {
            "tau": np.where(np.arange(truth.robot.n_joints) == 0, 0.5, 1.0)
            * truth.log.tau
        },
        {"torque-scale"},
    ),
    "two zeros": (with_zeros, {"zero"}),
    "drive side": (
        lambda truth: noisy(truth.log.tau / 101.0),
        {"torque-unit", "torque-scale"},
    ),
    "drive side with a balancer": (
        lambda truth: noisy((truth.log.tau - 0.3 * truth.still) / 101.0),
        {"torque-unit"},
    ),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_mistake_of_many_joints_has_one_name(truth, fault):
    spoil, names = WRONG[fault]
    found = found_in(truth, **spoil(truth))
    named = {finding.about for finding in found if finding.level is not Level.SAYS}
    assert named and named <= names, found
    assert "time =" not in "".join(finding.sentence for finding in found)


def test_a_result_in_which_links_lose_their_mass_is_none(truth):
    """Such as of external torque, from which a controller's model was taken off."""
    thetas = np.zeros_like(truth.arm.thetas)
    thetas[-1] = truth.theta
    carried = link_torque(truth.robot, truth.motion, thetas)
    external = replace(truth.log, tau=truth.log.tau - truth.rigid + carried)
    (finding,) = lost_links(judged(truth.robot, external).fit)
    assert finding.level is Level.REFUSES and "lose most of their mass" in finding.text
    assert not [*lost_links(judged(truth.robot, truth.log).fit)]


def test_right_logs_are_accused_of_nothing(truth):
    rms = np.sqrt(np.mean(truth.log.tau**2, axis=0))
    dry = np.maximum(0.05 * rms, 0.002 * np.max(rms))
    friction = replace(truth.robot.friction, coulomb=dry)
    robot = replace(truth.robot, friction=friction)
    for log in (truth.log, swings(robot, 0), swings(robot, 1)):
        found = findings_of(truth.robot, log)
        assert all(finding.level is Level.SAYS for finding in found), found


def test_a_forearm_with_a_quarter_of_its_mass_is_named_and_its_error_widens(truth):
    robot = truth.robot
    forearm = robot.n_joints - 4
    model = copy.copy(robot.mj_model)
    light = 0.25 * robot.links[forearm].theta
    write_body(model, robot.links[forearm].body_id, light)
    name = robot.links[forearm].body_name
    answer = judged(load_robot_model(model), truth.log)
    (found,) = answer.findings
    assert found.level is Level.SAYS
    assert f"contradicts the model's mass of {name}" in found.text
    key = f"m({name})"
    error = answer.fit.error_of(key)
    assert abs(answer.fit.by_name[key] - truth.arm.thetas[forearm, 0]) < 3.0 * error


def test_a_forearm_ten_times_too_heavy_is_no_factor_alone_and_its_mass_is_found(truth):
    """Both explain the log; with the link's mass as not known, the answer is right."""
    robot = truth.robot
    forearm = robot.n_joints - 4
    link = robot.links[forearm]
    model = copy.copy(robot.mj_model)
    write_body(model, link.body_id, 10.0 * link.theta)
    answer = judged(load_robot_model(model), truth.log)
    (found,) = answer.findings
    assert found.about is FaultName.MODEL and found.level is not Level.REFUSES
    assert f"contradicts the model's mass of {link.body_name}" in found.text
    if found.options:
        assert "; or the torques are" in found.text
        assert [way[0] for way in found.options] == [
            "--accept",
            "--mass-scale",
            "--torque-scale",
        ]
    masses = [
        (answer.fit.by_name[key], answer.fit.error_of(key), truth.arm.thetas[k, 0])
        for k, key in (
            (k, f"m({robot.links[k].body_name})") for k in range(1, forearm + 1)
        )
    ]
    assert all(abs(mass - true) < 3.0 * error for mass, error, true in masses)


def mirrored(body):
    """Return a body (10,) whose centre of mass has the wrong signs."""
    mass, centre, inertia = spatial.com_from_theta(body)
    return spatial.theta_from_com(mass, -centre, inertia)


# What is changed in the model of an arm: number of each link to its wrong body.
MISTAKES = {
    "forearm": ("ur5e", lambda thetas: {2: mirrored(thetas[2])}),
    "both": ("ur5e", lambda thetas: {1: mirrored(thetas[1]), 2: mirrored(thetas[2])}),
    "exchanged": ("panda", lambda thetas: {2: thetas[3], 3: thetas[2]}),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_of_the_model_in_its_links_is_named_and_their_errors_hold_the_truth(
    case,
):
    arm, change = MISTAKES[case]
    robot = load_robot_model(MODELS / ARMS[arm])
    drawn = draw_arm(robot, "real", arm == "panda", 20.0, True, 0)
    wrong = change(robot.thetas)
    model = copy.copy(robot.mj_model)
    for number, body in wrong.items():
        write_body(model, robot.links[number].body_id, body)
    answer = judged(load_robot_model(model), drawn.log)
    named = {link for each in answer.fit.question.mistakes for link in each.links}
    assert named == set(wrong)
    assert all(found.level is Level.SAYS for found in answer.findings)
    texts = "; ".join(found.text for found in answer.findings)
    for number in wrong:
        assert robot.links[number].body_name in texts
        names = answer.fit.arm.links[number]
        errors = np.array([answer.fit.error_of(name) for name in names])
        values = np.array([answer.fit.by_name[name] for name in names])
        off = np.abs(values - drawn.arm.thetas[number]) / errors
        assert np.all(off < 3.0), off
    as_it_is = judged(robot, drawn.log)
    question = as_it_is.fit.question
    assert as_it_is.findings == () and question.odd_number is None
    assert question.mistakes == () and question.doubtful == ()


def test_links_that_are_off_as_usual_are_not(truth):
    answer = judged(truth.robot, truth.log)
    assert answer.findings == () and answer.fit.question.odd_number is None


@pytest.fixture(scope="module")
def as_real():
    """Return a right log of an arm whose links, scales and friction are as far off as real ones."""
    robot = load_robot_model(MODELS / ARMS["ur5e"])
    return draw_arm(robot, "real", False, 20.0, False, 1)


def test_a_zero_that_centres_of_mass_hide_is_said_with_them_and_their_errors_hold_it(
    as_real,
):
    """The forearm's centre is 20 mm off beside the shoulder's zero, ± 2 without this."""
    shoulder = np.arange(as_real.robot.n_joints) == 1
    log = replace(as_real.log, q=as_real.log.q + np.radians(3.0) * shoulder)
    answer = judged(as_real.robot, log)
    (found,) = answer.findings
    assert (found.about, found.level) == (FaultName.ZERO, Level.SAYS)
    assert "joint shoulder_lift reads" in found.text and "; or the" in found.text
    assert answer.fit.question.odd_zeros == ("zero[shoulder_lift]",)
    links = {
        each.name: each for each in link_estimates(answer.fit, fit_file(answer.fit))
    }
    forearm = links["forearm_link"]
    off = forearm.theta - as_real.arm.thetas[2]
    errors = np.sqrt(np.diag(forearm.covariance))
    assert np.all(np.abs(off[1:4]) < 3.0 * errors[1:4])
    assert judged(as_real.robot, as_real.log).fit.question.odd_zeros == ()


def test_torque_of_one_joint_that_is_late_is_named(as_real):
    """Its viscous friction takes up most of it."""
    time = as_real.log.time
    tau = as_real.log.tau.copy()
    tau[:, 1] = np.interp(time - 0.02, time, tau[:, 1])
    (found,) = findings_of(as_real.robot, replace(as_real.log, tau=tau))
    assert found.about is FaultName.DELAY
    assert "torque of joint shoulder_lift is" in found.text and "later" in found.text
    assert findings_of(as_real.robot, as_real.log) == ()


@pytest.mark.parametrize("seed", [7, 8])
def test_no_possible_arm_fits_a_joint_at_a_time_better_than_the_estimate(seed):
    """The true one is possible, and is likelier than one whose rotors are held at zero in vain."""
    robot = load_robot_model(MODELS / ARMS["ur5e"])
    truth = draw_arm(robot, "real", False, 30.0, False, seed, one_at_a_time)
    fitted = judged(robot, truth.log).fit
    values = truth.arm.values(fitted.names)
    is_of_body = np.isin(range(len(values)), fitted.equations.bodies)
    values, _ = solve(fitted.normal, values, ~is_of_body)
    assert not np.any(fitted.equations.crossing(values))
    costs = []
    for each in (fitted.values, values):
        change = np.append(each, -1.0)
        costs.append(change @ fitted.normal @ change)
    assert costs[0] < costs[1] + 3.0


@pytest.mark.parametrize("seed", [7, 8])
def test_a_file_of_a_joint_at_a_time_is_better_than_the_model(seed):
    """Rotors and the inertia of links behind them are known as a sum alone; a file has both."""
    robot = load_robot_model(MODELS / ARMS["gen3"])
    truth = draw_arm(robot, "real", False, 30.0, seed % 2 == 0, seed, one_at_a_time)
    file = fit_file(judged(robot, truth.log).fit)
    errors = errors_of(file).as_used
    assert errors.after.relative_error < 0.5 * errors.before.relative_error
    gravity = turn_gravity(file.point.gravity, [file.by_name[n] for n in TILT_NAMES])
    cosine = gravity @ gravity_vector(robot) / np.sum(gravity**2)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < INTERVAL * GRAVITY_IN_FILE


@pytest.mark.parametrize("seed", [5, 6])
def test_one_loaded_joint_that_moves_with_two_light_ones_shows_no_lost_weight(seed):
    """Joints 4, 5 and 7 move alone: the last link takes up the weight of the others."""
    robot = load_robot_model(MODELS / ARMS["fr3"])

    def three_alone(plan, _):
        moved = plan.scale_amplitudes(np.isin(range(7), [3, 4, 6]))
        return moved.evaluate(np.arange(round(250.0 * plan.duration)) / 250.0)

    truth = draw_arm(robot, "straight", True, 20.0, False, seed, three_alone, 0.1)
    found = findings_of(robot, replace(truth.log, name="log"))
    assert not [each.text for each in found if each.level is not Level.SAYS]

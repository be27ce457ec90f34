"""A right log draws no alarm; each kind of wrong log is found, called by its name, and stops."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from benchmarks.real_arms import ARMS, DEVIATIONS, draw_arm
from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.log_checks import (
    check_against_model,
    check_log,
    require_acceptable,
)
from robot_sysid.dynamics.newton_euler import (
    LinkDynamics,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.logs import CHECKS
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import motion_chunks
from tests.support import arms
from tests.support.closed_loop_proof import excitation
from tests.support.log_files import read_measurements
from tests.support.places import DATA, MODELS
from tests.support.wrong_logs import truth_of

AXES = (arms.Z, arms.Y, arms.Y, arms.X)
JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2"'
ROBOT = arms.robot_of(arms.serial_arm(AXES, joint=JOINT))


@pytest.fixture(scope="module")
def four():
    """A right log of an arm of four joints."""
    return truth_of(ROBOT, 4)


def pushed(truth):
    """Half a second of contact."""
    acts = (truth.log.time > 5.0) & (truth.log.time < 5.5)
    return truth.log.tau + np.outer(acts, 0.7 * np.max(np.abs(truth.rigid), axis=0))


def late(truth, joint):
    """60 ms in one joint."""
    tau = truth.log.tau.copy()
    tau[15:, joint] = tau[:-15, joint]
    return tau


def hum(truth, joint):
    """A tenth of one joint's torque."""
    size = 0.15 * np.sqrt(np.mean(truth.rigid[:, joint] ** 2))
    return np.outer(size * np.sin(3.8 * truth.log.time), np.arange(4) == joint)


def rested(truth, axes):
    """Torque (K, n) of the true links at rest, gravity turned by some radians about x and y."""
    down = turn_gravity(gravity_vector(ROBOT), np.array(axes))
    links = np.array([*(link.theta for link in ROBOT.links[:-1]), truth.theta])
    still = np.zeros_like(truth.log.q)
    arm = with_gravity(ROBOT, down)
    return LinkDynamics(arm).motion(truth.log.q, still, still).torque(links)


def pulled(truth, newtons):
    """Torque (K, n) of a force at the last link's origin."""
    point = np.zeros((4, 10))
    point[-1, 0] = 1.0
    still = np.zeros_like(truth.log.q)
    return (
        LinkDynamics(ROBOT, np.array(newtons))
        .motion(truth.log.q, still, still)
        .torque(point)
    )


def sprung(truth, joint):
    """A spring at one joint."""
    stiffness = 0.5 * np.std(truth.rigid[:, joint]) / np.std(truth.log.q[:, joint])
    return stiffness * (truth.log.q[:, [joint]] - 0.4) * (np.arange(4) == joint)


def carried(truth, share):
    """Torque (K, n) of a part of the last link, which comes on halfway."""
    body = np.zeros((4, 10))
    body[-1] = share * truth.theta
    log = truth.log
    speed, acceleration = (
        np.gradient(values, log.time, axis=0) for values in (log.q, log.qd)
    )
    torque = LinkDynamics(ROBOT).motion(log.q, speed, acceleration).torque(body)
    return torque * (log.time > 6.3)[:, None]


WRONG = {
    "tilt": lambda t: {"tau": t.log.tau + rested(t, (0.07, -0.05)) - t.still},
    "payload-step: the last link carries": lambda t: {
        "tau": t.log.tau + carried(t, 0.8)
    },
    "force: a constant force of": lambda t: {
        "tau": t.log.tau + pulled(t, (4.0, 3.0, 0.0))
    },
    "force: at joint joint1 a torque follows": lambda t: {
        "tau": t.log.tau + sprung(t, 1)
    },
    "gravity: of the links' weight is missing": lambda t: {
        "tau": t.log.tau - 0.6 * t.still
    },
    "torque-scale: changes its scale by": lambda t: {
        "tau": t.log.tau * (1.0 + 0.03 * t.log.time)[:, None]
    },
    "crosstalk: the torque of joint joint2 holds": lambda t: {
        "tau": t.log.tau + 0.3 * t.rigid[:, [1]] * [0.0, 0.0, 1.0, 0.0]
    },
    "torque-scale": lambda t: {"tau": t.log.tau / 101.0},
    "gravity": lambda t: {"tau": t.log.tau - t.still},
    "computed": lambda t: {"tau": t.rigid},
    "sign": lambda t: {"tau": t.log.tau * [1.0, -1.0, 1.0, 1.0]},
    "order": lambda t: {
        name: getattr(t.log, name)[:, ::-1] for name in ("q", "qd", "tau")
    },
    "angle-unit": lambda t: {"q": np.degrees(t.log.q), "qd": np.degrees(t.log.qd)},
    "zero": lambda t: {"q": t.log.q + [0.0, 0.2, 0.0, 0.0]},
    "contact": lambda t: {"tau": pushed(t)},
    "delay": lambda t: {"tau": np.roll(t.log.tau, 10, axis=0)},
    "delay: torque of joint joint2 alone": lambda t: {"tau": late(t, 2)},
    "contact: torque of joint joint1 hums: a sine of 0.6": lambda t: {
        "tau": t.log.tau + hum(t, 1)
    },
    "torque-scale: torque of joint joint3 alone reads": lambda t: {
        "tau": t.log.tau * [1, 1, 1, 1e3]
    },
    "clock: by inertia beside gravity, the clock drifts": lambda t: {
        "time": t.log.time * (1.0 + 0.008 * t.log.time),
        "qd": None,
    },
    "clock: by inertia beside gravity, time in": lambda t: {
        "time": 1.3 * t.log.time,
        "qd": None,
    },
    "clock: by the recorded velocities, time in": lambda t: {"time": 1.15 * t.log.time},
}
"""Name of a check and its message to a fault of a log that it has to name; for all faults, on
public arms, see benchmarks/confusion.py."""


@pytest.mark.parametrize(("name", "way"), WRONG.items())
def test_a_wrong_log_is_called_by_its_name(four, name, way):
    found = check_against_model(ROBOT, [replace(four.log, **way(four))])
    kind, _, said = name.partition(": ")
    assert any(each.name == kind and said in each.text for each in found), found


def read_again(log, text):
    """What the columns file that a text names makes of a log."""
    scale = re.search(r"time = ([0-9.]+) \* TITLE", text)
    if scale:
        return replace(log, time=float(scale[1]) * log.time)
    signs = np.where([f"torque.joint{j} = -TITLE" in text for j in range(4)], -1.0, 1.0)
    return replace(log, tau=log.tau * signs)


REMEDIES = {
    "clock": lambda log, text: (read_again(log, text), EstimationOptions()),
    "sign": lambda log, text: (read_again(log, text), EstimationOptions()),
    "tilt": lambda log, text: (log, EstimationOptions(tilt="auto")),
    "delay": lambda log, text: (log, EstimationOptions(delay="auto")),
    "angle-unit": lambda log, text: (
        replace(log, q=np.radians(log.q), qd=np.radians(log.qd)),
        EstimationOptions(),
    ),
    "torque-scale": lambda log, text: (
        replace(
            log, tau=log.tau / float(re.search("reads ([0-9.e-]+) times", text)[1])
        ),
        EstimationOptions(),
    ),
}
"""Name of a check to what its words advise: the log and the options then."""


@pytest.mark.parametrize("name", REMEDIES)
def test_what_is_advised_puts_the_log_right(four, name):
    spoils = {"clock": {"time": 1.3 * four.log.time, "qd": None}}
    wrong = replace(four.log, **(spoils.get(name) or WRONG[name](four)))
    text = next(
        each.text for each in check_against_model(ROBOT, [wrong]) if each.name == name
    )
    log, options = REMEDIES[name](wrong, text)
    assert check_against_model(ROBOT, [log], options) == ()


@pytest.mark.parametrize(("seed", "scales", "pull"), [(5, 0.12, 0.0), (1, 0.0, 0.5)])
def test_torque_scales_or_a_tilted_base_are_no_fault_of_the_clock(seed, scales, pull):
    """Whatever the estimate allows for must not pass for another mistake; pull in m/s^2."""
    right = truth_of(ROBOT, seed)
    links = np.array([*(link.theta for link in ROBOT.links[:-1]), right.theta])
    askew = LinkDynamics(ROBOT, np.array([pull, 0.6 * pull, 0.0]))
    still = np.zeros_like(right.log.q)
    more = askew.motion(right.log.q, still, still).torque(links)
    tau = (right.log.tau + more) * (1.0 + scales * np.array([1.0, -1.0, 1.0, -1.0]))
    found = check_against_model(ROBOT, [replace(right.log, tau=tau)])
    assert all(each.name in ("torque-scale", "tilt") for each in found), found


@pytest.mark.parametrize("given", [[2.0] * 5, [2.0, 3.0, 4.0, 5.0, 6.0]])
def test_the_scale_to_pass_is_multiplied_with_the_one_that_was_given(truth, given):
    wrong = [replace(truth.log, tau=1e3 * truth.log.tau)]
    texts = (
        check_against_model(truth.robot, wrong, divided=d)[0].text
        for d in (None, given)
    )
    plain, scales = (
        re.search(r"--torque-scale ([0-9.e+,]+)", text)[1] for text in texts
    )
    expected = float(plain) * np.unique(given)
    assert_allclose([*map(float, scales.split(","))], expected, rtol=0.01)


def test_a_log_that_is_too_short_for_anything_is_called_that(four):
    log = four.log
    brief = log.time - log.time[0] < 0.6
    part = Measurement(log.time[brief], log.q[brief], None, log.tau[brief])
    first = check_against_model(ROBOT, [part])[0]
    assert first.level is Level.REFUSE
    assert re.match(r"the log is 0\.(59|6)\d* s long, too short; record", first.text)


def test_what_is_only_noted_is_no_note_of_a_note(four, monkeypatch):
    """A console puts "note: " before what it is told."""
    notes = []
    told = Progress()
    found = Finding("delay", Level.NOTE, "it lags")
    monkeypatch.setattr(told, "note", notes.append)
    log = SimpleNamespace(
        path="log.csv", pieces=(four.log,), notes=(), torque_scale=None
    )
    monkeypatch.setattr(
        "robot_sysid.diagnosis.log_checks.check_against_model", lambda *_: (found,)
    )
    check_log(ROBOT, log, (), told)
    assert notes == ["it lags [delay]"] and found.line() == "note: it lags [delay]"


def test_a_log_that_cannot_be_looked_at_is_named(four):
    log = SimpleNamespace(
        path="log.csv", pieces=(four.log,), notes=(), torque_scale=None
    )
    with pytest.raises(
        InputError,
        match=r"^log\.csv: the log's 12 s are too short for a cut-off of 0.001 Hz",
    ):
        check_log(ROBOT, log, (), Progress(), EstimationOptions(cutoff=1e-3))


# ---- right logs


@pytest.mark.parametrize("axes", [arms.SEVEN_AXES[:5], AXES])
def test_right_logs_draw_no_alarm(axes):
    robot = arms.robot_of(arms.serial_arm(axes, joint='range="-2 2" armature=".02"'))
    found = check_against_model(robot, [truth_of(robot, 103).log])
    assert [each for each in found if each.level is not Level.NOTE] == []


@pytest.mark.parametrize("axes", [AXES, (arms.Y,), (arms.Z, arms.Y), (arms.Y, arms.X)])
def test_dry_friction_at_rest_is_no_contact_and_a_short_arm_no_odd_one(axes):
    """A light arm with much dry friction, which acts until the very end of its creep to rest."""
    robot = arms.robot_of(arms.serial_arm(axes, joint=JOINT))
    motion = next(motion_chunks(excitation(robot, 0, 12.0), 200.0))
    noise = np.random.default_rng(0).normal(0.0, 0.05, motion.q.shape)
    log = Measurement(
        motion.time, np.round(motion.q, 5), None, ArmTorque(robot)(motion) + noise
    )
    assert check_against_model(robot, [log]) == ()


@pytest.mark.slow
@pytest.mark.skipif(
    not MODELS.exists(), reason="the models of public arms are not here"
)
@pytest.mark.parametrize(
    ("arm_name", "kind", "duration", "seed"),
    [
        # Rounded positions make most of the noise, and that of accelerations is no delay.
        *(("xarm7", kind, 60.0, 50) for kind in DEVIATIONS),
        *(("ur5e", kind, 60.0, 50) for kind in DEVIATIONS),
        # Of a joint that links hardly load, all but friction and its rotor fits with either sign.
        ("ur5e", "exact", 6.0, 4),
        ("xarm7", "exact", 8.0, 3),
    ],
)
def test_right_logs_of_public_arms_draw_no_alarm(arm_name, kind, duration, seed):
    robot = load_robot_model(MODELS / ARMS[arm_name])
    log = draw_arm(robot, kind, False, duration, seed % 2 == 0, seed).log
    assert check_against_model(robot, [log]) == ()


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the logs of real arms are not here")
@pytest.mark.parametrize(
    ("model", "log"),
    [
        *(
            ("kuka_lwr4/kuka_lwr4.urdf", f"kuka_lwr4/lwr4_hw{run}_200Hz.csv")
            for run in (1, 2, 3)
        ),
        ("tx40/tx40.urdf", "tx40/tx40_500Hz.csv"),
    ],
)
def test_logs_of_real_arms_draw_no_alarm(model, log):
    robot = load_robot_model(DATA / model)
    pieces = read_measurements(DATA / log, robot.joint_names).pieces
    levels = {each.level for each in check_against_model(robot, pieces)}
    assert levels <= {Level.NOTE}


# ---- what stops an identification, and what does not


FINDINGS = st.lists(
    st.builds(
        Finding,
        st.sampled_from(sorted(CHECKS)),
        st.sampled_from(Level),
        st.just("words"),
    ),
    max_size=6,
)


@given(FINDINGS, st.sets(st.sampled_from(sorted(CHECKS))))
def test_refusals_and_warnings_that_nobody_accepts_stop(found, accepted):
    refused = any(f.level is Level.REFUSE for f in found)
    warned = any(f.level is Level.WARN and f.name not in accepted for f in found)
    if not refused and not warned:
        require_acceptable("log.csv", found, accepted)
        return
    with pytest.raises(SysidError) as caught:
        require_acceptable("log.csv", found, accepted)
    assert isinstance(caught.value, InputError) == refused
    assert str(caught.value).startswith("log.csv: words")
    if not refused:
        names = {f.name for f in found if f.level is Level.WARN} - accepted
        assert all(f"--accept {name}" in str(caught.value) for name in names)

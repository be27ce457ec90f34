"""Servos of whole arms: what joints share, what they keep, and that true numbers are found.

Friction of the rollouts that make the logs creeps as MuJoCo's does, in steps of half a millisecond.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import robot_sysid.records.usual_errors as usual_errors
from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from robot_sysid.errors import InputError
from robot_sysid.records import Recording
from robot_sysid.records.messages import Progress
from robot_sysid.records.servo_setting import UNKNOWN, parse_servo_setting
from robot_sysid.servo.derived import derived_numbers
from robot_sysid.servo.fit import (
    LEAST_TIME_ERROR,
    common,
    fit_servos,
    is_too_fast,
    likely_gains,
)
from robot_sysid.servo.setting import loaded, with_setting
from robot_sysid.servo.unknowns import IN_FILE, LEAST_ERRORS, NAMES, UNKNOWNS, column
from robot_sysid.simulation.playback import servos_in_model

ARM = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".1 0 .02" mass="{mass}" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".15 0 0"><joint name="roll" axis="1 0 0" range="-2 2" damping=".1"/>
<inertial pos=".05 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/></body></body></worldbody>
<actuator><position joint="lift" kp="{kp}"/><position joint="roll" kp="{kp}"/></actuator>
</mujoco>"""
"""A joint that carries a link, and one whose link weighs nothing."""
ONE = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".1 0 .02" mass="{mass}" diaginertia="{inertia}"/></body></worldbody>
<actuator><position joint="lift" kp="{kp}"/></actuator></mujoco>"""
LIGHT = {"mass": 0.3, "inertia": "2e-4 5e-4 5e-4"}
NUMBERS = [[14.0], [0.5], [0.06], [0.03]]
LIMIT = 2.0
DELAY = 0.035


def arm(kp=17.8, mass=0.3):
    return robot_of(ARM.format(mass=mass, kp=kp))


def one_joint(kp=17.8, **links):
    return robot_of(ONE.format(kp=kp, **{**LIGHT, **links}))


def truth(n_joints=1, delay=DELAY, limit=LIMIT):
    """True numbers of all joints."""
    return servo_logs.servos(np.repeat(NUMBERS, n_joints, axis=1), delay, limit)


def log(robot, servos, seconds=6.0, scale=1.5, setting=UNKNOWN, seed=0):
    """A log of an arm whose joints get a scale of their motion."""
    time, command = servo_logs.sines_and_steps(seconds, seed)
    command = scale * command[:, : robot.n_joints]
    own = with_setting(servos, setting, FIRST)
    q = servo_logs.positions(loaded(robot, setting), time, command, own, steps=40)
    piece = Recording(time, q, None, command - q, command=command)
    return replace(piece, setting=setting)


FIRST = parse_servo_setting("kp=400")
SOFT = parse_servo_setting("kp=200")


def fit(robot, *pieces):
    return fit_servos(robot, pieces, Progress())


def in_errors(found, true, joint=0):
    """What the numbers that the file holds are off by, in stated errors."""
    numbers = [true.numbers[0, joint], true.limits[joint], *true.numbers[1:, joint]]
    names = [name for name in IN_FILE if name != "limited_damping"]
    errors = []
    for name, number in zip(names, numbers):
        unknown = UNKNOWNS[name]
        over = found.likely_gain[joint] if name == "gain" else true.numbers[0, joint]
        k = column(name)
        x = np.log(number / over / unknown.mean) / unknown.deviation
        error = np.sqrt(found.covariance[joint, k, k])
        errors.append((found.x[joint, k] - x) / error)
    return np.array(errors)


def off_in_file(found, true):
    """What the file's numbers are off by, over the true ones (4, n)."""
    return found.in_file.numbers / true.numbers - 1.0


# --- what joints share ---------------------------------------------------------------------------

K = column("command_delay")
PER_SECOND = 1.0 / UNKNOWNS["command_delay"].deviation


def delays(*values, errors):
    """Unknowns of joints and their covariances that are those of their delays alone."""
    x = np.zeros((len(values), len(NAMES)))
    x[:, K] = PER_SECOND * np.array(values)
    covariance = np.zeros((len(values), len(NAMES), len(NAMES)))
    covariance[:, K, K] = (PER_SECOND * np.array(errors)) ** 2
    return x, covariance


def test_a_delay_is_that_of_the_joints_which_show_it():
    delay, error = common("command_delay", *delays(0.02, 0.05, errors=(1e-4, 1.0)))
    assert delay == pytest.approx(0.02, abs=1e-5)
    assert error == pytest.approx(LEAST_TIME_ERROR, rel=0.03)


def test_joints_that_agree_are_surer_together():
    found = delays(*[0.02] * 4, errors=[8e-3] * 4)
    delay, error = common("command_delay", *found)
    assert delay == pytest.approx(0.02, abs=1e-12)
    assert error == pytest.approx(np.hypot(8e-3, LEAST_TIME_ERROR) / 2.0, rel=1e-6)


def test_a_delay_on_which_joints_disagree_is_less_sure():
    """What is missed of a joint moves its own delay; one of several moves no other's."""
    two = delays(0.02, 0.04, errors=(1e-3, 1e-3))
    delay, error = common("command_delay", *two)
    assert 0.02 <= delay <= 0.04
    assert error > 3.0 * LEAST_TIME_ERROR
    four = delays(0.02, 0.021, 0.019, 0.06, errors=[1e-3] * 4)
    delay, error = common("command_delay", *four)
    assert delay == pytest.approx(0.02, abs=5e-4)
    assert error < 2.0 * LEAST_TIME_ERROR


def test_gains_before_the_data_are_the_models_or_those_of_usual_servos():
    assert likely_gains(arm(kp=7.0)).tolist() == [7.0, 7.0]
    xml = ARM.format(mass=0.3, kp=9.0)
    bare = robot_of(xml[: xml.index("<actuator>")] + "</mujoco>")
    gains = likely_gains(bare)
    inertia = bare.mj_model.dof_M0[bare.dof_index]
    assert_allclose(gains, np.median(inertia) * usual_errors.SERVO_BANDWIDTH**2)


# --- whole fits ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kp", [5.0, 100.0])
def test_numbers_come_from_the_log_and_not_from_the_models_servos(kp):
    """Also the limit, that the model lacks."""
    robot = one_joint(kp)
    found = fit(robot, log(robot, truth()))
    assert found.is_known.all()
    assert np.all(np.abs(in_errors(found, truth())) < 3.0)
    assert np.all(np.abs(off_in_file(found, truth())) < [[0.1], [0.15], [0.3], [0.2]])
    assert found.in_file.limits[0] == pytest.approx(LIMIT, rel=0.05)
    assert abs(found.delay - DELAY) < 3.0 * found.delay_error < 0.01
    share = found.in_file.servo_damping / found.in_file.numbers[1]
    assert np.all(share < 0.15)
    assert found.in_file.delay == found.delay


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "is_kept"), [(6.0, True), (0.7, False)])
def test_a_limit_of_the_model_that_no_motion_reaches_stays(limit, is_kept):
    """One that the motion exceeds does not."""
    model = ONE.format(kp=17.8, **LIGHT)
    robot = robot_of(
        model.replace('kp="17.8"', f'kp="17.8" forcerange="-{limit} {limit}"')
    )
    gentle = log(robot, truth(limit=np.inf), scale=0.7)
    found = fit(robot, gentle)
    assert (found.in_file.limits[0] == limit) == is_kept
    assert found.in_file.limits[0] >= limit


@pytest.mark.slow
def test_joints_that_stand_keep_the_models_numbers():
    """All that they show is how friction creeps."""
    robot = arm()
    found = fit(robot, log(robot, truth(2), scale=np.array([1.5, 0.005])))
    assert found.is_known.tolist() == [True, False]
    in_model = servos_in_model(robot)
    assert_array_equal(found.in_file.numbers[:, 1], in_model.numbers[:, 1])
    assert found.in_file.limits[1] == in_model.limits[1]
    assert found.in_file.servo_damping[1] == in_model.servo_damping[1]
    assert found.in_file.firmness[1] == in_model.firmness[1]
    # Nothing is known of it but what is usual.
    assert not np.any(found.x[1])
    own = found.covariance[1][: len(NAMES), : len(NAMES)]
    assert_allclose(own, np.eye(len(NAMES)) + np.diag(LEAST_ERRORS**2))
    assert np.all(np.abs(in_errors(found, truth(2))) < 3.0)


@pytest.mark.slow
def test_a_joint_that_moves_only_later_is_not_searched_there():
    """Of a fit of the whole log, which goes on from that of its beginning."""
    robot = arm()
    first = log(robot, truth(2), 4.0, scale=np.array([1.5, 0.005]))
    later = log(robot, truth(2), 4.0)
    found = fit(robot, first)
    whole = fit_servos(robot, [first, later], Progress(), found)
    assert whole.is_known.tolist() == found.is_known.tolist() == [True, False]
    assert_array_equal(whole.x[1], found.x[1])
    assert np.all(np.abs(in_errors(whole, truth(2))) < 3.0)


def test_logs_in_which_nothing_moves_are_refused():
    robot = arm()
    time = 0.02 * np.arange(50)
    still = np.full((50, 2), 0.3)
    piece = Recording(time, still, None, 0.0 * still, command=still)
    with pytest.raises(InputError, match="no joint moves by 0.02 rad .* longer"):
        fit(robot, piece)


@pytest.mark.slow
def test_all_joints_have_one_delay_and_the_gain_of_those_that_show_it():
    """The roll's link weighs nothing: its gain over the model's is that of the lift."""
    robot = arm()
    found = fit(robot, log(robot, truth(2)))
    k = column("command_delay")
    deviation = UNKNOWNS["command_delay"].deviation
    errors = found.delay_error / deviation
    assert np.all(np.abs(found.x[:, k] - found.delay / deviation) < 3.0 * errors)
    assert abs(found.delay - DELAY) < 3.0 * found.delay_error
    gains = found.over_gain[:, column("gain")]
    assert gains[1] == pytest.approx(14.0, rel=0.3)
    # In the file it moves as it should whatever its gain is.
    ratios = found.in_file.numbers[[1, 3], 1] / found.in_file.numbers[0, 1]
    assert_allclose(ratios, [0.5 / 14.0, 0.03 / 14.0], rtol=0.25)


@pytest.mark.slow
def test_two_gains_are_one_fit_of_the_first_ones():
    """Recordings of a gain of 400 and one of 200; friction and rotor do not follow the register."""
    robot = one_joint()
    pieces = [
        log(robot, truth(), setting=setting, seed=seed)
        for seed, setting in enumerate((FIRST, SOFT))
    ]
    found = fit(robot, *pieces)
    assert np.all(np.abs(in_errors(found, truth())) < 3.0)
    assert np.all(np.abs(off_in_file(found, truth())) < [[0.1], [0.15], [0.3], [0.2]])
    # The numbers are those of the first one, whichever that is.
    other = fit(robot, *pieces[::-1])
    ratio = other.over_gain[0, column("gain")] / found.over_gain[0, column("gain")]
    assert ratio == pytest.approx(0.5, rel=0.05)


@pytest.mark.slow
def test_a_load_that_is_the_whole_link_fixes_the_scale():
    """Of links that are not weighed, the gain is no surer than their mass."""
    robot = one_joint(mass=0.45)
    weighed = parse_servo_setting("link=0.3 at 0.10198")
    true_arm = one_joint()
    time_and_positions = log(true_arm, truth())
    errors = []
    for setting in (weighed, UNKNOWN):
        found = fit(robot, replace(time_and_positions, setting=setting))
        k = column("gain")
        deviation = UNKNOWNS["gain"].deviation
        errors.append(deviation * np.sqrt(found.covariance[0, k, k]))
        gain = found.over_gain[0, k]
        # The sag is known either way.
        sag = derived_numbers(robot, found)["sag"]
        assert sag.values[0] == pytest.approx(0.3 * 9.81 * 0.102 / 14.0, rel=0.1)
        assert sag.errors[0] < 0.1 * sag.values[0]
        if setting is weighed:
            assert gain == pytest.approx(14.0, rel=0.06)
        else:
            # Half as much mass again: half as much gain again.
            assert gain > 17.0
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.slow
def test_a_log_shows_no_unit_of_torque():
    """Of links with twice the mass all torques are twice as large, and the delay is the same."""
    robot = one_joint()
    piece = log(robot, truth(), seconds=4.0)
    heavy = one_joint(mass=0.6, inertia="4e-4 1e-3 1e-3", kp=35.6)
    light, twice = (fit(arm_model, piece) for arm_model in (robot, heavy))
    assert_allclose(twice.x, light.x, atol=1e-6)
    assert_allclose(twice.over_gain[:, 0], 2.0 * light.over_gain[:, 0], rtol=1e-6)
    assert_allclose(twice.in_file.numbers, 2.0 * light.in_file.numbers, rtol=1e-6)
    assert_allclose(twice.covariance, light.covariance, atol=1e-6)
    assert twice.delay == pytest.approx(light.delay, rel=1e-6)


@pytest.mark.slow
def test_a_fit_that_begins_at_an_earlier_one_ends_where_that_one_does():
    """Judged without a part of the logs, the numbers that are used follow from all of them."""
    robot = one_joint()
    piece = log(robot, truth())
    part = fit(robot, piece[:240])
    whole = fit_servos(robot, [piece], Progress(), part)
    assert np.all(np.abs(in_errors(whole, truth())) < 3.0)
    errors = np.sqrt(np.diagonal(part.covariance, axis1=1, axis2=2))[:, : len(NAMES)]
    assert np.all(np.abs(whole.x - part.x) < 3.0 * errors + 1e-9)


@pytest.mark.parametrize(("gain", "is_fast"), [(10.0, False), (1000.0, True)])
def test_a_servo_that_turns_far_between_samples_is_fast(gain, is_fast):
    """At 50 Hz, of an inertia of 0.03 kg m^2: 0.37 and 3.7 rad between samples."""
    robot = one_joint(gain)
    time = np.arange(10) * 0.02
    pieces = [Recording(time, np.zeros((10, 1)), None, np.zeros((10, 1)))]
    x = np.zeros((1, len(NAMES)))
    unknown = UNKNOWNS["armature"]
    x[0, column("armature")] = np.log(0.03 / gain / unknown.mean) / unknown.deviation
    found = is_too_fast(robot, x, likely_gains(robot), pieces)
    assert found.tolist() == [is_fast]

"""A weight on the last link: what it should tell of the servos' sizes, and what it tells."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.servo_fits import identification_of, servo_fit, with_links
from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from robot_sysid.config import IdentifyConfig
from robot_sysid.logs.reader import open_logs
from robot_sysid.pipeline.servo_step import step_after_servos
from robot_sysid.records.messages import Progress
from robot_sysid.records.servo_setting import ServoSetting, parse_servo_setting
from robot_sysid.servo.derived import absolute_numbers
from robot_sysid.servo.fit import fit_servos
from robot_sysid.servo.unknowns import DEVIATIONS, UNKNOWNS, column
from robot_sysid.servo.weighing import HAND_ERROR, WEIGHTS, best_weighing

GAIN = column("gain")
MISFIT = UNKNOWNS["gain"].misfit


@pytest.fixture(scope="module")
def robot():
    return robot_of(servo_logs.LIGHT)


def unsure_fit(robot, by_links=0.4, given_links=0.01, **numbers):
    """A fit whose gains are off by a share because of the links, and by another one by noise.

    What servos do otherwise is in it, as in all fits.
    """
    fit = servo_fit(robot, **{"gain": 14.0, "torque_limit": 3.0, **numbers})
    inner = fit.given_links.copy()
    inner[:, GAIN, GAIN] = (np.hypot(given_links, MISFIT) / DEVIATIONS[GAIN]) ** 2
    outer = inner.copy()
    outer[:, GAIN, GAIN] += (by_links / DEVIATIONS[GAIN]) ** 2
    return replace(fit, given_links=inner, covariance=with_links(outer))


def test_the_heaviest_weight_that_servos_carry_is_chosen(robot):
    weighing = best_weighing(robot, unsure_fit(robot))
    assert weighing is not None and weighing.joints == ("joint0", "joint1")
    assert weighing.mass == 0.5 and weighing.position == (0.0, 0.0, 0.08)
    assert weighing.now == pytest.approx(np.linalg.norm([0.4, 0.01, MISFIT]))
    least = np.hypot(HAND_ERROR, MISFIT)
    assert weighing.after == pytest.approx(least, rel=0.05)
    # Half as strong, half as much: 1 and 2 and 5 times a power of ten.
    weaker = best_weighing(robot, unsure_fit(robot, torque_limit=1.5))
    assert weaker is not None and weaker.mass == 0.2
    # 2 N m of 3 hold 0.7 kg at 0.28 m.
    assert 0.28 * 9.81 * weighing.mass < 0.7 * 3.0 < 0.28 * 9.81 * 1.0


def test_the_lighter_the_weight_the_less_it_tells(robot):
    """The error of a log, if the links are right, counts as often as links pull more than it."""
    errors = []
    for strength in (0.2, 0.5, 3.0):
        fit = unsure_fit(robot, given_links=0.05, torque_limit=strength)
        weighing = best_weighing(robot, fit)
        assert weighing is not None
        errors.append(weighing.after)
    assert errors[0] > errors[1] > errors[2] > np.hypot(HAND_ERROR, MISFIT)
    hardly = unsure_fit(robot, torque_limit=0.07)
    assert best_weighing(robot, hardly) is None


def test_sizes_that_are_known_need_no_weight(robot):
    assert best_weighing(robot, unsure_fit(robot, by_links=0.1)) is None


def test_a_joint_that_no_weight_turns_is_not_named(robot):
    turned = servo_logs.LIGHT.replace('"0 1 0"', '"0 0 1"', 1)
    arm = robot_of(turned)
    weighing = best_weighing(arm, unsure_fit(arm))
    assert weighing is not None and weighing.joints == ("joint1",)


def test_what_a_log_does_not_show_at_all_is_not_promised(robot):
    """Nothing is known of the size of a torque that the log's noise hides."""
    assert best_weighing(robot, unsure_fit(robot, given_links=1.5)) is None


def step(robot, folder, settings=(), of_log=None):
    config = IdentifyConfig.of(
        robot.path,
        measurements=("a.csv", "b.csv"),
        output_dir=folder,
        torque_from="position-error",
        servo_setting=settings,
        units="deg",
    )
    setting = of_log or ServoSetting()
    result = identification_of(robot, unsure_fit(robot), setting=setting)
    return step_after_servos(config, result)


def test_the_command_says_what_each_log_was_recorded_with(robot, tmp_path):
    words = step(robot, tmp_path, ("kp=16",)).command
    stated = [b for a, b in zip(words, words[1:]) if a == "--servo-setting"]
    assert stated == ["kp=16, load=0", "kp=16, load=0", "kp=16, load=0.5 at 0 0 0.08"]
    assert parse_servo_setting(stated[-1]).load_position == (0.0, 0.0, 0.08)
    assert [str(tmp_path / "weight.csv"), "--units"] == [
        words[words.index("b.csv") + 1],
        words[words.index("deg") - 1],
    ]
    words = step(robot, tmp_path, ("kp=16", "kp=32")).command
    stated = [b for a, b in zip(words, words[1:]) if a == "--servo-setting"]
    assert stated[:2] == ["kp=16, load=0", "kp=32, load=0"]


def test_a_weight_that_is_there_is_not_asked_for_again(robot, tmp_path):
    weighed = "load=0.2 at 0 0 0.1"
    assert step(robot, tmp_path, (weighed,)) is None
    of_log = parse_servo_setting("link=0.49 at 0.1")
    assert step(robot, tmp_path, (), of_log) is None
    assert step(robot, tmp_path) is not None


@pytest.mark.slow
def test_the_weight_tells_what_is_expected_of_it(robot, tmp_path):
    """Of links that are half as heavy again as in the model."""
    heavier = servo_logs.LIGHT.replace('mass=".01"', 'mass=".015"')
    arm = servo_logs.WeighedServos(robot_of(heavier))
    truth = servo_logs.LIGHT_TRUTH.numbers[0]
    paths = [tmp_path / name for name in ("log.csv", "weight.csv")]
    arm.record(paths[0], None, 0.0)

    def gains(count, settings):
        """The fit of some logs, and its gains with their errors."""
        config = IdentifyConfig.of(
            robot.path, measurements=tuple(paths[:count]), torque_from="position-error"
        )
        options = replace(config.log, commanded=True)
        logs = open_logs(robot, tuple(paths[:count]), options, Progress(), "")
        logs = [replace(log, setting=each) for log, each in zip(logs, settings)]
        fit = fit_servos(robot, logs, Progress())
        return fit, absolute_numbers(fit)["gain"]

    empty = ServoSetting(load_mass=0.0)
    fit, alone = gains(1, [empty])
    weighing = best_weighing(robot, fit)
    assert weighing is not None
    arm.record(paths[1], None, weighing.mass)
    load = replace(empty, load_mass=weighing.mass, load_position=weighing.position)
    _, weighed = gains(2, [empty, load])
    named = np.isin(robot.joint_names, weighing.joints)
    assert np.max(alone.errors[named] / alone.values[named]) == pytest.approx(
        weighing.now
    )
    assert np.all((weighed.errors / weighed.values)[named] < 1.5 * weighing.after)
    assert np.all(np.abs(weighed.values / truth - 1.0)[named] < 2.0 * weighing.after)
    assert weighing.after < 0.5 * weighing.now
    assert weighing.mass in WEIGHTS

"""The command motors map --zeros-at-stops: zeros from the stops to which a person pushes an arm."""

from __future__ import annotations

import shlex

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.wrong_arms import resting_torque
from rigs.motors.damiao_rig import fault, map_line, only_asks, trajectory_file
from rigs.motors.person import wait_for_looks
from robot_sysid.damiao.joints import BY_HAND, read_joint_map, write_joint_map
from robot_sysid.damiao.protocol import ENABLED

LOWER = -1.2
UPPER = 2.0
MODEL = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y), joint=f'range="{LOWER} {UPPER}"'
)
STOPS = LOWER, UPPER


@pytest.fixture
def turn(bus):
    """Factory: a person turns motor ``j`` by an angle, in the positive direction of its joint."""

    def turning(j, angle):
        def turn_and_say():
            bus.arm.mechanism.q[j] += angle
            return "yes"

        return turn_and_say

    return turning


@pytest.fixture
def push(bus):
    """Factory: a person pushes joint angles to motor ``j``, holds each, and types an answer.

    The motor is mounted with a direction and an offset.
    """

    def pushing(j, *angles, direction=1, offset=0.0, answer=""):
        def hold():
            for angle in angles:
                bus.arm.mechanism.q[j] = direction * angle + offset
                wait_for_looks(bus)
            return answer

        return hold

    return pushing


@pytest.fixture
def files(tmp_path, arm_file):
    """The words of the command, and the map that it writes."""
    output = tmp_path / "new_map.csv"
    model = arm_file(MODEL)
    words = "map --channel can0 --zeros-at-stops --model", model, "--output", output
    return words, output


@pytest.fixture
def earlier(tmp_path):
    """A map of the two joints and of a gripper, with zeros that are off by 0.1 rad."""
    path = tmp_path / "earlier map.csv"
    rows = [
        map_line("gripper", 7, 0x17, 1, 0.3),
        map_line("joint1", 1, 0x11, 1, 0.4, BY_HAND),
        map_line("joint0", 2, 0x12, -1, 0.6),
    ]
    write_joint_map(path, rows)
    return path


# How the motors of the joints are mounted.
FIRST = {"direction": -1, "offset": 0.7}
SECOND = {"direction": 1, "offset": 0.3}


def test_a_whole_map_is_made_with_zeros_from_the_stops(
    motors, bus, person, push, turn, files
):
    """The first joint has motor 2, mirrored; the second one motor 1."""
    waiting, prompts = person
    words, output = files
    waiting += [turn(1, -0.5), turn(0, 0.5)]
    waiting += [push(1, *STOPS, **FIRST), push(0, UPPER, LOWER, **SECOND), "yes"]
    out = motors.succeed(*words)
    first, second = read_joint_map(output)
    assert (first.name, first.can_id, first.direction) == ("joint0", 2, -1)
    assert (second.name, second.can_id, second.direction) == ("joint1", 1, 1)
    assert first.verified == second.verified == BY_HAND
    # A step of a motor's position is 4e-4 rad.
    assert first.offset == pytest.approx(0.7, abs=5e-4)
    assert second.offset == pytest.approx(0.3, abs=5e-4)
    assert "model's own pose" not in "".join(prompts)
    assert "3.200 rad apart; the model's range is 3.200 rad" in out
    assert "-1.200 to 2.000" in out and "0.7000 ± 0.000" in out
    assert only_asks(bus.wire.sent)


def test_a_map_that_exists_gets_new_zeros_and_nothing_else(
    motors, bus, person, push, files, earlier
):
    waiting, prompts = person
    words, output = files
    waiting += [push(1, *STOPS, **FIRST), push(0, *STOPS, **SECOND), "yes"]
    out = motors.succeed(*words, "--joint-map", earlier)
    rows = read_joint_map(output)
    before = read_joint_map(earlier)
    for row, old in zip(rows, before):
        kept = row.name, row.can_id, row.master_id, row.direction, row.verified
        assert kept == (
            old.name,
            old.can_id,
            old.master_id,
            old.direction,
            old.verified,
        )
    offsets = [row.offset for row in rows]
    assert offsets == pytest.approx([0.3, 0.3, 0.7], abs=5e-4)
    assert "0.6000 -> 0.7000 ± 0.000" in out and "0.4000 -> 0.3000" in out
    assert len(prompts) == 3 and only_asks(bus.wire.sent)


def test_a_stop_that_was_not_reached_is_said_and_pushed_to_once_more(
    motors, bus, person, push, files, earlier
):
    waiting, _ = person
    words, output = files
    waiting += [push(1, LOWER, 1.0, **FIRST), push(1, UPPER, **FIRST)]
    waiting += [push(0, *STOPS, **SECOND), "yes"]
    out = motors.succeed(*words, "--joint-map", earlier)
    assert "2.200 rad apart; the model's range is 3.200 rad: a stop was not" in out
    assert read_joint_map(output)[2].offset == pytest.approx(0.7, abs=5e-4)


def test_a_zero_that_the_stops_contradict_may_only_be_kept(
    motors, bus, person, push, files, earlier
):
    """Of an encoder that reads 10 % too much."""
    waiting, _ = person
    words, output = files
    too_far = 1.1 * LOWER, 1.1 * UPPER
    waiting += [push(1, *too_far, **FIRST), "keep", push(0, *STOPS, **SECOND), "yes"]
    out = motors.succeed(*words, "--joint-map", earlier)
    assert "the range in the model is narrower than the mechanical one" in out
    assert "0.6000 -> as before" in out and "+0.320" in out
    assert [row.offset for row in read_joint_map(output)] == [0.3, 0.3, 0.6]


def too_short(bus, push):
    return [push(1, LOWER, 1.0, **FIRST)] * 3


def let_go(bus, push):
    """At both stops, and back before the program has looked often enough."""
    held = push(1, 0.5, **FIRST)

    def drop():
        for angle in STOPS:
            bus.arm.mechanism.q[1] = 0.7 - angle
        return held()

    return [drop] * 3


def scaled(bus, push):
    return [push(1, 1.1 * LOWER, 1.1 * UPPER, **FIRST)] * 3


def another_joint(bus, push):
    return [push(0, *STOPS, **SECOND)] * 3


def another_word(bus, push):
    return [push(1, *STOPS, **FIRST, answer="yes")]


def unconfirmed(bus, push):
    return [push(1, *STOPS, **FIRST), push(0, *STOPS, **SECOND), "y"]


def silenced(bus, push):
    held = push(1, *STOPS, **FIRST)

    def lose_answer():
        fault(1, silent=True)(bus)
        return held()

    return [lose_answer]


def enabled(bus, push):
    held = push(1, *STOPS, **FIRST)

    def enable():
        bus.motors[0].status = ENABLED
        bus.motors[0].registers.update({9: 0.0})
        return held()

    return [enable]


def interrupted(bus, push):
    def press():
        raise KeyboardInterrupt

    return [press]


REFUSED = {
    too_short: (3, "joint0) and its range in the model do not agree within 0.05 rad"),
    let_go: (3, "joint0) and its range in the model do not agree within 0.05 rad"),
    scaled: (3, "joint0) and its range in the model do not agree within 0.05 rad"),
    another_joint: (3, "joint0) and its range in the model do not agree"),
    another_word: (2, "'yes' is not what was asked for"),
    unconfirmed: (2, "not confirmed"),
    silenced: (3, "motor 2 does not answer any more"),
    enabled: (3, "another program has enabled motor 1"),
    interrupted: (130, "interrupted; no motor is enabled"),
}


@pytest.mark.parametrize("what", REFUSED, ids=lambda what: what.__name__)
def test_nothing_is_written_where_something_goes_wrong(
    motors, bus, person, push, files, earlier, what
):
    code, message = REFUSED[what]
    words, output = files
    person[0].extend(what(bus, push))
    actual_code, out, err = motors.run(*words, "--joint-map", earlier)
    assert actual_code == code and message in err
    assert code == 130 or "nothing was written" in err
    assert not output.exists() and only_asks(bus.wire.sent)
    if what is another_joint:
        assert "motor 1 has moved by 3.2" in out and "another joint was pushed" in out


def test_a_new_map_is_not_written_with_a_zero_that_the_stops_contradict(
    motors, bus, person, push, turn, files
):
    """There is no earlier zero to keep."""
    waiting, prompts = person
    words, output = files
    waiting += [turn(1, -0.5), turn(0, 0.5)]
    waiting += [push(1, LOWER, 1.0, **FIRST, answer="keep")]
    err = motors.fail(2, *words)
    assert "'keep' is not what was asked for; nothing was written" in err
    assert "keep" not in "".join(prompts) and not output.exists()


@pytest.mark.parametrize("answer", ["", "keep"])
def test_a_joint_without_a_range_gets_its_zero_by_the_pose(
    motors, bus, person, push, files, earlier, arm_file, answer
):
    waiting, prompts = person
    words, output = files
    endless = MODEL.replace(f'range="{LOWER} {UPPER}"', "", 1)
    model = arm_file(endless, "endless.xml")
    waiting += [push(0, *STOPS, **SECOND), push(1, 0.0, **FIRST, answer=answer), "yes"]
    out = motors.succeed(*words, "--model", model, "--joint-map", earlier)
    assert "without a range in the model" in out and "joint0" in prompts[1]
    expected = 0.6 if answer else 0.7
    assert read_joint_map(output)[2].offset == pytest.approx(expected, abs=5e-4)
    assert ("0.6000 -> as before" if answer else "by the pose") in out


def test_a_map_of_other_motors_is_refused_before_anybody_pushes(
    motors, bus, person, files, earlier
):
    words, _ = files
    bus.motors[0].registers[8] = 9.0
    earlier_words = "--joint-map", earlier
    assert "motor 1 (joint joint1) does not" in motors.fail(3, *words, *earlier_words)
    without_stops = [w for w in words if w != "--zeros-at-stops"]
    text = without_stops[0].replace(" --zeros-at-stops", "")
    err = motors.fail(2, text, *without_stops[1:], *earlier_words)
    assert "add --zeros-at-stops" in err and person[1] == []


def test_the_command_that_is_printed_runs(
    motors, bus, person, push, files, earlier, monkeypatch, tmp_path
):
    """It checks the motors for a motion that is planned already, with the new map."""
    monkeypatch.chdir(tmp_path)
    robot = small_arms.robot_of(MODEL)
    still = np.zeros((2, 2))
    torque = still + resting_torque(robot, still[:1], robot.thetas)
    trajectory_file(tmp_path, (np.array([0.0, 1.0]), still, still, torque))
    earlier.write_text(earlier.read_text().replace("0.6000,", "0.6000,hand"))
    waiting, _ = person
    words, output = files
    waiting += [push(1, *STOPS, 0.0, **FIRST), push(0, *STOPS, 0.0, **SECOND), "yes"]
    out = motors.succeed(*words, "--joint-map", earlier)
    line = out.splitlines()[-1]
    assert "motors check damiao_trajectory.csv" in line and str(output) in line
    code, out, err = motors.run(*shlex.split(line)[2:])
    assert code == 0 and "ready to play" in out, err

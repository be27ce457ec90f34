"""The commands that play nothing: setup, monitor, map."""

from __future__ import annotations

import re
import shlex

import pytest

from rigs.arms import small_arms
from rigs.motors.damiao_rig import only_asks
from robot_sysid.damiao.joints import read_joint_map
from robot_sysid.damiao.protocol import (
    DISABLED,
    ENABLE,
    ENABLED,
    REGISTER_ID,
    STORE,
    Register,
    is_special,
)

SETUP = "setup --channel can0"
MAP = "map --channel can0 --model"


def drives_nothing(frames):
    return not any(
        f.id != REGISTER_ID and (not is_special(f.data) or f.data[7] == ENABLE)
        for f in frames
    )


def test_setup_alone_lists_the_motors_and_changes_nothing(motors, bus):
    out = motors.succeed(SETUP)
    assert "DM4340" in out
    assert only_asks(bus.wire.sent)


def test_a_bus_without_motors_is_said(motors, bus):
    for motor in bus.motors:
        motor.registers[Register.ESC_ID] = 20.0
    for command in (SETUP, f"{SETUP} --motor 1 --mit", "monitor --channel can0"):
        error = motors.fail(1, command)
        assert "no motor answers: check power" in error
        assert "ip -details link show can0 says whether the bus lives" in error


def test_setup_changes_what_it_is_told_and_says_what_was_there(motors, bus):
    motor = bus.motors[0]
    motor.registers[Register.CTRL_MODE] = 2.0
    options = "--motor 1 --new-id 5 --new-master-id 0x15 --mit --watchdog 0.2 --store"
    out = motors.succeed(SETUP, options)
    assert (
        "motor 1: CTRL_MODE=2 is now CTRL_MODE=1" in out
        and "ESC_ID=1 is now ESC_ID=5" in out
    )
    assert "MST_ID=17 is now MST_ID=21" in out and "keeps its values" in out
    changed = Register.ESC_ID, Register.MST_ID, Register.CTRL_MODE, Register.TIMEOUT
    values = [motor.registers[number] for number in changed]
    assert values == [5.0, 21.0, 1.0, 4000.0] and motor.stored == motor.registers
    assert bus.motors[1].stored == {} and drives_nothing(bus.wire.sent)


def test_nothing_is_stored_unless_asked_for(motors, bus):
    out = motors.succeed(SETUP, "--motor 1 --watchdog 0.2 --new-id 3")
    motor = bus.motors[0]
    assert motor.registers[Register.TIMEOUT] == 4000.0 and motor.stored == {}
    assert not any(f.id == REGISTER_ID and f.data[2] == STORE for f in bus.wire.sent)
    assert "Done: motor 1 is changed, and forgets it when its power goes off\n" in out
    # The command that is printed stores them, under the new id.
    program, *words = shlex.split(re.search("  (robot-sysid motors setup .*)", out)[1])
    out = motors.succeed(*words[1:])
    assert motor.stored == motor.registers and motor.stored[Register.ESC_ID] == 3.0
    assert "forgets it" not in out and "Done: motor 3 is changed\n" in out


@pytest.mark.parametrize("change", ["--mit", "--clear-error", "--store", "--new-id 3"])
def test_an_enabled_motor_is_never_changed(motors, bus, change):
    bus.motors[0].status = ENABLED
    bus.motors[0].registers[Register.TIMEOUT] = 0.0
    registers = dict(bus.motors[0].registers)
    err = motors.fail(3, SETUP, "--motor 1", change)
    assert "motor 1 is enabled" in err
    assert bus.motors[0].registers == registers and only_asks(bus.wire.sent)


def test_an_error_is_cleared_by_name(motors, bus):
    bus.motors[1].status = 0xA
    out = motors.succeed(SETUP, "--motor 2 --clear-error")
    assert "status A: over-current is now status 0" in out and "forgets" not in out
    assert bus.motors[1].status == DISABLED


REFUSED = {
    "--mit": "--motor says which motor",
    "--motor 1 --new-id 2": "CAN id 0x02 is used by more than one motor",
    "--motor 1 --new-master-id 0x02": "taken as commands by the motor with CAN",
    "--motor 1 --new-master-id 0x102": "taken as commands by the motor with CAN",
    "--motor 1 --new-master-id 0x12": "master id 0x12 is used by more than one",
    "--motor 1 --new-id 3 --new-master-id 2": "commands by the motor with",
    "--motor 1 --new-id 16": "CAN id 16 is outside 1 to 15",
}


def test_what_cannot_be_meant_is_refused(motors, bus):
    for options, message in REFUSED.items():
        assert message in motors.fail(2, SETUP, options), options
        assert only_asks(bus.wire.sent)
    assert "no motor answers to CAN id 9" in motors.fail(3, SETUP, "--motor 9 --mit")


@pytest.mark.parametrize("option", ["--new-master-id 0x13", "--new-id 3"])
def test_ids_of_motors_that_already_clash_can_be_put_right_one_by_one(
    motors, bus, option
):
    """As they come from the factory: all answer on 0, and one's answers are another's commands."""
    for motor in bus.motors:
        motor.registers[Register.MST_ID] = 0.0
    bus.motors[1].registers[Register.MST_ID] = 0x101
    motors.succeed(SETUP, "--motor 1", option)


def test_monitor_shows_the_motors_and_enables_nothing(motors, bus):
    bus.arm.mechanism.q[:] = [0.25, -0.5]
    out = motors.succeed("monitor --channel can0 --for 1 --every 0.3")
    assert out.count("0x11") == 4 and " 0.250 " in out and "-0.500" in out
    assert only_asks(bus.wire.sent)


@pytest.fixture
def turned(bus):
    """Factory: what a person does who turns motor ``j``, and then says which way it went."""

    def turning(j, angle, answer="yes"):
        def turn():
            bus.arm.mechanism.q[j] += angle
            return answer

        return turn

    return turning


@pytest.mark.parametrize("answer", ["yes", "opposite"])
def test_a_map_is_made_by_hand(motors, bus, person, turned, tmp_path, model, answer):
    """The first joint has motor 2, mirrored; the second one motor 1. Each joint is turned in its
    positive direction, or, at an end of its range, the opposite way.
    """
    waiting, prompts = person
    output = tmp_path / "map.csv"
    side = {"yes": 1, "opposite": -1}[answer]

    def home():
        bus.arm.mechanism.q[:] = [0.3, -0.1]

    waiting += [
        turned(1, 0.05),
        turned(1, -0.5 * side, answer),
        turned(0, 0.4, "what?"),
    ]
    waiting += [turned(0, 0.4 * side, answer), home]
    motors.succeed(MAP, model, "--output", output)
    assert "move joint joint0 alone" in prompts[0]
    assert "no motor, or several, turned clearly" in prompts[1]
    assert "it was not said which way it moved; move joint joint1 alone" in prompts[3]
    first, second = read_joint_map(output)
    assert (first.name, first.can_id, first.direction) == ("joint0", 2, -1)
    assert first.master_id == 18
    assert (second.name, second.can_id, second.direction) == ("joint1", 1, 1)
    assert first.offset == pytest.approx(-0.1, abs=1e-3)
    assert second.offset == pytest.approx(0.3, abs=1e-3)
    assert only_asks(bus.wire.sent)


def test_a_map_is_not_guessed(motors, bus, person, tmp_path, model):
    waiting, _ = person
    output = tmp_path / "map.csv"

    def both():
        bus.arm.mechanism.q += 0.5
        return "yes"

    waiting += [both] * 3
    err = motors.fail(3, MAP, model, "--output", output)
    assert "cannot be told which motor drives joint0" in err
    assert not output.exists()


@pytest.mark.parametrize("answer", ["yes", "opposite"])
def test_a_joint_that_cannot_have_gone_as_was_said_is_not_mapped(
    motors, bus, person, turned, tmp_path, arm_file, answer
):
    """The second joint stands at the upper end of its range, which is the model's own pose."""
    model = small_arms.serial_arm((small_arms.Z, small_arms.Y), joint='range="-1 .001"')
    waiting, _ = person
    output = tmp_path / "map.csv"
    waiting += [turned(0, -0.5, "opposite"), turned(1, -0.5, answer)]
    waiting.append(lambda: bus.arm.mechanism.q.fill(0.0))
    words = MAP, arm_file(model), "--output", output
    if answer == "opposite":
        motors.succeed(*words)
        assert [row.direction for row in read_joint_map(output)] == [1, 1]
        return
    err = motors.fail(3, *words)
    assert "joint joint1 would have been moved to 0.50 rad" in err
    assert not output.exists()


def test_nobody_moves_an_arm_for_a_map_that_cannot_be_written(
    motors, bus, person, tmp_path, model
):
    for output, fault in {
        model: f"{model} exists; choose another --output",
        model / "map.csv": "is not a folder that may be written to",
    }.items():
        assert fault in motors.fail(2, MAP, model, "--output", output)
    assert person[1] == [] and bus.wire.frames == []


def test_the_model_says_which_way_is_positive(model):
    from robot_sysid.commands.motors.mapping import movement_texts
    from robot_sysid.parser import load_robot_model

    robot = load_robot_model(model)
    texts = movement_texts(robot)
    assert [text.partition("seen from ")[2] for text in texts] == ["+z (up)", "+y"]
    assert all("counter-clockwise" in text for text in texts)

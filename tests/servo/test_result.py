"""What comes of an arm without torque sensors: rows, tables, servo.json, and the written file."""

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest

from rigs.arms.servo_fits import FOUND, found_fit, identification_of, off_with_links
from rigs.arms.small_arms import robot_of
from rigs.files.schemas import schema
from rigs.logs.servo_logs import SERVOS, XML
from robot_sysid.records import file_access
from robot_sysid.records.servo_setting import parse_servo_setting
from robot_sysid.servo.motor_torque import TorqueFault, TorqueGains
from robot_sysid.servo.result import (
    COLUMNS,
    RATIOS,
    SIZES,
    UNKNOWN,
    servo_lines,
    servo_notes,
)
from robot_sysid.servo.unknowns import NAMES, UNKNOWNS

ROBOT = robot_of(XML)
GEARED = XML.replace('biasprm="0 -100 -2"', 'biasprm="0 -100 -2" gear="-2"')


def rows_of(result):
    """The rows of a result by source, name and owner."""
    return {(row.source, row.name, row.of): row for row in result.quantities}


@pytest.mark.parametrize("is_used", [True, False])
def test_what_sizes_rest_on_is_said(is_used):
    error = np.where([is_used, False], 0.1, np.inf)
    faults = (None if is_used else TorqueFault.APART, TorqueFault.ZERO)
    by_torque = TorqueGains(ROBOT.joint_names, np.zeros(2), error, faults)
    fit = replace(found_fit(ROBOT), by_torque=by_torque)
    result = identification_of(ROBOT, fit)
    text = json.loads(file_access.json_text(result.json_content()))["torque"]
    assert ("recorded torques" in text) == is_used
    assert ("No torque was measured" in text) != is_used
    assert f"  {text}:" in [*servo_lines(result)]
    notes = [*servo_notes(result)]
    assert notes == [*by_torque.notes] and len(notes) == 2


def test_each_number_has_a_row_of_each_joint():
    result = identification_of(ROBOT)
    rows = [*result.quantities]
    keys = [(row.name, row.of, row.source == "file") for row in rows]
    assert len(set(keys)) == len(keys)
    named = {name for name, of, is_file in keys if of != "arm" and not is_file}
    for name in named:
        joints = [of for other, of, is_file in keys if other == name and not is_file]
        assert joints == ["joint0", "joint1"]
    assert {*COLUMNS, "stribeck", "dead_zone", "loop_lag"} <= named
    # The written model's numbers come last.
    is_file = [key[-1] for key in keys]
    assert is_file == sorted(is_file)
    assert sum(is_file) == 2 * 6


def test_delays_are_that_of_the_commands_and_what_to_set_in_mujoco():
    first, second, *_ = identification_of(ROBOT).quantities
    assert (first.name, first.value, first.error) == ("command_delay", 0.02, 1e-3)
    half = 0.5 * ROBOT.mj_model.opt.timestep
    assert second.value == pytest.approx(0.02 + half, rel=1e-12)
    assert (second.name, second.error) == ("simulated_delay", 1e-3)


def test_numbers_of_the_model_stand_beside_those_that_it_has():
    rows = rows_of(identification_of(ROBOT))
    expected = {"gain": 100.0, "damping": 3.0, "frictionloss": 0.3, "armature": 0.05}
    for name, value in expected.items():
        assert rows["data", name, "joint0"].model == value
        assert rows["file", name, "joint0"].model == value
    assert rows["data", "torque_limit", "joint0"].model == 60.0
    assert rows["data", "torque_limit", "joint1"].model == np.inf
    assert rows["data", "load_share", "joint0"].model is None
    assert rows["data", "sag", "joint0"].model is None


def test_a_number_that_the_logs_do_not_show_is_not_one_of_theirs():
    """It goes with the others of its joint, and its cell is a question mark."""
    fit = found_fit(ROBOT)
    covariance = fit.covariance.copy()
    covariance[1] = off_with_links(ROBOT, fit, 0.6).covariance[1]
    result = identification_of(ROBOT, replace(fit, covariance=covariance))
    rows = rows_of(result)
    assert ("data", "gain", "joint0") in rows
    row = rows["model", "gain", "joint1"]
    assert "only ratios" in row.reason
    assert row.error > 0.4 * row.value
    # Its sag needs no scale.
    assert ("data", "sag", "joint1") in rows
    lines = [*servo_lines(result)]
    cells = cells_of(lines, "gain, N·m/rad")
    assert cells["joint0"] != UNKNOWN
    assert cells["joint1"] == UNKNOWN
    assert cells_of(lines, "sag, deg")["joint1"] != UNKNOWN


def cells_of(lines, title):
    """The cells of one column of the printed tables by joint."""
    for number, line in enumerate(lines):
        if title in line:
            begin = line.index(title)
            cells = {}
            for row in lines[number + 1 : number + 3]:
                # Columns are aligned at one of their sides.
                width = len(title) + 4
                cut = row[max(begin - 2, 0) : begin + width].split("  ")
                cells[row.split()[0]] = next(
                    cell.strip() for cell in cut if cell.strip()
                )
            return cells
    raise AssertionError(title)


def test_the_printed_tables_have_all_columns_and_numbers_with_their_errors():
    lines = [*servo_lines(identification_of(ROBOT))]
    for names in (RATIOS, SIZES):
        (head,) = (line for line in lines if COLUMNS[names[0]][0] in line)
        assert all(COLUMNS[name][0] in head for name in names)
    for joint in ("joint0", "joint1"):
        rows = [line for line in lines if line.strip().startswith(f"{joint} ")]
        assert len(rows) == 2
    # A dead band of 0.004 rad is 0.23 degrees.
    assert cells_of(lines, "dead band, deg")["joint0"].startswith("0.2")
    gain = cells_of(lines, "gain, N·m/rad")["joint0"]
    value, _, error = gain.partition(" ± ")
    assert float(value) == pytest.approx(FOUND["gain"], rel=0.02)
    expected = 0.02 * UNKNOWNS["gain"].deviation * FOUND["gain"]
    assert float(error) == pytest.approx(expected, rel=0.05)
    (played,) = (line for line in lines if line.startswith("In windows"))
    assert "5 s" in played and "1 rad of the model before, 0.1 of the new" in played
    delays = [line for line in lines if "delay" in line]
    assert len(delays) == 2
    assert "0.0200" in delays[0] and "0.0010" in delays[0]


def test_a_joint_that_stands_has_no_number_and_is_said_once():
    fit = replace(found_fit(ROBOT), is_known=np.array([True, False]))
    result = identification_of(ROBOT, fit)
    rows = [row for row in result.quantities if row.of == "joint1"]
    assert {row.source for row in rows} == {"model"}
    assert all("does not move" in row.reason for row in rows)
    lines = [*servo_lines(result)]
    assert cells_of(lines, "sag, deg")["joint1"] == UNKNOWN
    (note,) = servo_notes(result)
    assert note.startswith("joint1: ") and "does not move" in note


def test_a_joint_that_plays_worse_keeps_the_models_numbers_in_the_file():
    result = replace(identification_of(ROBOT), is_new=np.array([True, False]))
    in_file = [row.of for row in result.quantities if row.source == "file"]
    assert set(in_file) == {"joint0"}
    (note,) = servo_notes(result)
    assert note.startswith("joint1: ") and "worse" in note
    assert {change.owner for change in result.changes()} == {"joint0", 0}


def test_a_joint_without_a_servo_has_no_place_for_its_gain():
    robot = robot_of(XML.replace(SERVOS, ""))
    result = identification_of(robot)
    (note,) = servo_notes(result)
    assert "no position actuator on joint0, joint1" in note
    assert {change.kind for change in result.changes()} == {"joint"}
    rows = rows_of(result)
    assert np.isnan(rows["data", "gain", "joint0"].model)


@pytest.mark.parametrize(("xml", "gear"), [(XML, 1.0), (GEARED, -2.0)])
def test_what_is_written_of_a_joint_and_of_its_servo(xml, gear):
    """All damping is the joint's, beside the limit; a motor's numbers are before its gear."""
    joint, servo, *_ = identification_of(robot_of(xml)).changes()
    assert (joint.kind, joint.owner) == ("joint", "joint0")
    assert joint.numbers == {
        "damping": 3.0,
        "frictionloss": 0.2,
        "armature": 0.1,
        "solimpfriction": 0.99,
    }
    assert (servo.kind, servo.owner) == ("actuator", 0)
    expected = {"kp": 50.0 / gear**2, "kv": 0.0, "forcerange": 5.0 / abs(gear)}
    assert servo.numbers == pytest.approx(expected, rel=1e-12)


def test_what_the_model_does_not_have_and_needs_not_is_not_written():
    """A servo without damping gets none, and one without a limit that shows keeps none."""
    robot = robot_of(XML.replace('biasprm="0 -100 -2"', 'biasprm="0 -100 0"'))
    fit = found_fit(ROBOT)
    fit = replace(fit, in_file=replace(fit.in_file, limits=np.full(2, np.inf)))
    _, servo, *_ = identification_of(robot, fit).changes()
    assert set(servo.numbers) == {"kp"}


def is_valid(content):
    validator = jsonschema.Draft202012Validator(schema("servo"))
    return not [*validator.iter_errors(content)]


def content_of(result):
    return json.loads(file_access.json_text(result.json_content()))


def test_servo_json_is_what_its_schema_says():
    """With all that may be missing: limits, gains of the model, joints that move, a setting."""
    bare = robot_of(XML.replace(SERVOS, ""))
    still = replace(found_fit(ROBOT), is_known=np.array([True, False]))
    setting = parse_servo_setting("kp=400, load=0.2 at 0.1")
    of_setting = identification_of(ROBOT, setting=setting)
    unlimited = found_fit(bare)
    limits = np.full(2, np.inf)
    unlimited = replace(unlimited, in_file=replace(unlimited.in_file, limits=limits))
    results = [
        identification_of(ROBOT),
        identification_of(bare, unlimited),
        identification_of(ROBOT, still),
        of_setting,
    ]
    for result in results:
        assert is_valid(content_of(result))
    content = content_of(of_setting)
    assert content["schema"] == "robot-sysid servo 6"
    assert content["setting"] == "kp=400, load=0.2 at 0.1"
    assert len(content["quantities"]) == len([*of_setting.quantities])
    assert content["rollout"] == {
        "window": 5.0,
        "before": [1.0, 1.0],
        "after": [0.1, 0.1],
        "fitted": [0.1, 0.1],
        "goal": 0.5,
    }
    content["quantities"][0]["name"] = "other"
    assert not is_valid(content)


def test_the_schema_has_the_names_and_units_that_are_written_and_no_others():
    rows = content_of(identification_of(ROBOT))["quantities"]
    entry = schema("servo")["$defs"]["quantity"]["properties"]
    assert {row["name"] for row in rows} == set(entry["name"]["enum"])
    assert {row["unit"] for row in rows} == set(entry["unit"]["enum"])
    # Zeros of links are fitted beside the servos, and are no number of theirs.
    assert set(NAMES) - {"zero"} <= set(entry["name"]["enum"])


def test_elsewhere_the_larger_of_both_errors_is_expected():
    """A short end of a log may be an easy one, and a long fitted part too well learnt."""
    result = identification_of(ROBOT, error=0.1)
    easy_end = replace(result, fitted=np.full(2, 0.3))
    assert (result.expected, easy_end.expected) == (0.1, 0.3)
    *_, line = servo_lines(easy_end)
    assert "On other motions expect 0.3 rad" in line


@pytest.mark.parametrize(
    ("after", "goal", "is_better"),
    [(0.1, 0.5, True), (1.1, 2.0, False), (0.6, 0.5, False)],
)
def test_a_model_is_better_than_the_one_before_and_than_late_commands(
    after, goal, is_better
):
    assert identification_of(ROBOT, None, after, goal).is_better == is_better


def test_a_servo_faster_than_its_samples_has_a_note():
    fit = found_fit(ROBOT)
    is_fast = np.arange(ROBOT.n_joints) == 0
    result = identification_of(ROBOT, replace(fit, is_fast=is_fast))
    (note,) = (note for note in servo_notes(result) if "faster" in note)
    assert note.startswith(f"{ROBOT.joint_names[0]}: the servo swings faster")


def test_a_range_of_the_joint_does_not_cut_a_larger_limit_of_its_servo():
    """MuJoCo cuts the torque at the joint, whatever the actuator's range."""
    own = 'actuatorfrcrange="-4 4" '
    robot = robot_of(XML.replace('name="joint0" ', f'name="joint0" {own}', 1))
    joint, servo, *_ = identification_of(robot).changes()
    assert servo.numbers["forcerange"] == FOUND["torque_limit"] > 4.0
    assert joint.numbers["actuatorfrcrange"] == FOUND["torque_limit"]
    free, *_ = identification_of(ROBOT).changes()
    assert "actuatorfrcrange" not in free.numbers


def test_gravity_compensation_of_the_model_is_said():
    """Rollouts leave it out, and the file keeps it."""
    robot = robot_of(XML.replace("<body ", '<body gravcomp="1" ', 1))
    notes = [*servo_notes(identification_of(robot))]
    assert any("gravcomp" in note for note in notes)
    assert not any("gravcomp" in note for note in servo_notes(identification_of(ROBOT)))

"""Friction that bends with speed: the file that has it, and every command that reads that file."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.arms.core_fits import filter_logs, fit_recordings
from rigs.files import schemas
from rigs.files.file_judge import torque_error
from rigs.files.releases import since
from rigs.logs.measured_logs import log_of, plan_of
from robot_sysid.dynamics.friction import BEND, TERMS, polynomial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import SysidError
from robot_sysid.estimate.quantities import friction_in
from robot_sysid.estimate.restricted_fit import (
    bent_owners,
    errors_of,
    fit_file,
    straight_of,
)
from robot_sysid.estimate.rows import row_chunks
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.records.file_access import CURVED_NAME, MODEL_NAMES
from robot_sysid.records.quantities import BOUND, CURVED, DATA, FILE
from robot_sysid.results import written_model
from robot_sysid.servo import refuse_bends
from robot_sysid.simulation.usual_arm import usual_arm

TOP, SIZE, VISCOUS = 2.0, 0.3, 0.05
DAMPING = polynomial(VISCOUS, SIZE, TOP)
DRY = 0.3
BENT = 'range="-2 2" armature=".05" frictionloss="{}" damping="{} {} {}"'
STRAIGHT = 'range="-2 2" armature=".05"'
LINE = ("coulomb", "viscous")
STRAIGHT_NAME = MODEL_NAMES["mjcf"]
pytestmark = since(3, 7)


@pytest.fixture(scope="module")
def plant():
    """The arm, whose gears bend as much as they rub."""
    return small_arms.robot_of(small_arms.serial_arm(joint=BENT.format(DRY, *DAMPING)))


@pytest.fixture(scope="module")
def model():
    return small_arms.robot_of(small_arms.serial_arm(joint=STRAIGHT))


@pytest.fixture(scope="module")
def log(plant):
    return log_of(plant, noise_torque=0.01, encoder_resolution=1e-5)


@pytest.fixture(scope="module")
def estimate(model, log):
    return fit_recordings(model, filter_logs(model, log))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, plant, log):
    """A folder with the arm's model, its log, and what was identified from both."""
    folder = tmp_path_factory.mktemp("curved")
    (folder / "arm.xml").write_text(small_arms.serial_arm(joint=STRAIGHT))
    write_measurement_csv(folder / "log.csv", plant.joint_names, [log])
    other = log_of(plant, plan_of(plant, 5), 5, noise_torque=0.01)
    write_measurement_csv(folder / "other.csv", plant.joint_names, [other])
    rs.identify(folder / "arm.xml", folder / "log.csv").save(folder)
    return folder


def friction_of(robot, speed):
    """Return the torque (n,) of a compiled arm's friction at one speed of all joints."""
    qd = np.full((1, robot.n_joints), speed)
    still = np.zeros_like(qd)
    dynamics = ArmDynamics(robot)
    moved = [dynamics.torque(still, way * qd, still) for way in (1.0, -1.0)]
    return (0.5 * (moved[0] - moved[1]) + robot.friction.torque(qd))[0]


@pytest.mark.slow
def test_the_curve_predicts_another_motion_far_better_than_the_line(folder, plant):
    """Judged as files, by MuJoCo, on a log that did not make them."""
    other = log_of(plant, plan_of(plant, 5), 5, noise_torque=0.01)
    (signals,) = filter_logs(plant, other)
    errors = {}
    for name in (CURVED_NAME, STRAIGHT_NAME):
        written = load_robot_model(folder / name)
        errors[name] = torque_error(written.mj_model, written, signals)
    assert errors[CURVED_NAME] < 0.4 * errors[STRAIGHT_NAME]
    curved = load_robot_model(folder / CURVED_NAME)
    content = schemas.check(folder / "params.json")
    for curve in content["curves"]:
        joint = curved.joint_names.index(curve["of"])
        for speed, torque, error in zip(
            curve["speeds"], curve["torque"], curve["errors"]
        ):
            # What is printed is measured: the file and the truth are within two of its errors.
            assert abs(friction_of(curved, speed)[joint] - torque) < 2.0 * error
            true = friction_of(plant, speed)[joint]
            assert abs(torque - true) < 2.0 * error
    assert curve["known_to"] == curve["speeds"][-1]


@pytest.mark.slow
def test_a_curve_nowhere_falls_and_both_files_have_the_same_links(folder):
    curved, straight = (
        load_robot_model(folder / name) for name in (CURVED_NAME, STRAIGHT_NAME)
    )
    speeds = np.linspace(0.0, 20.0, 200)
    torques = np.array([friction_of(curved, speed) for speed in speeds[1:]])
    assert np.all(np.diff(torques, axis=0) > -1e-9)
    assert not np.any(straight.mj_model.dof_dampingpoly)
    assert_allclose(curved.thetas, straight.thetas, rtol=1e-9, atol=1e-12)
    assert_allclose(curved.armature, straight.armature, rtol=1e-12)


def rows_of_friction(estimate, joint):
    """Return the friction (K,) of a fit at a joint, and the columns (K, 2) of its line."""
    index = estimate.arm.joints.index(joint)
    friction, line = [], {}
    for recording in estimate.recordings:
        used = recording.is_used[:, estimate.arm.indices[index]]
        (rows,) = row_chunks(recording, 1, 10**9)
        for name, term in estimate.arm.terms.items():
            if name in TERMS and TERMS[name].is_friction:
                columns = term.columns(rows, estimate.point)[used, index]
                at = [k for k, each in enumerate(term.names) if each in estimate.names]
                values = [estimate.by_name[term.names[k]] for k in at]
                friction.append(columns[:, at] @ values)
                line[name] = columns[:, term.names.index(f"{name}[{joint}]")]
    return np.sum(friction, axis=0), np.column_stack([line[name] for name in LINE])


def test_printed_friction_is_the_line_nearest_to_all_of_it_in_the_rows(estimate):
    """Whatever its terms trade with one another, by a least squares of its own."""
    file = fit_file(estimate)
    rows = {(row.name, row.of): row for row in friction_in(estimate, file)}
    for joint in estimate.arm.joints:
        friction, line = rows_of_friction(estimate, joint)
        nearest, *_ = np.linalg.lstsq(line, friction, rcond=None)
        for name, value in zip(LINE, nearest):
            row = rows[name, joint]
            assert row.value == pytest.approx(value, rel=1e-6)
            written = straight_of(file).by_name[f"{name}[{joint}]"]
            assert abs(written - row.value) < 3.0 * row.error


def test_a_line_that_would_drive_a_joint_is_held_at_its_bound(estimate):
    """Friction that falls with speed has a line that falls: no file holds that."""
    name = "fading_slow[joint1]"
    full = estimate.values.copy()
    full[estimate.names.index(name)] += 50.0 * DRY
    falling = replace(estimate, values=full)
    rows = {
        row.name: row
        for row in friction_in(falling, fit_file(estimate))
        if row.of == "joint1"
    }
    assert rows["viscous"].source == BOUND and rows["viscous"].value == 0.0
    assert rows["coulomb"].source == DATA and rows["coulomb"].value > DRY


@pytest.mark.slow
def test_params_have_each_number_once_and_that_of_the_file_within_its_error(folder):
    content = schemas.check(folder / "params.json")
    printed, written = {}, {}
    for row in content["quantities"]:
        if row["source"] != CURVED and row["of"] in content["joint_names"]:
            rows = written if row["source"] == FILE else printed
            assert (row["name"], row["of"]) not in rows
            rows[row["name"], row["of"]] = row
    for joint in content["joint_names"]:
        for name in LINE:
            row = printed[name, joint]
            apart = written[name, joint]["value"] - row["value"]
            assert abs(apart) < 3.0 * row["error"]
        assert ("bend", joint) in printed and ("further_bend", joint) not in printed


def test_without_a_rotor_no_joint_bends(plant, model):
    """A sensor behind the gears sees neither rotors nor the friction of gears."""
    behind = small_arms.robot_of(
        small_arms.serial_arm(
            joint=BENT.format(DRY, *DAMPING).replace('armature=".05"', "")
        )
    )
    log = log_of(behind, noise_torque=0.01, encoder_resolution=1e-5)
    bare = small_arms.robot_of(small_arms.serial_arm(joint='range="-2 2"'))
    file = fit_file(fit_recordings(bare, filter_logs(bare, log)))
    assert not [*bent_owners(file)] and straight_of(file) is file


def test_a_bend_that_is_worth_nothing_makes_no_second_file(model):
    plain = small_arms.robot_of(
        small_arms.serial_arm(
            joint='range="-2 2" armature=".05" frictionloss=".3" damping=".2"'
        )
    )
    log = log_of(plain, noise_torque=0.01, encoder_resolution=1e-5)
    file = fit_file(fit_recordings(model, filter_logs(model, log)))
    assert straight_of(file) is file


def test_bends_below_zero_are_held_before_friction_that_they_push_there(estimate):
    """Held at once, viscous friction would stay at zero, which is right without the bend."""
    arm = estimate.arm
    viscous, bend = (arm.terms[name] for name in ("viscous", BEND.name))
    fitted = estimate.fit([viscous, bend], noise=estimate.noise, possible=False)
    fitted = replace(fitted, is_free=np.ones(len(fitted.names), dtype=bool))
    # Columns of each joint that go against one another, and the best values of both.
    columns = np.kron(np.array([[1.0, -0.5], [-0.5, 1.0]]), np.eye(len(arm.joints)))
    best = np.repeat([-0.1, -1.0], len(arm.joints))
    normal = np.zeros((len(best) + 1, len(best) + 1))
    normal[:-1, :-1] = columns
    normal[:-1, -1] = normal[-1, :-1] = columns @ best
    held = fitted.solve_within_bounds(normal, False)
    assert held.at_bound == bend.names
    assert_allclose(held.values[held.at(viscous.names)], 0.4)


@pytest.mark.slow
def test_an_old_mujoco_gets_the_line_alone_and_a_word(model, folder, monkeypatch):
    monkeypatch.delattr(mujoco.MjModel, "dof_dampingpoly")
    result = rs.identify(folder / "arm.xml", folder / "log.csv")
    written = result.save(folder / "old")
    assert CURVED_NAME not in [path.name for path in written]
    assert not (folder / "old" / CURVED_NAME).exists()
    content = schemas.check(folder / "old" / "params.json")
    assert content["file"]["curved"]["name"] is None
    texts = [remark["text"] for remark in content["remarks"]]
    assert any("begins with MuJoCo 3.7" in text for text in texts)
    assert content["verdict"][0].startswith(f"Usable: {folder / 'old'}")


@pytest.mark.slow
def test_a_curve_that_cannot_be_written_leaves_the_line_and_a_word(folder):
    result = rs.identify(folder / "arm.xml", folder / "log.csv")
    # Damping that would drive its joint, which the writer refuses.
    rows = [
        replace(row, value=-row.value)
        if row.source == CURVED and row.name in ("viscous", "bend")
        else row
        for row in result.quantities
    ]
    result = replace(result, quantities=tuple(rows))
    written = [path.name for path in result.save(folder / "refused")]
    assert STRAIGHT_NAME in written and CURVED_NAME not in written
    assert not (folder / "refused" / CURVED_NAME).exists()
    content = schemas.check(folder / "refused" / "params.json")
    assert content["file"]["curved"]["name"] is None
    texts = [remark["text"] for remark in content["remarks"]]
    start = f"{CURVED_NAME} is not written: "
    assert any(text.startswith(start) and "drive itself" in text for text in texts)
    assert str(folder / "refused" / STRAIGHT_NAME) in content["verdict"][0]


def test_the_console_names_the_curve_first_and_who_reads_it(folder):
    lines = json.loads((folder / "params.json").read_text())["verdict"]
    assert lines[0].startswith("Usable: ") and f"{CURVED_NAME}; torque e" in lines[0]
    others = [line for line in lines if f"{STRAIGHT_NAME} (" in line]
    assert others[0].startswith("With MuJoCo before 3.7")
    promise = json.loads((folder / "params.json").read_text())["file"]["curved"]
    assert promise["elsewhere"]["after"]["relative_error"] > 0.0


@pytest.mark.slow
def test_a_curved_model_is_refitted_and_a_log_of_it_is_told_from_nothing(folder):
    """Its curve is the model's number, not an unknown beside it."""
    curved = folder / CURVED_NAME
    again = rs.identify(curved, folder / "other.csv")
    assert again.failure is None
    straight, bent = (
        load_robot_model(path).mj_model
        for path in again.save(folder / "again")
        if path.suffix == ".xml"
    )
    assert not np.any(straight.dof_dampingpoly)
    model = load_robot_model(curved)
    speed = 1.0
    written = load_robot_model(folder / "again" / CURVED_NAME)
    assert_allclose(
        friction_of(written, speed), friction_of(model, speed), rtol=0.1, atol=0.03
    )
    # A top that was known once is not lost with a slower log.
    for joint, top in again.tops.items():
        assert top >= json.loads((folder / "params.json").read_text())["friction_tops"][
            joint
        ] * (1.0 - 1e-9)


@pytest.mark.slow
def test_a_curve_that_an_arm_does_not_have_leaves_nothing_in_its_file(folder):
    """Beside a line with less viscous friction it would fall, and drive the joint."""
    plain = 'range="-2 2" armature=".05" frictionloss=".3" damping=".05"'
    plant = small_arms.robot_of(small_arms.serial_arm(joint=plain))
    log = log_of(plant, noise_torque=0.01, encoder_resolution=1e-5)
    path = folder / "plain.csv"
    write_measurement_csv(path, plant.joint_names, [log])
    result = rs.identify(folder / CURVED_NAME, path)
    written = [p for p in result.save(folder / "plain") if p.suffix == ".xml"]
    for each in written:
        robot = load_robot_model(each)
        torques = [friction_of(robot, speed) for speed in np.linspace(0.01, 5.0, 60)]
        assert np.all(np.diff(torques, axis=0) > -1e-9)
        assert_allclose(friction_of(robot, 0.5), 0.325, atol=0.02)
    assert not np.any(load_robot_model(written[0]).mj_model.dof_dampingpoly)


@pytest.mark.slow
def test_check_finds_nothing_between_a_curved_model_and_its_arm(folder):
    check = rs.check(folder / CURVED_NAME, folder / "other.csv")
    assert not check.has_changed
    rows = [row for row in check.changes if row.name == "friction in motion"]
    assert rows and all(abs(row.value) <= row.least for row in rows)


@pytest.mark.slow
def test_a_payload_on_a_curved_arm_is_weighed(folder, plant):
    loaded = small_arms.compile_xml(
        small_arms.serial_arm(joint=BENT.format(DRY, *DAMPING))
    )
    theta = plant.prior.theta.copy()
    carried = small_arms.random_theta(np.random.default_rng(1), 0.5, 0.05)
    small_arms.write_body(loaded, plant.body_id, theta + carried)
    heavy = small_arms.robot_of(loaded)
    log = log_of(heavy, plan_of(plant, 7), 7, noise_torque=0.01)
    write_measurement_csv(folder / "loaded.csv", plant.joint_names, [log])
    result = rs.payload(folder / CURVED_NAME, folder / "log.csv", folder / "loaded.csv")
    row = result.quantity("mass", "payload")
    assert abs(row.value - 0.5) < 2.0 * row.error


@pytest.mark.slow
def test_plan_and_plant_read_the_curve(folder, plant):
    """The torque that a plan reserves is that of the file; a plant of it makes its logs."""
    planned = rs.plan(folder / CURVED_NAME, duration=5.0, seed=1)
    assert planned.failure is None
    result = rs.self_test(
        folder / "arm.xml",
        plant_model=folder / CURVED_NAME,
        duration=10.0,
        seed=1,
        noise_torque=0.01,
    )
    friction = [result.quantity(BEND.name, joint) for joint in plant.joint_names]
    assert any(row is not None and row.value > row.error for row in friction)


def test_motors_are_fed_no_friction_of_a_curve(folder):
    """Weight and inertia alone, which both files share."""
    parts = []
    for name in (CURVED_NAME, STRAIGHT_NAME):
        robot = load_robot_model(folder / name)
        motion = plan_of(robot).evaluate(np.linspace(0.0, 1.0, 20))
        parts.append(ArmDynamics(robot).weight_and_inertia(motion))
    assert_allclose(parts[0], parts[1], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_usual_arm_of_a_curved_model_has_a_curve_that_nowhere_falls(folder, seed):
    robot = load_robot_model(folder / CURVED_NAME)
    arm = usual_arm(robot, np.full(3, 2.0), np.random.default_rng(seed))
    torques = [friction_of(arm, speed) for speed in np.linspace(0.01, 5.0, 60)]
    assert np.all(np.diff(torques, axis=0) > -1e-9)
    assert not np.allclose(friction_of(arm, 0.5), friction_of(robot, 0.5), rtol=1e-3)


@pytest.mark.slow
def test_a_damping_that_is_no_bend_stays_beside_what_is_identified(tmp_path, model):
    """Drag, which grows with the square of speed."""
    drag = small_arms.robot_of(
        small_arms.serial_arm(
            joint='range="-2 2" armature=".05" frictionloss=".2" damping=".1 .2 0"'
        )
    )
    path = tmp_path / "drag.xml"
    path.write_text(
        small_arms.serial_arm(joint='range="-2 2" armature=".05" damping="0 .2 0"')
    )
    log = log_of(drag, noise_torque=0.01, encoder_resolution=1e-5)
    write_measurement_csv(tmp_path / "log.csv", drag.joint_names, [log])
    result = rs.identify(path, tmp_path / "log.csv")
    written = load_robot_model(
        next(p for p in result.save(tmp_path) if p.name == STRAIGHT_NAME)
    )
    assert_allclose(written.mj_model.dof_dampingpoly[:, 0], 0.2)
    assert_allclose(written.friction.viscous, 0.1, atol=0.03)
    notes = " ".join(remark.text for remark in result.remarks)
    assert re.search("nonlinear damping of .* as the model states it", notes)


def test_servos_of_a_curved_model_are_refused_with_the_file_that_they_need(folder):
    with pytest.raises(SysidError, match=f"bends with speed.*give {STRAIGHT_NAME}"):
        refuse_bends(load_robot_model(folder / CURVED_NAME))
    refuse_bends(load_robot_model(folder / STRAIGHT_NAME))


@pytest.mark.slow
def test_a_card_has_the_straight_line_and_says_so(folder):
    log = folder / "log.csv"
    result = rs.identify(folder / "arm.xml", log, cards="drake")
    written = {path.name: path for path in result.save(folder / "cards")}
    text = written["drake_card.py"].read_text()
    assert f"{CURVED_NAME} has the curve" in text
    straight = load_robot_model(written[STRAIGHT_NAME])
    damping = [float(x) for x in re.findall(r"'damping': ([\d.e-]+)", text)]
    assert_allclose(damping, straight.friction.viscous, rtol=1e-9)


def test_errors_of_both_files_are_of_the_same_blocks(estimate):
    file = fit_file(estimate)
    curved, straight = (errors_of(each) for each in (file, straight_of(file)))
    assert curved.before.relative_error == straight.before.relative_error
    assert curved.after.relative_error < 0.5 * straight.after.relative_error
    assert written_model.can_bend() == hasattr(mujoco.MjModel, "dof_dampingpoly")

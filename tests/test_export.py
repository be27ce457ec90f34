"""All results of a run are written or none, and never beside another run's; params.json has every
specified key, full precision, strict JSON and one schema."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from rigs.arms.small_arms import random_theta
from rigs.files import results as made
from rigs.files import urdf
from rigs.files.command_line import files_in
from rigs.files.model_files import ARM, write_files
from rigs.files.notes import NoteRecorder
from rigs.files.recorded_files import as_run
from rigs.files.schemas import schema
from robot_sysid.config import PayloadConfig
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.errors import InputError
from robot_sysid.export import RESULT_NAMES, save
from robot_sysid.parser import load_robot_model
from robot_sysid.records import file_access
from robot_sysid.records.file_access import json_text
from robot_sysid.records.quantities import FILE
from robot_sysid.results import content as rows
from robot_sysid.results.verdicts import Verdict
from tests.results.test_written_model import checkpoints, file_of, payload_of, result_of

THETA = random_theta(np.random.default_rng(1), 2.0)
EARLIER = {name: f"an earlier {name}" for name in (*RESULT_NAMES, "report_data.npz")}
OTHERS = {
    "trajectory.json": "a plan",
    "trajectory.csv": "its samples",
    "notes.txt": "mine",
}


@pytest.fixture
def robot(tmp_path):
    """An arm whose file is not in the output folder."""
    return load_robot_model(write_files(tmp_path / "in", {"m.xml": ARM}), joint="j2")


@pytest.fixture
def out(tmp_path):
    """An output folder, which does not exist yet."""
    return tmp_path / "out"


def save_result(result, out, progress=None, motor_file=None, **options):
    """Save a result as a run with options does."""
    options = {"output_dir": out, "empty": ("a",), "loaded": ("b",), **options}
    config = PayloadConfig.of(result.robot.path, **options)
    result = replace(result, checkpoints=checkpoints(result.robot))
    return save(result, config, progress or NoteRecorder(), motor_file)


def heavier(robot):
    """A result whose terminal link is 2 kg heavier than the model's."""
    return result_of(robot, robot.prior.theta + THETA)


def names_in(folder):
    """Sorted names of the files and folders in a folder, but for the record of what runs wrote."""
    return sorted({path.name for path in folder.iterdir()} - {file_access.RECORD_NAME})


def write_as_run(folder, files):
    """Write files, text by name, as an earlier run does."""
    with as_run(folder):
        for name, text in files.items():
            file_access.write_atomically(folder / name, text)


def test_the_whole_way_from_a_result(robot, out):
    progress = NoteRecorder()
    output = save_result(heavier(robot), out, progress)
    assert [path.name for path in output.files] == ["updated_model.xml", "params.json"]
    assert (progress.notes, output.failure) == ([], None)
    assert not any("Damiao" in line for line in output.lines)
    reloaded = load_robot_model(output.files[0], joint="j2")
    assert_allclose(reloaded.prior.theta, robot.prior.theta + THETA, rtol=0, atol=1e-12)
    assert "RMSE 0.030000 Nm" in output.files[0].read_text()
    assert made.theta_in(output.files[1])[0] == robot.prior.mass + 2.0


def test_an_mjcf_stands_beside_a_urdf_whose_meshes_mujoco_does_not_read(tmp_path, out):
    """Geometry is left out of it, so that MuJoCo loads it."""
    mesh = urdf.mesh("collision", "package://arm/l2.dae")
    links = {"l1": urdf.inertial(), "l2": urdf.inertial() + mesh}
    text = urdf.robot(urdf.serial(links))
    robot = load_robot_model(write_files(tmp_path / "in", {"arm.urdf": text}))
    (note,) = robot.notes
    assert "a written MJCF without them" in note
    output = save_result(heavier(robot), out)
    assert names_in(out) == ["params.json", "updated_model.urdf", "updated_model.xml"]
    assert output.verdict[0] == f"Usable: {out}/updated_model.xml"
    model = mujoco.MjModel.from_xml_path(str(output.files[0]))
    assert model.body("l2").mass == pytest.approx(3.0, rel=1e-5) and model.nmesh == 0
    with pytest.raises(ValueError):
        mujoco.MjModel.from_xml_path(str(output.files[1]))
    for path in output.files[:2]:
        theta = load_robot_model(path).prior.theta
        assert_allclose(theta, robot.prior.theta + THETA, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("has_rotor", [False, True])
def test_a_file_that_cannot_be_written_costs_only_itself(
    tmp_path, out, monkeypatch, has_rotor
):
    """What is said of errors is of a file that is there."""

    def fail(*arguments):
        raise mujoco.FatalError("no room")

    mesh = urdf.mesh("collision", "package://arm/l2.dae")
    links = {"l1": urdf.inertial(), "l2": urdf.inertial() + mesh}
    text = urdf.robot(urdf.serial(links))
    robot = load_robot_model(write_files(tmp_path / "in", {"arm.urdf": text}))
    numbers = {"armature": 0.1} if has_rotor else {"damping": 0.1}
    result = replace(heavier(robot), **file_of({"l1_l2": numbers}))
    monkeypatch.setattr(mujoco, "mj_saveLastXML", fail)
    progress = NoteRecorder()
    output = save_result(result, out, progress)
    assert names_in(out) == ["params.json", "updated_model.urdf"]
    assert output.verdict[0].startswith(f"Usable: {out}/updated_model.urdf")
    (note,) = [note for note in progress.notes if "not written" in note]
    assert note.startswith("updated_model.xml is not written: ") and "no room" in note
    file = json.loads((out / "params.json").read_text())["file"]
    assert (file and file["name"]) == (None if has_rotor else "updated_model.urdf")


def test_a_payload_has_a_card_beside_the_model(robot, out):
    result = result_of(robot, payload=payload_of(robot, THETA))
    output = save_result(result, out, as_body="load", cards="ur")
    assert names_in(out) == ["params.json", "payload_card.txt", "updated_model.xml"]
    model = load_robot_model(out / "updated_model.xml", joint="j2").mj_model
    assert model.body("load").mass == approx(2.0, rel=1e-12)
    card = (out / "payload_card.txt").read_text()
    assert "Universal Robots" in card and card.startswith(
        "Payload of 2 kg, identified with m.xml from 1 empty and 2"
    )
    assert json.loads((out / "params.json").read_text())["payload"]["card"]["kg"]
    assert output.failure is None


def test_torques_that_were_weighed_with_a_known_mass_go_into_no_model(robot, out):
    payload = replace(payload_of(robot, THETA), known_mass=2.0)
    assert save_result(result_of(robot, payload=payload), out).failure is None
    assert names_in(out) == ["params.json"]


@pytest.mark.parametrize("with_payload", [False, True])
def test_a_result_that_is_not_trusted_gets_a_params_json_alone(
    robot, out, with_payload
):
    payload = payload_of(robot, THETA) if with_payload else None
    remarks = (Verdict.TOO_WEAK.remark("so light"),)
    output = save_result(result_of(robot, payload=payload, remarks=remarks), out)
    assert names_in(out) == ["params.json"]
    omission = "no model and no card were" if with_payload else "no model was"
    assert output.failure.startswith(
        f"{omission} written: so light; {Verdict.TOO_WEAK.value[:30]}"
    )


def test_the_motor_trajectory_stands_beside_the_others_or_nothing_does(robot, out):
    errors = [InputError("no such motor")]

    def motor_file(files, folder):
        path = folder / "damiao_trajectory.csv"
        files.write(path, "half a file")
        for error in errors:
            raise error
        return (path,), ["  beyond it"]

    with pytest.raises(InputError, match="no such motor"):
        save_result(heavier(robot), out, motor_file=motor_file)
    assert not out.exists()
    errors.clear()
    output = save_result(heavier(robot), out, motor_file=motor_file)
    names = ["updated_model.xml", "damiao_trajectory.csv", "params.json"]
    assert [path.name for path in output.files] == names
    assert output.lines[-1] == "  beyond it"
    assert names_in(out) == sorted(names)


def test_no_result_of_an_earlier_run_stays_and_nothing_else_goes(robot, out):
    write_as_run(out, EARLIER)
    write_files(out, {**OTHERS, "bundle/m.xml": "sent", "params.json.bak": "mine"})
    progress = NoteRecorder()
    save_result(heavier(robot), out, progress)
    result_names = {"updated_model.xml", "params.json"}
    assert {*names_in(out)} == {*result_names, *OTHERS, "bundle", "params.json.bak"}
    assert (out / "bundle" / "m.xml").read_text() == "sent"
    assert all((out / name).read_text() == text for name, text in OTHERS.items())
    assert all("an earlier" not in (out / name).read_text() for name in result_names)
    removed = {*RESULT_NAMES} - result_names
    notes = {f"{out / name} of an earlier run was removed" for name in removed}
    assert sorted(progress.notes) == sorted(notes)


def test_the_motion_that_was_planned_for_motors_stays_to_be_played_again(robot, out):
    motion = {"damiao_trajectory.csv": "rows", "damiao_trajectory_weight.csv": "rows"}
    plan = {"trajectory.toml": 'path = "arm.xml"\nmotor_type = ["DM4340"]\n'}
    write_as_run(out, {**motion, **plan, "report.html": "old"})
    save_result(heavier(robot), out)
    results = ["updated_model.xml", "params.json"]
    assert names_in(out) == sorted([*motion, *plan, *results])


@pytest.mark.parametrize("case", ["not trusted", "does not fit"])
def test_an_old_model_goes_also_where_this_run_writes_none(robot, out, case):
    write_as_run(out, EARLIER)
    result = result_of(robot, -robot.prior.theta)
    if case == "not trusted":
        result = replace(heavier(robot), remarks=(Verdict.TOO_WEAK.remark(),))
    progress = NoteRecorder()
    output = save_result(result, out, progress)
    assert names_in(out) == ["params.json"]
    assert len(progress.notes) == len(RESULT_NAMES) - 1
    assert ("not a possible rigid body" in output.failure) == (case == "does not fit")
    assert json.loads((out / "params.json").read_text())["mass"] == result.body.mass


def test_what_this_run_reads_stays_whatever_it_is_called(out):
    log = "damiao_trajectory.csv"
    text = '<mujoco><include file="servo.json"/><worldbody/></mujoco>'
    files = {"m.xml": text, "servo.json": ARM, log: "rows"}
    write_files(out, files)
    write_as_run(out, {"payload_card.txt": "card"})
    robot_in_out = load_robot_model(out / "m.xml", joint="j2")
    (out / "link").symlink_to(out, target_is_directory=True)
    weak = replace(heavier(robot_in_out), remarks=(Verdict.TOO_WEAK.remark(),))
    progress = NoteRecorder()
    save_result(weak, out / "link", progress, empty=(out / log,))
    assert names_in(out) == sorted(["link", "m.xml", "params.json", log, "servo.json"])
    (note,) = progress.notes
    assert "payload_card.txt" in note


def test_a_run_that_ends_with_an_error_leaves_the_old_set(robot, out):
    write_as_run(out, EARLIER)
    write_files(out, OTHERS)
    old_files = files_in(out)

    def interrupt(*_):
        raise KeyboardInterrupt

    # The motors' file is drafted after the model and the card.
    with pytest.raises(KeyboardInterrupt):
        result = result_of(robot, payload=payload_of(robot, THETA))
        save_result(result, out, motor_file=interrupt)
    assert files_in(out) == old_files


# ---- params.json

SPECIFIED = [
    "joint_name",
    "mass",
    "center_of_mass_moment",
    "inertia_tensor",
    "coulomb_friction",
    "viscous_friction",
    "rmse",
    "condition_number",
    "n_base_params",
]
VALIDATOR = jsonschema.Draft202012Validator(schema("params"))


def content_of(result, card=None, notes=()):
    """The params.json of a result, which is strict JSON and keeps to the schema."""
    text = json_text(rows.content_of(result, card, notes))
    content = json.loads(text, parse_constant=pytest.fail)
    VALIDATOR.validate(content)
    return content


@pytest.mark.parametrize(
    "result", [made.found(), made.whole(), made.payload(), made.itself()]
)
def test_one_schema_holds_the_answer_to_every_question(result):
    content = content_of(result)
    assert list(content)[: len(SPECIFIED) + 1] == ["schema_version", *SPECIFIED]
    assert list(content) == schema("params")["required"]
    assert not VALIDATOR.is_valid({**content, "weight": 1.0})
    del content["quantities"]
    assert not VALIDATOR.is_valid(content)


@given(seed=st.integers(0, 2**32 - 1))
def test_reading_back_gives_the_same_bits(tmp_path_factory, seed):
    theta = random_theta(np.random.default_rng(seed))
    path = tmp_path_factory.mktemp("p") / "params.json"
    result = made.found(made.Estimate(values=np.append(theta, made.VALUES[10:])))
    path.write_text(json_text(rows.content_of(result)), encoding="utf-8")
    assert_array_equal(made.theta_in(path), theta)


def test_every_number_has_one_row():
    for result in (made.whole(), made.payload(), made.itself()):
        rows = content_of(result)["quantities"]
        keys = [(row["name"], row["of"], row["source"] == FILE) for row in rows]
        assert len(set(keys)) == len(keys)


def test_every_formula_is_the_column_of_its_term():
    formulas = content_of(made.whole())["friction_formulas"]
    assert set(formulas) == set(TERMS) - {"armature"}
    qd = np.linspace(-1.0, 1.0, 9)
    load = np.linspace(-3.0, 5.0, 9)
    top = 0.7
    names = {"qd": qd, "load": load, "top": top}
    for function in (np.sign, np.sqrt, abs, np.exp, np.tanh):
        names[function.__name__] = function
    for term, formula in formulas.items():
        column = eval(formula, names) * np.ones(9)
        expected = TERMS[term].of_state(np.sign(qd), qd, qd, load, top)
        assert_allclose(column, expected, rtol=1e-12)

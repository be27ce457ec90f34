"""All results of a run or none, and never beside another run's."""

from __future__ import annotations

import copy
import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid import export as module
from robot_sysid.errors import InputError
from robot_sysid.export import RESULT_NAMES, save
from robot_sysid.parser import load_robot_model
from robot_sysid.records import InertialParameters
from robot_sysid.results.record import Verdict
from tests.results.test_written_model import checkpoints, payload_of, result_of
from tests.support.command_line import files_in
from tests.support.model_files import ARM, random_theta, write_files

THETA = random_theta(np.random.default_rng(1), 2.0)
EARLIER = {name: f"an earlier {name}" for name in (*RESULT_NAMES, "report_data.npz")}
OTHERS = {
    "trajectory.json": "a plan",
    "trajectory.csv": "its samples",
    "notes.txt": "mine",
}


@pytest.fixture
def robot(tmp_path):
    return load_robot_model(write_files(tmp_path / "in", {"m.xml": ARM}), joint="j2")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def saved(robot, result, out, **options):
    return save(result, out, checkpoints(robot), **options)


def heavier(robot):
    return result_of(robot, robot.prior.theta + THETA)


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_whole_way_from_a_result(robot, out):
    found = saved(robot, heavier(robot), out)
    assert [path.name for path in found.files] == ["updated_model.xml", "params.json"]
    assert (found.notes, found.damiao, found.failure) == ((), None, None)
    again = load_robot_model(found.files[0], joint="j2")
    np.testing.assert_allclose(
        again.prior.theta, robot.prior.theta + THETA, rtol=0, atol=1e-12
    )
    assert "RMSE 0.000100 Nm" in found.files[0].read_text()
    content = json.loads(found.files[1].read_text())
    assert content["mass"] == robot.prior.mass + 2.0
    assert found.result_hash == hashlib.sha256(found.files[1].read_bytes()).hexdigest()


def test_a_payload_has_a_card_beside_the_model(robot, out):
    payload = payload_of(robot, THETA)
    found = saved(robot, result_of(robot, payload=payload), out, as_body="load")
    assert names_in(out) == ["params.json", "payload_card.txt", "updated_model.xml"]
    model = load_robot_model(out / "updated_model.xml", joint="j2").mj_model
    assert model.body("load").mass == pytest.approx(2.0, rel=1e-12)
    card = (out / "payload_card.txt").read_text()
    assert card.startswith(
        "Payload of 2.00000 ± 0.00010 kg, identified with m.xml from 1 empty and 2"
    )
    assert json.loads((out / "params.json").read_text())["payload"]["cards"]
    assert found.failure is None


def test_torques_that_were_weighed_with_a_known_mass_go_into_no_model(robot, out):
    payload = replace(payload_of(robot, THETA), known_mass=2.0)
    assert saved(robot, result_of(robot, payload=payload), out).failure is None
    assert names_in(out) == ["params.json"]


@pytest.mark.parametrize("with_payload", [False, True])
def test_a_result_that_is_not_trusted_gets_a_params_json_alone(
    robot, out, with_payload
):
    payload = payload_of(robot, THETA) if with_payload else None
    doubtful = result_of(
        robot, payload=payload, verdict=Verdict.TOO_WEAK, reasons=("so light",)
    )
    found = saved(robot, doubtful, out)
    assert names_in(out) == ["params.json"]
    what = "no model and no card were" if with_payload else "no model was"
    assert found.failure.startswith(
        f"{what} written: so light; {Verdict.TOO_WEAK.value[:30]}"
    )


def test_a_file_that_is_not_the_model_in_memory_gets_no_new_model(robot, out):
    other = copy.copy(robot.mj_model)
    other.body_mass[robot.body_id - 1] *= 1.5
    changed = replace(
        robot, mj_model=other, prior=InertialParameters(robot.prior.theta)
    )
    found = saved(changed, heavier(changed), out)
    assert "differs from the original in body_mass" in found.failure
    assert names_in(out) == ["params.json"]


def test_the_motor_trajectory_stands_beside_the_others_or_nothing_does(robot, out):
    def broken(file):
        file.write("half a file")
        raise InputError("no such motor")

    with pytest.raises(InputError, match="no such motor"):
        saved(robot, heavier(robot), out, motor_file=broken)
    assert not out.exists()
    found = saved(robot, heavier(robot), out, motor_file=lambda file: "a report")
    names = ["updated_model.xml", "damiao_trajectory.csv", "params.json"]
    assert [path.name for path in found.files] == names and found.damiao == "a report"
    assert names_in(out) == sorted(names)


def test_no_result_of_an_earlier_run_stays_and_nothing_else_goes(robot, out):
    write_files(
        out, {**EARLIER, **OTHERS, "bundle/m.xml": "sent", "params.json.bak": "mine"}
    )
    found = saved(robot, heavier(robot), out)
    new = {"updated_model.xml", "params.json"}
    assert set(names_in(out)) == new | set(OTHERS) | {"bundle", "params.json.bak"}
    assert (out / "bundle" / "m.xml").read_text() == "sent"
    assert all((out / name).read_text() == text for name, text in OTHERS.items())
    assert all("an earlier" not in (out / name).read_text() for name in new)
    gone = sorted(set(RESULT_NAMES) - new)
    assert sorted(found.notes) == [
        f"{out / name} of an earlier run was removed" for name in gone
    ]


@pytest.mark.parametrize("case", ["not trusted", "does not fit", "refused"])
def test_an_old_model_goes_also_where_this_run_writes_none(robot, out, case):
    write_files(out, EARLIER)
    result = heavier(robot)
    options = {}
    if case == "not trusted":
        result = replace(result, verdict=Verdict.TOO_WEAK)
    elif case == "does not fit":
        result = result_of(robot, -robot.prior.theta)
    else:
        options = {"refused": "played worse"}
    found = saved(robot, result, out, **options)
    assert (
        names_in(out) == ["params.json"] and len(found.notes) == len(RESULT_NAMES) - 1
    )
    assert ("not a possible rigid body" in found.failure) == (case == "does not fit")
    assert (
        json.loads((out / "params.json").read_text())["mass"]
        == result.estimate.inertial.mass
    )


def test_what_this_run_reads_stays_whatever_it_is_called(robot, out):
    log = "report_data.npz"
    text = '<mujoco><include file="servo.json"/><worldbody/></mujoco>'
    write_files(
        out,
        {
            "updated_model.xml": text,
            "servo.json": ARM,
            log: "a log",
            "payload_card.txt": "",
        },
    )
    own = load_robot_model(out / "updated_model.xml", joint="j2")
    (out / "link").symlink_to(out, target_is_directory=True)
    found = saved(own, heavier(own), out / "link", refused="no", inputs=[out / log])
    kept = ["link", "params.json", log, "servo.json", "updated_model.xml"]
    assert (
        names_in(out) == kept
        and len(found.notes) == 1
        and "payload_card.txt" in found.notes[0]
    )


def test_a_run_that_ends_with_an_error_leaves_the_old_set(robot, out, monkeypatch):
    write_files(out, {**EARLIER, **OTHERS})
    before = files_in(out)

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, "payload_cards", interrupted)
        with pytest.raises(KeyboardInterrupt):
            saved(robot, result_of(robot, payload=payload_of(robot, THETA)), out)
    assert files_in(out) == before

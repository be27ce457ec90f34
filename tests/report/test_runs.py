"""Folders of earlier runs: older, damaged, of another run, without their torques."""

from __future__ import annotations

import json
import re
import shutil

import pytest

from robot_sysid.errors import InputError
from robot_sysid.report.page import sections_of
from robot_sysid.report.runs import load_run
from robot_sysid.report.sections.verdict import next_steps
from robot_sysid.results.record import PAYLOAD, Verdict
from tests.support.reports import payload_result, saved


@pytest.fixture
def folder(link_run, tmp_path):
    shutil.copytree(link_run, tmp_path / "run")
    return tmp_path / "run"


def changed(folder, **values):
    path = folder / "params.json"
    content = {**json.loads(path.read_text()), **values}
    path.write_text(json.dumps({k: v for k, v in content.items() if v != "gone"}))


def parts_of(folder):
    return {part.key: part for part in sections_of(load_run(folder))}


def missing_in(folder):
    return " ".join(line for part in parts_of(folder).values() for line in part.missing)


def test_a_run_is_read_as_it_was_written(link_run):
    run = load_run(link_run)
    written = json.loads((link_run / "params.json").read_text())
    body, *others = run.bodies()
    assert run.trustworthy and run.missing == () and body.after[0] == written["mass"]
    assert [each.title for each in others] == ["link0", "link1"]
    assert body.title == written["body_name"]
    thetas = body.thetas
    assert thetas["truth"][0] == thetas["before"][0] == pytest.approx(body.after[0] / 1.05)
    assert thetas["in the file"][0] == pytest.approx(1.04 * thetas["truth"][0])
    assert body.errors[0] == written["standard_errors"]["m"]
    assert {"noise", "torque scale"} <= set(body.budget) and body.kept[8] and not body.kept[0]
    assert {(joint, term) for joint, term, *_ in run.friction()} >= {("joint0", "viscous")}
    assert ("joint0", "coulomb", 0.3, 0.01) in run.friction("in_the_file")


def test_the_verdict_and_the_errors_tell_the_same_of_the_written_file(folder):
    parts = parts_of(folder)
    said = " ".join(parts["verdict"].sentences)
    assert "Torque error of the model on held-out data: 12 % -> 3.4 %." in said
    (figure,) = parts["errors"].figures
    told = {row[0]: row[2] for row in figure.table.rows}
    assert told["model before: 20 % of the log, not fitted"] == "12 %"
    assert told["written model: 20 % of the log, not fitted"] == "3.4 %"
    assert list(told)[0] == "fitted" and list(told)[-1] == "written model: other <b>log</b>.csv"
    assert "Nothing was held out" not in str(parts["errors"].sentences)


def test_without_a_file_and_a_validation_nothing_was_held_out(folder):
    changed(folder, file=None, validation=[])
    parts = parts_of(folder)
    assert "Nothing was held out" in parts["errors"].sentences[0]
    assert "Torque error of the model" not in " ".join(parts["verdict"].sentences)


def test_a_model_that_was_not_written_has_no_error_after(folder):
    file = json.loads((folder / "params.json").read_text())["file"]
    file["torque_error"]["after"] = file["after"] = None
    changed(folder, file=file)
    said = " ".join(parts_of(folder)["verdict"].sentences)
    assert "12 % -> not known, no model was written" in said


def test_a_model_of_its_own_simulation_has_one_body(folder):
    own = {"source": "simulation of the model itself", "links": [], "file": None, "joints": {}}
    changed(folder, **own, standard_errors=None, validation=[])
    (body,) = load_run(folder).bodies()
    parts = parts_of(folder)
    assert "before" not in body.thetas and not missing_in(folder).count("cannot be shown")
    assert "had to come back" in " ".join(parts["verdict"].sentences)
    assert "simulated the model itself" in parts["next"].points[0]


def test_an_editor_may_have_changed_line_ends_and_added_a_mark(folder):
    result = folder / "params.json"
    before = load_run(folder).content
    result.write_bytes(b"\xef\xbb\xbf" + result.read_bytes().replace(b"\n", b"\r\n"))
    assert load_run(folder).content == before


def test_a_model_that_an_earlier_run_left_is_not_to_be_loaded(folder):
    """A run whose model could not be written leaves the one that was there."""
    assert "Load updated_model.xml in place of the model." in next_steps(load_run(folder)).points
    model = folder / "updated_model.xml"
    model.write_text(re.sub(r"RMSE [\d.]+ Nm", "RMSE 0.123456 Nm", model.read_text()))
    (said,) = [p for p in next_steps(load_run(folder)).points if "updated_model.xml" in p]
    assert said.startswith("Do not load updated_model.xml: it is from another run")


def test_torques_of_another_run_are_not_drawn(folder):
    changed(folder, notes=[])
    run = load_run(folder)
    assert run.data is None and "belongs to another run" in run.missing[0]
    assert "identify again" in missing_in(folder)


@pytest.mark.parametrize("version", [1, 3, 5, None, "4", "x" * 1000])
def test_a_file_of_another_version_is_one_line(folder, version):
    changed(folder, schema_version=version)
    with pytest.raises(InputError, match="this program reads 4; identify again") as caught:
        load_run(folder)
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "odd",
    [
        {"validation": 3},
        {"file": {"torque_error": 3, "before": 7, "others": [1, {"before": 2}]}},
        {"joints": {"joint0": 7}},
        {"joints": {"joint0": {"terms": {"coulomb": 7}}}},
        {"sensors": {"delay": "much"}, "base_parameters": 3},
        {"rmse_per_joint": {"joint0": "much"}},
        {"model": {"path": 7, "sha256": None}},
        {"rollout": {"errors": [{"joints": {"a": 1}}]}},
        {"notes": {"a": 1}, "reasons": "text"},
    ],
)
def test_an_odd_entry_costs_its_own_part_only(folder, odd):
    changed(folder, **odd)
    parts = sections_of(load_run(folder))
    shown = [part for part in parts if not any("cannot be shown" in m for m in part.missing)]
    assert len(shown) >= len(parts) - 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "cannot read"),
        ("[]", "no result of this program"),
        ("{}", "schema_version None"),
        ('{"schema_version": 4}', "damaged"),
        ('{"schema_version": 4, "question": "payload"}', "damaged"),
        ('{"schema_version": 4, "mass": 1, "center_of_mass_moment": [1]}', "damaged"),
        ("[" * 100_000, "cannot read"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path, text, words):
    (tmp_path / "params.json").write_text(text)
    with pytest.raises(InputError, match=words):
        load_run(tmp_path)


def test_a_mass_that_is_no_number_is_damage(folder):
    changed(folder, mass=None, links=[])
    with pytest.raises(InputError, match="not a number"):
        load_run(folder)


def test_a_folder_without_a_result_says_what_to_give(tmp_path):
    (tmp_path / "arm.json").write_text("{}")
    for place in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=r"holds no result.*identify again .* arm\.json"):
            load_run(place)


def test_a_payload_has_its_card(link_run, tmp_path):
    run = load_run(saved(tmp_path, payload_result(link_run.parent / "arm.xml")))
    parts = parts_of(tmp_path)
    assert run.question == PAYLOAD and any("setLoad" in name for name, _ in parts["card"].blocks)
    titles = ["payload", "link without payload", "link with payload"]
    assert [body.title for body in run.bodies()] == titles
    assert parts["card"].tables[0].rows == (("$x^{1}&", "1.100 ± 0.010"),)
    assert "there is no" in parts["verdict"].missing[0]
    assert sum("Mass of" in words for words in parts["verdict"].sentences) == 3


def test_what_was_played_is_shown(folder):
    part = parts_of(folder)["rollout"]
    assert len(part.figures) == 2 and part.points == ("a note",)
    assert "0.5 times" in " ".join(part.sentences)
    assert ("joint0", "0.02", "0.01") in part.figures[0].table.rows


def test_a_refused_payload_has_no_card(link_run, tmp_path):
    saved(tmp_path, payload_result(link_run.parent / "arm.xml", Verdict.SWAPPED))
    parts = parts_of(tmp_path)
    assert parts["verdict"].verdict == "bad" and "no card" in parts["card"].missing[0]

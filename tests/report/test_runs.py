"""Folders of earlier runs: older, damaged, of another run, without their torques."""

from __future__ import annotations

import json
import re
import shutil

import pytest

from robot_sysid.errors import InputError
from robot_sysid.output.cards import payload_cards
from robot_sysid.output.payload_json import payload_json_text
from robot_sysid.report.page import sections_of
from robot_sysid.report.runs import PAYLOAD, load_run
from robot_sysid.report.sections.verdict import next_steps
from tests.support import payload_results


@pytest.fixture
def folder(link_run, tmp_path):
    shutil.copytree(link_run, tmp_path / "run")
    return tmp_path / "run"


def changed(folder, **values):
    path = folder / "params.json"
    content = {**json.loads(path.read_text()), **values}
    path.write_text(json.dumps({k: v for k, v in content.items() if v != "gone"}))


def missing_in(folder):
    return " ".join(line for part in sections_of(load_run(folder)) for line in part.missing)


def test_a_run_is_read_as_it_was_written(link_run):
    run = load_run(link_run)
    written = json.loads((link_run / "params.json").read_text())
    (body,) = run.bodies()
    assert run.trustworthy and run.missing == () and body.after[0] == written["mass"]
    assert body.truth[0] == pytest.approx(written["prior"]["mass"])
    assert body.errors[0] == written["standard_errors"]["m"]
    assert {term for _, term, *_ in run.friction()} >= {"coulomb", "viscous"}


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


def test_an_older_file_is_shown_as_far_as_it_goes(folder):
    gone = ("standard_errors", "error_budget", "data_share", "prior", "validation", "limitations")
    changed(folder, schema_version=1, **dict.fromkeys(gone, "gone"))
    said = missing_in(folder)
    assert "schema 1" in said and "cannot be shown" not in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "odd",
    [
        {"validation": 3},
        {"error_budget": {"m": 5}},
        {"friction_per_joint": {"joint0": 7}},
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
        ("{}", "damaged"),
        ('{"mass": 1, "center_of_mass_moment": [1, 2], "inertia_tensor": {}}', "damaged"),
        ("[" * 100_000, "cannot read"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path, text, words):
    (tmp_path / "params.json").write_text(text)
    with pytest.raises(InputError, match=words):
        load_run(tmp_path)


def test_a_mass_that_is_no_number_is_damage(folder):
    changed(folder, mass=None)
    with pytest.raises(InputError, match="not a number"):
        load_run(folder)


def test_a_folder_without_a_result_says_what_to_give(tmp_path):
    for place in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match="holds no result"):
            load_run(place)


def test_a_payload_has_its_card(tmp_path):
    found = payload_results.result()
    cards = payload_cards(found.payload.inertial, found.flange)
    (tmp_path / "params.json").write_text(payload_json_text(found, cards))
    run = load_run(tmp_path)
    parts = {part.key: part for part in sections_of(run)}
    assert run.kind == PAYLOAD and any("setLoad" in name for name, _ in parts["card"].blocks)
    assert [body.title for body in run.bodies()][0] == "payload"
    assert "there is no" in parts["verdict"].missing[0]


def test_what_was_played_is_shown(folder):
    figures = {"before": 0.02, "after": 0.01, "ratio": 0.5}
    one = {"loop": "open loop", "horizon": 0.3, "overall": figures, "joints": {"joint0": figures}}
    played = {"held_out": "the last fifth", "score": 0.5, "errors": [one], "notes": ["a note"]}
    changed(folder, rollout=played)
    part = {each.key: each for each in sections_of(load_run(folder))}["rollout"]
    assert len(part.figures) == 1 and part.points == ("a note",)
    assert "0.5 times" in " ".join(part.sentences)
    assert ("joint0", "0.02", "0.01") in part.figures[0].table.rows


def test_a_refused_payload_has_no_card(tmp_path):
    from robot_sysid.records.payload import PayloadStatus

    found = payload_results.result(PayloadStatus.SWAPPED)
    (tmp_path / "params.json").write_text(payload_json_text(found, ()))
    parts = {part.key: part for part in sections_of(load_run(tmp_path))}
    assert parts["verdict"].verdict == "bad" and "no card" in parts["card"].missing[0]

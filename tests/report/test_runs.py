"""What a run leaves for its report is small whatever the log and read back as it was; folders of
earlier runs may be older, damaged, of another run, without their torques.
"""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.records import JointLimits
from robot_sysid.records.data import Traces
from robot_sysid.report.page import sections_of
from robot_sysid.report.runs import (
    DATA_NAME,
    MOST,
    autocorrelation,
    by_speed,
    data_bytes,
    histogram,
    load_data,
    load_run,
    report_data,
)
from robot_sysid.report.sections.verdict import next_steps
from robot_sysid.results.record import PAYLOAD, Verdict
from tests.support.arms import SEEDS
from tests.support.reports import payload_result, saved


def traces(count=500, joints=2):
    rng = np.random.default_rng(0)
    table = rng.normal(size=(count, joints))
    measured = table.copy()
    measured[count // 2] = np.nan
    full = np.full(joints, np.inf)
    limits = JointLimits(-full, full, np.ones(joints), full)
    names, time = tuple(f"j{k}" for k in range(joints)), np.arange(count) * 0.01
    slides = (False,) * joints
    return Traces(names, slides, time, table, table, measured, 0.9 * table, table, table, limits)


def test_what_is_written_is_read(tmp_path):
    made = report_data(traces(), "hash")
    (tmp_path / DATA_NAME).write_bytes(data_bytes(made))
    again = load_data(tmp_path / DATA_NAME)
    for each in fields(made):
        ours, theirs = getattr(made, each.name), getattr(again, each.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs)
        else:
            assert ours == theirs
    assert data_bytes(made) == data_bytes(report_data(traces(), "hash"))


def test_a_huge_log_is_thinned_and_says_so():
    made = report_data(traces(50_000))
    assert len(made.time) == MOST and made.n_samples == 50_000
    assert made.drawn.startswith(f"drawn: {MOST} of 50000 instants")
    assert np.all(np.sum(made.counts, axis=1) == 49_999)
    assert len(data_bytes(made)) < 500_000
    assert report_data(traces(500)).drawn == ""


def test_logs_follow_one_another():
    two = traces(10)
    time = np.concatenate((two.time[:5], two.time[:5]))
    made = report_data(Traces(**{**vars(two), "time": time}))
    assert np.all(np.diff(made.time) > 0.0)


def _spoiled(tmp_path, **changes):
    content = dict(np.load((tmp_path / "good.npz"), allow_pickle=False))
    content.update(changes)
    np.savez(tmp_path / DATA_NAME, **{k: v for k, v in content.items() if v is not None})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": np.array(99)}, "another version"),
        ({"version": None}, "another version"),
        ({"measured": None}, "damaged"),
        ({"measured": np.zeros((3, 7))}, "damaged"),
        ({"truth": np.zeros(3)}, "damaged"),
        ({"q": np.array(["a"])}, "damaged"),
        ({"q": np.array([{}], dtype=object)}, "cannot read"),
    ],
)
def test_a_file_that_is_not_ours_is_refused(tmp_path, changes, words):
    (tmp_path / "good.npz").write_bytes(data_bytes(report_data(traces())))
    _spoiled(tmp_path, **changes)
    with pytest.raises(InputError, match=words):
        load_data(tmp_path / DATA_NAME)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 cut"])
def test_what_is_no_archive_is_refused(tmp_path, content):
    (tmp_path / DATA_NAME).write_bytes(content)
    with pytest.raises(InputError, match="identify again"):
        load_data(tmp_path / DATA_NAME)


def test_a_missing_file_says_what_would_write_it(tmp_path):
    with pytest.raises(InputError, match="there is no .*identify again"):
        load_data(tmp_path / DATA_NAME)


@pytest.mark.parametrize(("place", "value"), [(8, 99), (60, 0xFF)])
def test_a_file_whose_packing_is_broken_is_refused(tmp_path, place, value):
    """Another method of compression in its heads, or bytes in the middle that are none of it."""
    content = bytearray(data_bytes(report_data(traces())))
    if place == 8:
        central = content.index(b"PK\x01\x02")
        content[place] = content[central + 10] = value
    else:
        content[place : place + 40] = bytes([value]) * 40
    (tmp_path / DATA_NAME).write_bytes(content)
    with pytest.raises(InputError, match="cannot read .*identify again"):
        load_data(tmp_path / DATA_NAME)


@given(seed=SEEDS, count=st.integers(1, 300), missing=st.floats(0.0, 1.0))
def test_every_sample_in_use_is_counted_once(seed, count, missing):
    rng = np.random.default_rng(seed)
    residual = rng.standard_t(2.0, (count, 2))
    residual[rng.random((count, 2)) < missing] = np.nan
    edges, counts = histogram(residual).values()
    np.testing.assert_array_equal(np.sum(counts, axis=1), np.sum(np.isfinite(residual), axis=0))
    assert np.all(np.diff(edges, axis=1) > 0.0)


@given(seed=SEEDS)
def test_noise_without_memory_stays_in_its_band(seed):
    noise = np.random.default_rng(seed).normal(size=(2000, 2))
    noise[100:140, 0] = np.nan
    lags, found, band = autocorrelation(np.arange(2000) * 0.01, noise).values()
    np.testing.assert_allclose(found[:, 0], 1.0)
    assert np.mean(np.abs(found[:, 1:]) > band[:, None]) < 0.2
    assert lags[0] == 0.0 and lags[-1] <= 2.0


def test_slow_residuals_have_the_memory_that_they_have():
    rng, slow = np.random.default_rng(0), np.zeros((20000, 1))
    for k in range(1, len(slow)):
        slow[k] = 0.9 * slow[k - 1] + rng.normal()
    lags, found, _ = autocorrelation(np.arange(20000) * 0.1, slow).values()
    np.testing.assert_allclose(found[0], 0.9 ** (lags / 0.1), atol=0.05)


def test_means_by_speed_are_those_of_the_samples_in_use():
    qd = np.linspace(-2.0, 2.0, 4001)[:, None]
    torque = 3.0 * qd + 1.0
    torque[qd > 1.0] = np.nan
    speed, mean, spread, *_ = by_speed(qd, torque, qd).values()
    known = np.isfinite(speed)
    np.testing.assert_allclose(mean[known], 3.0 * speed[known] + 1.0, atol=1e-9)
    assert np.nanmax(speed) <= 1.0 and np.all(spread[known] < 0.3)


def test_nothing_at_all_is_no_reason_to_fail():
    nothing = np.full((3, 1), np.nan)
    histogram(nothing)
    autocorrelation(np.zeros(3), nothing)
    assert np.all(np.isnan(by_speed(nothing, nothing, nothing)["speed"]))


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

"""What a run leaves for its report is small whatever the log and read back as it was; folders of
earlier runs may be older, damaged, of another run, without their torques.
"""

from __future__ import annotations

import io
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.errors import InputError
from robot_sysid.records import JointLimits
from robot_sysid.records.data import Traces
from robot_sysid.report.body_sections import card, parameters, visibility
from robot_sysid.report.joint_sections import errors, rollout, torque_figure
from robot_sysid.report.page import compare_bodies, compare_errors, sections_of, verdict
from robot_sysid.report.runs import (
    DATA_NAME,
    MAX_INSTANTS,
    autocorrelation,
    data_bytes,
    histogram,
    load_data,
    load_run,
    means_by_speed,
    report_data,
)
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.record import Verdict
from tests.support import results as made
from tests.support.arms import SEEDS
from tests.support.reports import ODD, payload_result, saved


def traces(count=500):
    """Random signals of two joints at 100 Hz, with one missing torque sample."""
    table = np.random.default_rng(0).normal(size=(count, 2))
    measured = table.copy()
    measured[count // 2] = np.nan
    infinite = np.full(2, np.inf)
    limits = JointLimits(-infinite, infinite, np.ones(2), infinite)
    time = np.arange(count) * 0.01
    columns = (table, table, measured, 0.9 * table, table, table)
    return Traces(("j0", "j1"), (False, False), time, *columns, limits)


def test_report_data_is_read_as_it_was_written(tmp_path):
    data = report_data(traces(), "hash")
    (tmp_path / DATA_NAME).write_bytes(data_bytes(data))
    loaded = load_data(tmp_path / DATA_NAME)
    for name, expected in vars(data).items():
        assert_array_equal(getattr(loaded, name), expected)
    assert data_bytes(data) == data_bytes(report_data(traces(), "hash"))


def test_a_huge_log_is_thinned_and_says_so():
    data = report_data(traces(20_000))
    assert len(data.time) == MAX_INSTANTS and data.n_samples == 20_000
    assert data.thinning_text.startswith(f"drawn: {MAX_INSTANTS} of 20000 instants")
    assert np.all(np.sum(data.counts, axis=1) == 19_999)
    assert len(data_bytes(data)) < 500_000
    assert report_data(traces(500)).thinning_text == ""


def test_times_of_several_logs_follow_one_another():
    log = traces(10)
    time = np.concatenate((log.time[:5], log.time[:5]))
    data = report_data(Traces(**{**vars(log), "time": time}))
    assert np.all(np.diff(data.time) > 0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": np.array(99)}, "another version"),
        ({"version": None}, "another version"),
        ({"measured": None}, "cannot read"),
        ({"measured": np.zeros((3, 7))}, "measured has shape"),
        ({"q": np.array(["a"])}, "cannot read"),
        ({"q": np.array([{}], dtype=object)}, "cannot read"),
    ],
)
def test_report_data_of_another_version_or_shape_is_refused(tmp_path, changes, message):
    arrays = dict(np.load(io.BytesIO(data_bytes(report_data(traces())))))
    for name, array in changes.items():
        arrays[name] = array
        if array is None:
            del arrays[name]
    np.savez(tmp_path / DATA_NAME, **arrays)
    with pytest.raises(InputError, match=f"{message}.*identify again"):
        load_data(tmp_path / DATA_NAME)


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04 cut"])
def test_a_missing_or_damaged_archive_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / DATA_NAME).write_bytes(content)
    with pytest.raises(InputError, match="identify again"):
        load_data(tmp_path / DATA_NAME)


@given(seed=SEEDS, count=st.integers(1, 300), missing=st.floats(0.0, 1.0))
def test_the_histogram_counts_every_residual_once(seed, count, missing):
    rng = np.random.default_rng(seed)
    residual = rng.standard_t(2.0, (count, 2))
    residual[rng.random((count, 2)) < missing] = np.nan
    edges, counts = histogram(residual).values()
    assert_array_equal(np.sum(counts, axis=1), np.sum(np.isfinite(residual), axis=0))
    assert np.all(np.diff(edges, axis=1) > 0.0)


@given(seed=SEEDS)
def test_the_autocorrelation_skips_missing_residuals(seed):
    noise = np.random.default_rng(seed).normal(size=(300, 2))
    noise[40:90, 0] = np.nan
    noise[:, 1] = np.nan
    lags, correlation, band = autocorrelation(np.arange(300) * 0.1, noise).values()
    assert lags[0] == 0.0 and lags[-1] <= 2.0
    power = np.nanmean(noise[:, 0] ** 2)
    for lag, value in zip(np.rint(lags / 0.1).astype(int), correlation[0]):
        mean = np.nanmean(noise[: 300 - lag, 0] * noise[lag:, 0])
        assert value == pytest.approx(mean / power, abs=1e-12)
    assert np.all(correlation[1] == 0.0) and band[0] == pytest.approx(
        1.96 / np.sqrt(250)
    )


def test_means_by_speed_skip_missing_torques():
    qd = np.linspace(-2.0, 2.0, 4001)[:, None]
    torque = 3.0 * qd + 1.0
    torque[qd > 1.0] = np.nan
    speed, measured, predicted = means_by_speed(qd, torque, qd).values()
    in_use = np.isfinite(speed)
    assert_allclose(measured[in_use], 4.0 * speed[in_use] + 1.0, atol=1e-9)
    assert_allclose(predicted[in_use], speed[in_use], atol=1e-9)
    assert np.nanmax(speed) <= 1.0
    no_samples = np.full((3, 1), np.nan)
    means = means_by_speed(no_samples, no_samples, no_samples)
    assert np.all(np.isnan(means["speed"]))


@pytest.fixture
def folder(link_run, tmp_path):
    """A copy of a run's folder, which a test may change."""
    shutil.copytree(link_run, tmp_path / "run")
    return tmp_path / "run"


def run_with_changes(folder, **values):
    """The run of a folder after some keys of its params.json have got other values."""
    path = folder / "params.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))
    return load_run(folder)


def test_a_run_is_read_as_it_was_written(link_run):
    run = load_run(link_run)
    content = json.loads((link_run / "params.json").read_text())
    body, *others = run.bodies
    assert run.content["valid"]["trustworthy"] and run.missing == ()
    assert body.identified[0] == content["mass"]
    assert [other.title for other in others] == ["link5"] and body.title == content[
        "body_name"
    ]
    thetas = body.thetas
    assert (
        thetas["truth"][0]
        == thetas["before"][0]
        == pytest.approx(0.5 * body.identified[0])
    )
    assert thetas["in the file"][0] == pytest.approx(0.9 * body.identified[0])
    assert body.errors[0] == content["standard_errors"]["m"]
    assert {"noise", "links"} == set(body.budget)
    assert body.is_from_model[8] and not body.is_from_model[0]
    assert run.friction("in_the_file")["j5"]["coulomb"] == (0.45, 0.01)
    assert np.isnan(run.content["sensors"]["zero[j6]"].error)


def test_the_verdict_and_the_errors_state_the_same_torque_error(folder):
    run = load_run(folder)
    section = verdict(run)
    assert (
        section.sentences == run.content["verdict"]
        and "27 % -> 0.25 %" in section.sentences[0]
    )
    assert len(section.figures) == 1
    totals, _ = errors(run).tables
    percentages = {row[:2]: row[3] for row in totals.rows}
    assert percentages["fifths of arm.csv", "model before"] == "27 %"
    assert percentages["fifths of arm.csv", "written model"] == "0.25 %"
    assert list(percentages)[0] == ("the fitted logs", "fit")
    assert list(percentages)[-1] == (ODD, "written model")
    played = rollout(run)
    assert "0.5 times" in " ".join(played.sentences)
    (table,) = played.tables
    assert table.rows[0][table.header.index("j5")] == "0.2 -> 0.02"
    held_out = replace(run, content={**run.content, "rmse_per_joint": {}})
    assert len(errors(held_out).sentences) == 1
    no_file = run_with_changes(folder, file=None, validation=[])
    assert "Nothing was held out" in errors(no_file).sentences[1]


def test_a_model_of_its_own_simulation_has_one_body(folder):
    source = "simulation of the model itself"
    absent = dict.fromkeys(("file", "standard_errors", "rollout"))
    absent |= {"links": [], "joints": {}, "validation": []}
    run = run_with_changes(folder, source=source, **absent)
    (body,) = run.bodies
    section, *_ = sections_of([run])
    assert "before" not in body.thetas
    assert section.figures == ()
    # Its errors are those of rounding, and are not stated.
    numbers, *_ = parameters(run).tables
    sources, *_ = visibility(run).tables
    assert {row[-1] for row in (*numbers.rows, *sources.rows)} == {"–"}
    (_, origin), *_ = section.details
    assert not any("Root mean square" in sentence for sentence in origin)


def test_residuals_and_errors_of_rounding_are_zero(folder):
    run = load_run(folder)
    data = replace(run.data, predicted=run.data.measured * (1.0 + 1e-15))
    caption = torque_figure(data, 0).caption
    assert "0 N·m after" in caption and "e-" not in caption
    tiny = {"rmse": 2e-14, "rmse_per_joint": {"j5": 3e-15}}
    totals, by_joint = errors(replace(run, content={**run.content, **tiny})).tables
    assert totals.rows[0][2] == by_joint.rows[0][1] == "0"


def test_of_several_models_in_the_folder_the_runs_own_is_to_be_loaded(folder):
    """A run that reads its model from its own output folder leaves two models there."""
    model = folder / "updated_model.xml"
    other = re.sub(r"RMSE [\d.]+ Nm", "RMSE 0.123456 Nm", model.read_text())
    (folder / "updated_model.urdf").write_text(other)
    (sentence,) = verdict(load_run(folder)).points
    assert sentence.startswith("Do not load updated_model.urdf: it is from another run")
    # The newest file is no better for being the newest.
    (folder / "updated_model.urdf").write_text(model.read_text())
    model.write_text(other)
    (sentence,) = verdict(load_run(folder)).points
    assert sentence.startswith("Do not load updated_model.xml")


def test_torques_of_another_run_are_not_drawn(folder):
    run = run_with_changes(folder, notes=[])
    assert run.data is None and "belongs to another run" in run.missing[0]
    assert run.missing[0] in verdict(run).missing and errors(run).figures


@pytest.mark.parametrize("version", [3, None, "x" * 1000])
def test_a_result_of_another_version_is_refused_in_one_line(folder, version):
    with pytest.raises(
        InputError, match="this program reads 4; identify again"
    ) as caught:
        run_with_changes(folder, schema_version=version)
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)


@pytest.mark.parametrize("odd", [{"sensors": "much"}, {"joints": {"j5": 7}}])
def test_a_result_with_an_entry_of_another_type_is_refused(folder, odd):
    with pytest.raises(InputError, match="a result cannot be shown"):
        sections_of([run_with_changes(folder, **odd)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot read"),
        ("[]", "no result of this program"),
        ("{}", "schema_version None"),
        ('{"schema_version": 4}', "damaged"),
        ('{"schema_version": 4, "mass": 1, "center_of_mass_moment": [1]}', "damaged"),
    ],
)
def test_a_damaged_result_is_refused(tmp_path, text, message):
    (tmp_path / "params.json").write_text(text)
    with pytest.raises(InputError, match=message):
        load_run(tmp_path)


def test_a_folder_without_a_result_says_what_to_give(tmp_path):
    with pytest.raises(
        InputError, match="holds no result: there is no params.json; give"
    ):
        load_run(tmp_path / "nowhere")


def test_a_payload_has_its_card_unless_it_is_refused(link_run, tmp_path):
    model = link_run.parent / "arm.xml"
    run = load_run(saved(tmp_path, payload_result(model)))
    section = card(run)
    ((_, _, text),) = section.blocks
    assert run.is_payload and text == (tmp_path / "payload_card.txt").read_text()
    titles = ["payload", "link without payload", "link with payload"]
    assert [body.title for body in run.bodies] == titles
    assert section.tables[0].rows == (("$x^{1}&", "1.100 ± 0.010"),)
    (numbers,) = verdict(run).tables
    assert numbers.rows[0][:3] == ("mass [kg]", "1.200", "0.010")
    assert verdict(run).verdict == "good"
    run = load_run(saved(tmp_path, payload_result(model, Verdict.SWAPPED)))
    assert verdict(run).verdict == "bad" and "no card" in card(run).missing[0]


def test_a_payload_whose_inertia_is_not_known_is_usable_and_says_so(link_run, tmp_path):
    result = payload_result(link_run.parent / "arm.xml")
    body = made.body(shown=False)
    result = replace(result, payload=replace(result.payload, body=body))
    run = load_run(saved(tmp_path, result))
    summary = verdict(run)
    section = visibility(run)
    assert summary.verdict == "good" and NOT_KNOWN in section.sentences
    assert "torques: the payload's inertia" in section.sentences[-1]
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows["Izz"][::2] == ("not known", "not known") and rows["m"][0] == "the data"


def test_a_comparison_has_the_error_table_of_each_run(link_run):
    run = load_run(link_run)
    runs = [replace(run, folder=run.folder.parent / f"run{k}") for k in range(5)]
    single, _ = errors(run).tables
    tables = compare_errors(runs).tables
    assert [table.title for table in tables] == [f"run{k}" for k in range(5)]
    for table in tables:
        assert (table.header, table.rows) == (single.header, single.rows)


def test_the_limits_explain_the_largest_cause_of_the_error_of_the_mass(folder):
    run = run_with_changes(folder, limitations=["friction changes from day to day"])
    body = replace(
        run.bodies[0], budget={"noise": np.ones(10), "links": 2.0 * np.ones(10)}
    )
    _, (_, sentences), _ = verdict(replace(run, bodies=[body])).details
    assert "comes from links: uncertainty of the other links" in sentences[-2]
    assert sentences[-1] == "friction changes from day to day"
    unknown = replace(body, budget={})
    _, (_, sentences), _ = verdict(replace(run, bodies=[unknown])).details
    assert not any("comes from" in sentence for sentence in sentences)


def test_amber_is_the_colour_of_a_caveat_and_red_of_what_is_not_usable(folder):
    colours = {}
    for status in ("BETTER", "AS_GOOD", "PARTLY_FROM_MODEL", "TORQUES_ONLY"):
        run = run_with_changes(folder, status=status)
        colours[status] = verdict(run).verdict
    assert list(colours.values()) == ["good", "good", "good", "part"]
    refused = ["Not usable: no model was written: the rollout is no better"]
    section = verdict(run_with_changes(folder, verdict=refused))
    assert section.verdict == "bad" and not section.tables


def test_runs_are_compared_in_the_bodies_that_they_share(link_run):
    """Bodies are compared by name: the terminal link of another joint is another body."""
    run = load_run(link_run)
    other = replace(run, folder=run.folder.parent / "other", bodies=run.bodies[::-1])
    tables = compare_bodies([run, other]).tables
    assert [table.header[0] for table in tables] == ["link6", "link5"]
    for table in tables:
        assert all(one == another for _, one, another in table.rows)
    alone = replace(other, bodies=[replace(run.bodies[0], title="tool")])
    comparison = compare_bodies([run, alone])
    assert not comparison.tables and "no body in common" in comparison.sentences[0]

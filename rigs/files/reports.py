"""Made-up runs of a small arm whose logs' names are markup and formulas, and the pages of them."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.files import results as made
from robot_sysid.parser import load_robot_model
from robot_sysid.records import DataOrigin
from robot_sysid.records.data import Traces
from robot_sysid.records.file_access import REPORT_NAME, json_text
from robot_sysid.report.page import write_report
from robot_sysid.report.runs import load_run, save_data
from robot_sysid.results.cards import card_text, number_groups
from robot_sysid.results.content import content_of
from robot_sysid.results.lines import verdict_lines
from robot_sysid.results.verdicts import Verdict

ODD = "other <script>alert(1)</script> $x^{1}& 関節.csv"
NAMED = {"link0": "link5", "link1": "link6", "joint0": "j5", "joint1": "j6"}


def arm_text():
    """An arm with the names of made-up results."""
    joint = 'range="-2 2" frictionloss=".3" damping=".2" armature=".05"'
    text = small_arms.serial_arm((small_arms.Z, small_arms.Y), joint=joint)
    for name, other in NAMED.items():
        text = text.replace(f'name="{name}"', f'name="{other}"')
    return text


def on_arm(result, path):
    """A made-up result as one about the arm in a file."""
    data = DataOrigin("log <u>log</u>.csv", 6.0, 100.0)
    return replace(result, robot=load_robot_model(path), data=data)


def link_result(path):
    """A result about every link of the arm in a file."""
    result = made.whole()
    (other,) = result.file.others
    odd = (
        replace(validation, source=ODD)
        for pair in (other, other.as_used)
        for validation in (pair.before, pair.after)
    )
    errors = (result.file.held_out, made.errors_from(*odd))
    file = replace(result.file, errors=errors)
    return on_arm(replace(result, file=file), path)


def payload_result(path, verdict=Verdict.OK):
    """A result about a payload on that arm."""
    scales = {"$x^{1}&": 1.1}
    recordings = {"empty": ("a.csv",), "loaded": ("<s>b</s>.csv", "c.csv")}
    options = {
        "torque_scale": scales.items(),
        "recordings": recordings,
        "verdict": verdict,
    }
    return on_arm(made.payload(**options), path)


def traces(count=500):
    """Random signals of two joints at 100 Hz, with one missing torque sample."""
    table = np.random.default_rng(0).normal(size=(count, 2))
    measured = table.copy()
    measured[count // 2] = np.nan
    time = np.arange(count) * 0.01
    columns = (table, measured, 0.9 * table, table, table)
    return Traces(made.JOINTS, (False, True), time, *columns)


def fingerprint(folder):
    """The hash of the result in a folder."""
    return hashlib.sha256((folder / "params.json").read_bytes()).hexdigest()


def saved(folder, result):
    """A folder that a run left, without its report."""
    folder.mkdir(parents=True, exist_ok=True)
    payload = result.payload
    card = None
    if payload is not None and result.verdict.is_trustworthy:
        card = number_groups(payload)
        text = card_text(payload, card, result.robot)
        (folder / "payload_card.txt").write_text(text, encoding="utf-8")
    content = content_of(result, card)
    text = json_text({**content, "verdict": [*verdict_lines(content)]})
    (folder / "params.json").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def link_run(tmp_path_factory):
    """The folder of a run on a log of an arm whose truth is known."""
    folder = tmp_path_factory.mktemp("link")
    model = folder / "arm.xml"
    model.write_text(arm_text(), encoding="utf-8")
    result = link_result(model)
    run = saved(folder / "link", result)
    save_data(run, traces(), fingerprint(run))
    comment = "<!-- System ID: body 'x' identified with RMSE 0.030000 Nm -->"
    (run / "updated_model.xml").write_text(comment + arm_text(), encoding="utf-8")
    return run


@pytest.fixture(scope="session")
def page(link_run):
    """The page about it."""
    path = write_report([load_run(link_run)], link_run)
    assert path.name == REPORT_NAME
    return path

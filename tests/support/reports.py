"""Runs of small arms whose names are markup and formulas, and the pages about them."""

from __future__ import annotations

import pytest

from robot_sysid.cli import main
from robot_sysid.output.cards import payload_cards
from robot_sysid.output.payload_json import payload_json_text
from robot_sysid.report.write import REPORT_NAME, write_report
from tests.support import arms, payload_results

LONG = "関節 with a very long name that goes on and on and on"
NAMED = {"link2": "&lt;script&gt;alert(1)&lt;/script&gt;", "joint1": "$x^{1}&amp;", "joint2": LONG}
JOINT = 'range="-2 2" frictionloss=".3" damping=".2" armature=".05"'
SENSORS = ("--noise-torque", "0.02", "--sample-rate", "100", "--seed", "1", "--quiet")


def arm_text():
    """An arm with odd names."""
    text = arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT)
    for name, odd in NAMED.items():
        text = text.replace(f'name="{name}"', f'name="{odd}"')
    return text


@pytest.fixture(scope="session")
def link_run(tmp_path_factory):
    """The folder of a run on a log of a simulated arm; the log is beside it."""
    folder = tmp_path_factory.mktemp("link")
    model, log = folder / "arm.xml", folder / "log.csv"
    model.write_text(arm_text(), encoding="utf-8")
    plant = ("--plant-model", str(model), "--save-measurements", str(log), "--duration", "6")
    known = ("--link-uncertainty", "1", "--output-dir", str(folder / "link"))
    call = [str(model), *plant, *SENSORS, *known]
    assert main(call) == 0
    return folder / "link"


@pytest.fixture(scope="session")
def page(link_run):
    """The page about it."""
    (path,) = write_report([link_run], link_run)
    assert path.name == REPORT_NAME
    return path


@pytest.fixture(scope="session")
def pages(link_run, page, tmp_path_factory):
    """One page of each kind."""
    folder = tmp_path_factory.mktemp("others")
    (folder / "payload").mkdir()
    found = payload_results.result()
    text = payload_json_text(found, payload_cards(found.payload.inertial, found.flange))
    (folder / "payload" / "params.json").write_text(text, encoding="utf-8")
    write_report([folder / "payload"], folder / "payload")
    whole = ["arm", str(link_run.parent / "arm.xml"), str(link_run.parent / "log.csv"), "--quiet"]
    given = ["--friction-model", "coulomb-viscous-offset", "--model-weight", "1", "--report"]
    # Whether the result may be used is not what this is about.
    assert main([*whole, *given, "--output-dir", str(folder / "arm")]) in (0, 1)
    (comparison,) = write_report([link_run, folder / "payload", folder / "arm"], folder)
    found = {name: folder / name / REPORT_NAME for name in ("payload", "arm")}
    return {"link": page, "comparison": comparison, **found}

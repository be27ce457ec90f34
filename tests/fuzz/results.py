"""Folders of earlier runs: their JSON, their data, and both in what reads them."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import matplotlib.font_manager  # noqa: F401 - makes its folders when it is first imported

from robot_sysid.cli import main
from robot_sysid.identify.adding.earlier import earlier_logs
from robot_sysid.output.cards import payload_cards
from robot_sysid.output.payload_json import payload_json_text
from robot_sysid.records.results import PARAMS_NAME
from robot_sysid.report.page import html, sections_comparing, sections_of
from robot_sysid.report.runs import load_run
from robot_sysid.report.saved import DATA_NAME
from tests.fuzz.harness import Case, written
from tests.fuzz.mutations import damaged, damaged_json
from tests.support import arms, payload_results

DATA_SHARE = 0.1
PAGE_SHARE = 0.001
"""A page with its figures takes a second, the numbers in it a thousandth. Chosen by a large number:
where the bytes of a guided run end, zeros follow."""


@functools.cache
def _runs() -> tuple[tuple[Mapping[str, bytes], str, Any], ...]:
    """What runs of a link, a whole arm and a payload leave, with the name and content of the JSON.

    The model and the log are not among the files.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model, log = folder / "arm.xml", folder / "log.csv"
        model.write_text(arms.serial_arm((arms.Z, arms.Y), joint='range="-2 2" damping=".2"'))
        motion = ("--duration", "4", "--sample-rate", "50", "--noise-torque", ".02", "--seed", "1")
        kept = ("--plant-model", str(model), "--save-measurements", str(log))
        _run(str(model), *motion, *kept, "--output-dir", str(folder / "link"))
        basic = ("--friction-model", "coulomb-viscous-offset", "--model-weight", "1")
        _run("arm", str(model), str(log), *basic, "--output-dir", str(folder / "arm"))
        link = _kept(folder / "link", PARAMS_NAME)
        content = json.loads(link[PARAMS_NAME])
        content["logs"], content["model"]["sha256"] = ["."], _robot().sha256
        arm = _kept(folder / "arm", "arm.json")
    found = payload_results.result()
    cards = payload_cards(found.payload.inertial, found.flange)
    payload = json.loads(payload_json_text(found, cards))
    return (
        (link, PARAMS_NAME, content),
        (arm, "arm.json", json.loads(arm["arm.json"])),
        ({}, PARAMS_NAME, payload),
    )


def _run(*arguments: str) -> None:
    # Whether the result may be used is not what this is about.
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert main([*arguments, "--quiet"]) in (0, 1)


def _kept(folder: Path, name: str) -> dict[str, bytes]:
    return {each: (folder / each).read_bytes() for each in (name, DATA_NAME)}


def case(random: Random) -> Case:
    """A folder; the file "page" is there where a page is made of it."""
    files, name, content = random.choice(_runs())
    page = {"page": b""} if random.random() > 1.0 - PAGE_SHARE else {}
    if files and random.random() < DATA_SHARE:
        return {**files, DATA_NAME: damaged(random, files[DATA_NAME]), **page}
    # Without its own hash in it, the data would not be looked at.
    return {name: damaged_json(random, content), **page}


def use(case: Case, folder: Path) -> None:
    """Read the folder as a report does, and as a run that adds to it."""
    place = written(case, folder)
    run = load_run(place)
    if "page" in case:
        html("a page", sections_of(run))
        html("a comparison", sections_comparing([run, run]))
    if PARAMS_NAME in case:
        earlier_logs(place / PARAMS_NAME, _robot())


@functools.cache
def _robot() -> Any:
    return arms.robot_of(arms.serial_arm((arms.Z, arms.Y)))

"""Folders of earlier runs: their JSON, their data, and both in what reads them."""

from __future__ import annotations

import functools
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import matplotlib.font_manager  # noqa: F401 - makes its folders when it is first imported

from benchmarks.trust.fuzz.harness import Case, write_case
from benchmarks.trust.fuzz.mutations import damage_bytes, damaged_json
from rigs.files import reports
from robot_sysid.records.file_access import DATA_NAME, PARAMS_NAME
from robot_sysid.report.page import write_report
from robot_sysid.report.runs import load_run, save_data

DATA_SHARE = 0.1
PAGE_SHARE = 0.001
"""A page with its figures takes a second, the numbers in it a thousandth. Chosen by a large number:
where the bytes of a guided run end, zeros follow."""


@functools.cache
def _runs() -> tuple[tuple[Mapping[str, bytes], Any], ...]:
    """Return the files of runs of a link and of a payload, with the content of params.json."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        model = folder / "arm.xml"
        model.write_text(reports.arm_text())
        result = reports.link_result(model)
        run = reports.saved(folder / "link", result)
        save_data(run, reports.traces(), reports.fingerprint(run))
        link = {name: (run / name).read_bytes() for name in (PARAMS_NAME, DATA_NAME)}
        other = reports.saved(folder / "payload", reports.payload_result(model))
        payload = json.loads((other / PARAMS_NAME).read_bytes())
    content = json.loads(link[PARAMS_NAME])
    return (link, content), ({}, payload)


def case(random: Random) -> Case:
    """Return the files of a result folder; "page" is one of them where a report is made."""
    files, content = random.choice(_runs())
    page = {"page": b""} if random.random() > 1.0 - PAGE_SHARE else {}
    if files and random.random() < DATA_SHARE:
        return {**files, DATA_NAME: damage_bytes(random, files[DATA_NAME]), **page}
    # Without its own hash in it, the data would not be looked at.
    return {PARAMS_NAME: damaged_json(random, content), **page}


def use(case: Case, folder: Path) -> None:
    """Read the folder as a report does."""
    path = write_case(case, folder)
    run = load_run(path)
    if "page" in case:
        write_report([run], path)
        write_report([run, run], path)

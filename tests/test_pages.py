"""Every command and every Python block of the pages runs, in its order, on files of those names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rigs.files import pages, schemas
from rigs.files.places import ROOT
from robot_sysid.cli import main

pytestmark = pytest.mark.slow

QUICKLY = ["--excitation-time-budget", "1"]
"""Ends a search early; what it finds is the business of other tests."""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with the files that the pages name, made by the commands themselves."""
    folder = tmp_path_factory.mktemp("workshop")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        pages.make_workshop(folder)
    return folder


PYTHON = ROOT / "docs/python.md"
"""Needs no file that it does not write."""
DAY = ROOT / "docs/motors.md"
"""Its commands run on simulated motors, see ``commands/test_first_day.py``."""
WITH_BLOCKS = [
    page for page in pages.PAGES if page not in (PYTHON, DAY) and pages.blocks(page)
]


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=lambda page: page.name)
def test_what_a_page_says_to_type_works(page, workshop, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "tour"
    shutil.copytree(workshop, folder, symlinks=True)
    monkeypatch.chdir(folder)
    if "run1.mcap" in page.read_text(encoding="utf-8"):
        pytest.importorskip("rosbags")
        pages.add_recordings(folder)
    said = ""
    names = {}  # of one session: a block may use what an earlier one has defined
    for language, block in pages.blocks(page):
        if language == "python":
            exec(compile(block, str(page), "exec"), names)  # the page is ours
            continue
        for words, code in pages.commands(block):
            if words[0] not in pages.OTHERS and "[options]" not in words:
                assert words[0] == "robot-sysid", words
                said += runs(words[1:], code, capsys)
    assert [line for line in pages.printed(page) if not pages.is_said(line, said)] == []


def test_the_page_of_python_runs_where_nothing_is_but_the_package(
    tmp_path, monkeypatch, capsys
):
    """As a reader pastes it: in an empty folder, from top to bottom, in one session."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for language, block in pages.blocks(PYTHON):
        if language == "python":
            exec(compile(block, str(PYTHON), "exec"), names)  # the page is ours
            continue
        for words, code in pages.commands(block):
            if words[0] == "robot-sysid":
                runs(words[1:], code, capsys)
    files = {path.name for path in tmp_path.iterdir()}
    assert {"kinova", "found", "plan.json", "measured.csv"} <= files
    assert names["result"].failure is None


def runs(words, expected_code, capsys):
    """A command ends as the page says; one that needs a bus says that there is none.

    Returns what it prints, its error as well.
    """
    searches = words[0] == "plan" or "optimal" in words
    hurry = QUICKLY if searches else []
    capsys.readouterr()
    code = main([*words, *hurry])
    out, error = capsys.readouterr()
    if "can0" in words:
        assert (code in (2, 3), "can0" in error) == (True, True), (words, error)
    else:
        assert code == expected_code, (words, error)
        schemas.check_results(Path())
    return out + error

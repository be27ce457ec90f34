"""docs/gallery.md has the arms of its script, and its numbers where the logs are."""

from __future__ import annotations

import re

import pytest

from benchmarks.accuracy import arm_numbers
from benchmarks.accuracy.public_arms import link_folder
from rigs.files import pages
from rigs.files.places import DATA

pytestmark = pytest.mark.slow


def test_the_page_has_the_arms_of_the_script_in_its_order():
    """Each with source, licence and command, and a table of joints or why there is none."""
    parts = re.split(r"^### (.*)$", arm_numbers.TABLE.read(), flags=re.MULTILINE)
    names = parts[1::2]
    assert names == [*(arm.name for arm in arm_numbers.ARMS), arm_numbers.OTHER_LOGS]
    for arm, text in zip(arm_numbers.ARMS, parts[2::2]):
        assert f"]({arm.source}), licence: {arm.licence}. Torque: {arm.torque}." in text
        assert f"```text\n{arm.command}\n```" in text
        rows = re.findall(r"^\| .* \|$", text, re.MULTILINE)
        assert (len(rows) > 2) != ("No numbers: " in text)
        assert len({row.count("|") for row in rows}) <= 1
    compared = re.findall(r"^\| (.*?) \|", parts[-1], re.MULTILINE)[2:]
    assert compared == [arm.name for arm in arm_numbers.ARMS if arm.other]


@pytest.mark.skipif(not DATA.exists(), reason="the logs of real arms are not here")
@pytest.mark.parametrize("arm", arm_numbers.ARMS, ids=lambda arm: arm.name[:4])
def test_the_numbers_of_an_arm_are_what_its_command_gives(arm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    link_folder(DATA)
    page = arm_numbers.TABLE.read()
    wrong = [line for line in arm_numbers.section(arm) if not pages.is_said(line, page)]
    assert wrong == []

"""The names of faults: texts for users and JSON, members for the program."""

import json

import pytest

from rigs.files.places import ROOT
from robot_sysid.records.fault_names import FaultName


@pytest.mark.parametrize("name", FaultName)
def test_a_name_is_a_text_for_users_and_files(name):
    assert str(name) == f"{name}" == name.value
    assert json.loads(json.dumps(name)) == name.value
    assert FaultName(name.value) is name
    assert name.words and name.words != name.value


@pytest.mark.parametrize("name", FaultName)
def test_each_name_has_its_row_on_the_page_of_logs(name):
    page = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert any(f"`{name}`" in line.split("|")[1] for line in rows)

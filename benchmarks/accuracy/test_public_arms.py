"""The rows of docs/evidence.md on public arms are what their commands give, where the logs are."""

from __future__ import annotations

import pytest

from benchmarks.accuracy import public_arms
from rigs.files import pages
from rigs.files.places import DATA

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.exists(), reason="the logs of real arms are not here"),
]


@pytest.mark.parametrize("arm", public_arms.ARMS, ids=lambda arm: arm.name[:4])
def test_a_row_of_the_page_is_true(arm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    public_arms.link_folder(DATA)
    page = public_arms.TABLE.page.read_text(encoding="utf-8")
    assert arm.command in page
    assert pages.is_said(public_arms.row(arm), page)

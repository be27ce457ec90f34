"""What the console shows, and to whom."""

from __future__ import annotations

import pytest

from robot_sysid.commands.console import Console
from robot_sysid.records.progress import Detail


@pytest.mark.parametrize(("verbose", "shown"), [(False, 1), (True, 2)])
def test_details_are_printed_where_they_are_asked_for_alone(capsys, verbose, shown):
    console = Console(verbose=verbose)
    for tell in (console.stage, console.note):
        tell("what is found")
        tell(Detail("how"))
    printed = capsys.readouterr()
    assert len(printed.out.splitlines()) == len(printed.err.splitlines()) == shown

"""The notebook of the example runs from top to bottom."""

from __future__ import annotations

import json

import pytest

from rigs.files.places import EXAMPLE

NOTEBOOK = json.loads((EXAMPLE / "python.ipynb").read_text(encoding="utf-8"))


def test_the_notebook_is_stored_without_what_it_printed():
    cells = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert NOTEBOOK["nbformat"] == 4 and len(cells) > 5
    assert all(
        cell["outputs"] == [] and cell["execution_count"] is None for cell in cells
    )


@pytest.mark.slow
def test_its_cells_run(monkeypatch):
    pytest.importorskip("matplotlib")
    pytest.importorskip("mujoco", minversion="3.2.5")
    monkeypatch.chdir(EXAMPLE)
    names: dict = {}
    for number, cell in enumerate(NOTEBOOK["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
    assert (
        abs(names["result"].mass - 1.517) < 3.0 * names["result"].standard_errors["m"]
    )
    written = names["result"].thetas[-1][0]
    assert names["compiled"].body("link6").mass[0] == pytest.approx(written)

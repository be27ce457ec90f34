"""Several runs beside each other: what each predicts of every joint."""

from __future__ import annotations

from dataclasses import replace

from robot_sysid.report.runs import load_run
from robot_sysid.report.sections.comparison import predicted
from robot_sysid.report.sections.signals import errors


def test_errors_of_every_joint_stand_beside_each_other(link_run):
    run = load_run(link_run)
    runs = [replace(run, folder=run.folder.parent / f"run{k}") for k in range(9)]
    (figure,) = predicted(runs).figures
    alone = errors(run).figures[0].table
    assert figure.table.header == alone.header and len(figure.table.rows) == 9
    for k, row in enumerate(figure.table.rows):
        assert row[0].startswith(f"run{k}: ") and row[1:] == alone.rows[-1][1:]
    assert "first 7 of 9" in figure.caption
    bare = replace(run, content={**run.content, "rmse_per_joint": {}, "file": None})
    bare = replace(bare, content={**bare.content, "validation": []})
    assert predicted([bare, bare]).figures == ()

"""Several runs beside each other: what each predicts of every joint."""

from __future__ import annotations

from dataclasses import replace

import pytest

from robot_sysid.report.runs import load_run
from robot_sysid.report.sections.comparison import predicted
from robot_sysid.report.sections.signals import error_sets, errors


@pytest.mark.parametrize("count", [2, 9])
def test_errors_of_every_joint_stand_beside_each_other(link_run, count):
    run = load_run(link_run)
    runs = [replace(run, folder=run.folder.parent / f"run{k}") for k in range(count)]
    (figure,) = predicted(runs).figures
    alone = errors(run).figures[0].table
    assert figure.table.header == alone.header and len(figure.table.rows) == count
    for k, row in enumerate(figure.table.rows):
        assert row[0].startswith(f"run{k}: ") and row[1:] == alone.rows[-1][1:]
    assert ("first 7 of 9" in figure.caption) == (count == 9)


def test_runs_without_errors_per_joint_are_compared_all_the_same(link_run):
    run = load_run(link_run)
    bare = replace(run, content={"rmse": 0.1})
    assert list(error_sets(bare)) == [] and predicted([bare, bare]).figures == ()
    assert len(predicted([bare, run]).figures[0].table.rows) == 1

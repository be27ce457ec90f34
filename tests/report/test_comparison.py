"""Several runs beside each other: what each predicts of every joint."""

from __future__ import annotations

from dataclasses import replace

from robot_sysid.report.runs import load_run
from robot_sysid.report.sections.comparison import predicted
from robot_sysid.report.sections.signals import errors


def test_errors_of_every_joint_stand_beside_each_other(link_run):
    run = load_run(link_run)
    runs = [replace(run, folder=run.folder.parent / f"run{k}") for k in range(5)]
    (table,) = predicted(runs).tables
    alone = errors(run).figures[0].table
    assert table.header == alone.header and len(table.rows) == 5 * len(alone.rows)
    for k, row in enumerate(table.rows):
        number, place = divmod(k, len(alone.rows))
        assert row == (f"run{number}: {alone.rows[place][0]}", *alone.rows[place][1:])

"""Several runs beside each other."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records.figures import THETA, with_error
from robot_sysid.report.drawing import Section, table
from robot_sysid.report.runs import Run
from robot_sysid.report.sections.signals import error_numbers, error_sets


def verdicts(runs: Sequence[Run]) -> Section:
    """Return each run's verdict."""
    rows, told = [], []
    for name, run in names(runs).items():
        content = run.content
        rows.append((name, content["question"], content["verdict"][0], content["model"]["path"]))
        told += [f"{name}: {line}" for line in run.missing]
    header = ("run", "what", "verdict", "model")
    models = {run.content["model"]["sha256"] for run in runs}
    warned = ("The runs are of different model files.",) if len(models) > 1 else ()
    tables, missing = (table(header, rows),), tuple(told)
    return Section("verdicts", "Verdicts", warned, tables, missing=missing, is_open=True)


def names(runs: Sequence[Run]) -> dict[str, Run]:
    """Return the runs by the name of their folder, or its path where two are called the same."""
    short = [run.name for run in runs]
    return {run.name if short.count(run.name) < 2 else str(run.folder): run for run in runs}


def compared(runs: Sequence[Run]) -> Section:
    """Return the parameters of the bodies that all runs have, beside each other."""
    bodies = {name: {b.title: b for b in run.bodies} for name, run in names(runs).items()}
    first, *others = bodies.values()
    both = [title for title in first if all(title in each for each in others)]
    words = "Values ± one standard error. Runs whose ranges do not meet contradict each other."
    if not both:
        words = "These runs have no body in common, so there are no numbers to compare."
    tables = []
    for title in both:
        same = [each[title] for each in bodies.values()]
        columns = [map(with_error, each.after, each.stated(each.errors)) for each in same]
        labels = (f"{label} [{unit}]" for label, unit in zip(PARAMETER_NAMES, THETA))
        tables.append(table((title, *bodies), list(zip(labels, *columns))))
    return Section("compared", "Parameters", (words,), tables, is_open=True)


def predicted(runs: Sequence[Run]) -> Section:
    """Return the torque errors of each run, of each joint where its file holds them."""
    sets = [
        each._replace(words=f"{name}: {each.words}")
        for name, run in names(runs).items()
        for each in error_sets(run)
    ]
    return Section("predicted", "Prediction errors", (), (table(*error_numbers(sets)),))


def friction_beside(runs: Sequence[Run]) -> Section:
    """Return the friction of each run."""
    found = {
        name: {key: with_error(*each) for key, each in run.friction().items()}
        for name, run in names(runs).items()
    }
    keys = dict.fromkeys(key for each in found.values() for key in each)
    rows = [(*key, *(each.get(key, "–") for each in found.values())) for key in keys]
    return Section("friction", "Friction", tables=(table(("joint", "term", *found), rows),))


PARTS = verdicts, compared, friction_beside, predicted
"""What a page about several runs consists of."""

"""Several runs beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records.figures import THETA, percent, with_error
from robot_sysid.report.drawing import NARROW, SERIES, drawn
from robot_sysid.report.elements import Figure, Section, table, text
from robot_sysid.report.runs import Run, mapping, number
from robot_sysid.report.sections.errors import error_bars, error_sets
from robot_sysid.report.sections.excitation import shortened


def verdicts(runs: Sequence[Run]) -> Section:
    """Return each run's verdict."""
    rows = [
        (
            name,
            {"link": "link", "payload": "payload", "arm": "whole arm"}[run.kind],
            "may be used" if run.trustworthy else "must not be used",
            run.bodies()[0].title,
            with_error(float(run.bodies()[0].after[0]), float(run.bodies()[0].errors[0]), "kg"),
            str(mapping(run.content, "model").get("path", "–")),
        )
        for name, run in zip(names(runs), runs)
    ]
    header = ("run", "what", "verdict", "body", "mass", "model")
    models = {mapping(run.content, "model").get("sha256") for run in runs}
    warned = ("The runs are of different model files.",) if len(models) > 1 else ()
    told = tuple(f"{name}: {line}" for name, run in zip(names(runs), runs) for line in run.missing)
    return Section("verdicts", "Verdicts", warned, (table(header, rows),), missing=told)


def names(runs: Sequence[Run]) -> list[str]:
    """Return a short name per run, none twice."""
    short = [run.name for run in runs]
    return [str(run.folder) if short.count(name) > 1 else name for name, run in zip(short, runs)]


def compared(runs: Sequence[Run]) -> Section:
    """Return the parameters of each run's first body beside each other."""
    figures = tuple(_parameter(runs, k) for k in range(10))
    words = "Bars are ± one standard error. Runs whose bars do not meet contradict each other."
    return Section("compared", "Parameters", (words, *_different(runs)), figures=figures)


def _different(runs: Sequence[Run]) -> tuple[str, ...]:
    titles = dict.fromkeys(f"{run.bodies()[0].title}" for run in runs)
    if len(titles) < 2:
        return ()
    return (f"Careful: these are different bodies ({', '.join(titles)}).",)


def _parameter(runs: Sequence[Run], k: int) -> Figure:
    label, unit = PARAMETER_NAMES[k], THETA[k]
    bodies = [run.bodies()[0] for run in runs]
    values = np.array([body.after[k] for body in bodies])
    errors = np.array([body.errors[k] for body in bodies])
    rows = [
        (name, text(value, error), text(error, error))
        for name, value, error in zip(names(runs), values, errors)
    ]
    numbers = table(("run", f"{label} [{unit}]", "± standard error"), rows)

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        places = -np.arange(len(runs), dtype=float)
        for j, place in enumerate(places):
            colour, marker = SERIES[j % len(SERIES)]
            bar = errors[j] if np.isfinite(errors[j]) else 0.0
            ax.errorbar(values[j], place, xerr=bar, fmt=marker, color=colour, capsize=3)
        ax.set_yticks(places, [shortened(name) for name in names(runs)])
        ax.set_ylim(places[-1] - 0.6, 0.6)
        ax.set_xlabel(f"{label} [{unit}]")
        ax.locator_params(axis="x", nbins=4)

    size = (NARROW, 1.0 + 0.3 * len(runs))
    return drawn(f"compare-{label}", f"{label} of each run [{unit}].", numbers, size, draw)


def predicted(runs: Sequence[Run]) -> Section:
    """Return the torque errors of each run, of each joint where its file holds them."""
    rows = []
    for name, run in zip(names(runs), runs):
        rows.append((name, "fitted", number(run.content.get("rmse")), "–"))
        tests = run.content.get("validation")
        tests = [run.content.get("held_out"), *(tests if isinstance(tests, list) else [tests])]
        for test in (each for each in tests if isinstance(each, dict)):
            relative = number(test.get("relative_error"))
            share = percent(relative) if np.isfinite(relative) else "–"
            rows.append((name, str(test.get("source")), number(test.get("rmse")), share))
    header = ("run", "data", "error [N·m]", "of the torque")
    sets = [
        (f"{name}: {words}", relative, per_joint)
        for name, run in zip(names(runs), runs)
        for words, relative, per_joint in list(error_sets(run))[-1:]
    ]
    words = "of every run on the data farthest from what it was fitted to."
    bars = (error_bars("compare-errors", sets, words),) if sets else ()
    return Section("predicted", "Prediction errors", tables=(table(header, rows),), figures=bars)


def friction_beside(runs: Sequence[Run]) -> Section:
    """Return the friction of each run."""
    found = [{(joint, name): (v, e) for joint, name, v, e in run.friction()} for run in runs]
    keys = list(dict.fromkeys(key for each in found for key in each))
    rows = [
        (
            joint,
            name,
            *(with_error(*each[joint, name]) if (joint, name) in each else "–" for each in found),
        )
        for joint, name in keys
    ]
    return Section("friction", "Friction", tables=(table(("joint", "term", *names(runs)), rows),))

"""Before -> after, what each number's error is made of, and what the torques do not show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import Array
from robot_sysid.records.figures import THETA, percent
from robot_sysid.report.drawing import AFTER, BEFORE, INK, NARROW, SERIES, TRUTH, drawn, legend
from robot_sysid.report.elements import Figure, Section, Table, plus_minus, table, text
from robot_sysid.report.runs import PAYLOAD, Body, Run, listed

GROUPS = ((0, 1, "mass"), (1, 4, "first moment"), (4, 10, "inertia about the origin"))


def parameters(run: Run) -> Section:
    """Return the ten parameters of every body, before and after."""
    figures, bodies = [], run.bodies()
    for number, body in enumerate(bodies):
        figures.append(_before_after(body, f"parameters-{number}"))
        if body.budget:
            figures.append(_causes(body, f"errors-{number}"))
    frame = "flange" if run.kind == PAYLOAD else "body"
    return Section(
        "parameters",
        "The numbers" if run.kind == PAYLOAD else "Before and after",
        sentences=(
            "m is the mass, h the first moment (mass times centre of mass), I the inertia about "
            f"the origin of the {frame}'s frame. Bars are ± one standard error, all causes "
            "together; a value without a bar has an error that is not known.",
        ),
        figures=tuple(figures),
        tables=(_com_table(bodies),),
    )


def _before_after(body: Body, name: str) -> Figure:
    columns = {"before": body.before, "after": body.after, "truth": body.truth}
    told = {what: theta for what, theta in columns.items() if theta is not None}
    rows = [
        (
            f"{label} [{unit}]",
            *(text(theta[k], body.errors[k]) for theta in told.values()),
            plus_minus(body.errors[k]),
        )
        for k, (label, unit) in enumerate(zip(PARAMETER_NAMES, THETA))
    ]
    numbers = table(("parameter", *told, "± standard error"), rows)
    against = "" if body.before is None else " against the model's values before"
    known = "" if body.truth is None else " and the truth of the simulated arm"
    caption = f"{body.title}: identified parameters{against}{known}, ± one standard error."
    return drawn(name, caption, numbers, (NARROW, 4.6), lambda canvas: _draw(canvas, body))


def _draw(canvas: Any, body: Body) -> None:
    heights = [end - start + 0.6 for start, end, _ in GROUPS]
    axes = canvas.subplots(3, 1, height_ratios=heights)
    for (start, end, title), ax in zip(GROUPS, axes):
        places = -np.arange(end - start, dtype=float)
        part = slice(start, end)
        if body.before is not None:
            hollow: Any = {"marker": "D", "mfc": "none", "mec": BEFORE, "ls": "none"}
            ax.plot(body.before[part], places + 0.16, label="before", **hollow)
        errors = np.where(np.isfinite(body.errors[part]), body.errors[part], 0.0)
        bar: Any = {"fmt": "o", "color": AFTER, "ms": 5, "capsize": 3, "label": "after"}
        ax.errorbar(body.after[part], places, xerr=errors, **bar)
        if body.truth is not None:
            cross: Any = {"marker": "x", "mew": 1.8, "color": TRUTH, "ls": "none"}
            ax.plot(body.truth[part], places - 0.16, label="truth", **cross)
        ax.set_yticks(places, PARAMETER_NAMES[part])
        ax.set_ylim(places[-1] - 0.6, 0.6)
        ax.set_xlabel(f"{title} [{THETA[start]}]")
        ax.margins(x=0.08)
        ax.locator_params(axis="x", nbins=6)
        _room(ax, body.after[part])
    legend(canvas, axes[0])


def _room(ax: Any, values: Array) -> None:
    """Widen an axis whose values are all but the same: what is drawn would be rounding."""
    low, high = ax.get_xlim()
    least = 0.02 * float(np.max(np.abs(values))) or 1e-6
    if high - low < least:
        middle = 0.5 * (low + high)
        ax.set_xlim(middle - 0.5 * least, middle + 0.5 * least)


def _causes(body: Body, name: str) -> Figure:
    causes = list(body.budget)
    squares = np.array([np.square(body.budget[cause]) for cause in causes])
    squares = np.where(np.isfinite(squares), squares, 0.0)
    total = np.sum(squares, axis=0)
    shares = np.divide(squares, total, out=np.zeros_like(squares), where=total > 0.0)
    rows = [
        (label, plus_minus(body.errors[k]), *(percent(float(share)) for share in shares[:, k]))
        for k, label in enumerate(PARAMETER_NAMES)
    ]
    numbers = table(("parameter", "± standard error", *causes), rows)
    caption = (
        f"{body.title}: what each parameter's error is made of, in shares of its variance. Where "
        "noise is small, a longer recording does not help."
    )

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        left, places = np.zeros(10), -np.arange(10.0)
        hatches = ("", "///", "...", "xxx", "\\\\\\", "++", "oo")
        for k, (cause, share) in enumerate(zip(causes, shares)):
            style = {"facecolor": SERIES[k % len(SERIES)][0], "edgecolor": INK, "alpha": 0.75}
            ax.barh(places, 100.0 * share, left=left, label=cause, hatch=hatches[k % 7], **style)
            left = left + 100.0 * share
        ax.set_yticks(places, PARAMETER_NAMES)
        ax.set_xlabel("share of the error's variance [%]")
        ax.set_xlim(0.0, 100.0)
        legend(canvas, ax, 2)

    return drawn(name, caption, numbers, (NARROW, 4.6), draw)


def _com_table(bodies: Sequence[Body]) -> Table:
    """Return the centres of mass before and after, and in truth where it is known."""
    columns: dict[str, list[Array | None]] = {
        "before": [body.before for body in bodies],
        "after": [body.after for body in bodies],
        "truth": [body.truth for body in bodies],
    }
    told = [what for what, thetas in columns.items() if any(t is not None for t in thetas)]
    rows = [
        (body.title, *(_com(columns[what][k]) for what in told)) for k, body in enumerate(bodies)
    ]
    return table(("centre of mass", *(f"{what} (x, y, z) [m]" for what in told)), rows)


def _com(theta: Array | None) -> str:
    if theta is None or theta[0] == 0.0:
        return "–"
    return ", ".join(f"{c + 0.0:.4f}" for c in theta[1:4] / theta[0])


def visibility(run: Run) -> Section:
    """Return what is identified, what was kept from the model, and what does not show."""
    body = run.bodies()[0]
    rows = [
        (label, _source(body, k), _share(body.share[k]), plus_minus(body.errors[k]))
        for k, label in enumerate(PARAMETER_NAMES)
    ]
    hidden = listed(run.content, "unidentifiable_combinations")
    base = run.content.get("base_parameters")
    sentences = list(_base_sentences(run, base))
    if hidden:
        sentences.append("These torques do not show: " + "; ".join(hidden) + ".")
    elif run.kind != "arm":
        sentences.append("All parameters that were asked for show in these torques.")
    tables = [] if run.kind == "arm" else [table(("parameter", "comes from", "data", "±"), rows)]
    if isinstance(base, list):
        tables.append(_base_table(base))
    return Section("visible", "Identified, kept, not visible", tuple(sentences), tuple(tables))


def _base_sentences(run: Run, base: Any) -> Iterator[str]:
    if isinstance(base, list):
        yield (
            f"The torques show {len(base)} combinations of the links' parameters; any motion of "
            f"this arm could show {run.content.get('structural_rank', 'as many')}. Numbers of a "
            "single link beyond these combinations lean on the model."
        )


def _base_table(base: list[Any]) -> Table:
    rows = [
        (
            str(each["combination"]),
            text(each["value"], each["standard_error"]),
            plus_minus(each["standard_error"]),
            "yes" if each["essential"] else "no",
        )
        for each in base
    ]
    return table(("combination", "value", "± standard error", "essential"), rows)


def _source(body: Body, k: int) -> str:
    if body.kept[k]:
        return "the model (not visible)"
    if np.isfinite(body.share[k]) and body.share[k] < 0.5:
        return "more model than data"
    return "the data" if np.isfinite(body.errors[k]) or not body.budget else "partly the model"


def _share(share: float) -> str:
    return "–" if not np.isfinite(share) else f"{100.0 * share:.0f} %"

"""Before -> after, what each number's error is made of, what does not show; payloads as cards.

Several runs beside each other are last.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import Array
from robot_sysid.records.messages import PARAMETER_UNITS, percent, with_error
from robot_sysid.report import drawing
from robot_sysid.report.drawing import AFTER, Figure, Section, Table, drawn, table
from robot_sysid.report.runs import Body, Run, number
from robot_sysid.report.sections.signals import error_numbers, error_sets
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.verdict import PRIOR_SHARE

_GROUPS = ((0, 1, "mass"), (1, 4, "first moment"), (4, 10, "inertia about the origin"))
_MARKS: dict[str, tuple[float, dict[str, Any]]] = {
    "before": (0.16, {"marker": "D", "mfc": "none", "mec": drawing.BEFORE}),
    "in the file": (-0.16, {"marker": "s", "mfc": "none", "mec": drawing.OTHER}),
    "truth": (-0.16, {"marker": "x", "mew": 1.8, "color": drawing.TRUTH}),
}
"""What stands beside the identified value: by how much of a row above it, and its marker."""
_LEAST_SPAN = 0.02
"""Width of an axis, relative to its values, below which what is drawn would be rounding."""


def parameters(run: Run) -> Section:
    """Return the ten parameters of every body, before and after."""
    figures = []
    for place, body in enumerate(run.bodies):
        figures.append(_before_after(body, f"parameters-{place}"))
        if body.budget:
            figures.append(_causes(body, f"errors-{place}"))
    words = (
        "m is the mass, h the first moment (mass times centre of mass), I the inertia about the "
        f"origin of the {'flange' if run.is_payload else 'body'}'s frame. Bars are ± one standard "
        "error, all causes together; a value without a bar has an error that is not known."
    )
    title = "The numbers" if run.is_payload else "Before and after"
    return Section("parameters", title, (words,), (masses(run.bodies),), figures)


def masses(bodies: Sequence[Body]) -> Table:
    """Return mass and centre of mass of some bodies: before, after, as written and in truth."""
    header = ("body", "", "mass [kg]", *(f"centre {axis} [m]" for axis in "xyz"))
    rows = [
        (body.title, when, *_mass_and_place(theta, body, when == "after"))
        for body in bodies
        for when, theta in body.thetas.items()
        if theta[0] != 0.0
    ]
    return table(header, rows)


def _mass_and_place(theta: Array, body: Body, identified: bool) -> Iterator[str]:
    mass, *errors = body.stated(body.central) if identified else [None] * 4
    yield with_error(float(theta[0]), mass)
    for place, error in zip((theta[1:4] / theta[0] + 0.0).tolist(), errors):
        yield f"{place:.4f}" if error is None else with_error(place, error)


def _before_after(body: Body, name: str) -> Figure:
    told = body.thetas
    rows = [
        (
            f"{label} [{unit}]",
            *(drawing.text(float(theta[k]), body.errors[k]) for theta in told.values()),
            drawing.plus_minus(body.errors[k]),
        )
        for k, (label, unit) in enumerate(zip(PARAMETER_NAMES, PARAMETER_UNITS))
    ]
    numbers = ("parameter", *told, "± standard error"), rows
    against = " against the model's values before" if "before" in told else ""
    known = " and the truth of the simulated arm" if "truth" in told else ""
    caption = (
        f"{body.title}: identified parameters{against}{known}, ± one standard error."
    )

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(
            3, 1, height_ratios=[end - start + 0.6 for start, end, _ in _GROUPS]
        )
        errors = np.where(np.isfinite(body.errors), body.errors, 0.0)
        for (start, end, title), ax in zip(_GROUPS, axes):
            places = -np.arange(end - start, dtype=float)
            part = slice(start, end)
            for what, (shift, style) in _MARKS.items():
                if what in told:
                    ax.plot(
                        told[what][part], places + shift, label=what, ls="none", **style
                    )
            bar: Any = {
                "fmt": "o",
                "color": AFTER,
                "ms": 5,
                "capsize": 3,
                "label": "after",
            }
            ax.errorbar(body.after[part], places, xerr=errors[part], **bar)
            ax.set_yticks(places, PARAMETER_NAMES[part])
            ax.set(
                ylim=(places[-1] - 0.6, 0.6),
                xlabel=f"{title} [{PARAMETER_UNITS[start]}]",
            )
            ax.margins(x=0.08)
            ax.locator_params(axis="x", nbins=6)
            least = 0.5 * _LEAST_SPAN * float(np.max(np.abs(body.after[part]))) or 5e-7
            low, high = ax.get_xlim()
            if high - low < 2.0 * least:
                ax.set_xlim(0.5 * (low + high) - least, 0.5 * (low + high) + least)
        drawing.legend(canvas, axes[0], 4)

    return drawn(name, caption, numbers, 4.6, draw)


def _causes(body: Body, name: str) -> Figure:
    causes = list(body.budget)
    squares = np.square(np.nan_to_num(np.array(list(body.budget.values()))))
    squares[:, ~np.isfinite(body.errors)] = 0.0
    total = np.sum(squares, axis=0)
    shares = np.divide(squares, total, out=np.zeros_like(squares), where=total > 0.0)
    # As many as there are colours; what is least stands together.
    most = np.argsort(-np.sum(shares, axis=1), kind="stable")[: len(drawing.SERIES) - 1]
    shown = {causes[k]: shares[k] for k in sorted(most.tolist())}
    shown["all others"] = np.sum(np.delete(shares, most, axis=0), axis=0)
    rows = [
        (label, drawing.plus_minus(error), *map(percent, each))
        for label, error, each in zip(PARAMETER_NAMES, body.errors, shares.T.tolist())
    ]
    caption = (
        f"{body.title}: what each parameter's error is made of, in shares of its variance. Where "
        "noise is small, a longer recording does not help."
    )

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        left = np.zeros(10)
        places = -np.arange(10.0)
        for (cause, share), (colour, _), hatch in zip(
            shown.items(), drawing.SERIES, drawing.HATCHES
        ):
            style = {
                "facecolor": colour,
                "edgecolor": drawing.INK,
                "alpha": 0.75,
                "hatch": hatch,
            }
            ax.barh(places, 100.0 * share, left=left, label=cause, **style)
            left = left + 100.0 * share
        ax.set_yticks(places, PARAMETER_NAMES)
        ax.set(xlabel="share of the error's variance [%]", xlim=(0.0, 100.0))
        drawing.legend(canvas, ax, 2)

    numbers = ("parameter", "± standard error", *causes), rows
    return drawn(name, caption, numbers, 4.6, draw)


def visibility(run: Run) -> Section:
    """Return what is identified, what was kept from the model, and what does not show."""
    body = run.bodies[0]
    content = run.content
    sources = [_source(body, k, run.is_payload) for k in range(len(PARAMETER_NAMES))]
    errors = map(drawing.plus_minus, body.errors)
    rows = list(zip(PARAMETER_NAMES, sources, map(percent, body.share), errors))
    tables = [table((body.title, "comes from", "data", "±"), rows)]
    sentences = []
    base = content["base_parameters"]
    sensors = content["sensors"]
    if base:
        sentences.append(
            f"The torques show {len(base)} combinations of the links' parameters; any motion of "
            f"this arm could show {content['structural_rank'] or 'as many'}. Numbers of a "
            "single link beyond these combinations lean on the model."
        )
        header = ("combination", "value", "± standard error", "essential")
        essential = {True: "yes", False: "no"}
        rows = [
            (words, *drawing.cells(*map(number, pair)), essential[kept])
            for words, *pair, kept in map(dict.values, base)
        ]
        tables.append(table(header, rows))
    if sensors:
        found = [(name, with_error(*each)) for name, each in sensors.items()]
        tables.append(table(("sensor", "found beside them"), found))
    hidden = list(content["unidentifiable_combinations"])
    if not run.all_known:
        hidden.insert(0, "the payload's inertia (its ± does not tell it from zero)")
        sentences.append(NOT_KNOWN)
    every = "All parameters that were asked for show in these torques."
    sentences.append(
        f"These torques do not show: {'; '.join(hidden)}." if hidden else every
    )
    return Section("visible", "Identified, kept, not visible", sentences, tables)


def _source(body: Body, k: int, is_payload: bool) -> str:
    if body.kept[k]:
        return "not known" if is_payload else "the model (not visible)"
    if np.isfinite(body.share[k]) and body.share[k] < PRIOR_SHARE:
        return "more model than data"
    return (
        "the data"
        if np.isfinite(body.errors[k]) or not body.budget
        else "partly the model"
    )


def card(run: Run) -> Section | None:
    """Return the payload as controllers take it; None where there is none."""
    payload = run.content["payload"]
    if payload is None:
        return None
    rows = [
        (joint, with_error(*each)) for joint, each in payload["torque_scale"].items()
    ]
    tables = [table(("joint", "torque scale"), rows)] if rows else []
    if not payload["cards"]:
        reason = "no card was written, because the payload is not to be used"
        if payload["known_mass"] is not None:
            reason = "this run calibrated the torques; it writes no card"
        return Section("card", "Payload card", (), tables, missing=(reason,))
    flange = payload["flange"]
    words = (
        f"In the frame of the flange {flange['name']} on body {flange['in_body']}. Check that the "
        "controller means the same frame."
    )
    blocks = []
    for entry in payload["cards"].values():
        comment = "\n".join(
            f"# {line}" for line in (entry["explanation"], *entry["notes"]) if line
        )
        blocks.append((entry["title"], f"{comment}\n{entry['text']}"))
    return Section(
        "card", "Payload card", (words,), tables, blocks=blocks, is_open=True
    )


def scatter(run: Run) -> Section | None:
    """Return the payload according to each recording alone, or None where nothing is known."""
    payload = run.content["payload"]
    if payload is None or not payload["scatter"]:
        return None
    header = ("recording", "kind", "mass [kg]", "± noise alone [kg]", "± all [kg]")
    rows = []
    for one in payload["scatter"]:
        mass, noise, whole = (
            number(one[key]) for key in ("mass", "noise_error", "error")
        )
        pair = drawing.cells(mass, noise)
        kind = "loaded" if one["is_loaded"] else "empty"
        rows.append((one["name"], kind, *pair, drawing.plus_minus(whole)))
    words = (
        "Mass of the payload according to each recording against all of the other kind. If one "
        "recording says something else than the others, it was made with another payload, or "
        "something was changed between them."
    )
    return Section("scatter", "Each recording alone", (words,), (table(header, rows),))


def verdicts(runs: Sequence[Run]) -> Section:
    """Return each run's verdict."""
    rows = []
    told = []
    for name, run in names(runs).items():
        content = run.content
        rows.append(
            (name, content["question"], content["verdict"][0], content["model"]["path"])
        )
        told += [f"{name}: {line}" for line in run.missing]
    header = ("run", "what", "verdict", "model")
    models = {run.content["model"]["sha256"] for run in runs}
    warned = ("The runs are of different model files.",) if len(models) > 1 else ()
    tables = (table(header, rows),)
    missing = tuple(told)
    return Section(
        "verdicts", "Verdicts", warned, tables, missing=missing, is_open=True
    )


def names(runs: Sequence[Run]) -> dict[str, Run]:
    """Return the runs by the name of their folder, or its path where two are called the same."""
    short = [run.name for run in runs]
    return {
        run.name if short.count(run.name) < 2 else str(run.folder): run for run in runs
    }


def compared(runs: Sequence[Run]) -> Section:
    """Return the parameters of the bodies that all runs have, beside each other."""
    bodies = {
        name: {b.title: b for b in run.bodies} for name, run in names(runs).items()
    }
    first, *others = bodies.values()
    both = [title for title in first if all(title in each for each in others)]
    words = "Values ± one standard error. Runs whose ranges do not meet contradict each other."
    if not both:
        words = "These runs have no body in common, so there are no numbers to compare."
    tables = []
    for title in both:
        same = [each[title] for each in bodies.values()]
        columns = [
            map(with_error, each.after, each.stated(each.errors)) for each in same
        ]
        labels = (
            f"{label} [{unit}]" for label, unit in zip(PARAMETER_NAMES, PARAMETER_UNITS)
        )
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
    return Section(
        "friction", "Friction", tables=(table(("joint", "term", *found), rows),)
    )


COMPARISON = verdicts, compared, friction_beside, predicted
"""What a page about several runs consists of."""

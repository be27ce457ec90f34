"""The payload in every controller's form, and what each recording alone says of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from robot_sysid.report.drawing import AFTER, BEFORE, MEASURED, NARROW, drawn, legend
from robot_sysid.report.elements import Figure, Section, plus_minus, table, text
from robot_sysid.report.runs import Run, mapping, number
from robot_sysid.report.sections.excitation import shortened


def card(run: Run) -> Section:
    """Return the payload as controllers take it."""
    cards = mapping(run.content, "cards")
    title = "Payload card"
    if not cards:
        reason = "no card was written, because the payload is not to be used"
        known = run.content.get("known_mass")
        reason = reason if known is None else "this run calibrated the torques; it writes no card"
        return Section("card", title, missing=(reason,))
    flange = mapping(run.content, "flange")
    words = (
        f"In the frame of the flange {flange.get('name', '?')} on body "
        f"{flange.get('in_body', '?')}. Check that the controller means the same frame."
    )
    return Section("card", title, (words,), blocks=tuple(_blocks(cards)))


def _blocks(cards: Any) -> Iterator[tuple[str, str]]:
    for entry in cards.values():
        about = [str(entry.get("explanation", "")), *map(str, entry.get("notes") or ())]
        comment = "\n".join(f"# {line}" for line in about if line)
        yield str(entry.get("title", "card")), f"{comment}\n{entry.get('text', '')}"


def scatter(run: Run) -> Section | None:
    """Return the payload according to each recording alone, or None where nothing is known."""
    found = [one for one in run.content.get("scatter") or () if isinstance(one, dict)]
    if not found:
        return None
    words = (
        "If one recording says something else than the others, it was made with another payload, "
        "or something was changed between them.",
    )
    return Section("scatter", "Each recording alone", words, figures=(_masses(run, found),))


def _masses(run: Run, found: list[dict[str, Any]]) -> Figure:
    mass = number(mapping(run.content, "payload").get("mass"))
    names = [str(one.get("name", "?")) for one in found]
    masses = np.array([number(one.get("mass")) for one in found])
    noise = np.nan_to_num([number(one.get("noise_error")) for one in found])
    whole = np.nan_to_num([number(one.get("error")) for one in found])
    header = ("recording", "kind", "mass [kg]", "± noise alone [kg]", "± all [kg]")
    rows = [
        (name, "loaded" if one.get("is_loaded") else "empty", text(m, n), plus_minus(n))
        + (plus_minus(w),)
        for name, one, m, n, w in zip(names, found, masses, noise, whole)
    ]
    caption = (
        "Mass of the payload according to each recording against all of the other kind [kg]: thin "
        "bars ± the whole error, thick bars ± noise alone. The line is the result of all."
    )

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        places = -np.arange(len(names), dtype=float)
        ax.axvline(mass, color=MEASURED, label="all together")
        ax.errorbar(masses, places, xerr=whole, fmt="none", ecolor=BEFORE, lw=1.0, capsize=3)
        style = {"fmt": "o", "color": AFTER, "elinewidth": 3.0, "label": "one alone"}
        ax.errorbar(masses, places, xerr=noise, **style)
        ax.set_yticks(places, [shortened(name, 26) for name in names])
        ax.set_xlabel("mass [kg]")
        legend(canvas, ax)

    size = (NARROW, 1.6 + 0.3 * len(names))
    return drawn("scatter", caption, table(header, rows), size, draw)

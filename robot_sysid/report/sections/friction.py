"""Friction of every joint: the curve that was identified and the measured points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robot_sysid.records.figures import position, term_unit, torque, with_error
from robot_sysid.report.drawing import AFTER, BEFORE, MEASURED, NARROW, drawn, legend
from robot_sysid.report.elements import Figure, Section, Table, table
from robot_sysid.report.runs import Run
from robot_sysid.report.saved import ReportData
from robot_sysid.report.sections.torques import NOTHING, scattered


def friction(run: Run) -> Section:
    """Return friction coefficients and curves."""
    title = "Friction"
    found = run.friction()
    slides = {} if run.data is None else dict(zip(run.data.joints, run.data.is_slide))
    if not found:
        return Section("friction", title, ("No friction was estimated.",))
    tables = (_coefficients(found, slides),)
    words = (
        "Dots: what is left of the measured torque when all but friction is taken off. Circles: "
        "their mean in bins of speed. Blue: the identified friction in the same bins, with all its "
        f"terms ({run.content.get('friction_model', 'as listed')})."
    )
    if run.data is None:
        return Section("friction", title, tables=tables, missing=(NOTHING,))
    data = run.data
    drawable = [j for j in range(len(data.joints)) if np.any(data.friction[:, j])]
    figures = tuple(_curve(data, joint) for joint in drawable)
    return Section("friction", title, (words,), tables, figures)


def _coefficients(
    found: Sequence[tuple[str, str, float, float]], slides: Mapping[str, bool]
) -> Table:
    """Return one row per joint, one column per term."""
    values = {(owner, name): with_error(value, error) for owner, name, value, error in found}
    owners = dict.fromkeys(owner for owner, _ in values)
    terms = dict.fromkeys(name for _, name in values)
    slide = any(slides.values())
    header = ("joint", *(f"{name} [{term_unit(name, slide) or '1'}]" for name in terms))
    rows = [(owner, *(values.get((owner, name), "–") for name in terms)) for owner in owners]
    mixed = slide and not all(slides.values())
    note = "Units are those of slides; of hinges N·m for N and rad for m." if mixed else ""
    return table(header, rows, note)


def _curve(data: ReportData, joint: int) -> Figure:
    unit, speed_unit = torque(data.is_slide[joint]), f"{position(data.is_slide[joint])}/s"
    columns = (data.speed, data.friction_measured, data.friction_predicted)
    rows = [row for row in zip(*(c[joint] for c in columns)) if np.isfinite(row[0])]
    header = (f"speed [{speed_unit}]", f"measured [{unit}]", f"identified [{unit}]")
    caption = f"{data.joints[joint]}: friction torque [{unit}] against speed [{speed_unit}]."

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        left = data.friction + data.measured - data.predicted
        dots = scattered(np.isfinite(left[:, joint]))
        ax.plot(data.qd[dots, joint], left[dots, joint], ".", color=MEASURED, ms=2.5, alpha=0.7)
        known = np.isfinite(data.speed[joint])
        speed = data.speed[joint, known]
        style = {"marker": "o", "mfc": "none", "mec": BEFORE, "ls": "none", "label": "measured"}
        ax.plot(speed, data.friction_measured[joint, known], **style)
        for side in (speed < 0.0, speed > 0.0):
            curve = data.friction_predicted[joint, known][side]
            label = "identified" if speed[side].size and speed[side][0] > 0.0 else None
            ax.plot(speed[side], curve, color=AFTER, lw=1.8, label=label)
        ax.set_xlabel(f"speed [{speed_unit}]")
        ax.set_ylabel(f"friction [{unit}]")
        legend(canvas, ax)

    return drawn(f"friction-{joint}", caption, table(header, rows), (NARROW, 3.0), draw)

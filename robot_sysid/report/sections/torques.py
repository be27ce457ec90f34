"""Measured against predicted torque, and what the difference looks like, joint by joint."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_sysid.records.figures import position, torque
from robot_sysid.report.drawing import AFTER, BEFORE, INK, MEASURED, NARROW, drawn, legend
from robot_sysid.report.elements import Figure, Section, table
from robot_sysid.report.runs import PAYLOAD, Run
from robot_sysid.report.saved import ReportData
from robot_sysid.report.statistics import LONGEST_LAG

NOTHING = "there is no report_data.npz: identify again with this version"
_SCATTERED = 400


def torques(run: Run) -> Section:
    """Return measured and predicted torque of each joint, the residual below."""
    data = run.data
    if data is None:
        return Section("torques", "Measured and predicted torque", missing=(NOTHING,))
    before = "the arm without the payload" if run.kind == PAYLOAD else "the model before"
    figures = [_torque(data, joint, before) for joint in range(len(data.joints))]
    sentences = [
        f"Grey: measured. Blue: predicted by the result. Orange, dashed: predicted by {before}. "
        "Below: measured minus predicted by the result. Gaps are samples that were not used, "
        "mostly because the joint hardly moved."
    ]
    if data.drawn:
        sentences.append(f"Long recording: {data.drawn}.")
    return Section(
        "torques", "Measured and predicted torque", tuple(sentences), figures=tuple(figures)
    )


def _torque(data: ReportData, joint: int, before: str) -> Figure:
    unit, name = torque(data.is_slide[joint]), data.joints[joint]
    measured, after = data.measured[:, joint], data.predicted[:, joint]
    left = measured - after
    rows = zip(data.time, measured, after, data.before[:, joint], left)
    header = ("time [s]", *(f"{n} [{unit}]" for n in ("measured", "after", "before", "residual")))
    caption = (
        f"{name}: measured torque, predicted after and before, and the residual [{unit}]; "
        f"root mean square {_rms(left):.3g} {unit} of {_rms(measured):.3g} {unit} "
        f"({before} leaves {_rms(measured - data.before[:, joint]):.3g} {unit})."
    )

    def draw(canvas: Any) -> None:
        upper, lower = canvas.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
        upper.plot(data.time, measured, color=MEASURED, lw=2.2, alpha=0.8, label="measured")
        style = {"color": BEFORE, "ls": "--", "lw": 0.9, "label": "before"}
        upper.plot(data.time, data.before[:, joint], **style)
        upper.plot(data.time, after, color=AFTER, label="after")
        upper.set_ylabel(f"torque [{unit}]")
        lower.plot(data.time, left, color=INK, lw=0.7)
        lower.set_ylabel(f"residual [{unit}]")
        lower.set_xlabel("time [s]")
        canvas.align_ylabels()
        legend(canvas, upper)

    return drawn(f"torque-{joint}", caption, table(header, rows), (NARROW, 3.6), draw)


def _rms(values: Any) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def residuals(run: Run) -> Section:
    """Return residuals against speed, their histogram and their autocorrelation."""
    data = run.data
    title = "What is left over"
    if data is None:
        return Section("residuals", title, missing=(NOTHING,))
    sentences = (
        "If only sensor noise is left over, the residual does not depend on speed, its histogram "
        "is the bell curve of the same width, and its autocorrelation stays within the grey band "
        "from the first lag on. A slope against speed is friction that the model does not have; a "
        "long tail in the autocorrelation means that the model, not noise, limits the result.",
    )
    figures = [_left_over(data, joint) for joint in range(len(data.joints))]
    return Section("residuals", title, sentences, figures=tuple(figures))


def _left_over(data: ReportData, joint: int) -> Figure:
    name, unit = data.joints[joint], torque(data.is_slide[joint])
    speed_unit = f"{position(data.is_slide[joint])}/s"
    rows = zip(data.speed[joint], data.residual_mean[joint], data.residual_spread[joint])
    header = (f"speed [{speed_unit}]", f"mean residual [{unit}]", f"spread [{unit}]")
    known = [row for row in rows if np.isfinite(row[0])]
    beyond = np.abs(data.correlation[joint, 1:]) > data.independent[joint]
    share = f"{100.0 * np.mean(beyond):.0f} %" if len(beyond) else "none"
    caption = (
        f"{name}: residual against speed (dots, with mean and spread), histogram with the bell "
        f"curve of its width, and autocorrelation up to {LONGEST_LAG:g} s; {share} of the lags are "
        "outside the band of noise without memory."
    )

    def draw(canvas: Any) -> None:
        against, (shape, memory) = _axes(canvas)
        _against_speed(against, data, joint)
        against.set_xlabel(f"speed [{speed_unit}]")
        against.set_ylabel(f"residual [{unit}]")
        _histogram(shape, data, joint)
        shape.set_xlabel(f"residual [{unit}]")
        band = data.independent[joint]
        memory.axhspan(-band, band, color=MEASURED, alpha=0.35, lw=0)
        memory.plot(data.lags, data.correlation[joint], color=AFTER, marker=".", ms=3)
        memory.set_xlabel("lag [s]")
        memory.set_ylabel("autocorrelation")
        memory.set_ylim(min(-0.3, float(np.min(data.correlation[joint])) - 0.05), 1.05)

    return drawn(f"residual-{joint}", caption, table(header, known), (NARROW, 3.9), draw)


def _axes(canvas: Any) -> tuple[Any, tuple[Any, Any]]:
    grid = canvas.add_gridspec(2, 2)
    return canvas.add_subplot(grid[0, :]), tuple(canvas.add_subplot(grid[1, k]) for k in (0, 1))


def _against_speed(ax: Any, data: ReportData, joint: int) -> None:
    left = data.measured[:, joint] - data.predicted[:, joint]
    dots = scattered(np.isfinite(left))
    ax.plot(data.qd[dots, joint], left[dots], ".", color=MEASURED, ms=2.5, alpha=0.7)
    known = np.isfinite(data.speed[joint])
    style = {"color": AFTER, "fmt": "o-", "ms": 3, "lw": 1.0, "capsize": 2}
    mean, spread = data.residual_mean[joint, known], data.residual_spread[joint, known]
    ax.errorbar(data.speed[joint, known], mean, yerr=spread, **style)


def scattered(used: Any) -> Any:
    """Return which samples (m,) are drawn as dots: some of those in use, evenly."""
    places = np.flatnonzero(used)
    return places[:: max(1, len(places) // _SCATTERED)]


def _histogram(ax: Any, data: ReportData, joint: int) -> None:
    edges, counts = data.edges[joint], data.counts[joint]
    total = max(float(np.sum(counts)), 1.0)
    ax.stairs(counts, edges, fill=True, color=MEASURED, alpha=0.6)
    middles, width = 0.5 * (edges[1:] + edges[:-1]), float(edges[1] - edges[0])
    spread = float(np.sqrt(np.sum(counts * middles**2) / total)) or 1.0
    bell = np.exp(-0.5 * (middles / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    ax.plot(middles, total * width * bell, color=AFTER)
    ax.set_ylabel("samples")

"""How the arm moved: positions, velocities and torques against their limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_sysid.records import Array
from robot_sysid.records.figures import position
from robot_sysid.report.drawing import (
    AFTER,
    BEFORE,
    INK,
    MEASURED,
    NARROW,
    OTHER,
    TRUTH,
    WIDE,
    drawn,
    legend,
)
from robot_sysid.report.elements import Figure, Section, table
from robot_sysid.report.runs import Run
from robot_sysid.report.saved import ReportData
from robot_sysid.report.sections.torques import NOTHING

_NEAR = 0.5
"""Share of what a joint moved through within which a limit is near enough to be drawn."""


def excitation(run: Run) -> Section:
    """Return what share of its limits each joint used, and its motion."""
    title = "Excitation"
    if run.data is None:
        return Section("excitation", title, missing=(NOTHING,))
    words = (
        "A motion that uses little of its limits tells little: the larger and faster it is, the "
        "smaller the errors. Speed limits are those that a motion of this program keeps, where the "
        "model has none of its own."
    )
    joints = range(len(run.data.joints))
    figures = (_shares(run.data), *(_motion(run.data, joint) for joint in joints))
    return Section("excitation", title, (words,), figures=figures)


def _shares(data: ReportData) -> Figure:
    spans = np.ptp(data.q, axis=0) / (data.upper - data.lower)
    speed = np.max(np.abs(data.qd), axis=0) / data.velocity
    known = np.where(np.isfinite(data.measured), data.measured, 0.0)
    load = np.max(np.abs(known), axis=0) / data.torque
    shares = {"range of positions": spans, "speed": speed, "torque": load}
    rows = [
        (name, *(_percent(share[j]) for share in shares.values()))
        for j, name in enumerate(data.joints)
    ]
    numbers = table(("joint", *(f"{what} [% of limit]" for what in shares)), rows)
    caption = (
        "Share of each limit that the motion used [%]; a joint without a bar has no limit of that "
        "kind in its model. Over 100 % the recording went beyond what the model allows."
    )

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        places = np.arange(len(data.joints))
        styles = ((AFTER, ""), (BEFORE, "///"), (TRUTH, "..."))
        for k, ((what, share), (colour, hatch)) in enumerate(zip(shares.items(), styles)):
            heights = 100.0 * np.where(np.isfinite(share), share, 0.0)
            style = {"facecolor": colour, "edgecolor": INK, "alpha": 0.8, "hatch": hatch}
            ax.bar(places + 0.27 * (k - 1), heights, 0.25, label=what, **style)
        ax.axhline(100.0, color=OTHER, ls="--", lw=1.0)
        ax.set_xticks(places, [shortened(name) for name in data.joints], rotation=20, ha="right")
        ax.set_ylabel("share of limit [%]")
        legend(canvas, ax)

    return drawn("excitation", caption, numbers, (WIDE, 3.2), draw)


def shortened(name: str, most: int = 22) -> str:
    """Return a name that leaves room for others."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f}" if np.isfinite(share) and share > 0.0 else "no limit"


def _motion(data: ReportData, joint: int) -> Figure:
    unit = position(data.is_slide[joint])
    q, qd = data.q[:, joint], data.qd[:, joint]
    low, high, fast = (float(v[joint]) for v in (data.lower, data.upper, data.velocity))
    rows = zip(data.time, q, qd)
    numbers = table(("time [s]", f"position [{unit}]", f"speed [{unit}/s]"), rows)
    limits = f"{low:.3g} to {high:.3g} {unit}" if np.isfinite(high - low) else "no position limit"
    caption = (
        f"{data.joints[joint]}: position [{unit}] and speed [{unit}/s] as recorded; limits "
        f"(dashed where near): {limits}, ± {fast:.3g} {unit}/s."
    )

    def draw(canvas: Any) -> None:
        upper, lower = canvas.subplots(2, 1, sharex=True)
        upper.plot(data.time, q, color=AFTER)
        lower.plot(data.time, qd, color=MEASURED)
        _limit_lines(upper, q, (low, high))
        _limit_lines(lower, qd, (-fast, fast))
        upper.set_ylabel(f"position [{unit}]")
        lower.set_ylabel(f"speed [{unit}/s]")
        lower.set_xlabel("time [s]")
        canvas.align_ylabels()

    return drawn(f"motion-{joint}", caption, numbers, (NARROW, 3.0), draw)


def _limit_lines(ax: Any, values: Array, limits: tuple[float, float]) -> None:
    low, high = float(np.min(values)), float(np.max(values))
    room = _NEAR * (high - low)
    for limit in limits:
        if low - room <= limit <= high + room:
            ax.axhline(limit, color=OTHER, ls="--", lw=1.0)

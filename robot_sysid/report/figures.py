"""What the figures of a run show: torques and friction.

A joint is known by its index from the base.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from robot_sysid.records import Array, Traces
from robot_sysid.records.messages import position_unit, torque_unit
from robot_sysid.report.drawing import COLOURS, Figure, add_legend, new_figure, svg

TORQUE_HEIGHT = 310.0
"""Height of a figure of torques above residuals [px]."""
FRICTION_HEIGHT = 230.0
"""Height of a figure of friction [px]."""
PANEL_WIDTH = 230.0
"""Width of a panel of the grid of all joints [px]: three fit side by side in half a screen, two on
a phone."""
PANEL_HEIGHT = 130.0
"""Height of a panel [px]: seven joints in rows of three fit on the first screen."""
MOST_POINTS = 200
"""Number of points of a line of a panel from which there are several to a pixel."""
MOST_TICKS = 3
"""Number of intervals between ticks of a panel, of which a wider choice would overlap."""
MEASURED_WIDTH = 3.2
"""Width of the line of measured torque [px], behind the predicted ones, so that it shows beside
them."""
MOST_DOTS = 300
"""Number of dots of a figure from which more would overlap."""


def torque_figure(traces: Traces, joint: int, name: str = "torque") -> Figure:
    """Return the figure of a joint's torque, measured and predicted, above both residuals."""
    unit = torque_unit(traces.is_slide[joint])
    measured = traces.measured[:, joint]
    before = traces.prior_prediction[:, joint]
    after = traces.predicted[:, joint]
    canvas, ((torque_axes,), (axes,)) = new_figure(TORQUE_HEIGHT, 2)
    time = traces.time
    torque_axes.plot(
        time, measured, color=COLOURS["measured"], lw=MEASURED_WIDTH, label="measured"
    )
    for label, prediction, style in (("before", before, "--"), ("after", after, "-")):
        colour = COLOURS[label]
        torque_axes.plot(time, prediction, style, color=colour, label=label)
        axes.plot(time, measured - prediction, style, color=colour)
    torque_axes.set_ylabel(f"torque [{unit}]")
    axes.set(xlabel="time [s]", ylabel=f"residual [{unit}]")
    add_legend(canvas)
    rms_before = _rms(measured - before)
    caption = (
        f"{traces.joints[joint]}: residual {rms_before:.3g} {unit} before, "
        f"{_rms(measured - after):.3g} {unit} after (root mean square), of a torque of "
        f"{_rms(measured):.3g} {unit}."
    )
    return Figure(caption, svg(canvas, f"{name}-{joint}"))


def torque_panel(traces: Traces, joint: int) -> Figure:
    """Return the small figure of a joint's torque, measured and predicted, for a grid of all."""
    canvas, ((axes,),) = new_figure(PANEL_HEIGHT, width=PANEL_WIDTH)
    chosen = slice(None, None, max(1, len(traces.time) // MOST_POINTS))
    time = traces.time[chosen]
    lines = (
        ("measured", traces.measured, "-", MEASURED_WIDTH),
        ("before", traces.prior_prediction, "--", None),
        ("after", traces.predicted, "-", None),
    )
    for name, torque, style, width in lines:
        colour = COLOURS[name]
        axes.plot(time, torque[chosen, joint], style, color=colour, lw=width)
    axes.locator_params(nbins=MOST_TICKS)
    unit = torque_unit(traces.is_slide[joint])
    caption = f"{traces.joints[joint]}: torque [{unit}]"
    return Figure(caption, svg(canvas, f"panel-{joint}"))


class ErrorBars(NamedTuple):
    """The error of a joint's torque before and after, as two bars.

    Attributes:
        joint: its name.
        before: error of the model before, over the joint's own torque; NaN where it has none.
        after: that of the result.
        scale: the largest error of all joints, to which bars are drawn.
    """

    joint: str
    before: float
    after: float
    scale: float


def error_bars(errors: Mapping[str, tuple[float, float]]) -> list[ErrorBars]:
    """Return the bars of all joints; ``errors``: joint to its relative error before and after."""
    numbers = [error for pair in errors.values() for error in pair]
    scale = max(filter(np.isfinite, numbers), default=0.0) or 1.0
    return [ErrorBars(joint, *pair, scale) for joint, pair in errors.items()]


def drawn_errors(traces: Traces) -> dict[str, tuple[float, float]]:
    """Return joint to the relative error of its torques as they are drawn, before and after."""
    torque = _rms(traces.measured)
    before = _rms(traces.measured - traces.prior_prediction) / torque
    after = _rms(traces.residual) / torque
    pairs = zip(before.tolist(), after.tolist())
    return dict(zip(traces.joints, pairs))


def _rms(values: Array) -> Array:
    """Return the root mean square of the finite numbers of each column; NaN where none is."""
    is_finite = np.isfinite(values)
    count = np.sum(is_finite, axis=0)
    squares = np.sum(np.where(is_finite, values, 0.0) ** 2, axis=0)
    return np.sqrt(squares / np.where(count > 0, count, np.nan))


def friction_figure(traces: Traces, joint: int) -> Figure:
    """Return the figure of a joint's friction torque, measured and identified, against speed."""
    friction = traces.friction[:, joint]
    measured = friction + traces.residual[:, joint]
    used = np.flatnonzero(np.isfinite(measured))
    used = used[:: max(1, len(used) // MOST_DOTS)]
    speed = traces.qd[used, joint]
    canvas, ((axes,),) = new_figure(FRICTION_HEIGHT)
    axes.plot(
        speed, measured[used], ".", color=COLOURS["measured"], label="measured", ms=5
    )
    axes.plot(
        speed, friction[used], ".", color=COLOURS["after"], label="identified", ms=4
    )
    is_slide = traces.is_slide[joint]
    axes.set(
        xlabel=f"speed [{position_unit(is_slide)}/s]",
        ylabel=f"friction [{torque_unit(is_slide)}]",
    )
    add_legend(canvas)
    caption = f"Friction of {traces.joints[joint]} [{torque_unit(is_slide)}]."
    return Figure(caption, svg(canvas, f"friction-{joint}"))

"""What the figures of a run show: torques and friction.

A joint is known by its index from the base.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array, Traces
from robot_sysid.records.messages import position_unit, torque_unit
from robot_sysid.report.drawing import COLOURS, Figure, add_legend, new_figure, svg

TORQUE_HEIGHT = 310.0
"""Height of a figure of torques above residuals [px]."""
FRICTION_HEIGHT = 230.0
"""Height of a figure of friction [px]."""
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


def joint_of_largest_change(traces: Traces) -> int:
    """Return the index of the joint whose root mean square residual has changed most."""
    before = _rms(traces.measured - traces.prior_prediction)
    return int(np.argmax(np.nan_to_num(np.abs(before - _rms(traces.residual)))))


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

"""What the figures of a run show: torques, friction, motion, numbers and errors.

A joint is known by its index from the base.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import Array, Traces
from robot_sysid.records.messages import PARAMETER_UNITS, position_unit, torque_unit
from robot_sysid.report.drawing import (
    COLOURS,
    Figure,
    add_legend,
    name_rows,
    new_figure,
    svg,
)
from robot_sysid.report.runs import Run, body_in

_MAX_DOTS = 300
"""Number of dots to which a scatter plot is thinned; more would overlap."""
_VERSIONS = {
    "before": (0.2, "D", "before"),
    "in the file": (-0.2, "s", "other"),
    "truth": (-0.2, "*", "truth"),
    "after": (0.0, "o", "after"),
}
"""Version of a body's parameters to (distance from its row, marker, colour)."""
_GROUPS = ((0, 1, "mass"), (1, 4, "first moment"), (4, 10, "inertia about the origin"))
"""(start, end, title) of the parameters (10,) that have one unit and share one panel."""


def torque_figure(traces: Traces, joint: int, name: str = "torque") -> Figure:
    """Return the figure of a joint's torque, measured and predicted, above both residuals."""
    unit = torque_unit(traces.is_slide[joint])
    measured = traces.measured[:, joint]
    before = traces.prior_prediction[:, joint]
    after = traces.predicted[:, joint]
    canvas, ((torque_axes,), (axes,)) = new_figure(310.0, 2, sharex=True)
    time = traces.time
    torque_axes.plot(
        time, measured, color=COLOURS["measured"], lw=3.2, label="measured"
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


def most_changed(traces: Traces) -> int:
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
    used = used[:: max(1, len(used) // _MAX_DOTS)]
    speed = traces.qd[used, joint]
    canvas, ((axes,),) = new_figure(230.0)
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


def motion_figure(traces: Traces, joint: int) -> Figure:
    """Return the figure of a joint's speed against its position, with its limits."""
    unit = position_unit(traces.is_slide[joint])
    q = traces.q[:, joint]
    qd = traces.qd[:, joint]
    limits = traces.limits
    low = float(limits.lower[joint])
    high = float(limits.upper[joint])
    fastest = float(limits.velocity[joint])
    canvas, ((axes,),) = new_figure(210.0)
    axes.plot(q, qd, color=COLOURS["after"], lw=1.0)
    for limit in (low, high):
        if np.isfinite(limit):
            axes.axvline(limit, color=COLOURS["other"], ls="--")
    for limit in (-fastest, fastest):
        axes.axhline(limit, color=COLOURS["other"], ls="--")
    axes.set(xlabel=f"position [{unit}]", ylabel=f"speed [{unit}/s]")
    position_limits = "no limit of position"
    if np.isfinite(high - low):
        position_limits = f"positions from {low:.3g} to {high:.3g} {unit}"
    caption = f"{traces.joints[joint]}; limits: {position_limits}, speed {fastest:.3g} {unit}/s."
    return Figure(caption, svg(canvas, f"motion-{joint}"))


def versions_of(run: Run, name: str) -> dict[str, Array]:
    """Return version ("before", "after", ...) to the parameters (10,) of a body of a run."""
    entry = run.bodies[name]
    versions = {"after": body_in(entry).theta}
    for version, key in (("before", "model"), ("in the file", "in_the_file")):
        # Of a run without links, "model" is the file.
        if "mass" in (entry.get(key) or {}):
            versions[version] = body_in(entry[key]).theta
    truth = None if run.traces is None else run.traces.truth
    if truth is not None and name == next(iter(run.bodies)):
        versions["truth"] = truth.theta
    return versions


def parameter_figure(run: Run, name: str) -> Figure:
    """Return the figure of a body's ten parameters in all versions, with standard errors."""
    versions = versions_of(run, name)
    errors = _errors_of(run.bodies[name])
    ratios = [end - start + 0.6 for start, end, _ in _GROUPS]
    canvas, axes = new_figure(420.0, 3, height_ratios=ratios)
    for panel, (start, end, title) in zip(axes[:, 0], _GROUPS):
        columns = {key: theta[start:end] for key, theta in versions.items()}
        _draw_versions(panel, columns, errors[start:end])
        name_rows(panel, PARAMETER_NAMES[start:end])
        panel.set_xlabel(f"{title} [{PARAMETER_UNITS[start]}]")
    add_legend(canvas)
    others = [version for version in versions if version != "after"]
    caption = f"{name}: identified parameters ± one standard error"
    caption += f", and {', '.join(others)}." if others else "."
    return Figure(caption, svg(canvas, f"parameters {name}"))


def mass_figure(run: Run) -> Figure:
    """Return the figure of the masses of all links in all versions, from the base on."""
    first, *others = run.bodies
    names = [*others, first]
    columns: dict[str, Array] = {}
    for row, name in enumerate(names):
        for version, theta in versions_of(run, name).items():
            masses = columns.setdefault(version, np.full(len(names), np.nan))
            masses[row] = theta[0]
    errors = np.array([_errors_of(run.bodies[name])[0] for name in names])
    canvas, ((axes,),) = new_figure(80.0 + 30.0 * len(names))
    _draw_versions(axes, columns, errors)
    name_rows(axes, names)
    axes.set_xlabel("mass [kg]")
    add_legend(canvas)
    return Figure("Mass of each link ± one standard error.", svg(canvas, "masses"))


def _errors_of(entry: Mapping[str, Any]) -> Array:
    """Return the standard errors (10,) of a body's parameters; NaN where not known."""
    errors = entry["standard_errors"]
    return np.array([errors.get(name) for name in PARAMETER_NAMES], dtype=float)


def _draw_versions(axes: Any, versions: Mapping[str, Array], errors: Array) -> None:
    """Draw markers of all versions of m numbers (m,), one row each; "after" with its errors."""
    rows = np.arange(len(errors))
    for version, (shift, marker, colour) in _VERSIONS.items():
        if version in versions:
            is_after = version == "after"
            axes.errorbar(
                versions[version],
                rows - shift,
                xerr=np.nan_to_num(errors) if is_after else None,
                fmt=marker,
                color=COLOURS[colour],
                mfc=COLOURS[colour] if is_after else "none",
                label="after ±" if is_after else version,
            )


def budget_figure(name: str, entry: Mapping[str, Any]) -> Figure:
    """Return the figure of the share that each cause has in the variance of each parameter."""
    budget = entry["error_budget"]
    squares = {}
    for cause, errors in budget.items():
        column = np.array([errors[name] for name in PARAMETER_NAMES], dtype=float)
        squares[cause] = np.nan_to_num(column) ** 2
    total = np.maximum(np.sum(list(squares.values()), axis=0), 1e-300)
    colours = [COLOURS[c] for c in ("after", "before", "truth", "other", "measured")]
    largest = sorted(squares, key=lambda cause: -np.sum(squares[cause] / total))
    canvas, ((axes,),) = new_figure(360.0)
    left = np.zeros(10)
    for cause, colour in zip(largest, colours):
        share = 100.0 * squares[cause] / total
        # Gaps between the boxes separate them without colours, too.
        axes.barh(
            range(10), share - 0.3, 0.76, left, color=colour, label=cause, alpha=0.8
        )
        left = left + share
    name_rows(axes, PARAMETER_NAMES)
    axes.set(xlim=(0.0, 100.0), xlabel="share of the error's variance [%]")
    add_legend(canvas)
    caption = (
        f"{name}: what each parameter's error comes from. Where noise is small, a longer recording "
        "does not help. What is left to 100 % has other causes."
    )
    return Figure(caption, svg(canvas, f"errors {name}"))


def prediction_figure(file: Mapping[str, Any]) -> Figure:
    """Return the figure of each joint's torque error on held-out data, before and after.

    ``file`` is the entry of params.json on the written model.
    """
    names = list(file["before"]["rmse_per_joint"])
    canvas, ((axes,),) = new_figure(90.0 + 32.0 * len(names))
    for shift, version in ((-0.2, "before"), (0.2, "after")):
        errors = (file[version] or {"rmse_per_joint": {}})["rmse_per_joint"]
        rows = np.arange(len(names)) + shift
        values = np.array([errors.get(name) for name in names], dtype=float)
        axes.barh(rows, values, 0.36, color=COLOURS[version], label=version, alpha=0.8)
    name_rows(axes, names)
    axes.set_xlabel("torque error [N·m, slides N]")
    add_legend(canvas)
    source = file["before"]["source"]
    caption = f"Torque error of the model before and after on {source} [N·m]."
    return Figure(caption, svg(canvas, "prediction"))

"""Sections of the report on joints: torques, residuals, friction, motion, prediction errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from robot_sysid.records import Array, Validation
from robot_sysid.records.messages import (
    percent,
    position_unit,
    term_unit,
    torque_unit,
    with_error,
)
from robot_sysid.report import drawing
from robot_sysid.report.drawing import Curves, Figure, Panel, Section, Table
from robot_sysid.report.runs import LONGEST_LAG, ReportData, Run, number
from robot_sysid.results.record import Quantity as Estimated

_NEAR = 0.5
"""Share of what a joint moved through within which a limit is near enough to be drawn."""


def torques(run: Run) -> Section | None:
    """Return measured and predicted torque of each joint, the residual below."""
    reference = "the arm without the payload" if run.is_payload else "the model before"
    explanation = (
        f"Grey: measured. Blue: predicted by the result. Orange, dashed: predicted by {reference}. "
        "Below: measured minus predicted by the result. Gaps are samples that were not used, "
        "mostly because the joint hardly moved."
    )
    if run.data is not None and run.data.thinning_text:
        explanation += f" Long recording: {run.data.thinning_text}."
    title = "Measured and predicted torque"
    return _by_joint(
        run, "torques", title, explanation, partial(_torque, reference=reference)
    )


def _by_joint(
    run: Run,
    key: str,
    title: str,
    explanation: str,
    figure: Callable[[ReportData, int], Figure],
    *numbers: Callable[[ReportData], Table],
) -> Section | None:
    if (data := run.data) is None:
        return None
    figures = [figure(data, joint) for joint in range(len(data.joints))]
    return Section(
        key, title, (explanation,), [table_of(data) for table_of in numbers], figures
    )


def _torque(data: ReportData, joint: int, reference: str) -> Figure:
    unit = torque_unit(data.is_slide[joint])
    name = data.joints[joint]
    curves = _before_after(data, joint)
    measured, prior_prediction, predicted = (values for values, _ in curves.values())
    residual = measured - predicted
    residual_rms, measured_rms, prior_rms = map(
        _rms, (residual, measured, measured - prior_prediction)
    )
    caption = (
        f"{name}: measured torque, predicted after and before, and the residual [{unit}]; "
        f"root mean square {residual_rms:.3g} {unit} of {measured_rms:.3g} {unit} "
        f"({reference} leaves {prior_rms:.3g} {unit})."
    )
    residual_curve: Curves = {
        f"residual [{unit}]": (residual, {"color": drawing.INK, "lw": 0.7})
    }
    panels = (
        Panel(f"torque [{unit}]", curves, height=2.5),
        Panel(f"residual [{unit}]", residual_curve),
    )
    return drawing.curves(
        f"torque-{joint}", caption, ("time [s]", data.time), panels, 3.6
    )


def most_changed(run: Run) -> Figure:
    """Return measured and predicted torque of the joint whose error has changed most."""
    data = run.data
    assert data is not None
    prior_residual, residual = (
        data.measured - prediction
        for prediction in (data.prior_prediction, data.predicted)
    )
    falls = [
        _rms(prior_rms) - _rms(residual_rms)
        for prior_rms, residual_rms in zip(prior_residual.T, residual.T)
    ]
    joint = int(np.argmax(np.nan_to_num(np.abs(falls))))
    name = data.joints[joint]
    unit = torque_unit(data.is_slide[joint])
    prior_rms = _rms(prior_residual[:, joint])
    residual_rms = _rms(residual[:, joint])
    caption = (
        f"Torque of {name}, measured and predicted before and after: the prediction was off by "
        f"{prior_rms:.3g} {unit}, and is by {residual_rms:.3g} {unit} (root mean square)."
    )
    panel = Panel(f"torque [{unit}]", _before_after(data, joint))
    return drawing.curves(
        "before-after", caption, ("time [s]", data.time), (panel,), 3.0
    )


def _before_after(data: ReportData, joint: int) -> Curves:
    unit = torque_unit(data.is_slide[joint])
    measured, prior_prediction, predicted = (
        torques[:, joint]
        for torques in (data.measured, data.prior_prediction, data.predicted)
    )
    return {
        f"measured [{unit}]": (
            measured,
            {"color": drawing.MEASURED, "lw": 2.2, "alpha": 0.8},
        ),
        f"before [{unit}]": (
            prior_prediction,
            {"color": drawing.BEFORE, "ls": "--", "lw": 0.9},
        ),
        f"after [{unit}]": (predicted, {"color": drawing.AFTER}),
    }


def _rms(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def residuals(run: Run) -> Section | None:
    """Return residuals against speed, their histogram and their autocorrelation."""
    explanation = (
        "If only sensor noise is left over, the residual does not depend on speed, its histogram "
        "is the bell curve of the same width, and its autocorrelation stays within the grey band "
        "from the first lag on. A slope against speed is friction that the model does not have; a "
        "long tail in the autocorrelation means that the model, not noise, limits the result."
    )
    return _by_joint(run, "residuals", "What is left over", explanation, _left_over)


def _left_over(data: ReportData, joint: int) -> Figure:
    residual_label = f"residual [{torque_unit(data.is_slide[joint])}]"
    speed_label = f"speed [{position_unit(data.is_slide[joint])}/s]"
    has_samples = np.isfinite(data.speed[joint])
    columns = (data.speed, data.residual_mean, data.residual_spread)
    speeds, mean, spread = (statistic[joint, has_samples] for statistic in columns)
    band = data.independent[joint]
    memories = data.correlation[joint]
    beyond = np.abs(memories[1:]) > band
    share = f"{100.0 * np.mean(beyond):.0f} %" if len(beyond) else "none"
    caption = (
        f"{data.joints[joint]}: residual against speed (dots, with mean and spread), histogram "
        f"with the bell curve of its width, and autocorrelation up to {LONGEST_LAG:g} s; {share} "
        "of the lags are outside the band of noise without memory."
    )

    def draw(canvas: Any) -> None:
        grid = canvas.add_gridspec(2, 2)
        above = canvas.add_subplot(
            grid[0, :], xlabel=speed_label, ylabel=residual_label
        )
        drawing.dots(
            above, data.qd[:, joint], (data.measured - data.predicted)[:, joint]
        )
        above.errorbar(
            speeds, mean, spread, color=drawing.AFTER, fmt="o-", ms=3, lw=1.0, capsize=2
        )
        shape = canvas.add_subplot(grid[1, 0], xlabel=residual_label, ylabel="samples")
        _histogram(shape, data.edges[joint], data.counts[joint])
        memory = canvas.add_subplot(
            grid[1, 1], xlabel="lag [s]", ylabel="autocorrelation"
        )
        memory.axhspan(-band, band, color=drawing.MEASURED, alpha=0.35, lw=0)
        memory.plot(data.lags, memories, color=drawing.AFTER, marker=".", ms=3)
        memory.set_ylim(min(-0.3, float(np.min(memories)) - 0.05), 1.05)

    numbers = (
        (speed_label, f"mean {residual_label}", f"spread of the {residual_label}"),
        zip(speeds, mean, spread),
    )
    return drawing.draw_figure(f"residual-{joint}", caption, numbers, 3.9, draw)


def _histogram(ax: Any, edges: Array, counts: Array) -> None:
    total = max(float(np.sum(counts)), 1.0)
    ax.stairs(counts, edges, fill=True, color=drawing.MEASURED, alpha=0.6)
    middles = 0.5 * (edges[1:] + edges[:-1])
    width = float(edges[1] - edges[0])
    spread = float(np.sqrt(np.sum(counts * middles**2) / total)) or 1.0
    bell = np.exp(-0.5 * (middles / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    ax.plot(middles, total * width * bell, color=drawing.AFTER)


def friction(run: Run) -> Section:
    """Return friction coefficients, what the written model holds of them, and curves."""
    data = run.data
    slides = {} if data is None else dict(zip(data.joints, data.is_slide))
    coefficient_sets = {
        "joint": run.friction(),
        "joint on another day": run.friction("another_day"),
        **run.friction_of_logs(),
        "joint in the written model": run.friction("in_the_file"),
    }
    tables = tuple(
        _coefficients(title, coefficients, slides)
        for title, coefficients in coefficient_sets.items()
        if coefficients
    )
    explanation = (
        "Dots: what is left of the measured torque when all but friction is taken off. Circles: "
        "their mean in bins of speed. Blue: the identified friction in the same bins, with all its "
        f"terms ({run.content['friction_model'] or 'as listed'})."
    )
    if not tables or data is None:
        explanation = (
            "Curves need the torques." if tables else "No friction was estimated."
        )
        return Section("friction", "Friction", (explanation,), tables)
    moved = [
        joint for joint in range(len(data.joints)) if np.any(data.friction[:, joint])
    ]
    figures = tuple(_curve(data, joint) for joint in moved)
    return Section("friction", "Friction", (explanation,), tables, figures)


def _coefficients(
    title: str,
    coefficients: Mapping[tuple[str, str], Estimated],
    slides: Mapping[str, bool],
) -> Table:
    """Return one row per joint, one column per term."""
    owners, terms = (dict.fromkeys(key[k] for key in coefficients) for k in (0, 1))
    slide = any(slides.values())
    header = (title, *(f"{name} [{term_unit(name, slide) or '1'}]" for name in terms))
    cells = {key: with_error(*quantity) for key, quantity in coefficients.items()}
    rows = [
        (owner, *(cells.get((owner, name), "–") for name in terms)) for owner in owners
    ]
    mixed = slide and not all(slides.values())
    note = (
        "Units are those of slides; of hinges N·m for N and rad for m." if mixed else ""
    )
    return drawing.table(header, rows, note)


def _curve(data: ReportData, joint: int) -> Figure:
    unit = torque_unit(data.is_slide[joint])
    speed = f"speed [{position_unit(data.is_slide[joint])}/s]"
    has_samples = np.isfinite(data.speed[joint])
    columns = (data.speed, data.friction_measured, data.friction_predicted)
    # Dry friction jumps where the speed changes its sign: no line is drawn across.
    turn = np.count_nonzero(data.speed[joint, has_samples] < 0.0)
    speeds, measured, identified = (
        np.insert(statistic[joint, has_samples], turn, np.nan) for statistic in columns
    )
    caption = f"{data.joints[joint]}: friction torque [{unit}] against {speed}."
    lines: Curves = {
        f"measured [{unit}]": (
            measured,
            {"ls": "none", "marker": "o", "mfc": "none", "mec": drawing.BEFORE},
        ),
        f"identified [{unit}]": (identified, {"color": drawing.AFTER, "lw": 1.8}),
    }
    cloud = (
        data.qd[:, joint],
        (data.friction + data.measured - data.predicted)[:, joint],
    )
    panel = Panel(f"friction [{unit}]", lines, cloud=cloud)
    return drawing.curves(f"friction-{joint}", caption, (speed, speeds), (panel,), 3.0)


def excitation(run: Run) -> Section | None:
    """Return what share of its limits each joint used, and its motion."""
    explanation = (
        "A motion that uses little of its limits tells little: the larger and faster it is, the "
        "smaller the errors. Speed limits are those that a motion of this program keeps, where the "
        "model has none of its own."
    )
    return _by_joint(run, "excitation", "Excitation", explanation, _motion, _shares)


def _shares(data: ReportData) -> Table:
    load = np.where(np.isfinite(data.measured), np.abs(data.measured), 0.0)
    limits = {
        "range of positions": (np.ptp(data.q, axis=0), data.upper - data.lower),
        "speed": (np.max(np.abs(data.qd), axis=0), data.velocity),
        "torque": (np.max(load, axis=0), data.torque),
    }
    shares = [100.0 * used / limit for used, limit in limits.values()]
    rows = [
        (
            joint,
            *(
                f"{joint_shares[j]:.0f}" if joint_shares[j] > 0.0 else "no limit"
                for joint_shares in shares
            ),
        )
        for j, joint in enumerate(data.joints)
    ]
    note = "Over 100 % the recording went beyond what the model allows."
    return drawing.table(
        ("joint", *(f"{title} [% of limit]" for title in limits)), rows, note
    )


def _motion(data: ReportData, joint: int) -> Figure:
    unit = position_unit(data.is_slide[joint])
    low, high, fast = (float(v[joint]) for v in (data.lower, data.upper, data.velocity))
    limits = (
        f"{low:.3g} to {high:.3g} {unit}"
        if np.isfinite(high - low)
        else "no position limit"
    )
    caption = (
        f"{data.joints[joint]}: position [{unit}] and speed [{unit}/s] as recorded; limits "
        f"(dashed where near): {limits}, ± {fast:.3g} {unit}/s."
    )
    panels = []
    for label, values, colour, limit_pair in (
        (f"position [{unit}]", data.q[:, joint], drawing.AFTER, (low, high)),
        (f"speed [{unit}/s]", data.qd[:, joint], drawing.MEASURED, (-fast, fast)),
    ):
        margin = _NEAR * np.ptp(values)
        drawn_limits = [
            x
            for x in limit_pair
            if np.min(values) - margin <= x <= np.max(values) + margin
        ]
        panels.append(Panel(label, {label: (values, {"color": colour})}, drawn_limits))
    return drawing.curves(
        f"motion-{joint}", caption, ("time [s]", data.time), panels, 3.0
    )


FITTED = "fitted"


class ErrorSet(NamedTuple):
    """Prediction errors per joint on some data: description, errors, colour of their bars."""

    description: str
    test: Validation
    colour: str


def errors(run: Run) -> Section:
    """Return the errors on fitted and held-out data and on other logs, before and after."""
    sets = list(error_sets(run))
    title = "Prediction errors"
    if not sets:
        return Section(
            "errors", title, missing=("the result file holds no errors per joint",)
        )
    caption = (
        "Root mean square error of the predicted torque of each joint [N·m, N for slides]: of the "
        "fit itself on what was fitted and what was not, and of the model and the written one, as "
        "files, on what was not."
    )
    if len(sets) > len(drawing.HATCHES):
        caption += f" The figure shows the first {len(drawing.HATCHES)} of {len(sets)}."
    header, rows = error_numbers(sets)
    bars = zip((row[3:] for row in rows), sets, drawing.HATCHES)
    series = [
        (error_set.description, heights, error_set.colour)
        for heights, error_set, _ in bars
    ]
    joints = [name.rpartition(" [")[0] for name in header[3:]]
    draw = partial(drawing.bars, groups=joints, series=series, label="error [N·m]")
    height = 1.2 + 0.2 * len(series) + 0.12 * len(series) * len(joints)
    figures = (drawing.draw_figure("errors", caption, (header, rows), height, draw),)
    held_out = any(error_set.description != FITTED for error_set in sets)
    sentences = (
        ()
        if held_out
        else ("Nothing was held out: other motion may be predicted worse.",)
    )
    return Section("errors", title, sentences, figures=figures)


def error_numbers(
    sets: Sequence[ErrorSet],
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Return header and rows: data, error [N m], its share of the torque, error of each joint."""
    joints = dict.fromkeys(
        joint for error_set in sets for joint in error_set.test.rmse_per_joint
    )
    header = (
        "data",
        "all joints [N·m]",
        "of the torque",
        *(f"{j} [N·m or N]" for j in joints),
    )
    rows: list[tuple[Any, ...]] = []
    for description, test, _ in sets:
        share = "–" if test.relative_error is None else percent(test.relative_error)
        joint_errors = (number(test.rmse_per_joint.get(joint)) for joint in joints)
        rows.append((description, number(test.rmse), share, *joint_errors))
    return header, rows


def error_sets(run: Run) -> Iterator[ErrorSet]:
    """Yield all errors per joint that the result file holds, those farthest from the fit last."""
    content = run.content
    file = run.content["file"] or {"others": ()}
    tests = []
    if content["rmse_per_joint"]:
        fitted = Validation("", 0, content["rmse"], None, content["rmse_per_joint"], {})
        yield ErrorSet(FITTED, fitted, drawing.MEASURED)
    for fits, colour, pairs in (
        (content["validation"][:1], drawing.OTHER, [file]),
        (content["validation"][1:], drawing.TRUTH, file["others"]),
    ):
        tests += [("fit", test, colour) for test in fits]
        for pair in pairs:
            tests.append(("model before", pair.get("before"), drawing.BEFORE))
            tests.append(("written model", pair.get("after"), drawing.AFTER))
    for description, test, colour in tests:
        if test is not None and test.rmse_per_joint:
            yield ErrorSet(f"{description}: {test.source}", test, colour)


def rollout(run: Run) -> Section | None:
    """Return how far the model moves away from the arm when it is played, or None."""
    entry = run.content["rollout"]
    if entry is None:
        return None
    opening = f"Both models were played on {entry['held_out']}; in closed loop with"
    sentences = [
        f"{opening} {entry['closed_loop_is']}.",
        "Root mean square position error of the model before -> after [rad, m for slides]:",
    ]
    score = entry["score"]
    if score is not None:
        better = "smaller" if score < 1.0 else "not smaller"
        sentences.insert(
            1, f"Errors are {better} than before: {score:.3g} times, all together."
        )
    rows = []
    for test in entry["errors"]:
        both = [(test["overall"]), *test["joints"].values()]
        cells = (
            f"{drawing.text(e['before'])} -> {drawing.text(e['after'])}" for e in both
        )
        rows.append((f"{test['loop']}, {drawing.text(test['horizon'])} s", *cells))
    joints = entry["errors"][0]["joints"] if rows else ()
    tables = (drawing.table(("played", "all", *joints), rows),) if rows else ()
    return Section(
        "rollout", "Played in the simulator", sentences, tables, (), entry["notes"]
    )

"""Sections of the report on joints: torques, residuals, friction, motion, prediction errors.

A joint is known by its index from the base. Signals of ``ReportData`` have the shape (K, n), for K
instants and n joints, its statistics (n, ...). ``Run.content`` is the content of params.json.
"""

from __future__ import annotations

import itertools
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
from robot_sysid.report.runs import LONGEST_LAG, Friction, ReportData, Run, number

_NEAR = 0.5
"""Largest distance of a limit from the recorded values at which it is drawn, as a share of the
range of these values."""


def torques(run: Run) -> Section | None:
    """Return the section with measured and predicted torque and residual of each joint.

    None if the run has no data to draw.
    """
    reference = "the arm without the payload" if run.is_payload else "the model before"
    explanation = (
        f"Grey: measured. Blue: predicted by the result. Orange, dashed: predicted by {reference}. "
        "Below: measured minus predicted by the result. Gaps are samples that were not used, "
        "mostly because the joint hardly moved."
    )
    if run.data is not None and run.data.thinning_text:
        explanation += f" Long recording: {run.data.thinning_text}."
    title = "Measured and predicted torque"
    figure_of_joint = partial(_torque_figure, reference=reference)
    return _section_by_joint(run, "torques", title, explanation, figure_of_joint)


def _section_by_joint(
    run: Run,
    key: str,
    title: str,
    explanation: str,
    figure_of_joint: Callable[[ReportData, int], Figure],
    *table_makers: Callable[[ReportData], Table],
) -> Section | None:
    """Return a section with one figure per joint, or None if the run has no data to draw.

    Args:
        run: the run whose data are drawn.
        key: identifier of the section in the page.
        title: heading.
        explanation: paragraph below the heading.
        figure_of_joint: returns the figure of a joint, of the data and the joint's index.
        table_makers: return one table of the section each, of the data.
    """
    data = run.data
    if data is None:
        return None
    figures = list(map(partial(figure_of_joint, data), range(len(data.joints))))
    tables = [make_table(data) for make_table in table_makers]
    return Section(key, title, (explanation,), tables, figures)


def _torque_figure(data: ReportData, joint: int, reference: str) -> Figure:
    """Return the figure of a joint's measured torque, predicted torque and residual over time.

    Args:
        data: signals to draw.
        joint: index of the joint, from the base.
        reference: name of the model that made the prior prediction, for the caption.
    """
    unit = torque_unit(data.is_slide[joint])
    name = data.joints[joint]
    measured = data.measured[:, joint]
    residual = measured - data.predicted[:, joint]
    residual_rms = _rms(residual)
    measured_rms = _rms(measured)
    prior_rms = _rms(measured - data.prior_prediction[:, joint])
    caption = (
        f"{name}: measured torque, predicted after and before, and the residual [{unit}]; "
        f"root mean square {residual_rms:.3g} {unit} of {measured_rms:.3g} {unit} "
        f"({reference} leaves {prior_rms:.3g} {unit})."
    )
    residual_curve: Curves = {
        f"residual [{unit}]": (residual, {"color": drawing.INK, "lw": 0.7})
    }
    panels = (
        Panel(f"torque [{unit}]", _torque_curves(data, joint), height=2.5),
        Panel(f"residual [{unit}]", residual_curve),
    )
    across = ("time [s]", data.time)
    return drawing.curves_figure(f"torque-{joint}", caption, across, panels, height=3.6)


def most_changed(run: Run) -> Figure:
    """Return the figure of measured and predicted torque of the joint that changed most.

    That is the joint whose root mean square prediction error differs most between the prior
    prediction and the result. The run must have data to draw.
    """
    data = run.data
    assert data is not None
    prior_residual = data.measured - data.prior_prediction
    residual = data.measured - data.predicted
    prior_rmses = np.array(list(map(_rms, prior_residual.T)))
    rmses = np.array(list(map(_rms, residual.T)))
    joint = int(np.argmax(np.nan_to_num(np.abs(prior_rmses - rmses))))
    name = data.joints[joint]
    unit = torque_unit(data.is_slide[joint])
    prior_rms = prior_rmses[joint]
    residual_rms = rmses[joint]
    caption = (
        f"Torque of {name}, measured and predicted before and after: the prediction was off by "
        f"{prior_rms:.3g} {unit}, and is by {residual_rms:.3g} {unit} (root mean square)."
    )
    panel = Panel(f"torque [{unit}]", _torque_curves(data, joint))
    across = ("time [s]", data.time)
    return drawing.curves_figure("before-after", caption, across, (panel,), height=3.0)


def _torque_curves(data: ReportData, joint: int) -> Curves:
    """Return curves of a joint's torque: measured, predicted by the prior and by the result."""
    unit = torque_unit(data.is_slide[joint])
    measured_style = {"color": drawing.MEASURED, "lw": 2.2, "alpha": 0.8}
    prior_style = {"color": drawing.BEFORE, "ls": "--", "lw": 0.9}
    return {
        f"measured [{unit}]": (data.measured[:, joint], measured_style),
        f"before [{unit}]": (data.prior_prediction[:, joint], prior_style),
        f"after [{unit}]": (data.predicted[:, joint], {"color": drawing.AFTER}),
    }


def _rms(values: Array) -> float:
    """Return the root mean square of all finite numbers in values (K,); NaN if none is finite."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def residuals(run: Run) -> Section | None:
    """Return the section with each joint's residuals against speed, histogram and autocorrelation.

    None if the run has no data to draw.
    """
    explanation = (
        "If only sensor noise is left over, the residual does not depend on speed, its histogram "
        "is the bell curve of the same width, and its autocorrelation stays within the grey band "
        "from the first lag on. A slope against speed is friction that the model does not have; a "
        "long tail in the autocorrelation means that the model, not noise, limits the result."
    )
    title = "What is left over"
    return _section_by_joint(run, "residuals", title, explanation, _residual_figure)


def _residual_figure(data: ReportData, joint: int) -> Figure:
    """Return the figure of a joint's residual: against speed, histogram and autocorrelation."""
    residual_label = f"residual [{torque_unit(data.is_slide[joint])}]"
    speed_label = f"speed [{position_unit(data.is_slide[joint])}/s]"
    has_samples = np.isfinite(data.speed[joint])
    speeds = data.speed[joint, has_samples]
    mean = data.residual_mean[joint, has_samples]
    spread = data.residual_spread[joint, has_samples]
    noise_bound = data.independent[joint]
    correlation = data.correlation[joint]
    is_beyond = np.abs(correlation[1:]) > noise_bound
    share = f"{100.0 * np.mean(is_beyond):.0f} %" if len(is_beyond) else "none"
    caption = (
        f"{data.joints[joint]}: residual against speed (dots, with mean and spread), histogram "
        f"with the bell curve of its width, and autocorrelation up to {LONGEST_LAG:g} s; {share} "
        "of the lags are outside the band of noise without memory."
    )

    def draw(canvas: Any) -> None:
        """Draw the three panels on an empty matplotlib figure."""
        grid = canvas.add_gridspec(2, 2)

        speed_axes = canvas.add_subplot(
            grid[0, :], xlabel=speed_label, ylabel=residual_label
        )
        residual = (data.measured - data.predicted)[:, joint]
        drawing.draw_dots(speed_axes, data.qd[:, joint], residual)
        speed_axes.errorbar(
            speeds, mean, spread, color=drawing.AFTER, fmt="o-", ms=3, lw=1.0, capsize=2
        )

        histogram_axes = canvas.add_subplot(
            grid[1, 0], xlabel=residual_label, ylabel="samples"
        )
        _draw_histogram(histogram_axes, data.edges[joint], data.counts[joint])

        lag_axes = canvas.add_subplot(
            grid[1, 1], xlabel="lag [s]", ylabel="autocorrelation"
        )
        lag_axes.axhspan(
            -noise_bound, noise_bound, color=drawing.MEASURED, alpha=0.35, lw=0
        )
        lag_axes.plot(data.lags, correlation, color=drawing.AFTER, marker=".", ms=3)
        lag_axes.set_ylim(min(-0.3, float(np.min(correlation)) - 0.05), 1.05)

    numbers = (
        (speed_label, f"mean {residual_label}", f"spread of the {residual_label}"),
        zip(speeds, mean, spread),
    )
    return drawing.draw_figure(
        f"residual-{joint}", caption, numbers, height=3.9, draw=draw
    )


def _draw_histogram(ax: Any, edges: Array, counts: Array) -> None:
    """Draw a histogram and the normal distribution of zero mean and equal root mean square.

    Args:
        ax: matplotlib axes to draw on.
        edges: (B + 1,) edges of the bins, evenly spaced.
        counts: (B,) number of samples in each bin.
    """
    total = max(float(np.sum(counts)), 1.0)
    ax.stairs(counts, edges, fill=True, color=drawing.MEASURED, alpha=0.6)
    middles = 0.5 * (edges[1:] + edges[:-1])
    width = float(edges[1] - edges[0])
    spread = float(np.sqrt(np.sum(counts * middles**2) / total)) or 1.0
    bell = np.exp(-0.5 * (middles / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    ax.plot(middles, total * width * bell, color=drawing.AFTER)


def friction(run: Run) -> Section:
    """Return the section on friction: tables of coefficients, and a curve per joint against speed.

    The tables have the coefficients of the run, with errors for another day, of each log and of the
    written model, as far as the run has them. A joint without predicted friction has no curve, and
    no joint has one if the run has no data to draw.
    """
    data = run.data
    slides = {} if data is None else dict(zip(data.joints, data.is_slide))
    coefficient_sets = {
        "joint": run.friction(),
        "joint on another day": run.friction("another_day"),
        **run.friction_of_logs(),
        "joint in the written model": run.friction("in_the_file"),
    }
    tables = []
    for title, coefficients in coefficient_sets.items():
        if coefficients:
            tables.append(_coefficient_table(title, coefficients, slides))
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
    joints = np.flatnonzero(np.any(data.friction, axis=0)).tolist()
    figures = list(map(partial(_friction_figure, data), joints))
    return Section("friction", "Friction", (explanation,), tables, figures)


def _coefficient_table(
    title: str, coefficients: Friction, slides: Mapping[str, bool]
) -> Table:
    """Return a table of friction coefficients: one row per joint, one column per friction term.

    Args:
        title: title of the first column, which names the joints.
        coefficients: joint or coupling to friction term to coefficient and standard error; "–"
            stands for a term that a joint lacks and another joint has.
        slides: joint to whether it is a slide, which determines the units; empty if not known.
    """
    all_terms = dict.fromkeys(itertools.chain.from_iterable(coefficients.values()))
    has_slide = any(slides.values())
    header = [title]
    for term in all_terms:
        header.append(f"{term} [{term_unit(term, has_slide) or '1'}]")
    rows = []
    for owner, terms in coefficients.items():
        row = [owner]
        for term in all_terms:
            row.append(with_error(*terms[term]) if term in terms else "–")
        rows.append(row)
    note = ""
    if has_slide and not all(slides.values()):
        note = "Units are those of slides; of hinges N·m for N and rad for m."
    return drawing.table(header, rows, note)


def _friction_figure(data: ReportData, joint: int) -> Figure:
    """Return the figure of a joint's friction torque, measured and identified, against speed."""
    unit = torque_unit(data.is_slide[joint])
    speed_label = f"speed [{position_unit(data.is_slide[joint])}/s]"
    # Bins of speed with too few samples are NaN.
    has_samples = np.isfinite(data.speed[joint])
    columns = (data.speed, data.friction_measured, data.friction_predicted)
    bins = np.array([column[joint, has_samples] for column in columns])
    # Dry friction jumps where the speed changes its sign: a NaN between the bins of negative and
    # of positive speed keeps the curve from crossing the jump.
    n_negative = np.count_nonzero(bins[0] < 0.0)
    speeds, measured, identified = np.insert(bins, n_negative, np.nan, axis=1)
    caption = f"{data.joints[joint]}: friction torque [{unit}] against {speed_label}."
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
    across = (speed_label, speeds)
    return drawing.curves_figure(
        f"friction-{joint}", caption, across, (panel,), height=3.0
    )


def excitation(run: Run) -> Section | None:
    """Return the section with each joint's motion and the share of its limits that it used.

    None if the run has no data to draw.
    """
    explanation = (
        "A motion that uses little of its limits tells little: the larger and faster it is, the "
        "smaller the errors. Speed limits are those that a motion of this program keeps, where the "
        "model has none of its own."
    )
    return _section_by_joint(
        run, "excitation", "Excitation", explanation, _motion_figure, _limit_table
    )


def _limit_table(data: ReportData) -> Table:
    """Return the table of the shares [%] of position range, speed and torque limits used by joints.

    A cell is "no limit" where the limit is infinite, and where the joint did not move at all.
    """
    load = np.where(np.isfinite(data.measured), np.abs(data.measured), 0.0)
    limits = {
        "range of positions": (np.ptp(data.q, axis=0), data.upper - data.lower),
        "speed": (np.max(np.abs(data.qd), axis=0), data.velocity),
        "torque": (np.max(load, axis=0), data.torque),
    }
    header = ["joint"]
    columns: list[Sequence[str]] = [data.joints]
    for title, (used, limit) in limits.items():
        shares = 100.0 * used / limit
        header.append(f"{title} [% of limit]")
        columns.append([f"{s:.0f}" if s > 0.0 else "no limit" for s in shares])
    note = "Over 100 % the recording went beyond what the model allows."
    return drawing.table(header, zip(*columns), note)


def _motion_figure(data: ReportData, joint: int) -> Figure:
    """Return the figure of a joint's position and speed over time, with limits that are near."""
    unit = position_unit(data.is_slide[joint])
    low = float(data.lower[joint])
    high = float(data.upper[joint])
    fast = float(data.velocity[joint])
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
        lowest_drawn = np.min(values) - margin
        highest_drawn = np.max(values) + margin
        drawn_limits = [x for x in limit_pair if lowest_drawn <= x <= highest_drawn]
        panels.append(Panel(label, {label: (values, {"color": colour})}, drawn_limits))
    across = ("time [s]", data.time)
    return drawing.curves_figure(f"motion-{joint}", caption, across, panels, height=3.0)


FITTED = "fitted"
"""Description of the errors on the data that the result was fitted to."""


class ErrorSet(NamedTuple):
    """Torque prediction errors of one model on one set of data.

    Attributes:
        description: which model on which data, as "written model: LOG"; ``FITTED`` for the fit.
        test: the errors, over all joints and per joint [N m or N].
        colour: colour of their bars in the figure.
    """

    description: str
    test: Validation
    colour: str


def errors(run: Run) -> Section:
    """Return the section on torque prediction errors on fitted data, held-out data and other logs.

    A figure shows the errors of each joint by the fit, by the model before and by the written one.
    """
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
    # The first three columns are no joints.
    series = []
    for row, error_set in zip(rows[: len(drawing.HATCHES)], sets):
        series.append((error_set.description, row[3:], error_set.colour))
    joints = [name.rpartition(" [")[0] for name in header[3:]]
    draw = partial(drawing.draw_bars, groups=joints, series=series, label="error [N·m]")
    height = 1.2 + 0.2 * len(series) + 0.12 * len(series) * len(joints)
    figures = (drawing.draw_figure("errors", caption, (header, rows), height, draw),)
    sentences: tuple[str, ...] = ()
    if all(error_set.description == FITTED for error_set in sets):
        sentences = ("Nothing was held out: other motion may be predicted worse.",)
    return Section("errors", title, sentences, figures=figures)


def error_numbers(
    sets: Sequence[ErrorSet],
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Return header and rows of a table of prediction errors, one row per set of errors.

    The columns are: description of the data, root mean square error of all joints [N m], its share
    of the torque, then the root mean square error of each joint [N m or N], NaN where a set has
    none.
    """
    joints: dict[str, None] = {}
    for error_set in sets:
        joints.update(dict.fromkeys(error_set.test.rmse_per_joint))
    joint_titles = map("{} [N·m or N]".format, joints)
    header = ("data", "all joints [N·m]", "of the torque", *joint_titles)
    rows: list[tuple[Any, ...]] = []
    for description, test, _ in sets:
        share = "–" if test.relative_error is None else percent(test.relative_error)
        joint_errors = map(number, map(test.rmse_per_joint.get, joints))
        rows.append((description, number(test.rmse), share, *joint_errors))
    return header, rows


def error_sets(run: Run) -> Iterator[ErrorSet]:
    """Yield the sets of torque errors of a run that have errors per joint.

    The first set is the fit's errors on the fitted data. Then follow errors on held-out data (the
    run's first validation) and on other logs (its further validations): each by the fit, by the
    model before and by the written model.
    """
    content = run.content
    # Errors "before" and "after" of the written file on held-out data, and pairs of them on others.
    file = content["file"] or {"others": ()}
    tests = []
    if content["rmse_per_joint"]:
        fitted = Validation("", 0, content["rmse"], None, content["rmse_per_joint"], {})
        yield ErrorSet(FITTED, fitted, drawing.MEASURED)
    for fits, colour, pairs in (
        (content["validation"][:1], drawing.OTHER, [file]),
        (content["validation"][1:], drawing.TRUTH, file["others"]),
    ):
        for test in fits:
            tests.append(("fit", test, colour))
        for pair in pairs:
            tests.append(("model before", pair.get("before"), drawing.BEFORE))
            tests.append(("written model", pair.get("after"), drawing.AFTER))
    for description, test, colour in tests:
        if test is not None and test.rmse_per_joint:
            yield ErrorSet(f"{description}: {test.source}", test, colour)


def rollout(run: Run) -> Section | None:
    """Return the section on position errors of simulations with the model before and after.

    None if the run simulated no held-out motion.
    """
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
        cells = [f"{test['loop']}, {drawing.text(test['horizon'])} s"]
        for error in (test["overall"], *test["joints"].values()):
            prior_text = drawing.text(error["before"])
            cells.append(f"{prior_text} -> {drawing.text(error['after'])}")
        rows.append(cells)
    joints = entry["errors"][0]["joints"] if rows else ()
    tables = (drawing.table(("played", "all", *joints), rows),) if rows else ()
    return Section(
        "rollout", "Played in the simulator", sentences, tables, (), entry["notes"]
    )

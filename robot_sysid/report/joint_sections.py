"""Sections of the report on joints: torques, residuals, friction, motion, prediction errors.

A joint is known by its index from the base. Signals of ``ReportData`` have the shape (K, n), for K
instants and n joints, its statistics (n, ...). ``Run.content`` is the content of params.json.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from robot_sysid.records import Array, Validation
from robot_sysid.records.messages import percent, position_unit, term_unit, torque_unit
from robot_sysid.report.drawing import Boxes, Drawing, Line, Panel, Points
from robot_sysid.report.runs import LONGEST_LAG, Friction, ReportData, Run, number
from robot_sysid.report.sections import Figure, Section, Table, table, text
from robot_sysid.results.parameter_table import without_rounding
from robot_sysid.results.record import HELD_NOTE

_LARGE_OFFSET = 0.5
"""Share of a residual's root mean square from which on its mean is stated."""
_NEAR = 0.5
"""Largest distance of a limit from the recorded values at which it is drawn, as a share of the
range of these values."""


def torques(run: Run) -> Section | None:
    """Return the section with measured and predicted torque and residuals of each joint.

    Its table has their root mean squares. None if the run has no data to draw.
    """
    reference = "the arm without the payload" if run.is_payload else "the model before"
    explanation = (
        f"Before: predicted by {reference}. After: predicted by the result. The residual is "
        "measured minus predicted. Gaps are samples that were not used, mostly because a joint "
        "hardly moved."
    )
    if run.data is not None and run.data.thinning_text:
        explanation += f" Long recording: {run.data.thinning_text}."
    return _section_by_joint(
        run,
        "torques",
        "Torque and residual of each joint, before and after",
        explanation,
        torque_figure,
        _residual_table,
    )


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


def torque_figure(data: ReportData, joint: int, name: str = "torque-{}") -> Figure:
    """Return the figure of a joint's torque, measured and predicted, above both residuals.

    Args:
        data: signals to draw.
        joint: index of the joint, from the base.
        name: name of the figure's files, with {} for the index of the joint.
    """
    unit = torque_unit(data.is_slide[joint])
    measured = data.measured[:, joint]
    prior = data.prior_prediction[:, joint]
    predicted = data.predicted[:, joint]
    prior_residual, residual = _residuals(data, joint)
    rms_texts = [f"{_rms(x):.3g} {unit}" for x in (prior_residual, residual)]
    caption = (
        f"{data.joints[joint]}: residual {rms_texts[0]} before, {rms_texts[1]} after (root mean "
        f"square), of a torque of {_rms(measured):.3g} {unit}."
    )
    offset = _mean(prior_residual)
    if abs(offset) > _LARGE_OFFSET * _rms(prior_residual):
        caption += (
            f" The residual before has a mean of {offset:.3g} {unit}. The torque error of the "
            "verdict leaves it out, because a torque sensor's offset would look the same."
        )
    torque_lines = (
        Line(data.time, measured, "measured", "measured", width=3.2),
        Line(data.time, prior, "before", "before", style="--"),
        Line(data.time, predicted, "after", "after"),
    )
    residual_lines = (
        Line(data.time, prior_residual, "before", style="--"),
        Line(data.time, residual, "after"),
    )
    panels = (
        Panel(torque_lines, y_label=f"torque [{unit}]", height=1.5),
        Panel(residual_lines, "time [s]", f"residual [{unit}]"),
    )
    return Figure(name.format(joint), caption, Drawing(panels, height=300.0))


def _residuals(data: ReportData, joint: int) -> list[Array]:
    """Return a joint's residuals (K,) before and after, zero where they are rounding errors."""
    measured = data.measured[:, joint]
    predictions = (data.prior_prediction[:, joint], data.predicted[:, joint])
    return [without_rounding(measured - tau, _rms(measured)) for tau in predictions]


def most_changed(data: ReportData) -> Figure:
    """Return the figure of the joint whose root mean square residual has changed most."""
    changes = []
    for joint in range(len(data.joints)):
        prior_rms, rms = map(_rms, _residuals(data, joint))
        changes.append(abs(prior_rms - rms))
    most_changed_joint = int(np.argmax(np.nan_to_num(changes)))
    return torque_figure(data, most_changed_joint, "before-after")


def _residual_table(data: ReportData) -> Table:
    """Return the table of root mean square torque and residuals of each joint."""
    rows = []
    for joint, name in enumerate(data.joints):
        measured = data.measured[:, joint]
        prior_residual, residual = _residuals(data, joint)
        row = [f"{name} [{torque_unit(data.is_slide[joint])}]"]
        row += [f"{_rms(x):.3g}" for x in (measured, prior_residual, residual)]
        # A tenth of what remains is the last digit that matters.
        row += [text(_mean(x), 0.1 * _rms(x)) for x in (prior_residual, residual)]
        rows.append(row)
    header = (
        "root mean square",
        "torque",
        "residual before",
        "residual after",
        "its mean before",
        "its mean after",
    )
    note = (
        "The torque error of the verdict is that of motion that was not fitted. It leaves out "
        "each joint's mean residual, because a torque sensor's offset would look the same."
    )
    return table(header, rows, note)


def _rms(values: Array) -> float:
    """Return the root mean square of all finite numbers in values (K,); NaN if none is finite."""
    return math.sqrt(_mean(values**2))


def _mean(values: Array) -> float:
    """Return the mean of all finite numbers in values (K,); NaN if none is finite."""
    finite = values[np.isfinite(values)]
    return float(np.mean(finite)) if len(finite) else float("nan")


def residuals(run: Run) -> Section | None:
    """Return the section with the histogram and the autocorrelation of each joint's residual.

    None if the run has no data to draw.
    """
    explanation = (
        "If only sensor noise is left, the histogram follows the normal distribution of the same "
        "width, and the autocorrelation stays within the grey band from the first lag on. A long "
        "tail of the autocorrelation means that the model, not noise, limits the result."
    )
    title = "Residual: noise or model error?"
    return _section_by_joint(run, "residuals", title, explanation, _residual_figure)


def _residual_figure(data: ReportData, joint: int) -> Figure:
    """Return the figure of the histogram and the autocorrelation of a joint's residual."""
    edges = data.edges[joint]
    counts = data.counts[joint]
    middles = 0.5 * (edges[1:] + edges[:-1])
    spread = float(np.sqrt(np.sum(counts * middles**2) / max(np.sum(counts), 1.0)))
    spread = spread or 1.0
    height = np.sum(counts) * (edges[1] - edges[0]) / (spread * np.sqrt(2.0 * np.pi))
    normal = height * np.exp(-0.5 * (middles / spread) ** 2)
    unit = torque_unit(data.is_slide[joint])
    histogram = Panel(
        (
            Boxes(edges[:-1], edges[1:], 0.0 * counts, counts, "measured", opacity=0.6),
            Line(middles, normal, "after", "normal distribution"),
        ),
        f"residual [{unit}]",
        "samples",
    )
    bound = float(data.independent[joint])
    correlation = data.correlation[joint]
    band = Boxes(
        data.lags[:1],
        data.lags[-1:],
        np.array([-bound]),
        np.array([bound]),
        "measured",
        opacity=0.35,
    )
    lag_panel = Panel(
        (band, Line(data.lags, correlation, "after")), "lag [s]", "autocorrelation"
    )
    share = (
        float(np.mean(np.abs(correlation[1:]) > bound)) if len(data.lags) > 1 else 0.0
    )
    caption = (
        f"{data.joints[joint]}: the autocorrelation leaves the band of white noise in "
        f"{100.0 * share:.0f} % of the lags up to {LONGEST_LAG:g} s; white noise does in 5 %."
    )
    drawing = Drawing([histogram, lag_panel], height=170.0, n_columns=2)
    return Figure(f"residual-{joint}", caption, drawing)


def friction(run: Run) -> Section:
    """Return the section on friction: tables of coefficients, and a curve per joint against speed.

    The tables have the coefficients of the run and of the written model. A joint without predicted
    friction has no curve, and no joint has one if the run has no data to draw.
    """
    data = run.data
    coefficient_sets = {
        "joint": run.friction(),
        "joint in the written model": run.friction("in_the_file"),
    }
    tables = []
    for title, coefficients in coefficient_sets.items():
        if coefficients:
            tables.append(_coefficient_table(title, coefficients, run.slides))
    explanation = (
        "Samples: measured torque without the predicted torque of the links and rotors. Line: the "
        f"identified friction with all its terms ({run.content['friction_model'] or 'as listed'}). "
        "Distance of the means from the line: friction that these terms do not describe."
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
    headings = [f"{t} [{term_unit(t, has_slide) or '1'}]" for t in all_terms]
    rows = []
    for owner, terms in coefficients.items():
        texts = [terms[t].text if t in terms else "–" for t in all_terms]
        rows.append([owner, *texts])
    notes = []
    if any("(held)" in cell for row in rows for cell in row):
        notes.append(f"{HELD_NOTE}.")
    if has_slide and not all(slides.values()):
        notes.append("Units are those of slides; of hinges N·m for N and rad for m.")
    return table([title, *headings], rows, " ".join(notes))


def _friction_figure(data: ReportData, joint: int) -> Figure:
    """Return the figure of a joint's friction torque, measured and identified, against speed."""
    unit = torque_unit(data.is_slide[joint])
    # Bins of speed with too few samples are NaN.
    has_samples = np.isfinite(data.speed[joint])
    columns = (data.speed, data.friction_measured, data.friction_predicted)
    bins = np.array([column[joint, has_samples] for column in columns])
    # Dry friction jumps where the speed changes its sign: a NaN between the bins of negative and
    # of positive speed keeps the curve from crossing the jump.
    n_negative = np.count_nonzero(bins[0] < 0.0)
    speeds, measured, identified = np.insert(bins, n_negative, np.nan, axis=1)
    samples = (data.friction + data.measured - data.predicted)[:, joint]
    marks = (
        Points(data.qd[:, joint], samples, "measured", "samples"),
        Points(speeds, measured, "ink", "mean of the samples", "o"),
        Line(speeds, identified, "after", "identified", width=2.2),
    )
    speed_label = f"speed [{position_unit(data.is_slide[joint])}/s]"
    drawing = Drawing([Panel(marks, speed_label, f"friction [{unit}]")], height=220.0)
    return Figure(f"friction-{joint}", f"Friction of {data.joints[joint]}.", drawing)


def excitation(run: Run) -> Section | None:
    """Return the section with each joint's motion and the share of its limits that it used.

    None if the run has no data to draw.
    """
    explanation = (
        "Speed against position of each joint, as recorded; dashed: limits, where they are near. "
        "The larger and faster the motion, the smaller the errors. Where the model has no limit of "
        "speed, it is that of the motions that robot-sysid plans."
    )
    title = "Motion and its limits"
    return _section_by_joint(
        run, "excitation", title, explanation, _motion_figure, _limit_table
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
    return table(header, zip(*columns), note)


def _motion_figure(data: ReportData, joint: int) -> Figure:
    """Return the figure of a joint's speed against its position, with limits that are near."""
    unit = position_unit(data.is_slide[joint])
    q = data.q[:, joint]
    qd = data.qd[:, joint]
    low = float(data.lower[joint])
    high = float(data.upper[joint])
    fastest = float(data.velocity[joint])
    marks = [Line(q, qd, "after", width=1.0)]
    q_ends = np.array([np.min(q), np.max(q)])
    qd_ends = np.array([np.min(qd), np.max(qd)])
    for limit in (low, high):
        if np.min(np.abs(limit - q_ends)) <= _NEAR * np.ptp(q_ends):
            marks.append(Line(np.full(2, limit), qd_ends, "other", style="--"))
    for limit in (-fastest, fastest):
        if np.min(np.abs(limit - qd_ends)) <= _NEAR * np.ptp(qd_ends):
            marks.append(Line(q_ends, np.full(2, limit), "other", style="--"))
    position_limits = "no limit of position"
    if np.isfinite(high - low):
        position_limits = f"positions from {low:.3g} to {high:.3g} {unit}"
    caption = f"{data.joints[joint]}; limits: {position_limits}, speed {fastest:.3g} {unit}/s."
    panel = Panel(marks, f"position [{unit}]", f"speed [{unit}/s]")
    return Figure(f"motion-{joint}", caption, Drawing([panel], height=200.0))


FITTED = "the fitted logs"
"""Description of the data that the result was fitted to."""
_MAX_SERIES = 6
"""Largest number of error sets in the figure; more bars per joint are too thin."""


class ErrorSet(NamedTuple):
    """Torque prediction errors of one model on one set of data.

    Attributes:
        model: which model, such as "written model".
        test: the errors, over all joints and per joint [N m or N]; their source describes the data,
            ``FITTED`` for what was fitted.
        colour: colour of their bars in the figure.
    """

    model: str
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
    sentences = [
        "The fit has all that was identified; the written model has what its file can hold, "
        "without sensor offsets, for one. Errors are root mean squares of the residual."
    ]
    if all(error_set.test.source == FITTED for error_set in sets):
        sentences.append("Nothing was held out: other motion may be predicted worse.")
    tables = (total_errors(sets), _errors_by_joint(sets))
    # What the models predict as files counts; the fit is drawn where there are none.
    drawn = [s for s in sets if s.model != "fit" or s.test.source == FITTED]
    figures = (_error_figure(drawn[:_MAX_SERIES]),)
    return Section("errors", title, sentences, tables, figures)


def _error_figure(sets: Sequence[ErrorSet]) -> Figure:
    """Return the bar chart of each joint's error, one bar per set of errors."""
    joints = list(sets[0].test.rmse_per_joint)
    rows = -np.arange(len(joints), dtype=float)
    width = 0.8 / len(sets)
    marks = []
    for index, (model, test, colour) in enumerate(sets):
        lengths = np.array([number(test.rmse_per_joint.get(joint)) for joint in joints])
        lengths = np.nan_to_num(lengths)
        top = rows + 0.4 - width * index
        # Folders of a log make its name too long for a legend.
        label = re.sub(r"(?<=: )\S*/", "", f"{model}: {test.source}")
        opacity = 0.9 if index < 3 else 0.55
        marks.append(
            Boxes(
                0.0 * lengths, lengths, top - 0.9 * width, top, colour, label, opacity
            )
        )
    largest = max(float(np.max(mark.right)) for mark in marks)
    panel = Panel(
        marks,
        "error [N·m, N of slides]",
        row_names=joints,
        x_range=(0.0, 1.05 * largest or 1.0),
    )
    height = 50.0 + len(joints) * max(20.0, 9.0 * len(sets))
    return Figure("errors", "Error of each joint's torque.", Drawing([panel], height))


def total_errors(sets: Sequence[ErrorSet], title: str = "") -> Table:
    """Return the table of errors over all joints, one row per set of errors."""
    rows = []
    for model, test, _ in sets:
        share = "–" if test.relative_error is None else percent(test.relative_error)
        rows.append((test.source, model, _error_text(test.rmse), share))
    header = ("data", "model", "all joints [N·m]", "of the torque")
    return table(header, rows, title=title)


def _error_text(error: float) -> str:
    """Return a torque error [N m or N] as text of a cell; "0" for one of rounding."""
    return f"{without_rounding(np.array(error), 1.0):.3g}"


def _errors_by_joint(sets: Sequence[ErrorSet]) -> Table:
    """Return the table of errors by joint, one column per set of errors."""
    joints_of_sets = [error_set.test.rmse_per_joint for error_set in sets]
    joints = list(dict.fromkeys(itertools.chain(*joints_of_sets)))
    header = ["joint [N·m or N]"]
    columns: list[Sequence[str]] = [joints]
    for model, test, _ in sets:
        header.append(f"{model}: {test.source}")
        joint_errors = map(test.rmse_per_joint.get, joints)
        columns.append(["–" if e is None else _error_text(e) for e in joint_errors])
    return table(header, zip(*columns))


def error_sets(run: Run) -> Iterator[ErrorSet]:
    """Yield the sets of torque errors of a run that have errors per joint.

    The first set is the fit's errors on the fitted data. Then follow errors on held-out data (the
    run's first validation) and on other logs (its further validations): each by the fit, by the
    model before and by the written model.
    """
    content = run.content
    # Errors "before" and "after" of the written file on held-out data, and pairs of them on others.
    file = content["file"] or {"others": ()}
    joint_errors = content["rmse_per_joint"]
    fitted = Validation(FITTED, 0, content["rmse"], None, joint_errors, {})
    tests: list[tuple[str, Validation | None, str]] = [("fit", fitted, "measured")]
    for fits, colour, pairs in (
        (content["validation"][:1], "other", [file]),
        (content["validation"][1:], "truth", file["others"]),
    ):
        tests += [("fit", test, colour) for test in fits]
        for pair in pairs:
            tests.append(("model before", pair.get("before"), "before"))
            tests.append(("written model", pair.get("after"), "after"))
    for model, test, colour in tests:
        if test is not None and test.rmse_per_joint:
            yield ErrorSet(model, test, colour)


def rollout(run: Run) -> Section | None:
    """Return the section on position errors of simulations with the model before and after.

    None if the run simulated no held-out motion.
    """
    entry = run.content["rollout"]
    if entry is None:
        return None
    opening = f"Both models were played on {entry['held_out']}; in closed loop with"
    sentences = [f"{opening} {entry['closed_loop_is']}."]
    score = entry["score"]
    if score is not None:
        better = "smaller" if score < 1.0 else "not smaller"
        sentences.append(
            f"Errors are {better} than before: {score:.3g} times, all together."
        )
    sentences.append(
        "Root mean square position error of the model before -> after [rad, m for slides]:"
    )
    rows = []
    for test in entry["errors"]:
        cells = [f"{test['loop']}, {text(test['horizon'])} s"]
        for error in (test["overall"], *test["joints"].values()):
            prior_text = text(error["before"])
            cells.append(f"{prior_text} -> {text(error['after'])}")
        rows.append(cells)
    joints = entry["errors"][0]["joints"] if rows else ()
    tables = (table(("played", "all", *joints), rows),) if rows else ()
    return Section(
        "rollout", "Played in the simulator", sentences, tables, (), entry["notes"]
    )

"""What was recorded, joint by joint: torques, friction and motion; how well it is predicted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from robot_sysid.records import Array
from robot_sysid.records.figures import percent, position, term_unit, torque, with_error
from robot_sysid.report import drawing
from robot_sysid.report.drawing import AFTER, BEFORE, MEASURED, OTHER, Figure, Section, Table, drawn
from robot_sysid.report.runs import LONGEST_LAG, ReportData, Run, listed, mapping, mappings, number
from robot_sysid.results.record import PAYLOAD

_SCATTERED = 400
_NEAR = 0.5
"""Share of what a joint moved through within which a limit is near enough to be drawn."""


def torques(run: Run) -> Section | None:
    """Return measured and predicted torque of each joint, the residual below."""
    before = "the arm without the payload" if run.question == PAYLOAD else "the model before"
    words = (
        f"Grey: measured. Blue: predicted by the result. Orange, dashed: predicted by {before}. "
        "Below: measured minus predicted by the result. Gaps are samples that were not used, "
        "mostly because the joint hardly moved."
    )
    if run.data is not None and run.data.drawn:
        words += f" Long recording: {run.data.drawn}."
    title = "Measured and predicted torque"
    return _by_joint(run, "torques", title, words, lambda data, j: _torque(data, j, before))


def _by_joint(
    run: Run, key: str, title: str, words: str, figure: Callable[[ReportData, int], Figure]
) -> Section | None:
    if run.data is None:
        return None
    figures = tuple(figure(run.data, joint) for joint in range(len(run.data.joints)))
    return Section(key, title, (words,), figures=figures)


def _torque(data: ReportData, joint: int, before: str) -> Figure:
    unit, name = torque(data.is_slide[joint]), data.joints[joint]
    measured, after = data.measured[:, joint], data.predicted[:, joint]
    earlier, left = data.before[:, joint], measured - after
    header = ("time [s]", *(f"{n} [{unit}]" for n in ("measured", "after", "before", "residual")))
    caption = (
        f"{name}: measured torque, predicted after and before, and the residual [{unit}]; "
        f"root mean square {_rms(left):.3g} {unit} of {_rms(measured):.3g} {unit} "
        f"({before} leaves {_rms(measured - earlier):.3g} {unit})."
    )

    def draw(canvas: Any) -> None:
        upper, lower = canvas.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
        upper.plot(data.time, measured, color=MEASURED, lw=2.2, alpha=0.8, label="measured")
        upper.plot(data.time, earlier, color=BEFORE, ls="--", lw=0.9, label="before")
        upper.plot(data.time, after, color=AFTER, label="after")
        lower.plot(data.time, left, color=drawing.INK, lw=0.7)
        upper.set_ylabel(f"torque [{unit}]")
        lower.set(xlabel="time [s]", ylabel=f"residual [{unit}]")
        canvas.align_ylabels()
        drawing.legend(canvas, upper)

    rows = zip(data.time, measured, after, earlier, left)
    return drawn(f"torque-{joint}", caption, (header, rows), 3.6, draw)


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def residuals(run: Run) -> Section | None:
    """Return residuals against speed, their histogram and their autocorrelation."""
    words = (
        "If only sensor noise is left over, the residual does not depend on speed, its histogram "
        "is the bell curve of the same width, and its autocorrelation stays within the grey band "
        "from the first lag on. A slope against speed is friction that the model does not have; a "
        "long tail in the autocorrelation means that the model, not noise, limits the result."
    )
    return _by_joint(run, "residuals", "What is left over", words, _left_over)


def _left_over(data: ReportData, joint: int) -> Figure:
    left = f"residual [{torque(data.is_slide[joint])}]"
    speed = f"speed [{position(data.is_slide[joint])}/s]"
    known = np.isfinite(data.speed[joint])
    columns = (data.speed, data.residual_mean, data.residual_spread)
    speeds, mean, spread = (each[joint, known] for each in columns)
    band, memories = data.independent[joint], data.correlation[joint]
    beyond = np.abs(memories[1:]) > band
    share = f"{100.0 * np.mean(beyond):.0f} %" if len(beyond) else "none"
    caption = (
        f"{data.joints[joint]}: residual against speed (dots, with mean and spread), histogram "
        f"with the bell curve of its width, and autocorrelation up to {LONGEST_LAG:g} s; {share} "
        "of the lags are outside the band of noise without memory."
    )

    def draw(canvas: Any) -> None:
        grid = canvas.add_gridspec(2, 2)
        above = canvas.add_subplot(grid[0, :], xlabel=speed, ylabel=left)
        _dots(above, data.qd[:, joint], (data.measured - data.predicted)[:, joint])
        above.errorbar(speeds, mean, spread, color=AFTER, fmt="o-", ms=3, lw=1.0, capsize=2)
        shape = canvas.add_subplot(grid[1, 0], xlabel=left, ylabel="samples")
        _histogram(shape, data.edges[joint], data.counts[joint])
        memory = canvas.add_subplot(grid[1, 1], xlabel="lag [s]", ylabel="autocorrelation")
        memory.axhspan(-band, band, color=MEASURED, alpha=0.35, lw=0)
        memory.plot(data.lags, memories, color=AFTER, marker=".", ms=3)
        memory.set_ylim(min(-0.3, float(np.min(memories)) - 0.05), 1.05)

    numbers = (speed, f"mean {left}", f"spread of the {left}"), zip(speeds, mean, spread)
    return drawn(f"residual-{joint}", caption, numbers, 3.9, draw)


def _dots(ax: Any, speed: Array, values: Array) -> None:
    places = np.flatnonzero(np.isfinite(values))
    places = places[:: max(1, len(places) // _SCATTERED)]
    ax.plot(speed[places], values[places], ".", color=MEASURED, ms=2.5, alpha=0.7)


def _histogram(ax: Any, edges: Array, counts: Array) -> None:
    total = max(float(np.sum(counts)), 1.0)
    ax.stairs(counts, edges, fill=True, color=MEASURED, alpha=0.6)
    middles, width = 0.5 * (edges[1:] + edges[:-1]), float(edges[1] - edges[0])
    spread = float(np.sqrt(np.sum(counts * middles**2) / total)) or 1.0
    bell = np.exp(-0.5 * (middles / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    ax.plot(middles, total * width * bell, color=AFTER)


def friction(run: Run) -> Section:
    """Return friction coefficients, what the written model holds of them, and curves."""
    data = run.data
    slides = {} if data is None else dict(zip(data.joints, data.is_slide))
    kinds = {"joint": run.friction(), "joint in the written model": run.friction("in_the_file")}
    tables = tuple(_coefficients(what, found, slides) for what, found in kinds.items() if found)
    words = (
        "Dots: what is left of the measured torque when all but friction is taken off. Circles: "
        "their mean in bins of speed. Blue: the identified friction in the same bins, with all its "
        f"terms ({run.content.get('friction_model') or 'as listed'})."
    )
    if not tables or data is None:
        words = "Curves need the torques." if tables else "No friction was estimated."
        return Section("friction", "Friction", (words,), tables)
    moved = [joint for joint in range(len(data.joints)) if np.any(data.friction[:, joint])]
    figures = tuple(_curve(data, joint) for joint in moved)
    return Section("friction", "Friction", (words,), tables, figures)


def _coefficients(
    title: str, found: Sequence[tuple[str, str, float, float]], slides: Mapping[str, bool]
) -> Table:
    """Return one row per joint, one column per term."""
    values = {(owner, name): with_error(value, error) for owner, name, value, error in found}
    owners, terms = (dict.fromkeys(key[k] for key in values) for k in (0, 1))
    slide = any(slides.values())
    header = (title, *(f"{name} [{term_unit(name, slide) or '1'}]" for name in terms))
    rows = [(owner, *(values.get((owner, name), "–") for name in terms)) for owner in owners]
    mixed = slide and not all(slides.values())
    note = "Units are those of slides; of hinges N·m for N and rad for m." if mixed else ""
    return drawing.table(header, rows, note)


def _curve(data: ReportData, joint: int) -> Figure:
    unit, speed_unit = torque(data.is_slide[joint]), f"{position(data.is_slide[joint])}/s"
    known = np.isfinite(data.speed[joint])
    columns = (data.speed, data.friction_measured, data.friction_predicted)
    speed, measured, identified = (each[joint, known] for each in columns)
    header = (f"speed [{speed_unit}]", f"measured [{unit}]", f"identified [{unit}]")
    caption = f"{data.joints[joint]}: friction torque [{unit}] against speed [{speed_unit}]."

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        _dots(ax, data.qd[:, joint], (data.friction + data.measured - data.predicted)[:, joint])
        ax.plot(speed, measured, "o", mfc="none", mec=BEFORE, label="measured")
        for side, label in ((speed < 0.0, None), (speed > 0.0, "identified")):
            ax.plot(speed[side], identified[side], color=AFTER, lw=1.8, label=label)
        ax.set(xlabel=header[0], ylabel=f"friction [{unit}]")
        drawing.legend(canvas, ax)

    rows = zip(speed, measured, identified)
    return drawn(f"friction-{joint}", caption, (header, rows), 3.0, draw)


def excitation(run: Run) -> Section | None:
    """Return what share of its limits each joint used, and its motion."""
    if run.data is None:
        return None
    words = (
        "A motion that uses little of its limits tells little: the larger and faster it is, the "
        "smaller the errors. Speed limits are those that a motion of this program keeps, where the "
        "model has none of its own."
    )
    motions = (_motion(run.data, joint) for joint in range(len(run.data.joints)))
    return Section("excitation", "Excitation", (words,), figures=(_shares(run.data), *motions))


def _shares(data: ReportData) -> Figure:
    load = np.where(np.isfinite(data.measured), np.abs(data.measured), 0.0)
    series = [
        ("range of positions", 100.0 * np.ptp(data.q, axis=0) / (data.upper - data.lower), AFTER),
        ("speed", 100.0 * np.max(np.abs(data.qd), axis=0) / data.velocity, BEFORE),
        ("torque", 100.0 * np.max(load, axis=0) / data.torque, drawing.TRUTH),
    ]
    rows = [
        (name, *(f"{share[j]:.0f}" if share[j] > 0.0 else "no limit" for _, share, _ in series))
        for j, name in enumerate(data.joints)
    ]
    numbers = ("joint", *(f"{what} [% of limit]" for what, _, _ in series)), rows
    caption = (
        "Share of each limit that the motion used [%]; a joint without a bar has no limit of that "
        "kind in its model. Over 100 % the recording went beyond what the model allows."
    )

    def draw(canvas: Any) -> None:
        ax = drawing.bars(canvas, data.joints, series, "share of limit [%]")
        ax.axhline(100.0, color=OTHER, ls="--", lw=1.0)

    return drawn("excitation", caption, numbers, 3.2, draw, drawing.WIDE)


def _motion(data: ReportData, joint: int) -> Figure:
    unit = position(data.is_slide[joint])
    q, qd = data.q[:, joint], data.qd[:, joint]
    low, high, fast = (float(v[joint]) for v in (data.lower, data.upper, data.velocity))
    header = ("time [s]", f"position [{unit}]", f"speed [{unit}/s]")
    limits = f"{low:.3g} to {high:.3g} {unit}" if np.isfinite(high - low) else "no position limit"
    caption = (
        f"{data.joints[joint]}: position [{unit}] and speed [{unit}/s] as recorded; limits "
        f"(dashed where near): {limits}, ± {fast:.3g} {unit}/s."
    )

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(2, 1, sharex=True)
        curves = ((q, AFTER, (low, high)), (qd, MEASURED, (-fast, fast)))
        for ax, (values, colour, limits), label in zip(axes, curves, header[1:]):
            ax.plot(data.time, values, color=colour)
            ax.set_ylabel(label)
            room = _NEAR * np.ptp(values)
            for limit in limits:
                if np.min(values) - room <= limit <= np.max(values) + room:
                    ax.axhline(limit, color=OTHER, ls="--", lw=1.0)
        axes[1].set_xlabel("time [s]")
        canvas.align_ylabels()

    return drawn(f"motion-{joint}", caption, (header, zip(data.time, q, qd)), 3.0, draw)


_MOST_SETS = 7
_WHEN = {"before": BEFORE, "after": AFTER}


class ErrorSet(NamedTuple):
    """Prediction errors on some data.

    Attributes:
        test: "rmse", "relative_error" and "rmse_per_joint", as in the result file.
    """

    words: str
    test: Mapping[str, Any]
    colour: str

    @property
    def cells(self) -> tuple[float, str]:
        """Error [N m] and its share of the torque, as cells of a table."""
        share = number(self.test.get("relative_error"))
        return number(self.test.get("rmse")), percent(share) if np.isfinite(share) else "–"

    def of(self, joints: Sequence[str]) -> list[float]:
        """Return the error [N m] of each joint; NaN where it is not known."""
        return [number(mapping(self.test, "rmse_per_joint").get(joint)) for joint in joints]


def errors(run: Run) -> Section:
    """Return the errors on fitted and held-out data and on other logs, before and after."""
    sets = list(error_sets(run))
    title = "Prediction errors"
    if not sets:
        return Section("errors", title, missing=("the result file holds no errors per joint",))
    words = (
        "of the fit itself on what was fitted and what was not, and of the model and the written "
        "one, as files, on what was not."
    )
    told = () if len(sets) > 1 else ("Nothing was held out: other motion may be predicted worse.",)
    return Section("errors", title, told, figures=(error_bars("errors", sets, words),))


def error_bars(name: str, sets: Sequence[ErrorSet], words: str) -> Figure:
    """Return the errors per joint of some sets of data, the first of them as bars too."""
    joints = list(dict.fromkeys(joint for each in sets for joint in each.test["rmse_per_joint"]))
    rows = [(each.words, *each.cells, *each.of(joints)) for each in sets]
    header = ("data", "all joints [N·m]", "of the torque", *(f"{j} [N·m or N]" for j in joints))
    start = "Root mean square error of the predicted torque of each joint [N·m, N for slides]: "
    if len(sets) > _MOST_SETS:
        words += f" The figure shows the first {_MOST_SETS} of {len(sets)}, the table all."
    series = [(each.words, each.of(joints), each.colour) for each in sets[:_MOST_SETS]]
    width = drawing.WIDE if len(joints) > 2 else drawing.NARROW

    def draw(canvas: Any) -> None:
        drawing.bars(canvas, joints, series, "error [N·m]")

    return drawn(name, start + words, (header, rows), 2.8 + 0.2 * len(series), draw, width)


def error_sets(run: Run) -> Iterator[ErrorSet]:
    """Yield all errors per joint that the result file holds, those farthest from the fit last."""
    file, tests = mapping(run.content, "file"), mappings(run.content, "validation")
    found = [("fit", test, drawing.OTHER) for test in tests[:1]] + _pair(file)
    found += [("fit", test, drawing.TRUTH) for test in tests[1:]]
    for other in mappings(file, "others"):
        found += _pair(other)
    if mapping(run.content, "rmse_per_joint"):
        yield ErrorSet("fitted", run.content, drawing.MEASURED)
    for words, test, colour in found:
        if mapping(test, "rmse_per_joint"):
            yield ErrorSet(f"{words}: {test.get('source')}", test, colour)


def _pair(pair: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], str]]:
    written = ("written model", mapping(pair, "after"), AFTER)
    return [("model before", mapping(pair, "before"), BEFORE), written]


def rollout(run: Run) -> Section | None:
    """Return how far the model moves away from the arm when it is played, or None."""
    found = mapping(run.content, "rollout")
    if not found:
        return None
    words = f"Both models were played on {found.get('held_out', 'held-out pieces')}"
    said = [f"{words}; in closed loop with {found.get('closed_loop_is', 'a servo')}."]
    score = number(found.get("score"))
    if np.isfinite(score):
        better = "smaller" if score < 1.0 else "not smaller"
        said.append(f"Errors are {better} than before: {score:.3g} times, all together.")
    figures = tuple(_played(test, k) for k, test in enumerate(mappings(found, "errors")))
    points = listed(found, "notes")
    return Section("rollout", "Played in the simulator", tuple(said), (), figures, points)


def _played(test: Mapping[str, Any], place: int) -> Figure:
    joints = {"all": mapping(test, "overall"), **mapping(test, "joints")}
    pairs = {when: [number(each.get(when)) for each in joints.values()] for when in _WHEN}
    series = [(when, heights, _WHEN[when]) for when, heights in pairs.items()]
    played = f"{test.get('loop', 'loop')}, {drawing.text(number(test.get('horizon')))} s"
    error = "root mean square position error of the model before and after [rad, m for slides]"

    def draw(canvas: Any) -> None:
        drawing.bars(canvas, list(joints), series, "position error [rad]")

    numbers = ("joint", *(f"{when} [rad or m]" for when in _WHEN)), zip(joints, *pairs.values())
    return drawn(f"rollout-{place}", f"{played}: {error}.", numbers, 3.2, draw)

"""Sections of the report on bodies: parameters, errors by cause, identifiability, cards.

A body has ten inertial parameters in the order of ``PARAMETER_NAMES``: mass [kg], first moments
[kg m], inertia about its frame's origin [kg m^2]. ``Run.content`` is the content of params.json.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.spatial import (
    PARAMETER_NAMES,
    characteristic_length,
    com_from_theta,
)
from robot_sysid.records import Array
from robot_sysid.records.file_access import CARD_NAME
from robot_sysid.records.messages import PARAMETER_UNITS, percent, with_error
from robot_sysid.report.drawing import SERIES, Boxes, Drawing, Panel, Points
from robot_sysid.report.runs import Body, Run
from robot_sysid.report.sections import Figure, Section, Table, plus_minus, table, text
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.parameter_table import (
    BeforeAfter,
    friction_rows,
    table_cells,
    without_rounding,
)
from robot_sysid.results.verdict import PRIOR_SHARE

_GROUPS = ((0, 1, "mass"), (1, 4, "first moment"), (4, 10, "inertia about the origin"))
"""(start, end, title) of the parameters (10,) that have one unit and share one panel."""
_MARKS = {
    "before": (0.16, "before", "D"),
    "in the file": (-0.16, "other", "s"),
    "truth": (-0.16, "truth", "s"),
}
"""Version of the parameters, see ``Body.thetas``, to (vertical offset from the identified value in
rows, colour and marker)."""
_CAUSE_TEXTS = {
    "noise": "noise of the recorded torques",
    "links": "uncertainty of the other links' numbers, which start from the model's",
    "torque scale": "scale of each joint's torque",
    "common torque scale": "scale of all torques",
    "joint offsets": "zero positions of the joints",
    "delay": "delay of torque behind position",
    "gravity": "tilt of the base",
    "friction model": "friction that its terms do not describe",
    "friction at its bound": "friction terms that would be negative and were held at zero",
    "filtering": "what the low-pass removes from the motion",
    "physical consistency": "the move to numbers that a rigid body can have",
}
"""Cause of errors to an explanation."""
_MIN_SHARE = 0.005
"""Share of the variance of all parameters below which a cause of errors has no column."""


def main_numbers(run: Run) -> Table:
    """Return the console's table of mass, centre of mass and friction of what was asked for.

    That is the payload, or the terminal link with its joint.
    """
    body = run.bodies[0]
    errors = body.errors_or_none(body.central)
    labels = ("mass", *map("centre of mass {}".format, "xyz"))
    prior: Sequence[float | None] = [None] * 4
    if "before" in body.thetas:
        prior = _mass_and_com(body.thetas["before"])
    identified = _mass_and_com(body.identified)
    rows = list(map(BeforeAfter, labels, prior, identified, errors, ("kg", *"mmm")))
    if not run.is_payload:
        rows += _friction_rows(run)
    rows = [replace(row, name=f"{row.name} [{row.unit}]", unit="") for row in rows]
    header, *rows_of_cells = table_cells(rows, body.title)
    frame = "flange" if run.is_payload else f"body {body.title}"
    note = f"Centre of mass in the frame of the {frame}. ±: one standard error, all causes."
    return table(header, rows_of_cells, note)


def _friction_rows(run: Run) -> Iterator[BeforeAfter]:
    """Return the rows of the terminal joint's friction and rotor inertia, where estimated."""
    joint_name = run.content["joint_name"]
    joint = run.content["joints"].get(joint_name, {"terms": {}, "model": {}})
    sources = run.content["parameter_source"]
    terms = {**joint["terms"]}
    for term, quantity in terms.items():
        # params.json has no number for an infinite error.
        if sources.get(f"{term}[{joint_name}]") == "from_model":
            terms[term] = quantity._replace(error=np.inf)
    is_slide = run.slides.get(joint_name, False)
    return friction_rows(terms, joint["model"], is_slide)


def _mass_and_com(theta: Array) -> list[float]:
    """Return mass [kg] and centre of mass [m] of a body, 0.0 for what rounds to nothing."""
    mass, com, _ = com_from_theta(theta)
    return [mass, *without_rounding(com, characteristic_length(theta)).tolist()]


def parameters(run: Run) -> Section:
    """Return the section with the ten parameters of every body before and after, and their errors.

    Figures show the body that was asked for, of a payload all three, and the masses of all links.
    """
    drawn = run.bodies if run.is_payload else run.bodies[:1]
    figures = []
    for body_index, body in enumerate(drawn):
        figures.append(_parameter_figure(body, f"parameters-{body_index}"))
        if body.budget:
            figures.append(_budget_figure(body, f"errors-{body_index}"))
    if len(run.bodies) > len(drawn):
        # From the base to the terminal link, which stands first.
        figures.append(_mass_figure([*run.bodies[1:], run.bodies[0]]))
    explanation = (
        "m is the mass, h the first moment (mass times centre of mass), I the inertia about the "
        f"origin of the {'flange' if run.is_payload else 'body'}'s frame. ± and bars are one "
        "standard error, all causes together; a value without it has an error that is not known."
    )
    if any("in the file" in body.thetas for body in run.bodies):
        explanation += (
            " In the file: as written to the model, fitted with the friction terms that its file "
            "can hold."
        )
    title = "The numbers" if run.is_payload else "Links before and after"
    tables = list(map(_parameter_table, run.bodies))
    tables += [_budget_table(body) for body in drawn if body.budget]
    return Section("parameters", title, (explanation,), tables, figures)


def _parameter_table(body: Body) -> Table:
    """Return the table of a body's mass, centre of mass, first moment and inertia, with errors."""
    com_labels = map("centre of mass {}".format, "xyz")
    labels = (PARAMETER_NAMES[0], *com_labels, *PARAMETER_NAMES[1:])
    units = (PARAMETER_UNITS[0], *"mmm", *PARAMETER_UNITS[1:])
    errors = np.concatenate((body.errors[:1], body.central[1:], body.errors[1:]))
    columns = [[*_mass_and_com(theta), *theta[1:]] for theta in body.thetas.values()]
    rows = []
    for label, unit, error, *values in zip(labels, units, errors.tolist(), *columns):
        texts = [text(float(value), error) for value in values]
        # Without a budget, the run is a simulation of the model itself: rounding, no error.
        error_text = plus_minus(error) if body.budget else "–"
        rows.append((f"{label} [{unit}]", *texts, error_text))
    return table((body.title, *body.thetas, "±"), rows)


def _budget_table(body: Body) -> Table:
    """Return the table of the share of each cause in the variance of each parameter of a body."""
    shares = _variance_shares(body)
    large = {c: share for c, share in shares.items() if np.max(share) >= _MIN_SHARE}
    rows = []
    for k, label in enumerate(PARAMETER_NAMES):
        percentages = [f"{100.0 * share[k]:.0f} %" for share in large.values()]
        rows.append((label, *percentages))
    title = f"{body.title}: what each parameter's error comes from, in shares of its variance"
    explanations = [f"{c}: {_CAUSE_TEXTS[c]}" for c in large if c in _CAUSE_TEXTS]
    return table(("", *large), rows, f"{'; '.join(explanations)}.", title)


def largest_cause_text(body: Body) -> str:
    """Return the largest cause of the error of a body's mass with its meaning, "" if not known."""
    if not body.budget or not np.isfinite(body.errors[0]):
        return ""
    cause = max(body.budget, key=lambda name: body.budget[name][0])
    meaning = _CAUSE_TEXTS.get(cause)
    return f"{cause}: {meaning}" if meaning else cause


def _variance_shares(body: Body) -> dict[str, Array]:
    """Return cause to its shares (10,) in the variances of a body's parameters, 0 to 1.

    They are zero for a parameter whose error is not known.
    """
    errors = np.array(list(body.budget.values()))
    squares = np.square(np.nan_to_num(errors))
    squares[:, ~np.isfinite(body.errors)] = 0.0
    total = np.sum(squares, axis=0)
    shares = np.divide(squares, total, out=np.zeros_like(squares), where=total > 0.0)
    return dict(zip(body.budget, shares))


def _parameter_figure(body: Body, name: str) -> Figure:
    """Return the figure of a body's ten parameters in all versions, with their standard errors.

    Args:
        body: the body.
        name: name of the figure's files without suffix, unique on the page.
    """
    model_text = " against the model's values before" if "before" in body.thetas else ""
    truth_text = " and the truth of the simulated arm" if "truth" in body.thetas else ""
    caption = f"{body.title}: identified parameters{model_text}{truth_text}."
    panels = []
    for start, end, title in _GROUPS:
        indices = slice(start, end)
        versions = {key: theta[indices] for key, theta in body.thetas.items()}
        marks = _version_marks(versions, body.errors[indices])
        label = f"{title} [{PARAMETER_UNITS[start]}]"
        names = PARAMETER_NAMES[indices]
        panels.append(Panel(marks, label, height=end - start + 0.4, row_names=names))
    return Figure(name, caption, Drawing(panels, height=380.0))


def _mass_figure(bodies: Sequence[Body]) -> Figure:
    """Return the figure of the masses of all links, before and after."""
    names = [body.title for body in bodies]
    versions: dict[str, Array] = {}
    for key in dict.fromkeys(key for body in bodies for key in body.thetas):
        masses_of_key = [
            body.thetas[key][0] if key in body.thetas else np.nan for body in bodies
        ]
        versions[key] = np.array(masses_of_key)
    errors = np.array([body.errors[0] for body in bodies])
    panel = Panel(_version_marks(versions, errors), "mass [kg]", row_names=names)
    height = 50.0 + 26.0 * len(bodies)
    return Figure("masses", "Mass of each link.", Drawing([panel], height))


def _version_marks(versions: Mapping[str, Array], errors: Array) -> list[Points]:
    """Return markers of all versions of m values, one row each, the identified one with errors.

    Args:
        versions: version, see ``Body.thetas``, to its values (m,).
        errors: (m,) standard errors of the identified values; NaN where they are not known.
    """
    rows = -np.arange(len(errors), dtype=float)
    marks = []
    for version, (shift, colour, shape) in _MARKS.items():
        if version in versions:
            values = versions[version]
            marks.append(Points(values, rows + shift, colour, version, shape))
    bars = np.where(np.isfinite(errors), errors, 0.0)
    identified = versions["after"]
    marks.append(
        Points(identified, rows, "after", "after ±", "o", bars, is_filled=True)
    )
    return marks


def _budget_figure(body: Body, name: str) -> Figure:
    """Return the figure of the share that each cause has in the variance of each parameter.

    Args:
        body: a body with an error budget.
        name: name of the figure's files without suffix, unique on the page.
    """
    shares = _variance_shares(body)
    # Each of the largest causes has its own colour; all others share the last one.
    largest = sorted(shares, key=lambda cause: -np.sum(shares[cause]))[
        : len(SERIES) - 1
    ]
    drawn = {cause: share for cause, share in shares.items() if cause in largest}
    others = [share for cause, share in shares.items() if cause not in largest]
    drawn["all others"] = np.sum([np.zeros(10), *others], axis=0)
    rows = -np.arange(10.0)
    left = np.zeros(10)
    marks = []
    for (cause, share), colour in zip(drawn.items(), SERIES):
        right = left + 100.0 * share
        # White lines between the boxes separate them without colours, too.
        marks.append(Boxes(left, right - 0.3, rows - 0.38, rows + 0.38, colour, cause))
        left = right
    caption = (
        f"{body.title}: what each parameter's error comes from. Where noise is small, a longer "
        "recording does not help."
    )
    panel = Panel(
        marks,
        "share of the error's variance [%]",
        row_names=PARAMETER_NAMES,
        x_range=(0.0, 100.0),
    )
    return Figure(name, caption, Drawing([panel], height=330.0))


def visibility(run: Run) -> Section:
    """Return the section on which parameters are identifiable from the data.

    Its tables are the source of each parameter of the first body, the base parameters and the
    estimated sensor errors, as far as there are any.
    """
    body = run.bodies[0]
    content = run.content
    source_rows = []
    for k, name in enumerate(PARAMETER_NAMES):
        source = _source(body, k, run.is_payload)
        error_text = "–" if run.is_self_test else plus_minus(body.errors[k])
        source_rows.append((name, source, percent(body.share[k]), error_text))
    header = (body.title, "source", "share of the data", "±")
    note = (
        "The share of the data is one of the value, whose other part comes from the prior. The ± "
        "has causes of its own, such as the other links, which the tables of errors list."
    )
    tables = [table(header, source_rows, note)]
    sentences = []
    base = content["base_parameters"]
    sensors = content["sensors"]
    if base:
        sentences.append(
            f"Base parameters: {len(base)} combinations of the links' parameters are identifiable "
            f"from these torques, of {content['structural_rank'] or 'as many'} that any motion of "
            "this arm could show. A parameter of a single link that is no base parameter depends "
            "on the model, too. Parameters without a link in parentheses are those of "
            f"{body.title}; essential: kept by backward elimination."
        )
        header = ("base parameter, in SI units", "value", "±", "essential")
        base_rows = []
        for base_parameter in base:
            # The keys of each object are written in the order of the table's columns.
            combination, value, error, is_essential = base_parameter.values()
            value_cells = (text(value, error), plus_minus(error))
            yes_or_no = "yes" if is_essential else "no"
            base_rows.append((combination, *value_cells, yes_or_no))
        tables.append(table(header, base_rows))
    if sensors:
        sensor_rows = zip(sensors, itertools.starmap(with_error, sensors.values()))
        tables.append(
            table(
                ("sensor error or nuisance parameter, in SI units", "estimate"),
                sensor_rows,
            )
        )
    hidden = list(content["unidentifiable_combinations"])
    if not run.is_fully_known:
        hidden.insert(0, "the payload's inertia (it is smaller than its ±)")
        sentences.append(NOT_KNOWN)
    if hidden:
        sentences.append(f"Not identifiable from these torques: {'; '.join(hidden)}.")
    else:
        sentences.append("All parameters that were asked for are identifiable.")
    return Section("visible", "Identifiability", sentences, tables)


def _source(body: Body, k: int, is_payload: bool) -> str:
    """Return where the value of a parameter comes from, the data or the model, as text of a cell.

    Args:
        body: the body.
        k: index of the parameter, 0 to 9.
        is_payload: whether the body is a payload, of which no model exists.
    """
    if body.is_from_model[k]:
        return "not known" if is_payload else "the model: not identifiable"
    if np.isfinite(body.share[k]) and body.share[k] < PRIOR_SHARE:
        return "more prior than data"
    return (
        "the data"
        if np.isfinite(body.errors[k]) or not body.budget
        else "partly the model"
    )


def card(run: Run) -> Section | None:
    """Return the section with the payload's numbers in the form of the controller, to be copied.

    None if the run identified no payload. If the run wrote no card, the section has the reason in
    place of the numbers.
    """
    payload = run.content["payload"]
    if payload is None:
        return None
    scales = payload["torque_scale"]
    rows = zip(scales, itertools.starmap(with_error, scales.values()))
    tables = [table(("joint", "torque scale"), rows)] if scales else []
    path = run.folder / CARD_NAME
    if payload["card"] is None or not path.is_file():
        reason = "no card was written, because the payload is not to be used"
        if payload["known_mass"] is not None:
            reason = "this run calibrated the torques; it writes no card"
        return Section("card", "Payload card", (), tables, missing=(reason,))
    flange = payload["flange"]
    explanation = (
        f"In the frame of the flange {flange['name']} on body {flange['in_body']}. Check that the "
        "controller means the same frame."
    )
    blocks = [(path.name, "", path.read_text("utf-8"))]
    return Section(
        "card", "Payload card", (explanation,), tables, blocks=blocks, is_open=True
    )


def scatter(run: Run) -> Section | None:
    """Return the section with the payload's mass according to each recording alone.

    None if the run identified no payload or knew the payload's mass, and where there is only one
    empty and one loaded recording.
    """
    payload = run.content["payload"]
    if payload is None or not payload["scatter"]:
        return None
    header = ("recording", "kind", "mass [kg]", "± noise alone [kg]", "± all [kg]")
    rows = []
    for recording in payload["scatter"]:
        side = "loaded" if recording["is_loaded"] else "empty"
        noise = recording["noise_error"]
        mass = text(recording["mass"], noise)
        error_texts = (plus_minus(noise), plus_minus(recording["error"]))
        rows.append((recording["name"], side, mass, *error_texts))
    explanation = (
        "Mass of the payload according to each recording against all of the other kind. If one "
        "recording says something else than the others, it was made with another payload, or "
        "something was changed between them."
    )
    return Section(
        "scatter", "Each recording alone", (explanation,), (table(header, rows),)
    )

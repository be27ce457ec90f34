"""Sections of the report on bodies: parameters, errors by cause, cards, ellipsoids of inertia.

A body has ten inertial parameters in the order of ``PARAMETER_NAMES``: mass [kg], first moments
[kg m], inertia about its frame's origin [kg m^2]. ``Run.content`` is the content of params.json.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import (
    PARAMETER_NAMES,
    characteristic_length,
    com_from_theta,
)
from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.preview.film import Colour, Studio
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.records.messages import PARAMETER_UNITS, percent, with_error
from robot_sysid.report import drawing
from robot_sysid.report.drawing import AFTER, Figure, Section, Table, draw_figure, table
from robot_sysid.report.runs import Body, Run, number
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.verdict import PRIOR_SHARE

_GROUPS = ((0, 1, "mass"), (1, 4, "first moment"), (4, 10, "inertia about the origin"))
"""(start, end, title) of the parameters (10,) that have one unit and share one panel."""
_MARKS: dict[str, tuple[float, dict[str, Any]]] = {
    "before": (0.16, {"marker": "D", "mfc": "none", "mec": drawing.BEFORE}),
    "in the file": (-0.16, {"marker": "s", "mfc": "none", "mec": drawing.OTHER}),
    "truth": (-0.16, {"marker": "x", "mew": 1.8, "color": drawing.TRUTH}),
}
"""Version of the parameters, see ``Body.thetas``, to (vertical offset from the identified value in
rows, style of its marker)."""
_YES_OR_NO = {True: "yes", False: "no"}
"""Text of a truth value in a cell of a table."""
_LEAST_SPAN = 0.02
"""Least width of a panel's axis, as a share of its largest value: a narrower one would magnify
rounding errors."""


def parameters(run: Run) -> Section:
    """Return the section with the ten parameters of every body before and after, and their errors.

    A body with an error budget has a second figure, of the causes of its errors.
    """
    figures = []
    for body_index, body in enumerate(run.bodies):
        figures.append(_parameter_figure(body, f"parameters-{body_index}"))
        if body.budget:
            figures.append(_budget_figure(body, f"errors-{body_index}"))
    explanation = (
        "m is the mass, h the first moment (mass times centre of mass), I the inertia about the "
        f"origin of the {'flange' if run.is_payload else 'body'}'s frame. Bars are ± one standard "
        "error, all causes together; a value without a bar has an error that is not known."
    )
    title = "The numbers" if run.is_payload else "Before and after"
    return Section("parameters", title, (explanation,), (masses(run.bodies),), figures)


def masses(bodies: Sequence[Body]) -> Table:
    """Return a table of mass and centre of mass, one row per body and version of its parameters.

    The versions are those of ``Body.thetas``; a version with zero mass has no row.
    """
    header = ("body", "", "mass [kg]", *map("centre {} [m]".format, "xyz"))
    rows = []
    for body in bodies:
        for version, theta in body.thetas.items():
            if theta[0] != 0.0:
                is_identified = version == "after"
                numbers = _mass_and_center(theta, body, is_identified)
                rows.append((body.title, version, *numbers))
    return table(header, rows)


def _mass_and_center(theta: Array, body: Body, is_identified: bool) -> Iterator[str]:
    """Yield texts of the mass [kg] and of the three coordinates of the centre of mass [m].

    Args:
        theta: (10,) one version of the body's parameters; its mass is not zero.
        body: the body, whose standard errors are shown with the identified version only.
        is_identified: whether ``theta`` is the identified version.
    """
    errors: list[float | None] = [None] * 4
    if is_identified:
        errors = body.errors_or_none(body.central)
    yield with_error(float(theta[0]), errors[0])
    # Adding zero turns -0.0 into 0.0.
    center = (theta[1:4] / theta[0] + 0.0).tolist()
    for coordinate, error in zip(center, errors[1:]):
        yield f"{coordinate:.4f}" if error is None else with_error(coordinate, error)


def _parameter_figure(body: Body, name: str) -> Figure:
    """Return the figure of a body's ten parameters in all versions, with their standard errors.

    Args:
        body: the body.
        name: name of the figure's files without suffix, unique on the page.
    """
    thetas = body.thetas
    rows = []
    for k, (label, unit) in enumerate(zip(PARAMETER_NAMES, PARAMETER_UNITS)):
        error = body.errors[k]
        values = [drawing.text(float(theta[k]), error) for theta in thetas.values()]
        rows.append((f"{label} [{unit}]", *values, drawing.plus_minus(error)))
    numbers = ("parameter", *thetas, "± standard error"), rows
    model_text = " against the model's values before" if "before" in thetas else ""
    truth_text = " and the truth of the simulated arm" if "truth" in thetas else ""
    caption = f"{body.title}: identified parameters{model_text}{truth_text}, ± one standard error."

    def draw(canvas: Any) -> None:
        """Draw one panel per group of parameters on an empty matplotlib figure."""
        ratios = [end - start + 0.6 for start, end, _ in _GROUPS]
        axes = canvas.subplots(3, 1, height_ratios=ratios)
        errors = np.where(np.isfinite(body.errors), body.errors, 0.0)
        for (start, end, title), ax in zip(_GROUPS, axes):
            positions = -np.arange(end - start, dtype=float)
            indices = slice(start, end)
            for version, (shift, style) in _MARKS.items():
                if version in thetas:
                    ax.plot(
                        thetas[version][indices],
                        positions + shift,
                        label=version,
                        ls="none",
                        **style,
                    )
            bar: Any = {
                "fmt": "o",
                "color": AFTER,
                "ms": 5,
                "capsize": 3,
                "label": "after",
            }
            identified = body.identified[indices]
            ax.errorbar(identified, positions, xerr=errors[indices], **bar)
            ax.set_yticks(positions, PARAMETER_NAMES[indices])
            ax.set(
                ylim=(positions[-1] - 0.6, 0.6),
                xlabel=f"{title} [{PARAMETER_UNITS[start]}]",
            )
            ax.margins(x=0.08)
            ax.locator_params(axis="x", nbins=6)
            # Any half width serves where all values are zero.
            half_span = 0.5 * _LEAST_SPAN * float(np.max(np.abs(identified))) or 5e-7
            low, high = ax.get_xlim()
            middle = 0.5 * (low + high)
            if high - low < 2.0 * half_span:
                ax.set_xlim(middle - half_span, middle + half_span)
        drawing.draw_legend(canvas, axes[0], 4)

    return draw_figure(name, caption, numbers, height=4.6, draw=draw)


def _budget_figure(body: Body, name: str) -> Figure:
    """Return the figure of the share that each cause has in the variance of each parameter.

    Args:
        body: a body with an error budget.
        name: name of the figure's files without suffix, unique on the page.
    """
    causes = list(body.budget)
    errors = np.array(list(body.budget.values()))
    # Variances (causes, 10); zero where an error is not known.
    squares = np.square(np.nan_to_num(errors))
    squares[:, ~np.isfinite(body.errors)] = 0.0
    total = np.sum(squares, axis=0)
    shares = np.divide(squares, total, out=np.zeros_like(squares), where=total > 0.0)
    # Each of the largest causes has its own colour; all others share the last one.
    n_drawn = len(drawing.SERIES) - 1
    largest = np.argsort(-np.sum(shares, axis=1), kind="stable")[:n_drawn]
    drawn_shares = {causes[k]: shares[k] for k in sorted(largest.tolist())}
    drawn_shares["all others"] = np.sum(np.delete(shares, largest, axis=0), axis=0)
    rows = []
    for k, label in enumerate(PARAMETER_NAMES):
        percentages = map(percent, shares[:, k].tolist())
        rows.append((label, drawing.plus_minus(body.errors[k]), *percentages))
    caption = (
        f"{body.title}: what each parameter's error is made of, in shares of its variance. Where "
        "noise is small, a longer recording does not help."
    )

    def draw(canvas: Any) -> None:
        """Draw one bar of stacked shares per parameter on an empty matplotlib figure."""
        ax = canvas.subplots()
        left = np.zeros(10)
        positions = -np.arange(10.0)
        for (cause, share), (colour, _), hatch in zip(
            drawn_shares.items(), drawing.SERIES, drawing.HATCHES
        ):
            style = {
                "facecolor": colour,
                "edgecolor": drawing.INK,
                "alpha": 0.75,
                "hatch": hatch,
            }
            ax.barh(positions, 100.0 * share, left=left, label=cause, **style)
            left = left + 100.0 * share
        ax.set_yticks(positions, PARAMETER_NAMES)
        ax.set(xlabel="share of the error's variance [%]", xlim=(0.0, 100.0))
        drawing.draw_legend(canvas, ax, 2)

    numbers = ("parameter", "± standard error", *causes), rows
    return draw_figure(name, caption, numbers, height=4.6, draw=draw)


def visibility(run: Run) -> Section:
    """Return the section on which parameters come from the data and which from the model.

    Its tables are the source of each parameter of the first body, the base parameters and the
    estimated sensor errors, as far as there are any.
    """
    body = run.bodies[0]
    content = run.content
    source_rows = []
    for k, name in enumerate(PARAMETER_NAMES):
        source = _source(body, k, run.is_payload)
        error_text = drawing.plus_minus(body.errors[k])
        source_rows.append((name, source, percent(body.share[k]), error_text))
    tables = [table((body.title, "comes from", "data", "±"), source_rows)]
    sentences = []
    base = content["base_parameters"]
    sensors = content["sensors"]
    if base:
        sentences.append(
            f"The torques show {len(base)} combinations of the links' parameters; any motion of "
            f"this arm could show {content['structural_rank'] or 'as many'}. Numbers of a "
            "single link beyond these combinations lean on the model."
        )
        header = ("combination", "value", "± standard error", "essential")
        base_rows = []
        for base_parameter in base:
            # The keys of each object are written in the order of the table's columns.
            combination, value, error, is_essential = base_parameter.values()
            value_cells = drawing.cells(number(value), number(error))
            base_rows.append((combination, *value_cells, _YES_OR_NO[is_essential]))
        tables.append(table(header, base_rows))
    if sensors:
        sensor_rows = zip(sensors, itertools.starmap(with_error, sensors.values()))
        tables.append(table(("sensor", "found beside them"), sensor_rows))
    hidden = list(content["unidentifiable_combinations"])
    if not run.is_fully_known:
        hidden.insert(0, "the payload's inertia (its ± does not tell it from zero)")
        sentences.append(NOT_KNOWN)
    every = "All parameters that were asked for show in these torques."
    sentences.append(
        f"These torques do not show: {'; '.join(hidden)}." if hidden else every
    )
    return Section("visible", "Identified, kept, not visible", sentences, tables)


def _source(body: Body, k: int, is_payload: bool) -> str:
    """Return where the value of a parameter comes from, the data or the model, as text of a cell.

    Args:
        body: the body.
        k: index of the parameter, 0 to 9.
        is_payload: whether the body is a payload, of which no model exists.
    """
    if body.is_from_model[k]:
        return "not known" if is_payload else "the model (not visible)"
    if np.isfinite(body.share[k]) and body.share[k] < PRIOR_SHARE:
        return "more model than data"
    return (
        "the data"
        if np.isfinite(body.errors[k]) or not body.budget
        else "partly the model"
    )


def card(run: Run) -> Section | None:
    """Return the section with the payload's numbers in the form of each controller, to be copied.

    None if the run identified no payload. If the run wrote no card, the section has the reason in
    place of the numbers.
    """
    payload = run.content["payload"]
    if payload is None:
        return None
    scales = payload["torque_scale"]
    rows = zip(scales, itertools.starmap(with_error, scales.values()))
    tables = [table(("joint", "torque scale"), rows)] if scales else []
    if not payload["cards"]:
        reason = "no card was written, because the payload is not to be used"
        if payload["known_mass"] is not None:
            reason = "this run calibrated the torques; it writes no card"
        return Section("card", "Payload card", (), tables, missing=(reason,))
    flange = payload["flange"]
    explanation = (
        f"In the frame of the flange {flange['name']} on body {flange['in_body']}. Check that the "
        "controller means the same frame."
    )
    blocks = []
    for entry in payload["cards"].values():
        lines = filter(None, (entry["explanation"], *entry["notes"]))
        comment = "\n".join(map("# {}".format, lines))
        blocks.append((entry["title"], f"{comment}\n{entry['text']}"))
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
        mass, noise, error = map(
            number, itemgetter("mass", "noise_error", "error")(recording)
        )
        pair = drawing.cells(mass, noise)
        side = "loaded" if recording["is_loaded"] else "empty"
        rows.append((recording["name"], side, *pair, drawing.plus_minus(error)))
    explanation = (
        "Mass of the payload according to each recording against all of the other kind. If one "
        "recording says something else than the others, it was made with another payload, or "
        "something was changed between them."
    )
    return Section(
        "scatter", "Each recording alone", (explanation,), (table(header, rows),)
    )


_SIZE = (800, 620)
"""Width and height of a picture [pixels]."""
_COLOURS: dict[str, Colour] = {
    "before": (0.9, 0.45, 0.05, 0.3),
    "after": (0.05, 0.38, 0.75, 0.5),
}
"""Version of the parameters to colour (red, green, blue, opacity) of its ellipsoid, 0 to 1."""
_ROOM = 6.0
"""Least distance of the camera from the whole arm, in sizes of the largest body."""
_FARTHER = 1.25
"""Least distance of the camera from the whole arm, in distances at which just the arm fits."""
_NEAREST = 3.0
"""Least distance of the camera from the last link, in extents of its largest ellipsoid."""
_TITLE = "Inertia on the arm"
"""Heading of the section with the pictures."""
Bodies = list[tuple[int, Body]]
"""Pairs (MuJoCo id of the body that carries the frame, body in that frame)."""


def picture(run: Run, mesh_dir: Path | None = None) -> Section:
    """Return the section with pictures of the arm and ellipsoids of its links' mass and inertia.

    The section has the reason in place of pictures if the model is not at its path any more or has
    changed, or if nothing can be rendered.

    Args:
        run: the run whose bodies are drawn.
        mesh_dir: folder with the model's meshes; None for the folder that the model names.
    """
    entry = run.content["model"]
    path = Path(entry["path"])
    try:
        if not path.is_file():
            raise SysidError(
                f"no pictures of the arm: its model is not at {path} any more"
            )
        robot = load_robot_model(path, mesh_dir, run.content["joint_name"])
        if robot.sha256 != entry["sha256"]:
            raise SysidError(
                f"no pictures of the arm: {path} has changed since the run"
            )
        return _ellipsoid_section(robot, list(_drawn_bodies(robot, run)))
    except SysidError as error:
        return Section("picture", _TITLE, missing=(str(error),))


def _ellipsoid_section(robot: RobotModel, bodies: Bodies) -> Section:
    """Return the section with a picture of the whole arm and one of its last link.

    SysidError if there is no graphics library to render with.

    Args:
        robot: the arm, drawn in its reference posture.
        bodies: pairs (MuJoCo id, body) to draw, one of them at the last link.
    """
    from matplotlib.image import imsave

    # matplotlib's version would make equal pictures differ.
    metadata: Any = {"Software": None}
    numbers = masses([body for _, body in bodies])
    figures = []
    last = [body_pair for body_pair in bodies if body_pair[0] == robot.body_id]
    _, last_body = last[0]
    impossible: dict[str, None] = {}
    with Studio(robot, *_SIZE) as studio:
        for name, subject, drawn_bodies in (
            ("arm", "the whole arm", bodies),
            ("close", "the last link", last),
        ):
            studio.look_at_arm(robot.reference[None])
            if name == "close":
                _approach_last_link(studio, robot, last_body)
            else:
                # So far away that the largest ellipsoid fits into the picture.
                largest = max(_largest_length(body) for _, body in bodies)
                studio.camera.distance = max(
                    _FARTHER * studio.camera.distance, _ROOM * largest
                )
            studio.pose(robot.reference)
            # The arm's own surfaces, so that the ellipsoids inside are seen.
            studio.make_transparent(0.35)
            impossible.update(dict.fromkeys(_add_ellipsoids(studio, drawn_bodies)))
            caption = f"Ellipsoids of inertia on {subject}, in its reference posture."
            pixels = np.ascontiguousarray(studio.render())
            buffer = io.BytesIO()
            imsave(buffer, pixels, format="png", metadata=metadata)
            figures.append(
                Figure(f"inertia-{name}", caption, numbers, png=buffer.getvalue())
            )
    explanation = (
        "Each ellipsoid is the homogeneous body with the mass and inertia of a link; its dot is "
        "the centre of mass. Orange: before. Blue: after."
    )
    impossible_text = "is no possible rigid body: only its centre of mass is drawn"
    points = tuple(f"{name} {impossible_text}" for name in impossible)
    return Section(
        "picture", _TITLE, (explanation,), figures=tuple(figures), points=points
    )


def _largest_length(body: Body) -> float:
    """Return the largest characteristic length [m] of a body in all versions of its parameters."""
    return max(map(characteristic_length, body.thetas.values()))


def _add_ellipsoids(studio: Studio, bodies: Bodies) -> Iterator[str]:
    """Add the ellipsoids of all bodies before and after to the picture.

    Yields body and version, as "link6 after", of parameters that no rigid body has and that
    therefore have no ellipsoid. The ellipsoids are added while the caller iterates.
    """
    for body_id, body in bodies:
        for version, colour in _COLOURS.items():
            theta = body.thetas.get(version)
            if theta is not None and not studio.add_ellipsoid(body_id, theta, colour):
                yield f"{body.title} {version}"


def _drawn_bodies(robot: RobotModel, run: Run) -> Iterator[tuple[int, Body]]:
    """Yield (id of a MuJoCo body, run's body in the frame of that MuJoCo body) for each to draw.

    These are the payload, and the terminal link with it, whose version "before" is the link without
    payload; of a run without a payload, the terminal link and the other links.
    """
    if run.is_payload:
        payload, link, total = run.bodies
        entry = run.content["payload"]["flange"]
        flange = Flange(
            "flange", np.array(entry["rotation"]), np.array(entry["translation"])
        )
        payload_thetas = {"after": flange.from_flange(payload.identified)}
        yield robot.body_id, replace(payload, thetas=payload_thetas)
        thetas = {"before": link.identified, "after": total.identified}
        yield (robot.body_id, replace(total, title="link with payload", thetas=thetas))
        return
    terminal, *others = run.bodies
    yield robot.body_id, terminal
    ids = {link.body_name: link.body_id for link in robot.links}
    for body in others:
        if body.title in ids:
            yield ids[body.title], body


def _approach_last_link(studio: Studio, robot: RobotModel, body: Body) -> None:
    """Point the camera at the last link's centre of mass, as near as its ellipsoids allow.

    Args:
        studio: the renderer, its camera at the distance of the whole arm.
        robot: the arm.
        body: the last link, or the payload in the link's frame.
    """
    theta = body.identified
    com = theta[1:4] / theta[0] if theta[0] > 0.0 else np.zeros(3)
    extent = max(_ellipsoid_extent(version, com) for version in body.thetas.values())
    # Pose of the link's frame in the world.
    rotation = studio.data.xmat[robot.body_id].reshape(3, 3)
    target = studio.data.xpos[robot.body_id] + rotation @ com
    # The link's surroundings stay in the picture.
    least_distance = 0.4 * studio.camera.distance
    studio.point_camera(target, max(least_distance, _NEAREST * extent))


def _ellipsoid_extent(theta: Array, point: Array) -> float:
    """Return an upper bound of the distance [m] of a body's ellipsoid from a point (3,) [m].

    The bound is the distance of the centre of mass plus the longest half axis a, of which
    a^2 = 5 (I_2 + I_3 - I_1) / (2 m) with the ascending principal moments I; zero without mass.

    Args:
        theta: (10,) parameters of the body, in the frame of the point.
        point: (3,) coordinates [m].
    """
    if theta[0] <= 0.0:
        return 0.0
    mass, com, inertia = com_from_theta(theta)
    moments = np.linalg.eigvalsh(inertia)
    half_axis = np.sqrt(max(2.5 * (np.sum(moments) - 2.0 * moments[0]) / mass, 0.0))
    return float(np.linalg.norm(com - point) + half_axis)

"""Sections of the report on bodies: parameters, errors by cause, cards, ellipsoids of inertia."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
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
_MARKS: dict[str, tuple[float, dict[str, Any]]] = {
    "before": (0.16, {"marker": "D", "mfc": "none", "mec": drawing.BEFORE}),
    "in the file": (-0.16, {"marker": "s", "mfc": "none", "mec": drawing.OTHER}),
    "truth": (-0.16, {"marker": "x", "mew": 1.8, "color": drawing.TRUTH}),
}
"""What stands beside the identified value: by how much of a row above it, and its marker."""
_LEAST_SPAN = 0.02
"""Width of an axis, relative to its values, below which what is drawn would be rounding."""


def parameters(run: Run) -> Section:
    """Return the ten parameters of every body, before and after."""
    figures = []
    for body_index, body in enumerate(run.bodies):
        figures.append(_before_after(body, f"parameters-{body_index}"))
        if body.budget:
            figures.append(_causes(body, f"errors-{body_index}"))
    explanation = (
        "m is the mass, h the first moment (mass times centre of mass), I the inertia about the "
        f"origin of the {'flange' if run.is_payload else 'body'}'s frame. Bars are ± one standard "
        "error, all causes together; a value without a bar has an error that is not known."
    )
    title = "The numbers" if run.is_payload else "Before and after"
    return Section("parameters", title, (explanation,), (masses(run.bodies),), figures)


def masses(bodies: Sequence[Body]) -> Table:
    """Return mass and centre of mass of some bodies: before, after, as written and in truth."""
    header = ("body", "", "mass [kg]", *(f"centre {axis} [m]" for axis in "xyz"))
    rows = [
        (body.title, when, *_mass_and_place(theta, body, when == "after"))
        for body in bodies
        for when, theta in body.thetas.items()
        if theta[0] != 0.0
    ]
    return table(header, rows)


def _mass_and_place(theta: Array, body: Body, identified: bool) -> Iterator[str]:
    mass, *errors = body.stated(body.central) if identified else [None] * 4
    yield with_error(float(theta[0]), mass)
    for coordinate, error in zip((theta[1:4] / theta[0] + 0.0).tolist(), errors):
        yield f"{coordinate:.4f}" if error is None else with_error(coordinate, error)


def _before_after(body: Body, name: str) -> Figure:
    thetas = body.thetas
    rows = [
        (
            f"{label} [{unit}]",
            *(
                drawing.text(float(theta[k]), body.errors[k])
                for theta in thetas.values()
            ),
            drawing.plus_minus(body.errors[k]),
        )
        for k, (label, unit) in enumerate(zip(PARAMETER_NAMES, PARAMETER_UNITS))
    ]
    numbers = ("parameter", *thetas, "± standard error"), rows
    model_text = " against the model's values before" if "before" in thetas else ""
    truth_text = " and the truth of the simulated arm" if "truth" in thetas else ""
    caption = f"{body.title}: identified parameters{model_text}{truth_text}, ± one standard error."

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(
            3, 1, height_ratios=[end - start + 0.6 for start, end, _ in _GROUPS]
        )
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
            ax.errorbar(body.after[indices], positions, xerr=errors[indices], **bar)
            ax.set_yticks(positions, PARAMETER_NAMES[indices])
            ax.set(
                ylim=(positions[-1] - 0.6, 0.6),
                xlabel=f"{title} [{PARAMETER_UNITS[start]}]",
            )
            ax.margins(x=0.08)
            ax.locator_params(axis="x", nbins=6)
            least = (
                0.5 * _LEAST_SPAN * float(np.max(np.abs(body.after[indices]))) or 5e-7
            )
            low, high = ax.get_xlim()
            if high - low < 2.0 * least:
                ax.set_xlim(0.5 * (low + high) - least, 0.5 * (low + high) + least)
        drawing.legend(canvas, axes[0], 4)

    return draw_figure(name, caption, numbers, 4.6, draw)


def _causes(body: Body, name: str) -> Figure:
    causes = list(body.budget)
    squares = np.square(np.nan_to_num(np.array(list(body.budget.values()))))
    squares[:, ~np.isfinite(body.errors)] = 0.0
    total = np.sum(squares, axis=0)
    shares = np.divide(squares, total, out=np.zeros_like(squares), where=total > 0.0)
    # As many as there are colours; what is least stands together.
    largest = np.argsort(-np.sum(shares, axis=1), kind="stable")[
        : len(drawing.SERIES) - 1
    ]
    drawn_shares = {causes[k]: shares[k] for k in sorted(largest.tolist())}
    drawn_shares["all others"] = np.sum(np.delete(shares, largest, axis=0), axis=0)
    rows = [
        (label, drawing.plus_minus(error), *map(percent, parameter_shares))
        for label, error, parameter_shares in zip(
            PARAMETER_NAMES, body.errors, shares.T.tolist()
        )
    ]
    caption = (
        f"{body.title}: what each parameter's error is made of, in shares of its variance. Where "
        "noise is small, a longer recording does not help."
    )

    def draw(canvas: Any) -> None:
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
        drawing.legend(canvas, ax, 2)

    numbers = ("parameter", "± standard error", *causes), rows
    return draw_figure(name, caption, numbers, 4.6, draw)


def visibility(run: Run) -> Section:
    """Return what is identified, what was kept from the model, and what does not show."""
    body = run.bodies[0]
    content = run.content
    sources = [_source(body, k, run.is_payload) for k in range(len(PARAMETER_NAMES))]
    errors = map(drawing.plus_minus, body.errors)
    rows = list(zip(PARAMETER_NAMES, sources, map(percent, body.share), errors))
    tables = [table((body.title, "comes from", "data", "±"), rows)]
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
        essential = {True: "yes", False: "no"}
        rows = [
            (combination, *drawing.cells(*map(number, pair)), essential[is_essential])
            for combination, *pair, is_essential in map(dict.values, base)
        ]
        tables.append(table(header, rows))
    if sensors:
        sensor_rows = [
            (name, with_error(*quantity)) for name, quantity in sensors.items()
        ]
        tables.append(table(("sensor", "found beside them"), sensor_rows))
    hidden = list(content["unidentifiable_combinations"])
    if not run.all_known:
        hidden.insert(0, "the payload's inertia (its ± does not tell it from zero)")
        sentences.append(NOT_KNOWN)
    every = "All parameters that were asked for show in these torques."
    sentences.append(
        f"These torques do not show: {'; '.join(hidden)}." if hidden else every
    )
    return Section("visible", "Identified, kept, not visible", sentences, tables)


def _source(body: Body, k: int, is_payload: bool) -> str:
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
    """Return the payload as controllers take it; None where there is none."""
    payload = run.content["payload"]
    if payload is None:
        return None
    rows = [
        (joint, with_error(*quantity))
        for joint, quantity in payload["torque_scale"].items()
    ]
    tables = [table(("joint", "torque scale"), rows)] if rows else []
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
        comment = "\n".join(
            f"# {line}" for line in (entry["explanation"], *entry["notes"]) if line
        )
        blocks.append((entry["title"], f"{comment}\n{entry['text']}"))
    return Section(
        "card", "Payload card", (explanation,), tables, blocks=blocks, is_open=True
    )


def scatter(run: Run) -> Section | None:
    """Return the payload according to each recording alone, or None where nothing is known."""
    payload = run.content["payload"]
    if payload is None or not payload["scatter"]:
        return None
    header = ("recording", "kind", "mass [kg]", "± noise alone [kg]", "± all [kg]")
    rows = []
    for recording in payload["scatter"]:
        mass, noise, error = (
            number(recording[key]) for key in ("mass", "noise_error", "error")
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
_COLOURS: dict[str, Colour] = {
    "before": (0.9, 0.45, 0.05, 0.3),
    "after": (0.05, 0.38, 0.75, 0.5),
}
_ROOM = 6.0
_FARTHER = 1.25
_NEAREST = 3.0
_TITLE = "Inertia on the arm"
Bodies = list[tuple[int, Body]]


def picture(run: Run, mesh_dir: Path | None = None) -> Section:
    """Return pictures of the arm with ellipsoids of the same mass and inertia as its links."""
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
        return _ellipsoid_section(robot, list(_bodies(robot, run)))
    except SysidError as error:
        return Section("picture", _TITLE, missing=(str(error),))


def _ellipsoid_section(robot: RobotModel, bodies: Bodies) -> Section:
    from matplotlib.image import imsave

    facts: Any = {"Software": None}
    numbers = masses([body for _, body in bodies])
    figures = []
    last = [body_pair for body_pair in bodies if body_pair[0] == robot.body_id]
    impossible: dict[str, None] = {}
    with Studio(robot, *_SIZE) as studio:
        for name, subject, drawn_bodies in (
            ("arm", "the whole arm", bodies),
            ("close", "the last link", last),
        ):
            studio.look_at_arm(robot.reference[None])
            if name == "close":
                _go_near(studio, robot, last[0][1])
            else:
                # So far away that the largest ellipsoid fits into the picture.
                thetas = [theta for _, body in bodies for theta in body.thetas.values()]
                distance = _ROOM * max(map(characteristic_length, thetas))
                studio.camera.distance = max(
                    _FARTHER * studio.camera.distance, distance
                )
            studio.pose(robot.reference)
            studio.make_transparent(0.35)
            impossible.update(dict.fromkeys(_add_ellipsoids(studio, drawn_bodies)))
            caption = f"Ellipsoids of inertia on {subject}, in its reference posture."
            pixels = np.ascontiguousarray(studio.render())
            buffer = io.BytesIO()
            imsave(buffer, pixels, format="png", metadata=facts)
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


def _add_ellipsoids(studio: Studio, bodies: Bodies) -> Iterator[str]:
    """Add all ellipsoids; yields the names of what has none."""
    for index, body in bodies:
        for when, colour in _COLOURS.items():
            theta = body.thetas.get(when)
            if theta is not None and not studio.add_ellipsoid(index, theta, colour):
                yield f"{body.title} {when}"


def _bodies(robot: RobotModel, run: Run) -> Iterator[tuple[int, Body]]:
    """Yield (MuJoCo id, body in its frame), what was asked for first."""
    first, *others = run.bodies
    if run.is_payload:
        entry = run.content["payload"]["flange"]
        flange = Flange(
            "flange", np.array(entry["rotation"]), np.array(entry["translation"])
        )
        yield (
            robot.body_id,
            replace(first, thetas={"after": flange.from_flange(first.after)}),
        )
        thetas = {"before": others[0].after, "after": others[1].after}
        yield (
            robot.body_id,
            replace(others[1], title="link with payload", thetas=thetas),
        )
        return
    yield robot.body_id, first
    ids = {link.body_name: link.body_id for link in robot.links}
    yield from ((ids[body.title], body) for body in others if body.title in ids)


def _go_near(studio: Studio, robot: RobotModel, body: Body) -> None:
    """Point the camera at the last link's centre of mass, as near as its ellipsoids allow."""
    com = body.after[1:4] / body.after[0] if body.after[0] > 0.0 else np.zeros(3)
    reach = max(_reach(theta, com) for theta in body.thetas.values())
    turn = studio.data.xmat[robot.body_id].reshape(3, 3)
    target = studio.data.xpos[robot.body_id] + turn @ com
    studio.point_camera(target, max(0.4 * studio.camera.distance, _NEAREST * reach))


def _reach(theta: Array, around: Array) -> float:
    """Return how far the ellipsoid of a body (10,) gets from a place (3,) [m]."""
    if theta[0] <= 0.0:
        return 0.0
    mass, com, inertia = com_from_theta(theta)
    moments = np.linalg.eigvalsh(inertia)
    half_axis = np.sqrt(max(2.5 * (np.sum(moments) - 2.0 * moments[0]) / mass, 0.0))
    return float(np.linalg.norm(com - around) + half_axis)

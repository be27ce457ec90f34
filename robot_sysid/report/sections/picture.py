"""The arm with the inertia of its links before and after, as ellipsoids."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Optional

import numpy as np

from robot_sysid.dynamics.spatial import characteristic_length
from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.preview.studio import Colour, Picture, Studio
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.report.elements import Figure, Section, table, text
from robot_sysid.report.runs import ARM, PAYLOAD, Run, mapping

_SIZE = (800, 620)
BEFORE: Colour = (0.90, 0.45, 0.05, 0.30)
AFTER: Colour = (0.05, 0.38, 0.75, 0.50)
_ROOM = 6.0
_TITLE = "Inertia on the arm"
Bodies = list[tuple[str, int, Array, Optional[Array]]]


def picture(run: Run, mesh_dir: Path | None = None) -> Section:
    """Return pictures of the arm with ellipsoids of the same mass and inertia as its links.

    Args:
        run: what is drawn.
        mesh_dir: the user's mesh folder, if any.
    """
    entry = mapping(run.content, "model")
    path = Path(str(entry.get("path", "")))
    joint = run.content.get("joint_name")
    try:
        if not path.is_file():
            raise SysidError(f"no pictures of the arm: its model is not at {path} any more")
        robot = load_robot_model(path, mesh_dir, joint if isinstance(joint, str) else None)
        if robot.sha256 != entry.get("sha256"):
            raise SysidError(f"no pictures of the arm: {path} has changed since the run")
        return _drawn(robot, run)
    except SysidError as error:
        return Section("picture", _TITLE, missing=(str(error),))


def _drawn(robot: RobotModel, run: Run) -> Section:
    bodies, impossible = list(_bodies(robot, run)), []
    figures = []
    with Studio(robot, *_SIZE) as studio:
        for name, words in (("arm", "the whole arm"), ("close", "the last link")):
            studio.look_at_arm(robot.reference[None])
            if name == "close":
                _go_near(studio, robot, bodies[-1][2])
            else:
                _step_back(studio, bodies)
            studio.pose(robot.reference)
            studio.glass(0.35)
            impossible += _add_ellipsoids(studio, bodies)
            figures.append(_figure(name, words, studio.picture(), bodies))
    said = (
        "Each ellipsoid is the homogeneous body with the mass and inertia of a link; its dot is "
        "the centre of mass. Orange: before. Blue: after.",
    )
    notes = tuple(
        f"{name} is no possible rigid body: only its centre of mass is drawn"
        for name in dict.fromkeys(impossible)
    )
    return Section("picture", _TITLE, said, figures=tuple(figures), points=notes)


def _add_ellipsoids(studio: Studio, bodies: Bodies) -> list[str]:
    """Add all ellipsoids; returns the names of what has none."""
    impossible = []
    for title, body, after, before in bodies:
        if before is not None and not studio.add_ellipsoid(body, before, BEFORE):
            impossible.append(f"{title} before")
        if not studio.add_ellipsoid(body, after, AFTER):
            impossible.append(title)
    return impossible


def _bodies(robot: RobotModel, run: Run) -> Iterator[tuple[str, int, Array, Array | None]]:
    """Yield (title, MuJoCo id, theta after and before in that body's frame)."""
    found = run.bodies()
    if run.kind == ARM:
        ids = {link.body_name: link.body_id for link in robot.links}
        for body in found:
            if body.title in ids:
                yield body.title, ids[body.title], body.after, body.before
    elif run.kind == PAYLOAD:
        entry = mapping(run.content, "flange")
        flange = Flange("flange", np.array(entry["rotation"]), np.array(entry["translation"]))
        yield "link, without and with payload", robot.body_id, found[2].after, found[1].after
        yield "payload", robot.body_id, flange.from_flange(found[0].after), None
    else:
        yield found[0].title, robot.body_id, found[0].after, found[0].before


def _go_near(studio: Studio, robot: RobotModel, theta: Array) -> None:
    """Point the camera at a body's centre of mass from a third of the distance."""
    com = theta[1:4] / theta[0] if theta[0] > 0.0 else np.zeros(3)
    turn = studio.data.xmat[robot.body_id].reshape(3, 3)
    place = studio.data.xpos[robot.body_id] + turn @ com
    studio.look(place, 0.4 * studio.camera.distance)


def _step_back(studio: Studio, bodies: Bodies) -> None:
    """Take the camera so far away that the largest ellipsoid fits into the picture."""
    thetas = [theta for _, _, after, before in bodies for theta in (after, before)]
    sizes = [characteristic_length(theta) for theta in thetas if theta is not None]
    studio.camera.distance = max(studio.camera.distance, _ROOM * max(sizes))


def _figure(name: str, words: str, pixels: Picture, bodies: Bodies) -> Figure:
    rows = []
    for title, _, after, before in bodies:
        for when, theta in (("before", before), ("after", after)):
            if theta is not None and theta[0] != 0.0:
                com = theta[1:4] / theta[0]
                rows.append((title, when, text(float(theta[0])), *(f"{c:.4f}" for c in com)))
    header = ("body", "", "mass [kg]", *(f"centre {axis} [m]" for axis in "xyz"))
    caption = f"Ellipsoids of inertia on {words}, in its reference posture."
    return Figure(f"inertia-{name}", caption, table(header, rows), png=png_bytes(pixels))


def png_bytes(pixels: Picture) -> bytes:
    """Return a picture as PNG."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    facts: Any = {"Software": None}
    imsave(buffer, np.ascontiguousarray(pixels), format="png", metadata=facts)
    return buffer.getvalue()

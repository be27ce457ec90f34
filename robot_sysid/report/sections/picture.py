"""The arm with the inertia of its links before and after, as ellipsoids."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import characteristic_length, com_from_theta
from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.preview.film import Colour, Studio
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.report.drawing import Figure, Section
from robot_sysid.report.runs import Body, Run
from robot_sysid.report.sections.parameters import masses

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
        return _drawn(robot, list(_bodies(robot, run)))
    except SysidError as error:
        return Section("picture", _TITLE, missing=(str(error),))


def _drawn(robot: RobotModel, bodies: Bodies) -> Section:
    from matplotlib.image import imsave

    facts: Any = {"Software": None}
    numbers = masses([body for _, body in bodies])
    figures = []
    last = [each for each in bodies if each[0] == robot.body_id]
    impossible: dict[str, None] = {}
    with Studio(robot, *_SIZE) as studio:
        for name, on, shown in (
            ("arm", "the whole arm", bodies),
            ("close", "the last link", last),
        ):
            studio.look_at_arm(robot.reference[None])
            if name == "close":
                _go_near(studio, robot, last[0][1])
            else:
                # So far away that the largest ellipsoid fits into the picture.
                thetas = [theta for _, body in bodies for theta in body.thetas.values()]
                room = _ROOM * max(map(characteristic_length, thetas))
                studio.camera.distance = max(_FARTHER * studio.camera.distance, room)
            studio.pose(robot.reference)
            studio.make_transparent(0.35)
            impossible.update(dict.fromkeys(_add_ellipsoids(studio, shown)))
            caption = f"Ellipsoids of inertia on {on}, in its reference posture."
            pixels = np.ascontiguousarray(studio.render())
            buffer = io.BytesIO()
            imsave(buffer, pixels, format="png", metadata=facts)
            figures.append(
                Figure(f"inertia-{name}", caption, numbers, png=buffer.getvalue())
            )
    said = (
        "Each ellipsoid is the homogeneous body with the mass and inertia of a link; its dot is "
        "the centre of mass. Orange: before. Blue: after."
    )
    told = "is no possible rigid body: only its centre of mass is drawn"
    points = tuple(f"{name} {told}" for name in impossible)
    return Section("picture", _TITLE, (said,), figures=tuple(figures), points=points)


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
    place = studio.data.xpos[robot.body_id] + turn @ com
    studio.point_camera(place, max(0.4 * studio.camera.distance, _NEAREST * reach))


def _reach(theta: Array, around: Array) -> float:
    """Return how far the ellipsoid of a body (10,) gets from a place (3,) [m]."""
    if theta[0] <= 0.0:
        return 0.0
    mass, com, inertia = com_from_theta(theta)
    moments = np.linalg.eigvalsh(inertia)
    half_axis = np.sqrt(max(2.5 * (np.sum(moments) - 2.0 * moments[0]) / mass, 0.0))
    return float(np.linalg.norm(com - around) + half_axis)

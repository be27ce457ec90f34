"""Section of the report with pictures of the arm: ellipsoids of its links' mass and inertia."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_sysid.dynamics.spatial import characteristic_length, com_from_theta
from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.report.motion_strip import motion_strip
from robot_sysid.report.runs import Body, Run
from robot_sysid.report.sections import Figure, Section
from robot_sysid.report.studio import Colour, Studio, png_bytes

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
_TITLE = "Inertia on the arm, and its motion"
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
        section = _ellipsoid_section(robot, list(_drawn_bodies(robot, run)))
        if run.data is None:
            return section
        strip = motion_strip(robot, run.data.time, run.data.q)
        return replace(section, figures=(*section.figures, strip))
    except SysidError as error:
        return Section("picture", _TITLE, missing=(str(error),))


def _ellipsoid_section(robot: RobotModel, bodies: Bodies) -> Section:
    """Return the section with a picture of the whole arm and one of its last link.

    SysidError if there is no graphics library to render with.

    Args:
        robot: the arm, drawn in its reference posture.
        bodies: pairs (MuJoCo id, body) to draw, one of them at the last link.
    """
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
            pixels = png_bytes(studio.render())
            figures.append(Figure(f"inertia-{name}", caption, png=pixels))
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

"""Pictures of the arm: ellipsoids of its links' mass and inertia."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from robot_sysid.errors import SysidError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.report.drawing import Figure
from robot_sysid.report.runs import Run
from robot_sysid.report.studio import Colour, Studio, png_bytes
from robot_sysid.spatial import characteristic_length

ROOM = 1.25
"""Distance of the camera from the arm, over that at which just the arm fits."""
LAST_LINK_DISTANCE = 0.3
"""Distance of the camera from the last link, over that from the whole arm."""
BODY_DISTANCE = 6.0
"""Least distance of the camera, over the size of the largest body that is drawn."""
# Version of the parameters to colour (red, green, blue, opacity) of its ellipsoid, 0 to 1.
_COLOURS: dict[str, Colour] = {
    "before": (0.9, 0.45, 0.05, 0.3),
    "after": (0.05, 0.38, 0.75, 0.5),
}
Body = tuple[int, str, Array]
"""MuJoCo id of a body, version of its parameters, and these (10,) in the frame of that body."""


def pictures(run: Run, mesh_dir: Path | None = None) -> tuple[list[Figure], str]:
    """Return pictures of the arm with ellipsoids, and why there are none.

    There are none if the model is not at its path any more or has changed, or if nothing can be
    rendered.

    Args:
        run: the run whose bodies are drawn.
        mesh_dir: folder with the model's meshes; None for the folder that the model names.
    """
    entry = run.content["model"]
    path = Path(entry["path"])
    try:
        if not path.is_file():
            raise SysidError(f"its model is not at {path} any more")
        names = run.content["joint_names"]
        robot = load_robot_model(path, mesh_dir, names[-1], first_joint=names[0])
        if robot.sha256 != entry["sha256"]:
            raise SysidError(f"{path} has changed since the run")
        return _ellipsoid_pictures(robot, list(_drawn_bodies(robot, run))), ""
    except SysidError as error:
        return [], f"No pictures of the arm: {error}."


def _ellipsoid_pictures(robot: RobotModel, bodies: Sequence[Body]) -> list[Figure]:
    """Return a picture of the whole arm and one of its last link, in the reference posture.

    SysidError if there is no graphics library to render with.

    Args:
        robot: the arm.
        bodies: the bodies to draw, one of them at the last link.
    """
    figures = []
    last = [body for body in bodies if body[0] == robot.body_id]
    with Studio(robot, width=800, height=620) as studio:
        target, distance = studio.arm_view()
        distance *= ROOM
        for subject, drawn in (("the whole arm", bodies), ("the last link", last)):
            if drawn is last:
                target = studio.data.xpos[robot.body_id]
                distance *= LAST_LINK_DISTANCE
            sizes = [characteristic_length(theta) for _, _, theta in drawn]
            studio.start(target, max(distance, BODY_DISTANCE * max(sizes)))
            for body_id, version, theta in drawn:
                studio.add_ellipsoid(body_id, theta, _COLOURS[version])
            caption = f"Ellipsoids of inertia on {subject}, in its reference posture."
            figures.append(Figure(caption, png=png_bytes(studio.render())))
    return figures


def _drawn_bodies(robot: RobotModel, run: Run) -> Iterator[Body]:
    """Yield the bodies to draw.

    These are the terminal link with the payload, before it without, and the payload; of a run
    without a payload, the links.
    """
    if run.content["payload"] is not None:
        payload, link, total = (
            np.asarray(run.theta(body, "value")) for body in run.bodies
        )
        entry = run.content["payload"]["flange"]
        pose = (np.array(entry["rotation"]), np.array(entry["translation"]))
        yield robot.body_id, "after", Flange("flange", *pose).from_flange(payload)
        yield robot.body_id, "before", link
        yield robot.body_id, "after", total
        return
    ids = {link.body_name: link.body_id for link in robot.links}
    for body in run.bodies:
        for version, column in (("before", "model"), ("after", "value")):
            theta = run.theta(body, column)
            if theta is not None:
                yield ids[body], version, theta

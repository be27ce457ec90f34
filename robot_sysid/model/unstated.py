"""Arms whose models state no masses, and the bodies of their geometry that stand for the links.

Who drew an arm has often no masses: a URDF leaves them out, or has one number in all links, 0.01 kg
or 1 kg with an inertia of 1. No factor makes masses of such numbers. What a model does state is how
large its links are: by their shapes, or by the distances between the joints. So each link gets a
body that is as large, whose mass is a share of the arm's by volume, and counts as not known: mass,
centre of mass and inertia have errors as large as themselves.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import InputError
from robot_sysid.model.bodies import arm_links, write_body
from robot_sysid.model.stated import (
    ALIKE,
    LEAST_SHARE,
    MASS,
    Shape,
    copied_kinds,
    least_size,
    link_sizes,
    shape_of,
    steps_to_next,
    with_references,
)
from robot_sysid.model.units import (
    FOAM,
    LARGEST_GYRATION,
    LEAD,
    SHORTEST_ARM,
    mass_unit,
    stated_bodies,
)
from robot_sysid.records import KINDS, ArmLink, Array, RobotModel, SubtreeBody
from robot_sysid.spatial import ROD_MOMENT
from robot_sysid.wording import option_name

SHAPE_DENSITY = 500.0
"""Mass over the volume of the boxes around the shapes of links [kg/m^3]: about the median of public
arms with collision shapes."""
ARM_DENSITY = 14.0
"""Mass of an arm over the cube of the distances between its joints, where links have no shapes
[kg/m^3]: median of public arms."""
LEAST_BODY = spatial.theta_from_com(1e-6, np.zeros(3), 1e-9 * np.eye(3))
"""Parameters (10,) of a body without shapes that moves by itself, which MuJoCo wants to weigh."""


def lacks_masses(
    robot: RobotModel, massless: Collection[str], as_stated: bool = False
) -> bool:
    """Return whether a model states no mass of more than half of its arm's links.

    Args:
        robot: the arm as its file states it.
        massless: names of bodies of which its file states none.
        as_stated: whether any number that the file has counts as a mass.
    """
    unstated = _unstated_links(robot, massless, as_stated)
    return 2 * len(unstated) > sum(link.has_mass for link in robot.links)


def with_bodies_of_geometry(
    robot: RobotModel,
    massless: Collection[str],
    drawn: Any = None,
    total_mass: float | None = None,
    as_stated: bool = False,
) -> RobotModel:
    """Return an arm with bodies of the links' geometry for those of which it states no mass.

    Where it states most, and yet its mass is given, they stand for all links.

    Args:
        robot: the arm as its file states it.
        massless: names of bodies of which the file states no mass.
        drawn: the compiled model with more shapes, from which bodies follow; None for its own.
        total_mass: mass of the arm with the base that it stands on [kg]; None for what arms of its
            size have.
        as_stated: as of ``lacks_masses``.

    Raises:
        InputError: links that state their mass are heavier than the arm.
    """
    unstated = _unstated_links(robot, massless, as_stated)
    if not lacks_masses(robot, massless, as_stated):
        unstated = [k for k, link in enumerate(robot.links) if link.has_mass]
    shown = replace(robot, mj_model=drawn or robot.mj_model)
    shapes = _shapes_of(shown, unstated)
    masses = _masses_of(shown, unstated, shapes, total_mass)
    thetas = _bodies_of_links(shown, masses, shapes)
    mj_model = copy.copy(robot.mj_model)
    for body_id, theta in thetas.items():
        write_body(mj_model, body_id, theta)
    mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
    qpos = robot.reference_qpos
    chain = mj_model.dof_jntid[robot.dof_index].tolist()
    links = list(with_references(mj_model, qpos, arm_links(mj_model, qpos, chain)))
    for index in unstated:
        theta = links[index].theta
        links[index] = replace(
            links[index], reference=theta, placeholders=KINDS, odd=()
        )
    return replace(
        robot,
        mj_model=mj_model,
        links=tuple(links),
        stated=stated_bodies(robot),
        lacks_masses=True,
    )


def _unstated_links(
    robot: RobotModel, massless: Collection[str], as_stated: bool
) -> list[int]:
    """Return the indices of links none of whose bodies states a mass.

    Nor do masses that were copied, or that most bodies have and no arm: foam, or lead; where any
    number counts as a mass (``as_stated``), these do.
    """
    bodies = [b for link in robot.links for b in link.bodies if b.theta[0] > 0.0]
    unstated = {b.body_id for b in bodies if b.name in massless}
    if not as_stated:
        unstated |= _placeholder_masses(robot, bodies)
    return [
        index
        for index, link in enumerate(robot.links)
        if link.has_mass
        and all(b.body_id in unstated for b in link.bodies if b.theta[0] > 0.0)
    ]


def _placeholder_masses(robot: RobotModel, bodies: Sequence[SubtreeBody]) -> set[int]:
    """Return the ids of bodies whose masses were copied, or are one number that no arm has."""
    placeholders: set[int] = set()
    copied = copied_kinds(robot.links)
    if len(copied) >= ALIKE:
        placeholders |= {body for body, kinds in copied.items() if MASS in kinds}
    counts = Counter(b.theta[0] for b in bodies)
    for mass, count in counts.most_common(1):
        is_usual = count >= ALIKE and 2 * count > len(bodies)
        if is_usual and mass_unit(robot) != 1.0:
            placeholders |= {b.body_id for b in bodies if b.theta[0] == mass}
    return placeholders


def _shapes_of(robot: RobotModel, unstated: Sequence[int]) -> dict[int, Shape]:
    """Return MuJoCo id of each body of some links to its shape, of those that have one.

    None of all where they are those of no arm, as in millimetres.
    """
    mj_model = robot.mj_model
    data = data_at_pose(mj_model, robot.reference_qpos)
    shapes = {}
    for index in unstated:
        for body in robot.links[index].bodies:
            shape = shape_of(mj_model, data, [body])
            if shape is not None:
                shapes[body.body_id] = shape
    mass = SHAPE_DENSITY * sum(shape.volume for shape in shapes.values())
    length = max(robot.reach, SHORTEST_ARM)
    radii = [math.sqrt(np.trace(shape.gyration) / 2.0) for shape in shapes.values()]
    is_small = max(radii, default=0.0) < max(length, LARGEST_GYRATION)
    is_possible = is_small and FOAM < mass / length**3 < LEAD
    return shapes if is_possible else {}


def _masses_of(
    robot: RobotModel,
    unstated: Sequence[int],
    shapes: Mapping[int, Shape],
    total_mass: float | None,
) -> dict[int, float]:
    """Return index of each link without a stated mass to the mass [kg] that stands for it.

    Links share the mass by volume, as far as they have shapes, else by length. The base that the
    arm stands on has its share where it is no larger than they are, and so no vehicle or table.

    Raises:
        InputError: links that state their mass are heavier than the arm.
    """
    all_sizes = link_sizes(robot.links)
    sizes = all_sizes[list(unstated)]
    volumes = np.array(
        [
            sum(
                shapes[b.body_id].volume
                for b in robot.links[k].bodies
                if b.body_id in shapes
            )
            for k in unstated
        ]
    )
    if shapes:
        has_shape = volumes > 0.0
        across = np.sum(volumes) / np.sum(sizes[has_shape])
        weights = np.where(has_shape, volumes, across * sizes)
        base = _base_volume(robot)
        usual_mass = SHAPE_DENSITY * np.sum(weights)
    else:
        weights = sizes
        base = 0.0
        whole_mass = ARM_DENSITY * max(robot.reach, SHORTEST_ARM) ** 3
        usual_mass = whole_mass * np.sum(sizes) / np.sum(all_sizes)
    if total_mass is None:
        shares = weights / np.sum(weights)
        return dict(zip(unstated, (usual_mass * shares).tolist()))
    others = [k for k in range(robot.n_joints) if k not in unstated]
    known = float(np.sum(robot.thetas[others, 0]))
    if known >= total_mass:
        raise InputError(
            f"{option_name('total_mass', f'{total_mass:g}')}: links that state their mass weigh "
            f"{known:.3g} kg; give the mass of the whole arm"
        )
    counted_base = base if base <= np.sum(weights) else 0.0
    shares = weights / (np.sum(weights) + counted_base)
    return dict(zip(unstated, ((total_mass - known) * shares).tolist()))


def _base_volume(robot: RobotModel) -> float:
    """Return the volume [m^3] of the shapes that carry the arm's first joint."""
    mj_model = robot.mj_model
    data = data_at_pose(mj_model, robot.reference_qpos)
    body = int(mj_model.body_parentid[robot.links[0].body_id])
    ids = {body}
    while body:
        body = int(mj_model.body_parentid[body])
        ids.add(body)
    bodies = [SubtreeBody(each, "", np.zeros(10), True) for each in sorted(ids)]
    shape = shape_of(mj_model, data, bodies)
    return shape.volume if shape else 0.0


def _bodies_of_links(
    robot: RobotModel, masses: Mapping[int, float], shapes: Mapping[int, Shape]
) -> dict[int, Array]:
    """Return MuJoCo id of a body to its parameters (10,) in its own frame.

    Args:
        robot: the arm.
        masses: index of a link to its mass [kg], which its bodies share by the volume of their
            shapes; without any, the first one is a rod (``_rods``).
        shapes: of bodies, by their ids.
    """
    mj_model = robot.mj_model
    rods = _rods(robot.links)
    thetas = {}
    for index, mass in masses.items():
        link = robot.links[index]
        size = rods[index].length
        own = {b.body_id: shapes[b.body_id] for b in link.bodies if b.body_id in shapes}
        if not own:
            gyration = ROD_MOMENT * size**2 * np.eye(3)
            own = {link.body_id: Shape(1.0, rods[index].centre, gyration)}
        volume = sum(shape.volume for shape in own.values())
        for body in link.bodies:
            if body.body_id not in own:
                is_moved = bool(mj_model.body_jntnum[body.body_id])
                thetas[body.body_id] = LEAST_BODY if is_moved else np.zeros(10)
                continue
            shape = own[body.body_id]
            body_mass = mass * shape.volume / volume
            centre = shape.centre
            stated_centre = mj_model.body_ipos[body.body_id]
            if LEAST_SHARE * size < np.linalg.norm(stated_centre) < size:
                centre = stated_centre
            inertia = body_mass * shape.gyration
            thetas[body.body_id] = spatial.theta_from_com(body_mass, centre, inertia)
    return thetas


@dataclass(frozen=True)
class _Rod:
    """A rod that stands for a link without shapes.

    Attributes:
        centre: (3,) its middle in the link's frame [m].
        length: [m].
    """

    centre: Array
    length: float


def _rods(links: Sequence[ArmLink]) -> list[_Rod]:
    """Return a rod for each link: to the next joint, from anywhere on its own joint's axis.

    A joint's frame may lie anywhere on its axis, and often lies where that crosses the next one:
    the forearm of a FR3 is all before the frame of its link. So the rod begins where the axis
    leaves the link before it. What carries the first joint may be a table, and is no part of it.
    """
    rods = []
    least = least_size(links)
    for number, (link, step) in enumerate(zip(links, steps_to_next(links))):
        way_here = link.rotation.T @ link.translation
        axis = link.screw[:3]
        begin = -(axis @ way_here) * axis if number else np.zeros(3)
        length = max(float(np.linalg.norm(step - begin)), least)
        rods.append(_Rod(0.5 * (begin + step), length))
    return rods

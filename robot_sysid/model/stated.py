"""What a model states of its links, and the bodies that stand for what it does not.

Exporters and people fill in what nobody knows: a centre of mass at the joint, one inertia for all
links, a gram where MuJoCo wants some mass. An estimate that takes such placeholders for knowledge
is wrong, and its standard errors are too small. So mass, centre of mass and inertia of each link
count as stated or as a placeholder; a placeholder is replaced by what a body with the link's
geometry has: the boxes around its shapes or, where there are none, a rod from its joint to the
next.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.model.bodies import pose_in
from robot_sysid.records import (
    KINDS,
    ArmLink,
    Array,
    InertialParameters,
    RobotModel,
    SubtreeBody,
)
from robot_sysid.records.usual_errors import LEAST_SIZE, LEAST_SIZE_SHARE
from robot_sysid.spatial import ROD, ROD_MOMENT

MASS, CENTRE, INERTIA = KINDS
LEAST_SHARE = 1e-3
"""Share of the links' median mass below which a mass is a placeholder, and of the link's size below
which the distance of a centre of mass from its joint is one: well below those of public arms."""
ALIKE = 3
"""Number of links with one and the same inertia from which it is a placeholder."""
LEAST_MOMENT_SHARE = 0.2
"""Share of the mean moment of a rod of the link's size and mass below which an inertia is a
placeholder: below those of links of public arms."""
LARGEST_MOMENT_SHARE = 1000.0
"""Mean moment of inertia over that of such a rod above which it is no link's: several times the
largest of links of public models; kg mm2 and g mm2 for kg m2 are factors of 1e6 and 1e9."""
LEAST_OFF_CENTRE = 0.2
"""Least distance of the middle of a link's shapes from its joint, as a share of the link's size,
for a centre of mass at the joint to be a placeholder: shapes may have their middle there, too."""
GROUND_TYPES = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
"""MuJoCo's types of geoms that are ground, and no shape of a link."""


def with_references(
    mj_model: Any, qpos: Array, links: Sequence[ArmLink]
) -> tuple[ArmLink, ...]:
    """Return the links of an arm with their sizes, placeholders and reference bodies.

    Args:
        mj_model: the compiled model.
        qpos: (nq,) the reference configuration.
        links: base to terminal, as the model has them.
    """
    masses = np.array([link.theta[0] for link in links if link.theta[0] > 0.0])
    if not len(masses):
        return tuple(links)
    median = np.median(masses[masses >= LEAST_SHARE * np.max(masses)])
    data = data_at_pose(mj_model, qpos)
    copied = copied_kinds(links)
    result = []
    for link, step, size in zip(links, steps_to_next(links), link_sizes(links)):
        rod = Shape(0.0, 0.5 * step, ROD_MOMENT * size**2 * np.eye(3))
        shape = shape_of(mj_model, data, link.bodies) or rod
        centre = shape.centre
        gyration = shape.gyration
        mass, com, inertia = spatial.com_from_theta(link.theta)
        copied_of_link = _kinds_of_link(link, copied)
        unknown = {*copied_of_link}
        odd = set()
        if mass < LEAST_SHARE * median:
            unknown |= {MASS, INERTIA}
        share = np.trace(inertia) / max(mass * np.trace(rod.gyration), 1e-300)
        if share < LEAST_MOMENT_SHARE or not spatial.is_consistent(link.theta):
            unknown.add(INERTIA)
        if LEAST_SHARE < share < LEAST_MOMENT_SHARE or share > LARGEST_MOMENT_SHARE:
            odd |= {INERTIA} - copied_of_link
        unknown |= odd
        is_at_joint = np.linalg.norm(com) < LEAST_SHARE * size
        if is_at_joint and np.linalg.norm(centre) > LEAST_OFF_CENTRE * size:
            unknown.add(CENTRE)
        reference = link.theta
        if unknown:
            mass = median if MASS in unknown else mass
            com = centre if CENTRE in unknown else com
            inertia = mass * gyration if INERTIA in unknown else inertia
            reference = spatial.theta_from_com(mass, com, inertia)
        size = max(size, ROD * spatial.characteristic_length(reference))
        kinds = tuple(kind for kind in KINDS if kind in unknown)
        if link.has_mass:
            link = replace(
                link,
                reference=reference,
                size=size,
                placeholders=kinds,
                odd=tuple(kind for kind in KINDS if kind in odd),
            )
        result.append(link)
    return tuple(result)


def steps_to_next(links: Sequence[ArmLink]) -> Array:
    """Return the way (n, 3) from the joint of each link to the next one [m]; zero for the last."""
    return np.array([*(link.translation for link in links[1:]), np.zeros(3)])


def link_sizes(links: Sequence[ArmLink]) -> Array:
    """Return the sizes (n,) of links by the distances between their joints [m]."""
    lengths = np.linalg.norm(steps_to_next(links), axis=1)
    return np.maximum(lengths, least_size(links))


def least_size(links: Sequence[ArmLink]) -> float:
    """Return the size that no link of an arm is smaller than [m]."""
    lengths = np.linalg.norm(steps_to_next(links), axis=1)
    return max(LEAST_SIZE_SHARE * float(np.sum(lengths)), LEAST_SIZE)


def copied_kinds(links: Sequence[ArmLink]) -> dict[int, set[str]]:
    """Return MuJoCo id of a body to what of it was copied from body to body, mass or inertia.

    Parts of one kind have one inertia and one mass. An inertia that bodies of different masses
    have, or that is the same about all axes, was copied; so was a mass that comes with it in all
    bodies.
    """
    groups = defaultdict(list)
    copied: dict[int, set[str]] = {}
    present = [b for link in links for b in link.bodies if np.any(b.theta)]
    for body in present:
        moments = InertialParameters(body.theta).principal_moments
        groups[f"{moments[-1]:.4g}"].append(
            (body, np.ptp(moments) < 1e-6 * moments[-1])
        )
    least = min(ALIKE, max(len(present), 2))
    for members in groups.values():
        masses = {f"{body.theta[0]:.9g}" for body, _ in members}
        is_ball = all(is_round for _, is_round in members)
        if len(members) >= least and (is_ball or len(masses) > 1):
            is_whole = len(masses) == 1 and len(members) == len(present)
            for body, _ in members:
                copied[body.body_id] = {MASS, INERTIA} if is_whole else {INERTIA}
    return copied


def _kinds_of_link(link: ArmLink, copied: Mapping[int, set[str]]) -> set[str]:
    """Return what was copied of all bodies of a link that have mass."""
    kinds = {*KINDS}
    for body in link.bodies:
        if np.any(body.theta):
            kinds &= copied.get(body.body_id, set())
    return kinds if link.has_mass else set()


@dataclass(frozen=True)
class Shape:
    """What the boxes around the shapes of bodies have if they are filled evenly.

    Attributes:
        volume: of all boxes [m^3].
        centre: (3,) in the frame of the first body [m].
        gyration: (3, 3) inertia about the centre over the mass [m^2].
    """

    volume: float
    centre: Array
    gyration: Array


def shape_of(mj_model: Any, data: Any, bodies: Sequence[SubtreeBody]) -> Shape | None:
    """Return the shape of bodies, from their geoms; None where there are none."""
    ids = [body.body_id for body in bodies]
    volume = 0.0
    theta = np.zeros(spatial.N_INERTIAL)
    for geom in np.flatnonzero(np.isin(mj_model.geom_bodyid, ids)).tolist():
        middle, half = np.split(mj_model.geom_aabb[geom], 2)
        if mj_model.geom_type[geom] in GROUND_TYPES or not np.all(half > 0.0):
            continue
        box = 8.0 * np.prod(half)
        inertia = box / 3.0 * (half @ half * np.eye(3) - np.diag(half**2))
        own = spatial.theta_from_com(box, middle, inertia)
        pose = pose_in(data.geom(geom), data.body(ids[0]))
        theta += spatial.transform_theta(own, *pose)
        volume += box
    if volume == 0.0:
        return None
    _, centre, inertia = spatial.com_from_theta(theta)
    return Shape(float(volume), centre, inertia / volume)


def with_stated_links(robot: RobotModel) -> RobotModel:
    """Return an arm whose links are taken as the model has them, placeholders too."""
    links = tuple(replace(link, reference=link.theta) for link in robot.links)
    return replace(robot, links=links)


def placeholder_notes(
    links: Sequence[ArmLink], as_stated: bool = False
) -> Iterator[str]:
    """Yield sentences on what a model does not state of its links, or has wrong.

    The last link's numbers follow from a log. They do not matter there, but to the simulation that
    takes placeholders as the model has them (``as_stated``).
    """
    body = "a body of the link's geometry stands for each, with an error as large as itself"
    unstated = f"not known, so {body}"
    wrong = f"so {body}"
    named = links[:-1]
    if as_stated:
        unstated = f"taken as the model has them here; with a log {body}"
        wrong = f"taken as it is here; with a log {body}"
        named = links
    unknown = _listed_kinds(named, is_odd=False)
    odd = _listed_kinds(named, is_odd=True)
    if unknown:
        yield f"the model has placeholders for {unknown}: {unstated}"
    if odd:
        yield (
            f"{odd} in the model is probably wrong: no link of its size and mass has "
            f"such a number, {wrong}"
        )


def _listed_kinds(links: Sequence[ArmLink], is_odd: bool) -> str:
    """Return which kinds of number are placeholders, or odd ones, and of which links."""
    kinds = defaultdict(list)
    for kind in KINDS:
        names = [
            link.body_name
            for link in links
            if kind in link.placeholders and (kind in link.odd) == is_odd
        ]
        if names:
            kinds[", ".join(names)].append(kind)
    return "; ".join(f"the {', '.join(own)} of {names}" for names, own in kinds.items())

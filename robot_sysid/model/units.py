"""Model files with lengths, masses or moments of inertia in other units than SI, as CAD programs
export them, and arms with all their masses scaled.

A body of mass m and inertia I about its centre of mass has a radius of gyration r with r^2 = tr(I)
/ 2 m, and m / r^3 is at most 9 times its density, that of a sphere. Medians over the links of
public models of r, over the distances between the joints, and of m / r^3 differ by less than two
orders of magnitude. Wrong units are factors of 30 and more off in one of them.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.errors import ModelError
from robot_sysid.model.bodies import link_reach
from robot_sysid.model.stated import LEAST_SHARE
from robot_sysid.records import RobotModel, StatedBodies

FOAM = 0.1
"""Mass of an arm over the cube of its length below which it would be foam [kg/m^3]: public arms
have 5 to 250."""
LEAD = 1000.0
"""Mass of an arm over the cube of its length above which it would be lead [kg/m^3]."""
SHORTEST_ARM = 0.3
"""Length that an arm is taken to have at least [m]: its joints may turn about one point."""
LONGEST_ARM = 30.0
"""Longest arm there is, a crane [m]."""
LARGEST_GYRATION = 1.5
"""Largest radius of gyration of a link that is larger than the arm is long [m]."""
LARGEST_CENTRE = 3.0
"""Distance of a link's centre of mass from its joint over the arm's length above which it is no
link's: of links of public models it is hardly longer than the link, and millimetres for metres are
a factor of 1000."""
DENSEST = 2e5
"""Mass over the cube of the radius of gyration of a sphere of the densest metal [kg/m^3]."""


BODY_NUMBERS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_sameframe",
    "body_simple",
    "dof_simplenum",
)
"""Fields of a compiled model that ``model.bodies.write_body`` changes."""


def stated_bodies(robot: RobotModel) -> StatedBodies:
    """Return the bodies of an arm as they are, to have them again where others take their place."""
    numbers = {name: getattr(robot.mj_model, name).copy() for name in BODY_NUMBERS}
    return StatedBodies(numbers, robot.links)


def as_stated(robot: RobotModel) -> RobotModel:
    """Return an arm with the bodies that its file states."""
    stated = robot.stated
    if stated is None:
        return robot
    mj_model = copy.copy(robot.mj_model)
    for name, values in stated.numbers.items():
        getattr(mj_model, name)[:] = values
    mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
    return replace(
        robot,
        mj_model=mj_model,
        links=stated.links,
        mass_scale=1.0,
        stated=None,
        lacks_masses=False,
    )


def with_mass_scale(robot: RobotModel, factor: float, error: float = 0.0) -> RobotModel:
    """Return an arm all of whose masses and moments of inertia are multiplied by a factor.

    ``error``: by which share it may be off.
    """
    if error:
        robot = replace(robot, mass_error=float(np.hypot(robot.mass_error, error)))
    if factor == 1.0:
        return robot
    mj_model = copy.copy(robot.mj_model)
    mj_model.body_mass[:] *= factor
    mj_model.body_inertia[:] *= factor
    mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
    links = []
    for link in robot.links:
        links.append(
            replace(
                link,
                theta=factor * link.theta,
                reference=factor * link.reference,
                bodies=tuple(replace(b, theta=factor * b.theta) for b in link.bodies),
            )
        )
    scale = factor * robot.mass_scale
    return replace(
        robot,
        mj_model=mj_model,
        links=tuple(links),
        mass_scale=scale,
        stated=robot.stated or stated_bodies(robot),
    )


def mass_unit(robot: RobotModel, factor: float = 1.0) -> float:
    """Return the factor that brings an arm's masses, times another factor, into kilograms.

    It is 1 for an arm that there may be, between ``FOAM`` and ``LEAD``: masses in tonnes are 1000
    times too small, masses in grams 1000 times too large.
    """
    length = robot.reach
    # Without shapes, it follows from inertias, which may be placeholders.
    tip = min(link_reach(robot), length)
    density = factor * robot.mass / max(length + tip, SHORTEST_ARM) ** 3
    if density < FOAM:
        return 1e3
    return 1.0 if density <= LEAD else 1e-3


def refuse_cad_units(robot: RobotModel) -> None:
    """Raise ModelError where an arm's lengths, masses or inertias are in other units than SI, or
    the centre of mass of a single link.

    A factor for all masses is advised where the arm with it is one that there may be.
    """
    fault = _unit_fault(robot)
    if fault:
        unit = mass_unit(robot)
        is_remedy = unit != 1.0 and not _unit_fault(with_mass_scale(robot, unit))
        # An option replaces the one that was given before.
        factor = unit * robot.mass_scale
        remedy = [("--mass-scale", f"{factor:g}")] if is_remedy else []
        raise ModelError(f"{robot.path}: {fault}", remedy)
    for link in robot.links[:-1]:
        distance = float(np.linalg.norm(spatial.com_from_theta(link.theta)[1]))
        if distance > LARGEST_CENTRE * max(robot.reach, SHORTEST_ARM):
            raise ModelError(
                f"{robot.path}: the centre of mass of {link.body_name} is probably wrong: it lies "
                f"{distance:.3g} m from its joint; state it in metres"
            )


def _unit_fault(robot: RobotModel) -> str:
    """Return which of an arm's numbers are in other units than SI, and what to do; "" for none.

    Medians count, so that single links may have other numbers. Links with three equal moments of
    inertia, which stand for unknown ones, are left out; where most are such, units of inertias are
    not judged.
    """
    mj_model = robot.mj_model
    bodies = np.array(subtree(mj_model, robot.links[0].body_id))
    masses = mj_model.body_mass[bodies]
    bodies = bodies[masses > LEAST_SHARE * np.max(masses)]
    length = robot.reach
    com_distance = np.median(np.linalg.norm(mj_model.body_ipos[bodies], axis=1))
    if max(length, com_distance) > LONGEST_ARM:
        return (
            f"the distances between its joints add up to {length:.3g} m, and centres of mass lie "
            f"{com_distance:.3g} m away from their links' frames: these lengths fit mm, not m; "
            "divide them by 1000"
        )
    moments = mj_model.body_inertia[bodies]
    is_stated = np.ptp(moments, axis=1) > 1e-6 * np.max(moments, axis=1)
    if 2 * np.sum(is_stated) > len(bodies):
        masses = mj_model.body_mass[bodies[is_stated]]
        radii = np.sqrt(np.sum(moments[is_stated], axis=1) / (2.0 * masses))
        radius = np.median(radii)
        compactness = np.median(masses / radii**3)
        if radius > max(length, LARGEST_GYRATION) or compactness > DENSEST:
            return (
                f"half of its links have more than {np.median(masses):.3g} kg, and half a radius "
                f"of gyration of more than {radius:.3g} m, which no arm has; state masses in kg "
                "and moments of inertia in kg m2, as g, kg mm2 and g mm2 are what CAD programs "
                "write"
            )
    if mass_unit(robot) != 1.0:
        return (
            f"its links weigh {robot.mass:.3g} kg in all, for their length as much as foam or more "
            "than lead, which no arm has; state masses in kg, not in t or g"
        )
    return ""

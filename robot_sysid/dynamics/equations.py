"""Names of parameters, and the links whose torque they make."""

from __future__ import annotations

from collections.abc import Iterable

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import RobotModel


def split_name(name: str) -> tuple[str, str]:
    """Return (term, joint or motor) of a parameter's name such as "coulomb[joint6]".

    The second one is "" for a parameter without brackets, such as one of a body.
    """
    term, _, owner = name.partition("[")
    return term, owner[:-1]


def names_of(term: str, joints: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a term's parameters, one per joint, such as "scale[joint6]"."""
    return tuple(f"{term}[{joint}]" for joint in joints)


def link_names(robot: RobotModel, link: int) -> tuple[str, ...]:
    """Return the ten parameter names of a link other than the terminal one, such as ``m(forearm)``.

    ``link`` is the link's index in ``robot.links``.
    """
    return tuple(f"{name}({robot.links[link].body_name})" for name in PARAMETER_NAMES)


def other_links(robot: RobotModel) -> tuple[int, ...]:
    """Return the indices, ascending, of all links but the terminal one that have a mass."""
    return tuple(i for i, link in enumerate(robot.links[:-1]) if link.has_mass)

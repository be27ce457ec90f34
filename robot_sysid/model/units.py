"""Units of masses, moments of inertia and lengths in a model file, as CAD programs export them.

A body of mass m and inertia I about its centre of mass has a radius r with r^2 = tr(I) / 2 m, the
root mean square distance of its mass from there, and a compactness m / r^3 of at most 9 times its
density, that of a sphere. Medians over the links of 33 public models are r = 0.02 to 0.11 of the
distances between the joints and m / r^3 = 290 to 23 000 kg/m^3. Wrong units are factors of 30 and
more off in one of them.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.errors import ModelError
from robot_sysid.model.bodies import PLACEHOLDER
from robot_sysid.model.chain import body_label
from robot_sysid.records import Array, RobotModel

_MASSES = {"kg": 1.0, "g": 1e3, "t": 1e-3}
"""Unit of mass to how many of it are 1 kg."""
_INERTIAS = {
    "kg m2": 1.0,
    "kg mm2": 1e6,
    "g mm2": 1e9,
    "kg cm2": 1e4,
    "g cm2": 1e7,
    "g m2": 1e3,
}
"""Unit of inertia to how many of it are 1 kg m^2."""
_USUAL = np.log([0.05, 3000.0])
"""Logarithms of the usual radius, as a share of the arm's length, and compactness [kg/m^3]."""
_SPREAD = np.log([2.2, 9.0])
"""Largest deviations of the public models from the usual."""
_MAX_SPREADS = 2.0
"""Largest deviation that links may have in the units that are named, in terms of ``_SPREAD``."""
_LARGEST_SHARE = 0.7
"""Radius as a share of the arm's length that no links have: a rod has 0.29 of its own length."""
_LEAST_COMPACTNESS = 0.2
"""Compactness of a rod of 0.1 kg and 2.7 m."""
_LARGEST_COMPACTNESS = 2e5
"""Compactness of a sphere of the densest metal, 22 600 kg/m^3."""
_SHORTEST = 1.5
"""Least length that is taken for an arm's: joints may turn about one point [m]."""
_LEAST_LINKS = 3
"""Least number of links from which units of masses and inertias are judged."""
_LONGEST = 30.0
"""Longest arm: a crane [m]."""


def refuse_cad_units(robot: RobotModel) -> None:
    """Raise ModelError where an arm's lengths, masses or inertias are in other units than SI.

    Medians count, so that single links may have other numbers, up to a radius of gyration that no
    arm has. Links with three equal moments of inertia, which stand for unknown ones, are left out;
    where most are such, units of masses and inertias are not judged.
    """
    mj_model = robot.mj_model
    bodies = np.array(subtree(mj_model, robot.links[0].body_id))
    masses = mj_model.body_mass[bodies]
    bodies = bodies[masses > PLACEHOLDER * np.max(masses)]
    offsets = [float(np.linalg.norm(link.translation)) for link in robot.links[1:]]
    length = sum(offsets)
    com_distance = np.median(np.linalg.norm(mj_model.body_ipos[bodies], axis=1))
    for fault, distance in (
        ("the distances between its joints add up to", length),
        ("centres of mass lie away from their links' frames by", com_distance),
    ):
        if distance > _LONGEST:
            raise ModelError(
                f"{robot.path}: {fault} {distance:.3g} m: these lengths fit mm, not m; divide them "
                "by 1000"
            )
    masses = mj_model.body_mass[bodies]
    moments = mj_model.body_inertia[bodies]
    radii = np.sqrt(np.sum(moments, axis=1) / (2.0 * masses))
    names = np.array([f"'{body_label(mj_model, body)}'" for body in bodies])
    is_stated = np.ptp(moments, axis=1) > 1e-6 * np.max(moments, axis=1)
    if np.sum(is_stated) >= max(_LEAST_LINKS, 0.5 * len(bodies) + 0.5):
        _refuse_units(
            robot, length, names[is_stated], masses[is_stated], radii[is_stated]
        )
    largest = int(np.argmax(radii))
    if radii[largest] > _LONGEST:
        raise ModelError(
            f"{robot.path}: link {names[largest]} has {masses[largest]:.3g} kg and a radius of "
            f"gyration of {radii[largest]:.3g} m, which no arm has; correct its inertia"
        )


def _refuse_units(
    robot: RobotModel,
    length: float,
    names: NDArray[np.str_],
    masses: Array,
    radii: Array,
) -> None:
    """Raise ModelError where the links of an arm have masses or inertias in other units than SI.

    Args:
        length: distances between its joints, added up [m].
        names: of the links, in quotes.
        masses: of the links [kg].
        radii: of gyration of the links [m].
    """
    share = float(np.median(radii)) / max(length, _SHORTEST)
    compactness = float(np.median(masses / radii**3))
    if (
        share < _LARGEST_SHARE
        and _LEAST_COMPACTNESS < compactness < _LARGEST_COMPACTNESS
    ):
        return
    units = _likely_units(share, compactness)
    if units is None:
        return
    mass_unit, inertia_unit = units
    faults = []
    if mass_unit != "kg":
        factor = _MASSES[mass_unit]
        faults.append(f"masses fit {mass_unit}, not kg: divide them by {factor:g}")
    if inertia_unit != "kg m2":
        factor = _INERTIAS[inertia_unit]
        faults.append(
            f"inertias fit {inertia_unit}, not kg m2: divide them by {factor:g}"
        )
    middle = int(np.argsort(radii)[len(radii) // 2])
    raise ModelError(
        f"{robot.path}: {'; '.join(faults)} (link {names[middle]} has {masses[middle]:.3g} kg and "
        f"a radius of gyration of {radii[middle]:.3g} m)"
    )


def _likely_units(share: float, compactness: float) -> tuple[str, str] | None:
    """Return the units of mass and inertia that make links the most usual, None where none do.

    Args:
        share: median radius as a share of the arm's length.
        compactness: median compactness of the links [kg/m^3].
    """
    candidates = []
    for mass_unit, inertia_unit in product(_MASSES, _INERTIAS):
        mass_factor = _MASSES[mass_unit]
        radius_factor = np.sqrt(_INERTIAS[inertia_unit] / mass_factor)
        new_compactness = compactness / mass_factor * radius_factor**3
        numbers = np.log([share / radius_factor, new_compactness])
        deviations = np.abs(numbers - _USUAL) / _SPREAD
        if np.max(deviations) < _MAX_SPREADS:
            candidates.append((float(np.sum(deviations)), mass_unit, inertia_unit))
    return min(candidates)[1:] if candidates else None

"""Model files with lengths, masses or moments of inertia in other units than SI, as CAD programs
export them.

A body of mass m and inertia I about its centre of mass has a radius of gyration r with
r^2 = tr(I) / 2 m, and m / r^3 is at most 9 times its density, that of a sphere. Medians over the
links of 33 public models are r = 0.02 to 0.11 of the distances between the joints and m / r^3 = 290
to 23 000 kg/m^3. Wrong units are factors of 30 and more off in one of them.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.errors import ModelError
from robot_sysid.model.bodies import PLACEHOLDER
from robot_sysid.records import RobotModel

_LARGEST_COMPACTNESS = 2e5
"""m / r^3 of a sphere of the densest metal, 22 600 kg/m^3."""
_SHORTEST = 1.5
"""Least length that is taken for an arm's: joints may turn about one point [m]."""
_LONGEST = 30.0
"""Longest arm: a crane [m]."""


def refuse_cad_units(robot: RobotModel) -> None:
    """Raise ModelError where an arm's lengths, masses or inertias are in other units than SI.

    Medians count, so that single links may have other numbers. Links with three equal moments of
    inertia, which stand for unknown ones, are left out; where most are such, units of masses and
    inertias are not judged.
    """
    mj_model = robot.mj_model
    bodies = np.array(subtree(mj_model, robot.links[0].body_id))
    masses = mj_model.body_mass[bodies]
    bodies = bodies[masses > PLACEHOLDER * np.max(masses)]
    offsets = [np.linalg.norm(link.translation) for link in robot.links[1:]]
    length = float(sum(offsets))
    com_distance = np.median(np.linalg.norm(mj_model.body_ipos[bodies], axis=1))
    if max(length, com_distance) > _LONGEST:
        raise ModelError(
            f"{robot.path}: the distances between its joints add up to {length:.3g} m, and centres "
            f"of mass lie {com_distance:.3g} m away from their links' frames: these lengths fit "
            "mm, not m; divide them by 1000"
        )
    moments = mj_model.body_inertia[bodies]
    is_stated = np.ptp(moments, axis=1) > 1e-6 * np.max(moments, axis=1)
    if 2 * np.sum(is_stated) <= len(bodies):
        return
    bodies = bodies[is_stated]
    masses = mj_model.body_mass[bodies]
    radii = np.sqrt(np.sum(moments[is_stated], axis=1) / (2.0 * masses))
    radius = np.median(radii)
    compactness = np.median(masses / radii**3)
    if radius > max(length, _SHORTEST) or compactness > _LARGEST_COMPACTNESS:
        raise ModelError(
            f"{robot.path}: half of its links have more than {np.median(masses):.3g} kg, and half "
            f"a radius of gyration of more than {radius:.3g} m, which no arm has; state masses in "
            "kg and moments of inertia in kg m2, as g, kg mm2 and g mm2 are what CAD programs write"
        )

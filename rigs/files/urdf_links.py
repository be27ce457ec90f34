"""URDF files whose links are off, everything else in them as it was."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from robot_sysid.records import Array

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
PLACES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Names of the numbers of an inertia to their places."""


def write_urdf_off(
    source: Path, target: Path, share: float, rng: np.random.Generator
) -> None:
    """Write a URDF whose masses, centres of mass and inertias are all off by a share (rms).

    Centres of mass are off by this share of the radius of gyration. Inertias stay possible: second
    moments of mass along their main axes get factors above zero.
    """
    tree = ElementTree.parse(source)
    for link in tree.getroot().iter("link"):
        inertial = link.find("inertial")
        if inertial is not None:
            move_inertial(inertial, share, rng)
    tree.write(target, encoding="utf-8")


def move_inertial(
    inertial: ElementTree.Element, share: float, rng: np.random.Generator
) -> None:
    """Change the numbers of an element ``inertial`` by a share, unless it has no mass."""
    mass_factor = float(np.exp(share * rng.standard_normal()))
    steps = rng.standard_normal(3)
    factors = np.exp(share * rng.standard_normal(3))
    mass_element = inertial.find("mass")
    inertia_element = inertial.find("inertia")
    if mass_element is None or inertia_element is None:
        return
    mass = float(mass_element.get("value", "0"))
    if mass <= 0.0:
        return
    inertia = np.zeros((3, 3))
    for name, (row, column) in zip(MOMENTS, PLACES):
        inertia[row, column] = inertia[column, row] = float(
            inertia_element.get(name, 0)
        )
    gyration = float(np.sqrt(max(np.trace(inertia), 0.0) / (2.0 * mass)))
    origin = inertial.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(inertial, "origin")
    centre = np.array([float(word) for word in origin.get("xyz", "0 0 0").split()])
    centre = centre + share * gyration * steps
    changed = mass_factor * with_second_moments(inertia, factors)
    mass_element.set("value", f"{mass_factor * mass:.9g}")
    origin.set("xyz", " ".join(f"{number:.9g}" for number in centre.tolist()))
    for name, (row, column) in zip(MOMENTS, PLACES):
        inertia_element.set(name, f"{changed[row, column]:.9g}")


def with_second_moments(inertia: Array, factors: Array) -> Array:
    """Return an inertia (3, 3) whose second moments of mass S along main axes have factors (3,).

    S = 1/2 tr(I) 1 - I,    I = tr(S) 1 - S
    """
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    sizes, axes = np.linalg.eigh(second)
    second = (axes * (factors * sizes)) @ axes.T
    return np.asarray(np.trace(second) * np.eye(3) - second)

"""Model files of arms that are drawn at random: what holds on public arms has to hold on these."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rigs.arms.wrong_arms import ARMS
from robot_sysid.records import Array

DRAWN = "drawn-"
"""Before the seed in the name of a model that is drawn."""
AXES = {"z": "0 0 1", "y": "0 1 0", "x": "1 0 0"}
"""Axis of a joint, in the frame of its body, by its letter; x is along the link before it."""
PATTERNS = ("zyyyzy", "zyyxyx", "zyxyxyx", "zyzyxyx", "zyyxyxy")
"""Axes from the base to the last link, as those of arms that are sold."""
RANGE = 2.4
"""Largest angle of a joint, to both sides [rad]."""
DENSITY = 2.0
"""Mass of a link over its length near the base [kg per 0.1 m]; arms weigh 4 to 40 kg."""


def model_path(name: str, models: Path, folder: Path) -> Path:
    """Return the model file of an arm.

    Args:
        name: of a public arm, ``drawn-SEED``, or a file of a model.
        models: the folder of public models.
        folder: where a model that is drawn is written.
    """
    if name in ARMS:
        return models / ARMS[name]
    if not name.startswith(DRAWN):
        return Path(name)
    path = folder / f"{name}.xml"
    path.write_text(drawn_model(np.random.default_rng(int(name[len(DRAWN) :]))))
    return path


def drawn_model(rng: np.random.Generator) -> str:
    """Return the MJCF of an arm of six or seven turning joints: tubes along x, thinner outwards."""
    axes = rng.choice(PATTERNS)
    size = rng.uniform(0.6, 1.6)
    lengths = size * rng.uniform(0.05, 0.32, len(axes))
    # Each second joint of a wrist sits next to the one before it.
    lengths[-3:] *= 0.4
    heaviness = DENSITY * size**2 * np.geomspace(1.0, 0.3, len(axes))
    bodies = ""
    place = np.array([0.0, 0.0, rng.uniform(0.05, 0.3)])
    for number, (axis, length, density) in enumerate(zip(axes, lengths, heaviness)):
        mass = density * (10.0 * length + rng.uniform(0.2, 0.8))
        bodies += (
            f'<body name="part{number}" pos="{numbers(place)}">'
            f'<joint name="axis{number}" axis="{AXES[axis]}" range="{-RANGE} {RANGE}"/>'
            f"{tube(rng, mass, length, 0.12 * size * 0.85**number)}"
        )
        offset = 0.05 * size * rng.standard_normal(2)
        place = np.array([length, *offset])
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody>'
        f"{bodies}{'</body>' * len(axes)}</worldbody></mujoco>"
    )


def tube(rng: np.random.Generator, mass: float, length: float, radius: float) -> str:
    """Return the inertial element of a tube along x, its centre of mass not quite in the middle."""
    centre = np.array([0.5 * length, 0.0, 0.0])
    centre += 0.3 * radius * rng.standard_normal(3)
    along = mass * radius**2
    across = 0.5 * along + mass * length**2 / 12.0
    moments = np.array([0.8 * along, *(across * rng.uniform(0.9, 1.1, 2))])
    return (
        f'<inertial mass="{mass:.4g}" pos="{numbers(centre)}" '
        f'diaginertia="{numbers(moments)}"/>'
    )


def numbers(values: Array) -> str:
    """Return numbers with spaces between them."""
    return " ".join(f"{value:.5g}" for value in values.tolist())

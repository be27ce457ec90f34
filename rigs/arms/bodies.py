"""Random rigid bodies and estimates of them, for tests of cards and of their errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rigs.arms.small_arms import random_rotation
from rigs.files import results as made
from robot_sysid import spatial
from robot_sysid.records import Flange
from robot_sysid.records.quantities import BodyEstimate
from robot_sysid.results.cards import card_text, number_groups
from robot_sysid.results.record import Payload

TOOL = np.array([0.0, 0.0, 0.107])
FLANGE = Flange("site 'tool'", np.eye(3), TOOL, "link7", "found by name")
COVARIANCE = np.diag(np.square([0.0153, *[2e-4] * 3, *[1e-4] * 6]))
SHAPES = [
    "any",
    "nearly round",
    "nearly a disc",
    "round",
    "rod",
    "point",
    "tiny",
    "heavy",
]


def random_body(rng, shape):
    """Mass [kg], centre of mass (3,) [m], inertia about it (3, 3) [kg m^2] of a possible body."""
    second_moments = {
        "any": rng.uniform(0.01, 1.0, 3),
        "nearly round": 0.3 + 10.0 ** rng.uniform(-14, -6) * rng.uniform(size=3),
        "nearly a disc": np.array([0.5, 0.5 + 10.0 ** rng.uniform(-14, -6), 0.01]),
        "round": np.full(3, 0.2),
        "rod": np.array([1.0, 0.0, 0.0]),
        "point": np.zeros(3),
        "tiny": 1e-3 * rng.uniform(0.1, 1.0, 3),
        "heavy": 50.0 * rng.uniform(0.1, 1.0, 3),
    }[shape]
    mass = {"tiny": 1e-3, "heavy": 40.0}.get(shape, rng.uniform(0.1, 5.0))
    axes = random_rotation(rng)
    spread = axes @ np.diag(0.01 * mass * second_moments) @ axes.T
    inertia = np.trace(spread) * np.eye(3) - spread
    return mass, 0.2 * rng.normal(size=3), inertia


def body_estimate(mass, com, inertia, covariance=COVARIANCE, n_identified=10):
    """A body of whose ten parameters the first n_identified are identified."""
    theta = spatial.theta_from_com(mass, np.array(com), inertia)
    return BodyEstimate(theta, "it", covariance, np.arange(10) < n_identified)


def card_of(body, choice="auto", path="m.xml"):
    """The text of payload_card.txt of a body, for an arm in a file of this name."""
    recordings = {"empty": ("a",), "loaded": ("b", "c")}
    payload = Payload(**vars(body), flange=FLANGE, recordings=recordings)
    arm = replace(made.ARM, path=Path(path))
    return card_text(payload, number_groups(body), arm, choice)

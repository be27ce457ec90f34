"""The one number that makes an inertia impossible: a wrong power of ten, or a wrong sign.

No body has a principal moment that is larger than the sum of the other two. Where a model says so
by more than rounding, most often one of its six numbers was typed or converted wrongly: 1.676 for
0.001676. Moments that are possible lie in narrow bounds, so that few powers of ten make one number
possible again; of these the likeliest is the one that makes a body like those of other arms.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_sysid import spatial
from robot_sysid.mjcf.documents import ModelDocument
from robot_sysid.mjcf.inertial import URDF_MOMENTS
from robot_sysid.records import Array

LARGEST_POWER = 6
"""Largest power of ten by which a number may be wrong: that of millimetres squared."""
SLENDER = 0.2
"""Usual moment about one axis over the mean of the other two, where these leave a power of ten
open: geometric mean of such links of public arms."""
PRODUCT = 0.05
"""Usual product of inertia over the geometric mean of its two moments: about the middle of links of
public arms."""
CLEARLY = 0.3
"""Powers of ten by which another number has to fit worse for the likeliest one to be named."""
POSSIBLE = 1e-4
"""Least second moment of a body along any axis, as a share of their sum, for it to be possible with
a mended number: one that is flat to the last digit was not mended by it."""
FAR_FROM_POSSIBLE = 0.05
"""What the largest principal moment has over the sum of the other two, or the least one below zero,
as a share of the largest, from which on an inertia has a wrong number: rounding leaves less."""
# Numbers of one inertia that are moments.
_MOMENTS = (0, 3, 5)


@dataclass(frozen=True)
class WrongNumber:
    """A number of an inertia that is probably wrong.

    Attributes:
        place: its place among ``URDF_MOMENTS``.
        stated, right: as it is, and as it probably should be [kg m^2].
    """

    place: int
    stated: float
    right: float

    @property
    def name(self) -> str:
        """Its name in a URDF, such as "ixx"."""
        return URDF_MOMENTS[self.place]

    def describe(self, owner: str) -> str:
        """Return what is wrong, as a clause on an owner such as "link 'forearm'"."""
        ratio = self.stated / self.right
        fault = "has probably the wrong sign"
        if ratio > 1.0:
            fault = f"is probably some {ratio:.0f} times too large"
        elif 0.0 < ratio < 1.0:
            fault = f"is probably some {1.0 / ratio:.0f} times too small"
        return (
            f"{self.name} of {owner} ({self.stated:g}) {fault}: no body has such moments of "
            f"inertia, and one with {self.right:g} is a usual one"
        )


def wrong_number(six: Array, mass: float, length: float) -> WrongNumber | None:
    """Return the number that makes an inertia impossible; None where no single one does clearly.

    Args:
        six: (6,) its numbers in the order of ``URDF_MOMENTS`` [kg m^2].
        mass: of the body [kg].
        length: of the link [m].
    """
    best: dict[int, tuple[float, float]] = {}
    for place, value in _alternatives(six):
        score = _oddness(six, place, value, mass, length)
        best[place] = min(best.get(place, (np.inf, 0.0)), (score, value))
    ranked = sorted((score, place, value) for place, (score, value) in best.items())
    scores = [score for score, _, _ in ranked]
    if not ranked or (len(ranked) > 1 and scores[1] - scores[0] < CLEARLY):
        return None
    _, place, value = ranked[0]
    return WrongNumber(place, float(six[place]), value)


def _alternatives(six: Array) -> Iterator[tuple[int, float]]:
    """Yield place and value of numbers each of which alone makes an inertia possible."""
    powers = [p for p in range(-LARGEST_POWER, LARGEST_POWER + 1) if p]
    for place, stated in enumerate(six.tolist()):
        values = [stated * 10.0**power for power in powers]
        for value in [-stated, *values]:
            mended = np.where(np.arange(6) == place, value, six)
            if stated and is_possible(spatial.symmetric_from_six(mended)):
                # The digits as they would have been typed.
                yield place, float(f"{value:.12g}")


def is_possible(inertia: Array) -> bool:
    """Return whether a body may have an inertia (3, 3) about its centre of mass, by a margin."""
    moments = np.linalg.eigvalsh(inertia)
    half = 0.5 * float(np.sum(moments))
    return half > 0.0 and bool(
        half - moments[-1] > POSSIBLE * half and moments[0] > 0.0
    )


def is_far_from_possible(inertia: Array) -> bool:
    """Return whether an inertia (3, 3) is none that rounding or a coarse CAD leaves of a body's."""
    smallest, middle, largest = np.linalg.eigvalsh(inertia).tolist()
    lacking = max(largest - middle - smallest, -smallest)
    return bool(lacking > FAR_FROM_POSSIBLE * max(abs(largest), abs(smallest)))


def _oddness(six: Array, place: int, value: float, mass: float, length: float) -> float:
    """Return by how many powers of ten a body with another number is unlike those of other arms."""
    mended = np.where(np.arange(6) == place, value, six)
    moments = mended[list(_MOMENTS)]
    usual = spatial.ROD_MOMENT * mass * length**2
    size = abs(np.log10(np.mean(moments) / usual)) if usual > 0.0 else 0.0
    if place in _MOMENTS:
        others = (np.sum(moments) - value) / 2.0
        return float(size + abs(np.log10(value / (SLENDER * others))))
    if value == -six[place]:
        return float(size)
    row, column = np.argwhere(
        spatial.symmetric_from_six(np.arange(6, dtype=float)) == place
    )[0]
    expected = PRODUCT * np.sqrt(moments[row] * moments[column])
    return float(size + abs(np.log10(abs(value) / expected)))


def wrong_numbers_of(document: ModelDocument) -> Iterator[str]:
    """Yield what is wrong with inertias of an MJCF that no body has, a clause each."""
    for node in document.root.iter("inertial"):
        body = node.getparent()
        stated = [*_floats(node.get("fullinertia"))]
        if len(stated) != 6:
            # Principal moments alone, of a frame that may be turned.
            stated = [*_floats(node.get("diaginertia")), 0.0, 0.0, 0.0]
        mass = [*_floats(node.get("mass"))]
        if len(stated) != 6 or len(mass) != 1:
            continue
        six = spatial.six_from_fullinertia(np.array(stated))
        steps = [np.array([*_floats(child.get("pos"))]) for child in body.iter("body")]
        lengths = [float(np.linalg.norm(step)) for step in steps[1:2]]
        lengths.append(2.0 * float(np.linalg.norm([*_floats(node.get("pos"))])))
        if is_far_from_possible(spatial.symmetric_from_six(six)):
            wrong = wrong_number(six, mass[0], max(lengths))
            if wrong is not None:
                yield wrong.describe(f"body '{body.get('name', '')}'")


def _floats(text: str | None) -> Iterator[float]:
    """Yield the numbers of an attribute; none where it has others than numbers."""
    with contextlib.suppress(ValueError):
        yield from [float(word) for word in (text or "").split()]


def nearest_possible(inertia: Array) -> Array | None:
    """Return the inertia (3, 3) of the nearest body; None where that has none.

    Nearest is the sum of squares of second moments tr(I)/2 1 - I, the part of the pseudo-inertia
    about the centre of mass that is not mass: negative ones become next to nothing.
    """
    body = spatial.theta_from_com(1.0, np.zeros(3), inertia)
    matrix = spatial.pseudo_inertia(body)
    values, axes = np.linalg.eigh(matrix[:3, :3])
    size = float(np.sum(np.maximum(values, 0.0)))
    if size <= 0.0:
        return None
    matrix[:3, :3] = (axes * np.maximum(values, 2.0 * POSSIBLE * size)) @ axes.T
    _, _, nearest = spatial.com_from_theta(spatial.theta_from_pseudo_inertia(matrix))
    return nearest

"""Mistakes that model files have in the numbers of links.

A centre of mass with the wrong sign or in another frame, an inertia about the body's origin where
one about the centre of mass is meant, the numbers of two links exchanged: such a number is off by
as much as itself, and a prior around it is wrong, however wide. Each mistake is another reference
body for its links, with the same errors around it, so that all are compared by their log evidence
(``estimate.links``) without a fit of their own. One mistake may hide behind another one, so that
two are tried at once as well.

Shapes: L links of an arm, K mistakes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from itertools import combinations

import numpy as np

from robot_sysid import spatial
from robot_sysid.records import KINDS, ArmLink, Array, RobotModel
from robot_sysid.records.levels import CLEAR
from robot_sysid.spatial import N_INERTIAL

MISTAKEN = 7.0
"""Least gain in the log evidence at which a model is taken to have a mistake: the logarithm of a
thousand, as one link in a hundred has one, which is one of about ten. Right models of real arms
gain less."""
DOUBTFUL = 2.5
"""The same at which it may have one, for which its links allow then: right models gain less."""
LEAST_STEP = 0.1
"""Least distance between two centres of mass that are tried, as a share of the link's size: links
are usually off by as much."""
MASS, CENTRE, INERTIA = KINDS


class MistakeKind(Enum):
    """What a model has in place of a link's own numbers."""

    MIRRORED = auto()
    """A centre of mass with other signs."""
    TURNED = auto()
    """A centre of mass in a frame that is turned about an axis by a quarter or by half a turn."""
    ABOUT_ORIGIN = auto()
    """An inertia about the body's origin, as one about the centre of mass."""
    EXCHANGED = auto()
    """Numbers of two links, each those of the other one."""


LEAST_GAINS = {
    MistakeKind.MIRRORED: (DOUBTFUL, MISTAKEN),
    MistakeKind.TURNED: (DOUBTFUL, MISTAKEN),
    MistakeKind.ABOUT_ORIGIN: (DOUBTFUL, MISTAKEN),
    MistakeKind.EXCHANGED: (0.5 * CLEAR, CLEAR),
}
"""Least gains of each kind. Numbers of two links that are exchanged change twenty numbers, and take
up other errors: with links that allow for a small gain, the file of a real arm is worse on the rest
of its log."""


@dataclass(frozen=True)
class Mistake:
    """A mistake that a model may have in its links, and their bodies without it.

    Attributes:
        kind: what is wrong.
        links: numbers in the arm of the links that are wrong.
        way: number of the frame that a centre of mass is in.
        bodies: (10,) each, the links without it, in the model's own frames.
    """

    kind: MistakeKind
    links: tuple[int, ...]
    bodies: tuple[Array, ...] = field(compare=False)
    way: int = 0


def least_gains(mistakes: Sequence[Mistake]) -> tuple[float, float]:
    """Return the least gains (2,) at which mistakes together may be there, and are there."""
    doubtful, sure = np.sum([LEAST_GAINS[each.kind] for each in mistakes], axis=0)
    return float(doubtful), float(sure)


def without_mistakes(robot: RobotModel, mistakes: Sequence[Mistake]) -> RobotModel:
    """Return an arm whose links have the reference bodies that they have without mistakes."""
    if not mistakes:
        return robot
    links = list(robot.links)
    for mistake in mistakes:
        for number, body in zip(mistake.links, mistake.bodies):
            links[number] = replace(links[number], reference=body)
    return replace(robot, links=tuple(links))


def mistake_shifts(
    robot: RobotModel, links: Sequence[int], mistakes: Sequence[Mistake]
) -> Array:
    """Return by how much mistakes change the parameters of L links (10 L, K)."""
    shifts = np.zeros((N_INERTIAL * len(links), len(mistakes)))
    for shift, mistake in zip(shifts.T, mistakes):
        for number, body in zip(mistake.links, mistake.bodies):
            at = N_INERTIAL * links.index(number)
            own = slice(at, at + N_INERTIAL)
            shift[own] = body - robot.links[number].reference
    return shifts


def usual_mistakes(robot: RobotModel, links: Sequence[int]) -> Iterator[Mistake]:
    """Yield the mistakes that a model may have in some of an arm's links, by their numbers."""
    for number in links:
        link = robot.links[number]
        if CENTRE not in link.placeholders:
            yield from _wrong_centres(number, link)
            yield from _wrong_inertia(number, link)
    stated = [number for number in links if not robot.links[number].placeholders]
    for first, second in combinations(stated, 2):
        bodies = (robot.links[second].reference, robot.links[first].reference)
        yield Mistake(MistakeKind.EXCHANGED, (first, second), bodies)


def _wrong_centres(number: int, link: ArmLink) -> Iterator[Mistake]:
    """Yield mistakes by which a link's centre of mass is mirrored or turned."""
    mass, stated, inertia = spatial.com_from_theta(link.reference)
    tried = [stated]
    for way, (kind, matrix) in enumerate(_other_frames()):
        centre = matrix @ stated
        steps = [np.linalg.norm(centre - other) for other in tried]
        if min(steps) > LEAST_STEP * link.size:
            tried.append(centre)
            body = spatial.theta_from_com(mass, centre, inertia)
            yield Mistake(kind, (number,), (body,), way)


def _other_frames() -> Iterator[tuple[MistakeKind, Array]]:
    """Yield what the frame of a centre of mass is mistaken for, as (3, 3): the simplest first."""
    for count in (1, 3, 2):
        for turned in combinations(range(3), count):
            signs = np.where(np.isin(range(3), turned), -1.0, 1.0)
            kind = MistakeKind.MIRRORED if count % 2 else MistakeKind.TURNED
            yield kind, np.diag(signs)
    for axis in np.eye(3):
        quarter = np.outer(axis, axis) + spatial.skew(axis)
        yield MistakeKind.TURNED, quarter
        yield MistakeKind.TURNED, quarter.T


def _wrong_inertia(number: int, link: ArmLink) -> Iterator[Mistake]:
    """Yield the mistake by which a link's inertia is one about the body's origin, if it may be."""
    mass, centre, stated = spatial.com_from_theta(link.reference)
    about_origin = spatial.theta_from_com(mass, centre, np.zeros((3, 3)))
    inertia = stated - spatial.symmetric_from_six(about_origin[4:])
    body = spatial.theta_from_com(mass, centre, inertia)
    if INERTIA not in link.placeholders and spatial.is_consistent(body):
        yield Mistake(MistakeKind.ABOUT_ORIGIN, (number,), (body,))
